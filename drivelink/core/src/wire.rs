//! The bytes of `estimate`, `external` and `sample` on zenoh: packed little-endian numbers, and before the elements of a sequence
//! its length as a LEB128 varint. `drivelink/pubsub/wire.py` states the layout for people and decodes it.

use estimator_core::external::External;
use estimator_core::sample::{Sample, TransmissionEstimate};

/// Elements of the sequence in one message, at most: the length is one byte.
pub const MOST_ELEMENTS: usize = 8;
/// Bytes of an estimate before its transmissions.
const ESTIMATE_HEAD: usize = 8 + 8 + 4 + 3 * 8 + 1;
/// Bytes of a sample before its motors.
const SAMPLE_HEAD: usize = 8 + 8 + 3 * 8 + 1;
/// Bytes of a message, at most.
pub const MOST_BYTES: usize = ESTIMATE_HEAD + MOST_ELEMENTS * 4 * 8;

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

    fn put<const N: usize>(&mut self, bytes: [u8; N]) -> &mut Payload {
        self.bytes[self.length..self.length + N].copy_from_slice(&bytes);
        self.length += N;
        self
    }

    fn f64(&mut self, number: f64) -> &mut Payload {
        self.put(number.to_le_bytes())
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
    joint: [f64; 3],
    transmissions: &[TransmissionEstimate],
) -> Payload {
    let transmissions = &transmissions[..transmissions.len().min(MOST_ELEMENTS)];
    let mut payload = Payload::new();
    payload.put(sequence.to_le_bytes()).put(stamp_ns.to_le_bytes()).put(status.to_le_bytes());
    payload.f64(joint[0]).f64(joint[1]).f64(joint[2]);
    payload.put([transmissions.len() as u8]);
    for each in transmissions {
        payload.f64(each.flexibility_torque).f64(each.stiffness).f64(each.stiffness_std).f64(each.deflection);
    }
    payload
}

/// The bytes of `<prefix>/<joint>/external`.
#[must_use]
pub fn encode_external(external: &External, stamp_ns: u64) -> Payload {
    let mut payload = Payload::new();
    payload.put(external.sequence.to_le_bytes()).put(stamp_ns.to_le_bytes());
    payload.put(external.status.to_le_bytes()).f64(external.torque).f64(external.torque_std);
    payload
}

/// The bytes of `<prefix>/<joint>/sample` of a joint with so many motors.
#[must_use]
pub fn encode_sample(sample: &Sample, motors: usize, stamp_ns: u64) -> Payload {
    let motors = motors.min(sample.motor_position.len());
    let mut payload = Payload::new();
    payload.put(sample.sequence.to_le_bytes()).put(stamp_ns.to_le_bytes());
    payload.f64(sample.link_position).f64(sample.link_velocity).f64(sample.external_torque);
    payload.put([motors as u8]);
    for motor in 0..motors {
        payload.f64(sample.motor_position[motor]);
        payload.f64(sample.motor_velocity[motor]);
        payload.f64(sample.motor_torque[motor]);
    }
    payload
}

const _: () = assert!(SAMPLE_HEAD + MOST_ELEMENTS * 3 * 8 <= MOST_BYTES);
