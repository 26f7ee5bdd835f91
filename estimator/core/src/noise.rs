//! Encoder noise from third differences of the readings, at least the uniform rounding of a step (variance 1/12 step²):
//! of a count, or of a reading that is renewed less often than it is sent and moves on by more than a count.

use crate::choices::{FAR, NOISE_S};
use serde::{Deserialize, Serialize};

const THIRD: f64 = 0.05; // the third difference of white noise has 20 times its variance

/// Variance of the noise of one smooth signal.
#[derive(Clone, Copy, Debug, Default, Serialize, Deserialize)]
pub struct NoiseMeter {
    past: [f64; 3], // newest first
    known: u8,
    seen: f64,
    measured: f64,
    stair: f64,  // square of the step at hand; 0: it moves on in every period
    stairs: f64, // its mean
}

impl NoiseMeter {
    /// The signal goes on elsewhere, as noisy as it was.
    pub fn restart(&mut self) {
        self.known = 0;
    }

    /// Whether there is a measurement.
    #[must_use]
    pub fn is_known(&self) -> bool {
        self.measured > 0.0
    }

    /// One sample.
    pub fn update(&mut self, value: f64, period_s: f64) {
        let [a, b, c] = self.past;
        self.past = [value, a, b];
        if self.known < 3 {
            self.known += 1;
            return;
        }
        self.seen += 1.0;
        let gain = (period_s / NOISE_S).max(1.0 / self.seen).min(1.0);
        if value != a {
            self.stair = if a == b { (value - a).powi(2) } else { 0.0 };
        }
        self.stairs += gain * (self.stair - self.stairs);
        let third = value - 3.0 * a + 3.0 * b - c;
        let square = THIRD * third * third;
        if self.measured == 0.0 {
            // Before anything is known: an average over what has been seen.
            self.measured += square / self.seen.max(1.0);
            return;
        }
        self.measured += gain * (square.min(FAR * FAR * self.measured) - self.measured);
    }

    /// rad², with the resolution that has been seen (∞: none).
    #[must_use]
    pub fn variance(&self, resolution: f64) -> f64 {
        self.measured.max(self.step(resolution).powi(2) / 12.0)
    }

    /// Of the readings, rad, with the resolution that has been seen (∞: none).
    #[must_use]
    pub fn step(&self, resolution: f64) -> f64 {
        if resolution.is_finite() { self.stairs.sqrt().max(resolution) } else { 0.0 }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_parabola_has_no_noise_but_that_of_its_counts() {
        let mut meter = NoiseMeter::default();
        for k in 0..500 {
            meter.update(1e-4 * f64::from(k * k), 1e-3);
        }
        assert!(meter.variance(f64::INFINITY) < 1e-18);
        assert!((meter.variance(1e-3) - 1e-6 / 12.0).abs() < 1e-12);
    }

    #[test]
    fn a_reading_that_is_renewed_every_twentieth_period_is_as_coarse_as_its_steps() {
        let mut meter = NoiseMeter::default();
        for k in 0..4000 {
            meter.update(1e-3 * f64::from(k / 20 * 20), 1e-3);
        }
        let (found, step) = (meter.variance(1e-5), 0.02);
        assert!((found / (step * step / 12.0) - 1.0).abs() < 0.05, "{found}"); // 5 %: the first step's start
    }

    #[test]
    fn noise_is_no_step() {
        let mut meter = NoiseMeter::default();
        for k in 0..500 {
            meter.update(if k % 2 == 0 { 0.1 } else { -0.1 }, 1e-3);
        }
        assert!((meter.step(1e-3) - 1e-3).abs() < 1e-12 && meter.step(f64::INFINITY) == 0.0);
    }

    #[test]
    fn alternating_noise_is_measured() {
        // ±a has third differences of ±8 a: 64/20 of its variance.
        let mut meter = NoiseMeter::default();
        for k in 0..5000 {
            meter.update(if k % 2 == 0 { 0.1 } else { -0.1 }, 1e-3);
        }
        assert!((meter.variance(f64::INFINITY) / 0.01 - 3.2).abs() < 1e-6);
    }
}
