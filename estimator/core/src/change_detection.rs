//! Is the balance explained? One test on normalised innovations, with a declared rate of false alarms.
//!
//! An innovation's variance is foreseen: noise and what the parameters add. Divided by it, the mean square of
//! a few innovations, which span the filter's correlation time, is that of a heavy-tailed variable, a t
//! distribution's: usual noise is Gaussian, what real joints add is not. The alarm is its quantile at the
//! rate of false alarms that is asked for. After one, nothing is learned until what was before the change
//! has left the filters; then the stiffness is opened up and followed, and is explained again when the
//! innovations are as foreseen.

use crate::student::t_quantile;

const TAILS: f64 = 4.0; // degrees of freedom: model errors (dry friction at a reversal) come in bursts
const UPDATES: usize = 3; // over which innovations are averaged: the correlation time of the filters …
const EXPLAINED: usize = 10; // … and over which they have to be as foreseen before the curve is believed again
const AS_FORESEEN: f64 = 2.0; // mean square, of innovations that are correlated over three updates
const LEAST: f64 = 0.004; // of the torque: no smaller change is called one
const FLUSH_DELAYS: f64 = 2.6; // until less than a thousandth of what was before a change is in the filters
const FOLLOW_S: f64 = 0.6; // after an alarm, in which the change is still being followed
const LONGEST_S: f64 = 20.0; // without an explanation, as the memory is: from then on it is noise
const SURPRISING: f64 = 9.0; // mean square over EXPLAINED_S: three standard deviations
const EXPLAINED_S: f64 = 0.3;
const MOST: f64 = 36.0; // that one innovation counts, and as much while the filters are being flushed

/// See the module.
#[derive(Clone, Debug)]
pub struct ChangeDetection {
    dt: f64,
    flush_s: f64,
    limit_square: f64,
    squares: [(f64, f64); EXPLAINED], // innovation² and what was foreseen, newest first
    known: usize,
    phase: Phase,
    surprise: f64, // mean square of innovations over what is foreseen of it
    surprised_s: f64,
}

#[derive(Clone, Copy, Debug, PartialEq)]
enum Phase {
    Explained,
    Flushing { left_s: f64 },
    Following { since_s: f64 },
}

impl ChangeDetection {
    /// For updates dt_s apart, of filters that delay a slow signal by `delay_s`.
    #[must_use]
    pub fn new(false_alarms_per_hour: f64, dt_s: f64, delay_s: f64) -> ChangeDetection {
        let limit = t_quantile(TAILS, false_alarms_per_hour * dt_s / 3600.0);
        ChangeDetection {
            dt: dt_s,
            flush_s: FLUSH_DELAYS * delay_s,
            limit_square: limit * limit,
            squares: [(0.0, 0.0); EXPLAINED],
            known: 0,
            phase: Phase::Explained,
            surprise: 1.0,
            surprised_s: 0.0,
        }
    }

    /// Nothing has been seen yet.
    pub fn reset(&mut self) {
        self.known = 0;
        self.phase = Phase::Explained;
        (self.surprise, self.surprised_s) = (1.0, 0.0);
    }

    /// The filters hold something wrong: what has been seen does not go on.
    pub fn pause(&mut self) {
        self.known = 0;
    }

    /// One innovation, in units of the torque; returns whether the parameters are to be opened up now.
    ///
    /// `settled`: whether there is a curve to be held against.
    pub fn watch(&mut self, innovation: f64, predicted_variance: f64, noise: f64, settled: bool) -> bool {
        let flushing = matches!(self.phase, Phase::Flushing { .. });
        if settled {
            let square = innovation * innovation / (noise + predicted_variance + LEAST * LEAST);
            let counted = if flushing { MOST } else { square.min(MOST) };
            self.surprise += (self.dt / EXPLAINED_S).min(1.0) * (counted - self.surprise);
            self.surprised_s = if self.surprise > SURPRISING { self.surprised_s + self.dt } else { 0.0 };
        }
        if let Phase::Flushing { left_s } = &mut self.phase {
            *left_s -= self.dt;
            if *left_s > 0.0 {
                return false;
            }
            self.phase = Phase::Following { since_s: 0.0 };
            self.known = 0;
            return true;
        }
        self.squares.copy_within(..EXPLAINED - 1, 1);
        self.squares[0] = (innovation * innovation, noise + predicted_variance);
        self.known = (self.known + 1).min(EXPLAINED);
        if let Phase::Following { since_s } = &mut self.phase {
            *since_s += self.dt;
            if *since_s > FOLLOW_S && self.explained() {
                self.phase = Phase::Explained;
            }
        }
        if !settled || self.known < UPDATES {
            return false;
        }
        let (square, foreseen) = self.mean(UPDATES);
        if square > self.limit_square * foreseen + LEAST * LEAST {
            self.phase = Phase::Flushing { left_s: self.flush_s };
        }
        false
    }

    fn mean(&self, updates: usize) -> (f64, f64) {
        let count = updates.min(self.known).max(1);
        let sum = self.squares[..count].iter().fold((0.0, 0.0), |sum, one| (sum.0 + one.0, sum.1 + one.1));
        (sum.0 / count as f64, sum.1 / count as f64)
    }

    /// Whether the joint has changed and is being followed.
    #[must_use]
    pub fn changed(&self) -> bool {
        self.phase != Phase::Explained
    }

    /// Whether innovations are as foreseen.
    #[must_use]
    pub fn explained(&self) -> bool {
        match self.phase {
            _ if self.surprise > SURPRISING => false,
            Phase::Explained => true,
            Phase::Flushing { .. } => false,
            Phase::Following { .. } => {
                let (square, foreseen) = self.mean(EXPLAINED);
                self.known == EXPLAINED && square <= AS_FORESEEN * foreseen
            }
        }
    }

    /// Whether the filters hold nothing from before a change.
    #[must_use]
    pub fn may_learn(&self) -> bool {
        !matches!(self.phase, Phase::Flushing { .. })
    }

    /// Whether innovations are noise: not while a change is followed, unless nothing ever explains it.
    #[must_use]
    pub fn may_learn_noise(&self) -> bool {
        match self.phase {
            Phase::Explained => self.surprise <= SURPRISING || self.surprised_s > LONGEST_S,
            Phase::Flushing { .. } => false,
            Phase::Following { since_s } => since_s > LONGEST_S,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_step_raises_the_alarm_and_its_end_is_explained() {
        let mut monitor = ChangeDetection::new(1.0, 0.03, 0.08);
        for _ in 0..100 {
            assert!(!monitor.watch(0.01, 0.0, 1e-4, true) && !monitor.changed());
        }
        let mut opened = 0;
        for _ in 0..12 {
            opened += i32::from(monitor.watch(0.3, 0.0, 1e-4, true));
        }
        assert!(opened == 1 && monitor.changed());
        for _ in 0..60 {
            monitor.watch(0.01, 0.0, 1e-4, true);
        }
        assert!(!monitor.changed() && monitor.explained());
    }
}
