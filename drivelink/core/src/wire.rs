//! The messages `estimate`, `external` and `sample` on zenoh, the only definition: packed little-endian numbers, and before the
//! elements of a sequence its length as a LEB128 varint. `drivelink/pubsub/wire.py` decodes and describes by [`MESSAGES`].

use estimator_core::external::External;
use estimator_core::sample::{Sample, TransmissionEstimate};

/// Elements of the sequence in one message, at most: the length is one byte.
pub const MOST_ELEMENTS: usize = 8;
/// Bytes of a message, at most.
pub const MOST_BYTES: usize = EstimateHead::BYTES + 1 + MOST_ELEMENTS * TransmissionPart::BYTES;

/// One number: its name with the unit in it, its type, its meaning.
pub type Field = (&'static str, &'static str, &'static str);

/// The parts of all messages by name.
pub const MESSAGES: [(&str, &[Field]); 5] = [
    ("estimate", EstimateHead::FIELDS),
    ("transmissions", TransmissionPart::FIELDS),
    ("external", ExternalHead::FIELDS),
    ("sample", SampleHead::FIELDS),
    ("motors", MotorPart::FIELDS),
];

const SEQUENCE: &str = "number of the SYNC; a jump by more than one is a gap of whole periods";
const STAMP: &str = "UNIX time of the SYNC, ns";

macro_rules! part {
    ($name:ident { $($field:ident: $kind:ident = $meaning:expr),* $(,)? }) => {
        struct $name {
            $($field: $kind),*
        }

        impl $name {
            const FIELDS: &[Field] = &[$((stringify!($field), stringify!($kind), $meaning)),*];
            const BYTES: usize = 0 $(+ size_of::<$kind>())*;

            fn put(&self, payload: &mut Payload) {
                $(payload.put(self.$field.to_le_bytes());)*
            }
        }
    };
}

part!(EstimateHead {
    sequence: u64 = SEQUENCE,
    stamp_ns: u64 = STAMP,
    status: u32 = "status bits, see below",
    flexibility_torque_nm: f64 = "the joint's flexibility torque, N·m",
    stiffness_nm_rad: f64 = "the joint's stiffness, N·m/rad",
    stiffness_std_nm_rad: f64 = "its standard deviation, N·m/rad",
});
part!(TransmissionPart {
    flexibility_torque_nm: f64 = "of this transmission, N·m",
    stiffness_nm_rad: f64 = "of this transmission, N·m/rad",
    stiffness_std_nm_rad: f64 = "its standard deviation, N·m/rad",
    deflection_rad: f64 = "φ = q − θ, rad",
});
part!(ExternalHead {
    sequence: u64 = SEQUENCE,
    stamp_ns: u64 = STAMP,
    status: u32 = "bit 0 valid, bit 1 contact, see below",
    external_torque_nm: f64 = "torque of the environment on the link, +τ_k of eqs 4, 6, N·m",
    external_torque_std_nm: f64 = "its standard deviation, N·m",
});
part!(SampleHead {
    sequence: u64 = SEQUENCE,
    stamp_ns: u64 = STAMP,
    link_position_rad: f64 = "q, rad; NaN where there is none, as below",
    link_velocity_rad_s: f64 = "measured link velocity, rad/s",
    external_torque_nm: f64 = "τ_k of eq. 4, N·m",
});
part!(MotorPart {
    motor_position_rad: f64 = "θ, rad, joint side",
    motor_velocity_rad_s: f64 = "measured motor velocity, rad/s, joint side",
    motor_torque_nm: f64 = "τ, N·m, joint side; acts from this SYNC to the next",
});

/// The bytes of one message.
#[derive(Clone, Copy, Debug)]
pub struct Payload {
    bytes: [u8; MOST_BYTES],
    length: usize,
}

impl Payload {
    fn new() -> Payload {
        Payload { bytes: [0; MOST_BYTES], length: 0 }
    }

    fn put<const N: usize>(&mut self, bytes: [u8; N]) {
        self.bytes[self.length..self.length + N].copy_from_slice(&bytes);
        self.length += N;
    }

    /// What goes over the wire.
    #[must_use]
    pub fn bytes(&self) -> &[u8] {
        &self.bytes[..self.length]
    }
}

/// The bytes of `<prefix>/<joint>/estimate`, with at most [`MOST_ELEMENTS`] transmissions.
///
/// `joint`: flexibility torque, stiffness and its standard deviation.
#[must_use]
pub fn encode_estimate(
    sequence: u64,
    stamp_ns: u64,
    status: u32,
    [flexibility_torque_nm, stiffness_nm_rad, stiffness_std_nm_rad]: [f64; 3],
    transmissions: &[TransmissionEstimate],
) -> Payload {
    let transmissions = &transmissions[..transmissions.len().min(MOST_ELEMENTS)];
    let mut payload = Payload::new();
    EstimateHead {
        sequence,
        stamp_ns,
        status,
        flexibility_torque_nm,
        stiffness_nm_rad,
        stiffness_std_nm_rad,
    }
    .put(&mut payload);
    payload.put([transmissions.len() as u8]);
    for each in transmissions {
        TransmissionPart {
            flexibility_torque_nm: each.flexibility_torque,
            stiffness_nm_rad: each.stiffness,
            stiffness_std_nm_rad: each.stiffness_std,
            deflection_rad: each.deflection,
        }
        .put(&mut payload);
    }
    payload
}

/// The bytes of `<prefix>/<joint>/external`.
#[must_use]
pub fn encode_external(external: &External, stamp_ns: u64) -> Payload {
    let mut payload = Payload::new();
    ExternalHead {
        sequence: external.sequence,
        stamp_ns,
        status: external.status,
        external_torque_nm: external.torque,
        external_torque_std_nm: external.torque_std,
    }
    .put(&mut payload);
    payload
}

/// The bytes of `<prefix>/<joint>/sample` of a joint with so many motors.
#[must_use]
pub fn encode_sample(sample: &Sample, motors: usize, stamp_ns: u64) -> Payload {
    let motors = motors.min(sample.motor_position.len());
    let mut payload = Payload::new();
    SampleHead {
        sequence: sample.sequence,
        stamp_ns,
        link_position_rad: sample.link_position,
        link_velocity_rad_s: sample.link_velocity,
        external_torque_nm: sample.external_torque,
    }
    .put(&mut payload);
    payload.put([motors as u8]);
    for motor in 0..motors {
        MotorPart {
            motor_position_rad: sample.motor_position[motor],
            motor_velocity_rad_s: sample.motor_velocity[motor],
            motor_torque_nm: sample.motor_torque[motor],
        }
        .put(&mut payload);
    }
    payload
}

const _: () = assert!(SampleHead::BYTES + 1 + MOST_ELEMENTS * MotorPart::BYTES <= MOST_BYTES);
const _: () = assert!(ExternalHead::BYTES <= MOST_BYTES);

#[cfg(test)]
mod tests {
    use super::*;

    const PART: TransmissionEstimate = TransmissionEstimate {
        flexibility_torque: 1.0,
        stiffness: 2.0,
        stiffness_std: 3.0,
        deflection: 4.0,
        ..TransmissionEstimate::NOTHING
    };

    fn number(bytes: &[u8], at: usize) -> f64 {
        f64::from_le_bytes(bytes[at..at + 8].try_into().unwrap())
    }

    #[test]
    fn an_estimate_is_packed_little_endian_with_the_length_of_its_sequence() {
        let payload = encode_estimate(7, 1_000_000, 0x0102, [-1.5, 150.0, 0.25], &[PART, PART]);
        let bytes = payload.bytes();
        assert_eq!(bytes.len(), 8 + 8 + 4 + 3 * 8 + 1 + 2 * 4 * 8);
        assert_eq!(bytes[..8], 7u64.to_le_bytes());
        assert_eq!(bytes[8..16], 1_000_000u64.to_le_bytes());
        assert_eq!(bytes[16..20], [2, 1, 0, 0]);
        assert_eq!([20, 28, 36].map(|at| number(bytes, at)), [-1.5, 150.0, 0.25]);
        assert_eq!(bytes[44], 2);
        assert_eq!([45, 53, 61, 69, 77].map(|at| number(bytes, at)), [1.0, 2.0, 3.0, 4.0, 1.0]);
    }

    #[test]
    fn more_elements_than_a_message_holds_are_left_out() {
        let payload = encode_estimate(0, 0, 0, [0.0; 3], &[PART; MOST_ELEMENTS + 1]);
        assert_eq!(payload.bytes()[EstimateHead::BYTES] as usize, MOST_ELEMENTS);
        assert_eq!(payload.bytes().len(), MOST_BYTES);
    }

    #[test]
    fn a_sample_has_as_many_motors_as_the_joint() {
        let two = |a, b| [a, b];
        let sample = Sample {
            sequence: 1,
            motor_position: two(0.1, 0.2),
            motor_velocity: two(0.3, 0.4),
            motor_torque: two(0.5, 0.6),
            link_position: 0.7,
            link_velocity: 0.8,
            external_torque: 0.9,
        };
        for motors in [1, 2] {
            let payload = encode_sample(&sample, motors, 0);
            assert_eq!(payload.bytes().len(), SampleHead::BYTES + 1 + motors * MotorPart::BYTES);
            assert_eq!(payload.bytes()[SampleHead::BYTES] as usize, motors);
            assert_eq!(number(payload.bytes(), SampleHead::BYTES + 1), 0.1);
        }
    }
}
