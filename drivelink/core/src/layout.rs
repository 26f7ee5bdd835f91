//! Which frame carries which signal, at what scale: the result of the nodes' configuration.

/// What a mapped object means to the joint.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Signal {
    /// θ of the node's motor.
    MotorPosition,
    /// θ' of the node's motor.
    MotorVelocity,
    /// τ of the node's motor.
    MotorTorque,
    /// 0x6041.
    Statusword,
    /// q.
    LinkPosition,
    /// q'.
    LinkVelocity,
    /// θ' of the node's motor, for a cross-check alone.
    VelocityCheck,
    /// The current beside the torque, or the torque beside the current, N·m.
    TorqueCheck,
    /// θ of the node's motor by another encoder.
    SecondPosition,
    /// 0x60F4, as position.
    FollowingError,
    /// 0x6062, as position.
    PositionDemand,
    /// Mapped by the drive, not used by us.
    Other,
}

/// One object in a TPDO.
#[derive(Clone, Debug)]
#[cfg_attr(feature = "python", derive(pyo3::FromPyObject))]
pub struct MappedObject {
    /// What it means.
    #[cfg_attr(feature = "python", pyo3(from_py_with = signal_of))]
    pub signal: Signal,
    /// Its length in the frame, at most 64 for a signal that is used.
    pub bits: u32,
    /// Whether two's complement.
    pub signed: bool,
    /// SI units at the joint side per count.
    pub scale: f64,
    /// SI units, subtracted after scaling.
    pub offset: f64,
    /// Whether the counter rolls over.
    pub wraps: bool,
    /// Counts after which it does; 0: at its length.
    pub modulus: i128,
}

impl MappedObject {
    /// Counts after which it rolls over; 0: never.
    #[must_use]
    pub fn range(&self) -> i128 {
        match (self.wraps, self.modulus) {
            (false, _) => 0,
            (true, 0) => 1 << self.bits,
            (true, modulus) => modulus,
        }
    }
}

impl Signal {
    /// Whether it is there to check others alone: no sample waits for it.
    #[must_use]
    pub fn checks(self) -> bool {
        matches!(
            self,
            Signal::VelocityCheck
                | Signal::TorqueCheck
                | Signal::SecondPosition
                | Signal::FollowingError
                | Signal::PositionDemand
        )
    }
}

/// What a mapped object of Python means.
#[cfg(feature = "python")]
fn signal_of(object: &pyo3::Bound<'_, pyo3::PyAny>) -> pyo3::PyResult<Signal> {
    use pyo3::types::PyAnyMethods;
    Ok(match object.extract::<String>()?.as_str() {
        "motor_position" => Signal::MotorPosition,
        "motor_velocity" => Signal::MotorVelocity,
        "motor_torque" => Signal::MotorTorque,
        "statusword" => Signal::Statusword,
        "link_position" => Signal::LinkPosition,
        "link_velocity" => Signal::LinkVelocity,
        "velocity_check" => Signal::VelocityCheck,
        "torque_check" => Signal::TorqueCheck,
        "second_position" => Signal::SecondPosition,
        "following_error" => Signal::FollowingError,
        "position_demand" => Signal::PositionDemand,
        _ => Signal::Other,
    })
}

/// One TPDO: its identifier and the objects in it, in order from bit 0.
#[derive(Clone, Debug)]
#[cfg_attr(feature = "python", derive(pyo3::FromPyObject))]
pub struct Tpdo {
    /// Identifier of the frame, 11 bits.
    pub cob_id: u32,
    /// What is in it.
    pub objects: Vec<MappedObject>,
    /// 1 to 240: every so many SYNCs; else when the drive pleases.
    pub transmission_type: u32,
}

/// One node of a joint.
#[derive(Clone, Debug)]
#[cfg_attr(feature = "python", derive(pyo3::FromPyObject))]
pub struct Node {
    /// 1 to 127.
    pub node_id: u32,
    /// Which motor it drives.
    pub motor: Option<usize>,
    /// Its frames.
    pub tpdos: Vec<Tpdo>,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_sample_waits_for_no_reading_that_only_checks_another() {
        for signal in [Signal::MotorPosition, Signal::MotorTorque, Signal::LinkPosition, Signal::Other] {
            assert!(!signal.checks());
        }
        for signal in [Signal::VelocityCheck, Signal::TorqueCheck, Signal::SecondPosition] {
            assert!(signal.checks());
        }
    }
}
