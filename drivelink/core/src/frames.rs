//! One TPDO from bytes to SI values.
//!
//! A frame is decoded on arrival. Positions that roll over are unwrapped here.

use crate::layout::{MappedObject, Signal, Tpdo};

/// Data bytes of a frame, at most (CAN FD).
pub const MOST_BYTES: usize = 64;

/// ISO 11898-1: data lengths of CAN FD beyond 8 bytes.
const FD_LENGTHS: [usize; 8] = [8, 12, 16, 20, 24, 32, 48, 64];
/// A counter of so many bits does not move by a quarter of its range between two readings.
const WIDE: i128 = 1 << 24;

/// Where an integer lies in a frame (CiA 301, 7.4.8.2: bit 0 first, little-endian).
#[derive(Clone, Copy, Debug)]
struct Place {
    bit: u32,
    bits: u32,
    signed: bool,
}

impl Place {
    fn read(self, data: &[u8]) -> i128 {
        let mut window = [0u8; 16];
        let rest = data.get(self.bit as usize / 8..).unwrap_or_default();
        for (to, from) in window.iter_mut().zip(rest) {
            *to = *from;
        }
        let raw = (u128::from_le_bytes(window) >> (self.bit % 8)) & ((1 << self.bits) - 1);
        let negative = self.signed && self.bits > 0 && raw >> (self.bits - 1) & 1 == 1;
        raw as i128 - if negative { 1 << self.bits } else { 0 }
    }
}

/// One mapped object on its way into the sample: counts to SI, rolled-over counters straightened.
#[derive(Clone, Debug)]
pub struct Field {
    place: Place,
    /// Where in the joint's values it goes, see [`target`].
    pub target: usize,
    /// Whether it is there to check others alone.
    checks: bool,
    /// SI units per count.
    pub scale: f64,
    offset: f64,
    range: i128,
    longest: i128,
    last: Option<i128>,
    total: i128,
}

impl Field {
    fn new(mapped: &MappedObject, bit: u32, target: usize) -> Field {
        let range = mapped.range();
        Field {
            place: Place { bit, bits: mapped.bits, signed: mapped.signed },
            target,
            checks: mapped.signal.checks(),
            scale: mapped.scale,
            offset: mapped.offset,
            range,
            longest: range / if range >= WIDE { 4 } else { 1 },
            last: None,
            total: 0,
        }
    }

    /// The value in SI units of the reading in a frame.
    ///
    /// A counter that rolls over is followed by the shorter way round: exact as long as it moves by less than half
    /// its range between two readings, be there a gap or not. The first reading is taken as the one nearest zero: an
    /// unsigned absolute encoder a little below its zero is not a turn away from it. So is one that no motion
    /// explains, see [`WIDE`].
    pub fn decode(&mut self, data: &[u8]) -> f64 {
        let mut count = self.place.read(data);
        if self.range > 0 {
            let half = self.range / 2;
            let near_zero = (count + half).rem_euclid(self.range) - half;
            let step = self.last.map(|last| (count - last + half).rem_euclid(self.range) - half);
            self.total = match step {
                Some(step) if step.abs() <= self.longest => self.total + step,
                _ => near_zero,
            };
            self.last = Some(count);
            count = self.total;
        }
        count as f64 * self.scale - self.offset
    }
}

/// Where a signal of a node goes among the values of a joint with `motors` motors: m positions, m velocities,
/// m torques, the link's position and velocity, and for each motor what is there to check others.
pub fn target(signal: Signal, motor: Option<usize>, motors: usize) -> Option<usize> {
    match signal {
        Signal::MotorPosition => motor,
        Signal::MotorVelocity => motor.map(|motor| motors + motor),
        Signal::MotorTorque => motor.map(|motor| 2 * motors + motor),
        Signal::LinkPosition => Some(3 * motors),
        Signal::LinkVelocity => Some(3 * motors + 1),
        Signal::VelocityCheck => motor.map(|motor| 3 * motors + 2 + motor),
        Signal::TorqueCheck => motor.map(|motor| 4 * motors + 2 + motor),
        Signal::SecondPosition => motor.map(|motor| 5 * motors + 2 + motor),
        Signal::FollowingError => motor.map(|motor| 6 * motors + 2 + motor),
        Signal::PositionDemand => motor.map(|motor| 7 * motors + 2 + motor),
        Signal::Statusword | Signal::Other => None,
    }
}

/// One TPDO of one node, with what has become of it in this cycle.
#[derive(Clone, Debug)]
pub struct TpdoDecoder {
    /// Which of the joint's nodes sends it.
    pub node: usize,
    /// Identifier of its frames.
    pub cob_id: u32,
    /// What goes into the sample, and what checks it.
    pub fields: Vec<Field>,
    statusword: Option<Place>,
    /// SYNCs from one frame to the next; 0: the drive sends when it pleases, the value is held.
    pub every: i64,
    length: usize,
    longest: usize,
    /// In this cycle.
    pub arrived: bool,
    /// Since the start, or since the node rebooted.
    pub heard: bool,
    /// Cycles for which, after a missing frame, the one that comes may be the late one.
    pub suspect: u32,
    /// Frames that were missing and have not come late: so many may still be on their way.
    pub owed: u32,
    /// In this cycle, a frame was taken for a late one because another one came.
    pub replaced: bool,
    /// Periods since the last one.
    pub silent: i64,
    /// Cycles for which two different frames in one cycle still discredit it.
    pub conflict: u32,
    last: ([u8; MOST_BYTES], usize),
}

impl TpdoDecoder {
    /// The decoder of a TPDO of node number `node`, which drives `motor`.
    pub fn new(tpdo: &Tpdo, node: usize, motor: Option<usize>, motors: usize) -> TpdoDecoder {
        let mut fields = Vec::new();
        let mut statusword = None;
        let mut bit = 0;
        for mapped in &tpdo.objects {
            if let Some(target) = target(mapped.signal, motor, motors) {
                fields.push(Field::new(mapped, bit, target));
            } else if mapped.signal == Signal::Statusword && statusword.is_none() {
                statusword = Some(Place { bit, bits: mapped.bits, signed: mapped.signed });
            }
            bit += mapped.bits;
        }
        let length = (bit as usize).div_ceil(8);
        // More than eight bytes travel in the next CAN FD length, padded.
        let padded = FD_LENGTHS.into_iter().find(|padded| *padded >= length);
        TpdoDecoder {
            node,
            cob_id: tpdo.cob_id,
            fields,
            statusword,
            every: if (1..=240).contains(&tpdo.transmission_type) {
                tpdo.transmission_type.into()
            } else {
                0
            },
            length,
            longest: padded.filter(|_| length > 8).unwrap_or(length),
            arrived: false,
            heard: false,
            suspect: 0,
            owed: 0,
            replaced: false,
            silent: 0,
            conflict: 0,
            last: ([0; MOST_BYTES], 0),
        }
    }

    /// Whether a sample is incomplete without it.
    pub fn needed(&self) -> bool {
        self.fields.iter().any(|field| !field.checks)
    }

    /// Needed, and sent on SYNC.
    pub fn timed(&self) -> bool {
        self.needed() && self.every > 0
    }

    /// Needed, and sent when the drive pleases: the last value is held.
    pub fn held(&self) -> bool {
        self.needed() && self.every == 0
    }

    /// Whether a frame of so many bytes carries what is mapped.
    pub fn fits(&self, length: usize) -> bool {
        (self.length..=self.longest).contains(&length)
    }

    /// Whether these are the bytes of the last frame.
    pub fn repeats(&self, data: &[u8]) -> bool {
        self.last.0[..self.last.1] == *data
    }

    /// The bytes of the last frame are these; the statusword in them, if there is one.
    pub fn store(&mut self, data: &[u8]) -> Option<i64> {
        let length = data.len().min(MOST_BYTES);
        self.last.0[..length].copy_from_slice(&data[..length]);
        self.last.1 = length;
        self.statusword.map(|place| place.read(data) as i64)
    }

    /// Start anew: nothing has been heard, no counter is known.
    pub fn forget(&mut self) {
        self.arrived = false;
        self.heard = false;
        self.silent = 0;
        self.conflict = 0;
        self.suspect = 0;
        self.owed = 0;
        for field in &mut self.fields {
            field.last = None;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn position(bits: u32, signed: bool, modulus: i128) -> MappedObject {
        let signal = Signal::MotorPosition;
        MappedObject { signal, bits, signed, scale: 1.0, offset: 0.0, wraps: true, modulus }
    }

    #[test]
    fn an_integer_of_any_length_is_found_at_any_bit() {
        for bits in 1..=64u32 {
            for bit in 0..7 {
                for value in [0i128, 1, (1 << (bits - 1)) - 1, -(1i128 << (bits - 1)), -1] {
                    let word = ((value as u128) & ((1 << bits) - 1)) << bit;
                    let data = word.to_le_bytes();
                    let place = Place { bit, bits, signed: true };
                    let expected = if bits == 1 && value == 1 { -1 } else { value };
                    assert_eq!(place.read(&data[..9]), expected, "{bits} bits at {bit}");
                }
            }
        }
    }

    #[test]
    fn a_counter_goes_on_where_it_rolls_over() {
        let mut field = Field::new(&position(16, false, 0), 0, 0);
        let truth: Vec<i64> = (0..2000).map(|k| 100 * k - 300).collect();
        for &count in &truth {
            assert_eq!(field.decode(&(count as u16).to_le_bytes()), count as f64);
        }
    }

    #[test]
    fn more_than_eight_bytes_travel_in_the_next_length_of_can_fd() {
        let objects = vec![position(40, false, 0), position(40, false, 0)];
        let tpdo = Tpdo { cob_id: 0x181, objects, transmission_type: 1 };
        let decoder = TpdoDecoder::new(&tpdo, 0, Some(0), 1);
        assert_eq!([9, 10, 12, 16].map(|length| decoder.fits(length)), [false, true, true, false]);
    }

    #[test]
    fn the_first_reading_is_the_one_nearest_zero() {
        let mut field = Field::new(&position(32, false, 5000), 0, 0);
        assert_eq!(field.decode(&4900u32.to_le_bytes()), -100.0);
        assert_eq!(field.decode(&100u32.to_le_bytes()), 100.0);
    }
}
