//! The bytes of `<prefix>/<joint>/estimate` and `…/external`: what `zenoh_ext::z_serialize` makes of a tuple.

use std::fmt;

use zenoh::bytes::ZBytes;
use zenoh_ext::z_deserialize;

/// Status bit 0: the numbers may be used.
pub const VALID: u32 = 1 << 0;
/// Status bit 1: the motion reveals the stiffness.
pub const OBSERVABLE: u32 = 1 << 1;

/// What must be clear beside VALID: model alarm, restarted, drive fault, stale, untimed, node restarted,
/// contradicted.
pub const AGAINST: u32 = 1 << 4 | 1 << 6 | 1 << 8 | 1 << 10 | 1 << 11 | 1 << 12 | 1 << 14;
/// Status bit 13: what is NaN is not given (stiffness of a rigid joint, standard deviation of mode paper).
pub const PARTIAL: u32 = 1 << 13;
/// Transmissions in one message; their number is one byte.
pub const MAX_TRANSMISSIONS: usize = 8;

const HEAD: usize = 8 + 8 + 4 + 3 * 8;
const ELEMENT: usize = 4 * 8;

/// Why a payload is not used.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Refused {
    /// The bytes are no estimate.
    NoEstimate,
    /// It is called valid and holds a number that no joint has: not finite, or a negative stiffness.
    NotValid,
}

impl fmt::Display for Refused {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.write_str(match self {
            Refused::NoEstimate => "no estimate",
            Refused::NotValid => "called valid, but not every number in it is one",
        })
    }
}

impl std::error::Error for Refused {}

/// What the world does to the link at one SYNC.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct External {
    pub sequence: u64,
    pub stamp_ns: u64,
    pub status: u32,
    pub external_torque_nm: f64,
    pub external_torque_std_nm: f64,
}

impl External {
    /// Read a payload; an error for anything that is no external torque, is called valid and cannot be, or says
    /// contact and is not valid.
    pub fn decode(payload: &ZBytes) -> Result<Self, Refused> {
        let (sequence, stamp_ns, status, torque, std) =
            z_deserialize::<(u64, u64, u32, f64, f64)>(payload).map_err(|_| Refused::NoEstimate)?;
        let external = Self {
            sequence,
            stamp_ns,
            status,
            external_torque_nm: torque,
            external_torque_std_nm: std,
        };
        let plausible = torque.is_finite() && std.is_finite() && std >= 0.0;
        if if external.valid() { plausible } else { !external.contact() } {
            Ok(external)
        } else {
            Err(Refused::NotValid)
        }
    }

    /// Status bit 0: the numbers may be used.
    pub fn valid(&self) -> bool {
        self.status & 1 != 0
    }

    /// Status bit 1: something touches the link.
    pub fn contact(&self) -> bool {
        self.status & 2 != 0
    }
}

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
    /// Read a payload; an error for anything that is no estimate, or is called valid and cannot be.
    ///
    /// The number of transmissions is checked against the payload's length before anything is allocated for it.
    pub fn decode(payload: &ZBytes) -> Result<Self, Refused> {
        let bytes = payload.to_bytes();
        let count = usize::from(*bytes.get(HEAD).ok_or(Refused::NoEstimate)?);
        if count > MAX_TRANSMISSIONS || bytes.len() != HEAD + 1 + count * ELEMENT {
            return Err(Refused::NoEstimate);
        }
        let (sequence, stamp_ns, status, torque, stiffness, std, transmissions) =
            z_deserialize::<Wire>(payload).map_err(|_| Refused::NoEstimate)?;
        let estimate = Self {
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
        };
        if estimate.valid() && !estimate.plausible() {
            return Err(Refused::NotValid);
        }
        Ok(estimate)
    }

    /// What a controller checks of an estimate that is fresh: valid, and nothing in its status speaks against it.
    pub fn usable(&self) -> bool {
        self.status & (VALID | AGAINST) == VALID
    }

    /// Whether every number is finite, stiffness and standard deviation not negative.
    fn plausible(&self) -> bool {
        let absent = |number: f64| self.status & PARTIAL != 0 && number.is_nan();
        let magnitude = |number: f64| (number.is_finite() && number >= 0.0) || absent(number);
        self.flexibility_torque_nm.is_finite()
            && magnitude(self.stiffness_nm_rad)
            && magnitude(self.stiffness_std_nm_rad)
            && self.transmissions.iter().all(|one| {
                one.flexibility_torque_nm.is_finite()
                    && magnitude(one.stiffness_nm_rad)
                    && magnitude(one.stiffness_std_nm_rad)
                    && (one.deflection_rad.is_finite() || absent(one.deflection_rad))
            })
    }

    pub fn valid(&self) -> bool {
        self.status & VALID != 0
    }

    pub fn observable(&self) -> bool {
        self.status & OBSERVABLE != 0
    }
}
