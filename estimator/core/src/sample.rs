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

/// Bits of [`Estimate::status`]; 0 to 7 and 15 are the estimator's, 8 to 14 the service's.
pub mod status {
    status_bits! {
        VALID = 0, OBSERVABLE = 1, GAP = 2, CHANGED = 3, MODEL_ALARM = 4, INPUT_REJECTED = 5, RESTARTED = 6,
        TORQUE_VALID = 7, STIFFNESS_VALID = 15,
    }
    /// All numbers may be used.
    pub const USABLE: u32 = VALID | TORQUE_VALID | STIFFNESS_VALID;
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
    #[serde(deserialize_with = "crate::sample::motors")]
    pub motors: usize,
}

/// How many motors a joint has, from bytes: as many as fit into arrays.
pub(crate) fn motors<'de, D: serde::Deserializer<'de>>(from: D) -> Result<usize, D::Error> {
    let motors = usize::deserialize(from)?;
    if motors > MOTORS {
        Err(serde::de::Error::custom(format!("a joint of {motors} motors")))
    } else {
        Ok(motors)
    }
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn torques_and_stiffnesses_of_an_antagonistic_joint_add_and_so_do_variances() {
        let part = |torque, stiffness, stiffness_std| TransmissionEstimate {
            flexibility_torque: torque,
            stiffness,
            stiffness_std,
            ..TransmissionEstimate::NOTHING
        };
        let parts = [part(1.0, 100.0, 3.0), part(-4.0, 50.0, 4.0)];
        let totals = |arrangement| {
            let joint = joint_estimate(arrangement, 7, status::VALID, parts, 2);
            assert_eq!((joint.sequence, joint.status, joint.motors), (7, status::VALID, 2));
            (joint.flexibility_torque, joint.stiffness, joint.stiffness_std)
        };
        assert_eq!(totals(Arrangement::Antagonistic), (-3.0, 150.0, 5.0));
        assert_eq!(totals(Arrangement::Serial), (1.0, 100.0, 3.0));
    }

    #[test]
    fn bytes_of_more_motors_than_a_joint_has_are_no_snapshot() {
        for (motors, sound) in [(MOTORS, true), (MOTORS + 1, false), (1 << 40, false)] {
            let parts = [TransmissionEstimate::NOTHING; MOTORS];
            let mut estimate = joint_estimate(Arrangement::Serial, 7, status::VALID, parts, 2);
            estimate.motors = motors;
            let bytes = crate::snapshot::keep(&estimate).unwrap();
            assert_eq!(crate::snapshot::restore::<Estimate>(&bytes).is_ok(), sound);
        }
    }
}
