//! Channels that stand still, or jump.

use std::collections::VecDeque;

use super::{CHANNELS, PLACES, SampleValidator};
use crate::choices::{FAR, PATIENCE};
use crate::sample::MOTORS;
use crate::suspicion::{Reason, Signal};

/// Of a position: what arithmetic, or a text of ten digits, leaves of counts that cancel …
const ROUNDING: f64 = 4e-9;
const SINGLE: f64 = 2.5e-7; // … and of one in single precision
const FINEST: f64 = 1e-6; // of a change: no joint moves by a million counts in a period
pub(super) const MOVING: f64 = 0.2; // share of the last 20 samples in which a position has changed

impl SampleValidator {
    /// Whether a channel is frozen: everything at rest is no fault, one encoder count now and then no motion.
    pub(super) fn stands_still(&mut self, places: &[f64; PLACES], torques: &[f64; MOTORS]) -> bool {
        let watched = self.watched();
        let count = watched + self.motors;
        let m = &mut self.memory;
        let mut values = [0.0; CHANNELS];
        values[..watched].copy_from_slice(&places[..watched]);
        values[watched..count].copy_from_slice(&torques[..self.motors]);
        let Some(old) = m.values.replace(values) else {
            m.runs = [0; CHANNELS];
            return false;
        };
        let bend = self.gain / FAR * m.torque; // what the torque makes of a motor's way in a period
        let (mut moving, mut still) = (0.0, None);
        let learns = m.motion > MOVING && m.moved < self.learning;
        m.moved += u32::from(learns);
        for i in 0..count {
            let run = m.runs[i] + 1;
            if values[i] == old[i] {
                m.runs[i] = run;
                if run == 1 && i < watched {
                    m.stopped_dead[i] = stops_dead(&self.trail, i, m.steps[i], bend);
                }
                // A torque always counts as one that was moving before.
                let longer = m.usual[i] > 0 && run >= self.still.max(3 * m.usual[i]);
                if longer && (i >= watched || m.stopped_dead[i]) {
                    still = still.or(Some(i));
                }
            } else {
                if i < watched {
                    moving = 1.0;
                }
                if learns {
                    m.usual[i] = m.usual[i].max(run);
                }
                (m.stood[i], m.runs[i]) = (m.runs[i], 0);
            }
        }
        self.trail.pop_front();
        self.trail.push_back(*places);
        m.motion += 0.05 * (moving - m.motion);
        // One that stopped dead goes on being frozen when nothing else moves any more: all may be.
        let dead = still.is_some_and(|place| place < watched);
        m.frozen = still.is_some() && m.motion > MOVING || dead && m.frozen;
        let frozen = m.frozen;
        if let Some(place) = still.filter(|_| frozen) {
            self.found = Some((self.signal(place), Reason::Frozen));
        }
        frozen
    }

    pub(super) fn jumped(&mut self, places: &[f64; PLACES], periods: f64) -> bool {
        let watched = self.watched();
        let m = &mut self.memory;
        let checked = m.seen >= PATIENCE || (m.seen >= 2 && m.samples > self.learning);
        if m.rejected == 0 {
            m.astray = [false; PLACES];
        }
        let (mut jumped, mut slopes) = (false, [0.0; PLACES]);
        for i in 0..watched {
            let change = places[i] - m.places[i];
            slopes[i] = change / periods;
            let bend = (slopes[i] - m.slopes[i]).abs();
            if checked && bend > m.limits[i] {
                m.astray[i] = true;
                m.stopped_dead[i] |= m.runs[i] == 1; // its stop is the jump
                jumped = true;
                let signal = if i < self.motors { Signal::MotorPosition(i) } else { Signal::LinkPosition };
                self.found = Some((signal, Reason::Jumped));
            }
            if jumped {
                continue;
            }
            let size = change.abs();
            // Of a joint that turns steadily no change is small; a change of the change is whole counts as well.
            let second = if m.seen > 0 && periods == m.span { bend * periods } else { 0.0 };
            let place = places[i];
            let rounding = if f64::from(place as f32) == place { SINGLE } else { ROUNDING };
            let least = (rounding * place.abs()).max(FINEST * size);
            for count in [size, second] {
                if count > least && count < m.steps[i] {
                    m.steps[i] = count;
                }
            }
            m.fastest[i] = m.fastest[i].max(size / periods);
            if bend > m.peaks[i] && m.seen > 0 {
                // The first two samples make the first slope.
                m.peaks[i] = bend;
                m.limits[i] = m.limits[i].max(FAR * bend);
            }
        }
        if !jumped {
            (m.slopes, m.span) = (slopes, periods);
        }
        jumped
    }
}

/// Whether a position that now stands did so out of motion: it was never, as far as its resolution `count` tells, half
/// as fast as on average, and friction stops it later: with a way that bends by at most `bend` a period it goes
/// n² bend / 2 in the last n, of which the last count is not read.
fn stops_dead(trail: &VecDeque<[f64; PLACES]>, place: usize, count: f64, bend: f64) -> bool {
    let last = trail.len() - 1;
    let way = |n: usize| (trail[last][place] - trail[last - n][place]).abs();
    let half = |n: usize| 0.5 * way(last) * n as f64 / last as f64;
    way(last) > FAR * count
        && (1..last).all(|n| half(n) < count || way(n) > half(n))
        && (1..last).any(|n| way(n) > ((0.5 * bend).sqrt() * n as f64 + count.sqrt()).powi(2))
}

#[cfg(test)]
mod tests {
    use super::super::SampleValidator;
    use super::stops_dead;
    use crate::model::{Arrangement, Model, Motor, Transmission};
    use crate::sample::{MOTORS, Sample};

    #[test]
    fn digits_of_a_text_and_single_precision_are_no_counts() {
        let motor = Motor::bare(0.1, 0.2, Transmission::Unknown);
        let model = Model {
            arrangement: Arrangement::Single,
            motors: vec![motor],
            link: None,
            link_effects: Vec::new(),
        };
        let count = std::f64::consts::TAU / 8000.0;
        let text = |x: f64| format!("{x:.9}").parse::<f64>().unwrap();
        let single = |x: f64| f64::from(x as f32);
        for (written, middle) in [(text as fn(f64) -> f64, 1.5), (text, 0.0), (single, 1.5)] {
            let mut validator = SampleValidator::new(&model, 1e-3);
            for k in 0..5000_u64 {
                let t = 1e-3 * k as f64;
                let q = written(((middle + (2.0 * t).sin()) / count).round() * count);
                let sample = Sample {
                    sequence: k,
                    motor_position: [q; MOTORS],
                    motor_velocity: [f64::NAN; MOTORS],
                    motor_torque: [t.sin(); MOTORS],
                    link_position: q,
                    link_velocity: f64::NAN,
                    external_torque: f64::NAN,
                };
                validator.check(&sample);
            }
            for resolution in [validator.resolution()[0], validator.resolution()[1]] {
                assert!((resolution - count).abs() < 1e-3 * count, "{resolution} of {count}");
            }
        }
    }

    #[test]
    fn friction_stops_no_motor_dead_wherever_between_two_counts_it_rests() {
        let bend = 0.04; // counts in a period
        for rest in (0..100).map(|percent| 0.01 * f64::from(percent)) {
            let read = |before: u32| (rest - 0.5 * bend * f64::from(before).powi(2)).floor();
            let last = (0..).find(|before| read(before + 1) < read(0)).unwrap();
            let trail = |read: &dyn Fn(u32) -> f64| (0..=20).rev().map(|k| [read(last + k); 3]).collect();
            assert!(!stops_dead(&trail(&read), 0, 1.0, bend), "{rest}");
            let hangs = |before: u32| (rest - 1.5 * f64::from(before)).floor();
            assert!(stops_dead(&trail(&hangs), 0, 1.0, bend), "{rest}");
        }
    }
}
