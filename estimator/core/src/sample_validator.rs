//! Validates samples before the mathematics: gaps, non-finite values, positions that jump.

mod channels;

use std::collections::VecDeque;

use serde::{Deserialize, Serialize};

use crate::choices::{BRIEF_S, FAR, GAP_S, JUMP_RAD, NOISE_S, PATIENCE, PEAK_S, UNUSUAL, WILD_RAD_S2};
use crate::library::ABSURD;
use crate::model::Model;
use crate::sample::{MOTORS, Sample, status};
use crate::suspicion::{Reason, Signal, Suspicion};
use channels::MOVING;

const PLACES: usize = MOTORS + 1;
const CHANNELS: usize = 2 * MOTORS + 1;

/// What the validator made of a sample.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Accepted {
    /// Since the last sample that was accepted; 0: this one is not to be used.
    pub periods: u32,
    /// The filters cannot be carried on over what happened.
    pub restart: bool,
    /// GAP, INPUT_REJECTED, RESTARTED.
    pub status: u32,
    /// A channel has stood still for longer than it ever did while others move.
    pub frozen: bool,
    /// With a restart: by how much each position has moved its zero, motors, then the link.
    pub jumps: Option<[f64; PLACES]>,
    /// What is wrong with it, where something is.
    pub suspicion: Option<Suspicion>,
}

/// Decides of each sample whether it can be used, and how far it is from the last one that was.
///
/// A position jumps when it leaves the straight line through the last two by more than acceleration can
/// explain: the largest lately seen, what the torque can give, and an absolute floor. A single jump is left
/// out and bridged; where the new place persists, it is the encoder's zero that has moved, and the filters
/// start anew from there. After a gap a place that no velocity seen so far leads to is a jump, too. A torque
/// may jump, but one that would throw the bare motor about and is many times the largest one seen is left
/// out unless it persists. A channel is frozen when it repeats itself exactly for three times as long as
/// between two changes in the first motion, while a position moves; a position only if it stopped dead, sooner
/// than friction can: a link that comes to rest while the motors go on, as under a controller, is no fault, nor
/// is a motor that friction stops. One that jumps after it has repeated itself so has not moved its zero.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct SampleValidator {
    #[serde(deserialize_with = "crate::sample::motors")]
    motors: usize,
    flexible: bool,
    period: f64,
    fade: f64,
    fade_torque: f64,
    longest: i64,
    patience: u32,
    gain: f64,
    tame: [f64; MOTORS],
    still: u32,
    learning: u32,
    found: Option<(Signal, Reason)>, // what is wrong with the sample at hand
    trail: VecDeque<[f64; PLACES]>,  // the last places, of the time that a frozen channel stands at least
    memory: Memory,
}

#[derive(Clone, Debug, Default, Serialize, Deserialize)]
struct Memory {
    sequence: Option<u64>,
    places: [f64; PLACES],
    slopes: [f64; PLACES],
    span: f64, // periods that the slopes are over
    peaks: [f64; PLACES],
    steps: [f64; PLACES], // smallest change seen of each position, or of its changes: its resolution
    limits: [f64; PLACES], // bends that are jumps
    fastest: [f64; PLACES], // changes in a period
    stopped_dead: [bool; PLACES], // rather than slowed down
    astray: [bool; PLACES],
    values: Option<[f64; CHANNELS]>,
    runs: [u32; CHANNELS],
    stood: [u32; CHANNELS], // the run before the last change
    usual: [u32; CHANNELS],
    torque: f64,
    largest: [f64; MOTORS],
    wild: u32,
    seen: u32,
    samples: u32,
    moved: u32, // samples of motion from which standing still was learned
    rejected: u32,
    motion: f64,
    frozen: bool,
    stood_still: bool, // one that has jumped, before it did
}

impl Memory {
    fn fresh() -> Memory {
        Memory { steps: [f64::INFINITY; PLACES], limits: [f64::INFINITY; PLACES], ..Memory::default() }
    }
}

impl SampleValidator {
    /// A validator of this joint's samples.
    #[must_use]
    pub fn new(model: &Model, period_s: f64) -> SampleValidator {
        let periods = |seconds: f64| (seconds / period_s).round();
        let lightest = model.motors.iter().map(|motor| motor.inertia).fold(f64::INFINITY, f64::min);
        let mut tame = [f64::INFINITY; MOTORS];
        model.motors.iter().zip(&mut tame).for_each(|(motor, tame)| *tame = WILD_RAD_S2 * motor.inertia);
        let still = periods(BRIEF_S).max(4.0) as u32;
        SampleValidator {
            motors: model.motors.len(),
            flexible: model.has_deflection(),
            period: period_s,
            fade: (-period_s / NOISE_S).exp(),
            fade_torque: (-period_s / PEAK_S).exp(),
            longest: periods(GAP_S).max(3.0) as i64,
            patience: PATIENCE.max(periods(BRIEF_S) as u32),
            gain: FAR * period_s * period_s / lightest,
            tame,
            still,
            learning: periods(NOISE_S) as u32,
            found: None,
            trail: vec![[f64::NAN; PLACES]; still as usize + 1].into(),
            memory: Memory::fresh(),
        }
    }

    /// The signal at a place: positions of the motors, the link's where it is watched, torques.
    fn signal(&self, place: usize) -> Signal {
        match place {
            place if place < self.motors => Signal::MotorPosition(place),
            place if place < self.watched() => Signal::LinkPosition,
            place => Signal::MotorTorque(place - self.watched()),
        }
    }

    /// Forget everything.
    pub fn reset(&mut self) {
        self.memory = Memory::fresh();
        self.trail.iter_mut().for_each(|places| *places = [f64::NAN; PLACES]);
    }

    /// Positions may count from anywhere after this; torques, and how long readings repeat, are as before.
    pub fn lose_zeros(&mut self) {
        let Memory { torque, largest, usual, moved, .. } = self.memory;
        self.reset();
        self.memory = Memory { torque, largest, usual, moved, ..Memory::fresh() };
    }

    /// Smallest change of each position (motors, then the link) or of its changes: its resolution, rad; ∞ before any.
    #[must_use]
    pub fn resolution(&self) -> &[f64; PLACES] {
        &self.memory.steps
    }

    fn watched(&self) -> usize {
        self.motors + usize::from(self.flexible)
    }

    /// Judge one sample.
    pub fn check(&mut self, sample: &Sample) -> Accepted {
        self.found = None;
        let accepted = self.judge(sample);
        Accepted { suspicion: self.found.map(|(signal, why)| Suspicion::of_sample(signal, why)), ..accepted }
    }

    fn judge(&mut self, sample: &Sample) -> Accepted {
        let rejected = Accepted { status: status::INPUT_REJECTED, ..Accepted::default() };
        let places = self.places(sample);
        if let Some(place) = self.impossible(&places) {
            self.found = Some((self.signal(place), Reason::Impossible));
            return rejected;
        }
        if self.is_wild(&sample.motor_torque) {
            return rejected;
        }
        let Some(last) = self.memory.sequence else { return self.begin(sample.sequence, places, 0, None) };
        let periods = sample.sequence.wrapping_sub(last) as i64;
        if periods <= 0 {
            return self.begin(sample.sequence, places, status::RESTARTED, None);
        }
        if periods > self.longest {
            return self.after_gap(sample.sequence, places, periods);
        }
        self.memory.samples = self.memory.samples.saturating_add(1);
        self.review();
        let was_frozen = self.memory.frozen;
        let frozen = self.stands_still(&places, &sample.motor_torque);
        if self.jumped(&places, periods as f64) {
            if !frozen {
                return self.left_out(sample.sequence, places, periods, was_frozen);
            }
            self.memory.slopes = [0.0; PLACES]; // the jump is that it stopped
        }
        let m = &mut self.memory;
        (m.sequence, m.places) = (Some(sample.sequence), places);
        m.seen = m.seen.saturating_add(1);
        m.rejected = 0;
        let gap = if periods > 1 { status::GAP } else { 0 };
        let still = if frozen { status::INPUT_REJECTED } else { 0 };
        Accepted {
            periods: periods as u32,
            restart: false,
            status: gap | still,
            frozen,
            ..Accepted::default()
        }
    }

    /// A position that jumps is left out until the new place persists.
    fn left_out(&mut self, sequence: u64, places: [f64; PLACES], periods: i64, was_frozen: bool) -> Accepted {
        if self.memory.rejected == 0 {
            self.memory.stood_still = self.has_stood();
        }
        self.memory.rejected += 1;
        if !was_frozen && self.memory.rejected < self.patience {
            return Accepted { status: status::INPUT_REJECTED, ..Accepted::default() };
        }
        // After a value that was frozen, or repeated, it goes on: no zero has moved.
        let moved = !was_frozen && !self.memory.stood_still;
        let jumps = moved.then(|| self.jumps(&places, periods as f64));
        self.begin(sequence, places, status::INPUT_REJECTED | status::RESTARTED, jumps)
    }

    fn places(&self, sample: &Sample) -> [f64; PLACES] {
        let mut places = [0.0; PLACES];
        places[..self.motors].copy_from_slice(&sample.motor_position[..self.motors]);
        if self.flexible {
            places[self.motors] = sample.link_position;
        }
        places
    }

    /// The first position that is no number or no place, if any.
    fn impossible(&self, places: &[f64; PLACES]) -> Option<usize> {
        let watched = &places[..self.watched()];
        let size: f64 = watched.iter().map(|x| x.abs()).sum();
        let is_none = |x: &f64| x.is_nan() || x.abs() >= ABSURD;
        is_none(&size).then(|| watched.iter().position(is_none).unwrap_or(self.motors))
    }

    /// Whether one that jumps has repeated itself before, having stopped dead or for longer than it does in motion.
    fn has_stood(&self) -> bool {
        let m = &self.memory;
        let longer = |i: usize| m.stopped_dead[i] || m.usual[i] > 0 && m.stood[i] > m.usual[i];
        let stood = |i: usize| m.astray[i] && m.stood[i] > PATIENCE && longer(i);
        m.motion > MOVING && (0..self.watched()).any(stood)
    }

    /// By how much each zero has moved, of those that have.
    fn jumps(&self, places: &[f64; PLACES], periods: f64) -> [f64; PLACES] {
        let (m, watched) = (&self.memory, self.watched());
        std::array::from_fn(|i| {
            let moved = i < watched && m.astray[i] && m.runs[i] < PATIENCE - 2;
            if moved { places[i] - m.places[i] - periods * m.slopes[i] } else { 0.0 }
        })
    }

    fn begin(
        &mut self,
        sequence: u64,
        places: [f64; PLACES],
        status: u32,
        jumps: Option<[f64; PLACES]>,
    ) -> Accepted {
        let m = &mut self.memory;
        (m.sequence, m.places) = (Some(sequence), places);
        m.slopes = [0.0; PLACES];
        self.trail.iter_mut().for_each(|places| *places = [f64::NAN; PLACES]);
        m.astray = [false; PLACES];
        (m.frozen, m.seen, m.rejected) = (false, 0, 0);
        self.review();
        Accepted { periods: 1, restart: true, status, jumps, ..Accepted::default() }
    }

    /// Whether a torque is no finite number, or beyond anything seen and new.
    fn is_wild(&mut self, torques: &[f64; MOTORS]) -> bool {
        let m = &mut self.memory;
        for i in 0..self.motors {
            let size = torques[i].abs();
            if !size.is_finite() {
                self.found = Some((Signal::MotorTorque(i), Reason::Impossible));
                return true;
            }
            if size >= self.tame[i].max(FAR * m.largest[i]) {
                m.wild += 1;
                if m.wild < self.patience || size > ABSURD * self.tame[i] {
                    let jumps = m.largest[i] > 0.0; // a joint may be in motion when it is seen first
                    self.found = jumps.then_some((Signal::MotorTorque(i), Reason::Jumped)).or(self.found);
                    return true;
                }
            }
            m.largest[i] = m.largest[i].max(size);
            m.torque = m.torque.max(size);
        }
        m.wild = 0;
        false
    }

    /// What has been seen fades, and with it what is too much.
    fn review(&mut self) {
        let m = &mut self.memory;
        m.torque *= self.fade;
        m.largest = m.largest.map(|size| self.fade_torque * size);
        let floor = JUMP_RAD.max(self.gain * m.torque);
        for i in 0..PLACES {
            m.peaks[i] *= self.fade;
            let step = if m.steps[i].is_finite() { UNUSUAL * m.steps[i] } else { f64::INFINITY };
            m.limits[i] = floor.max(FAR * m.peaks[i]).max(step);
        }
    }

    /// The first sample after a gap too long to be bridged; its place is to be one that can be reached.
    fn after_gap(&mut self, sequence: u64, places: [f64; PLACES], periods: i64) -> Accepted {
        let mut flags = status::GAP | status::RESTARTED;
        let mut jumps = [0.0; PLACES];
        let m = &mut self.memory;
        if m.samples > self.learning {
            for i in 0..self.motors + usize::from(self.flexible) {
                let off = places[i] - m.places[i];
                if off.abs() > JUMP_RAD + UNUSUAL * m.fastest[i] * periods as f64 {
                    jumps[i] = off;
                }
            }
            if let Some(place) = jumps.iter().position(|jump| *jump != 0.0) {
                let signal =
                    if place < self.motors { Signal::MotorPosition(place) } else { Signal::LinkPosition };
                self.found = Some((signal, Reason::Jumped));
                m.rejected += 1;
                if m.rejected < self.patience {
                    return Accepted { status: status::INPUT_REJECTED | status::GAP, ..Accepted::default() };
                }
                flags |= status::INPUT_REJECTED;
            }
        }
        let any = jumps.iter().any(|jump| *jump != 0.0);
        self.begin(sequence, places, flags, any.then_some(jumps))
    }

    /// T.
    #[must_use]
    pub fn period(&self) -> f64 {
        self.period
    }
}
