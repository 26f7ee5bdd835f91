//! The bytes of `<prefix>/<joint>/estimate`: what `zenoh_ext::z_serialize` makes of a tuple.

use zenoh::bytes::ZBytes;
use zenoh_ext::{z_deserialize, ZDeserializeError};

/// Status bit 0: the numbers may be used.
pub const VALID: u32 = 1 << 0;
/// Status bit 1: the motion at hand tells the stiffness.
pub const OBSERVABLE: u32 = 1 << 1;

/// One transmission of the joint.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Transmission {
    pub flexibility_torque_nm: f64,
    pub stiffness_nm_rad: f64,
    pub stiffness_std_nm_rad: f64,
    pub deflection_rad: f64,
}

/// The joint at one SYNC.
#[derive(Debug, Clone, PartialEq)]
pub struct Estimate {
    pub sequence: u64,
    pub stamp_ns: u64,
    pub status: u32,
    pub flexibility_torque_nm: f64,
    pub stiffness_nm_rad: f64,
    pub stiffness_std_nm_rad: f64,
    pub transmissions: Vec<Transmission>,
}

type Wire = (u64, u64, u32, f64, f64, f64, Vec<(f64, f64, f64, f64)>);

impl Estimate {
    /// Read a payload; an error for anything that is no estimate.
    pub fn decode(payload: &ZBytes) -> Result<Self, ZDeserializeError> {
        let (sequence, stamp_ns, status, torque, stiffness, std, transmissions) =
            z_deserialize::<Wire>(payload)?;
        Ok(Self {
            sequence,
            stamp_ns,
            status,
            flexibility_torque_nm: torque,
            stiffness_nm_rad: stiffness,
            stiffness_std_nm_rad: std,
            transmissions: transmissions
                .into_iter()
                .map(|(torque, stiffness, std, deflection)| Transmission {
                    flexibility_torque_nm: torque,
                    stiffness_nm_rad: stiffness,
                    stiffness_std_nm_rad: std,
                    deflection_rad: deflection,
                })
                .collect(),
        })
    }

    pub fn valid(&self) -> bool {
        self.status & VALID != 0
    }

    pub fn observable(&self) -> bool {
        self.status & OBSERVABLE != 0
    }
}
