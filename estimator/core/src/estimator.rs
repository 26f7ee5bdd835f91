//! The estimator of a joint: one `step` a tick.

use crate::error::Error;
use crate::model::Model;
use crate::sample::{Estimate, MOTORS, Sample, TransmissionEstimate};
use crate::settings::Settings;

/// What both modes offer.
#[derive(Clone, Debug)]
pub struct Estimator {
    motors: usize,
}

impl Estimator {
    /// The estimator that the settings ask for, for samples every `period_s` seconds.
    ///
    /// # Errors
    /// The model contradicts itself, or names what does not exist.
    pub fn new(model: &Model, _settings: &Settings, period_s: f64) -> Result<Estimator, Error> {
        model.check()?;
        if !(period_s > 0.0 && period_s.is_finite()) {
            return Err(Error(format!("period_s: expected a finite number > 0, got {period_s}")));
        }
        Ok(Estimator { motors: model.motors.len() })
    }

    /// The estimate at this sample, whatever floats it holds.
    pub fn step(&mut self, sample: &Sample) -> Estimate {
        Estimate {
            sequence: sample.sequence,
            status: 0,
            flexibility_torque: f64::NAN,
            stiffness: f64::NAN,
            stiffness_std: f64::NAN,
            transmissions: [TransmissionEstimate::NOTHING; MOTORS],
            motors: self.motors,
        }
    }

    /// Forget everything that was learned.
    pub fn reset(&mut self) {}

    /// The next sample may not be of its moment: use it, but learn nothing from it.
    pub fn distrust(&mut self) {}

    /// What the model left unexplained of the torque balance at the last sample, N·m; NaN: unknown.
    #[must_use]
    pub fn residual(&self) -> f64 {
        f64::NAN
    }
}
