//! Inputs and outputs of an estimator, one tick at a time.

use serde::{Deserialize, Serialize};

use crate::model::Arrangement;

/// Motors of a joint, at most.
pub const MOTORS: usize = 2;

/// What was measured at one SYNC; NaN stands for what is not there.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Sample {
    /// Number of the SYNC; a jump by more than one is a gap of whole periods.
    pub sequence: u64,
    /// θ_i, rad.
    pub motor_position: [f64; MOTORS],
    /// θ'_i as the drive measures it, rad/s.
    pub motor_velocity: [f64; MOTORS],
    /// τ_i, N·m, which acts from this SYNC to the next one.
    pub motor_torque: [f64; MOTORS],
    /// q, rad.
    pub link_position: f64,
    /// q' as it is measured, rad/s.
    pub link_velocity: f64,
    /// τ_k of eq 4, N·m.
    pub external_torque: f64,
}

/// Constants of status bits, and `BITS`: all of them by name.
#[macro_export]
macro_rules! status_bits {
    ($($name:ident = $bit:literal),* $(,)?) => {
        $(
            #[doc = concat!("See `Status.", stringify!($name), "` in `estimator/sample.py`.")]
            pub const $name: u32 = 1 << $bit;
        )*
        /// All bits by name.
        pub const BITS: &[(&str, u32)] = &[$((stringify!($name), $name)),*];
    };
}

/// Bits of [`Estimate::status`]; 0 to 7 are the estimator's, from 8 on the service's.
pub mod status {
    status_bits! {
        VALID = 0, OBSERVABLE = 1, GAP = 2, CHANGED = 3, MODEL_ALARM = 4, INPUT_REJECTED = 5, RESTARTED = 6,
        TORQUE_VALID = 7,
    }
    /// All numbers may be used.
    pub const USABLE: u32 = VALID | TORQUE_VALID;
}

/// One transmission: torque and stiffness with their standard deviations, deflection.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct TransmissionEstimate {
    /// τ_e, N·m.
    pub flexibility_torque: f64,
    /// Its standard deviation, N·m.
    pub flexibility_torque_std: f64,
    /// σ, N·m/rad.
    pub stiffness: f64,
    /// Its standard deviation, N·m/rad.
    pub stiffness_std: f64,
    /// φ, rad.
    pub deflection: f64,
}

impl TransmissionEstimate {
    /// Nothing is known yet.
    pub const NOTHING: TransmissionEstimate = TransmissionEstimate {
        flexibility_torque: f64::NAN,
        flexibility_torque_std: f64::NAN,
        stiffness: f64::NAN,
        stiffness_std: f64::NAN,
        deflection: f64::NAN,
    };
}

/// The joint at one SYNC: totals (eqs 9, 11) and each transmission's own.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Estimate {
    /// That of the sample.
    pub sequence: u64,
    /// See [`status`].
    pub status: u32,
    /// τ_e,t, N·m.
    pub flexibility_torque: f64,
    /// Its standard deviation, N·m.
    pub flexibility_torque_std: f64,
    /// σ_t, N·m/rad.
    pub stiffness: f64,
    /// Its standard deviation, N·m/rad.
    pub stiffness_std: f64,
    /// The first `motors` of them.
    pub transmissions: [TransmissionEstimate; MOTORS],
    /// How many motors the joint has.
    pub motors: usize,
}

/// The joint's estimate from its transmissions' own (eqs 9, 11); variances of independent ones add.
#[must_use]
pub fn joint_estimate(
    arrangement: Arrangement,
    sequence: u64,
    status: u32,
    transmissions: [TransmissionEstimate; MOTORS],
    motors: usize,
) -> Estimate {
    let [first, second] = transmissions;
    let mut joint = Estimate {
        sequence,
        status,
        flexibility_torque: first.flexibility_torque,
        flexibility_torque_std: first.flexibility_torque_std,
        stiffness: first.stiffness,
        stiffness_std: first.stiffness_std,
        transmissions,
        motors,
    };
    if arrangement == Arrangement::Antagonistic {
        joint.flexibility_torque += second.flexibility_torque;
        joint.flexibility_torque_std = first.flexibility_torque_std.hypot(second.flexibility_torque_std);
        joint.stiffness += second.stiffness;
        joint.stiffness_std = first.stiffness_std.hypot(second.stiffness_std);
    }
    joint
}
