//! The estimator of a joint: one `step` a tick.

use serde::{Deserialize, Serialize};

use crate::error::Error;
use crate::external::External;
use crate::laws::Law;
use crate::model::Model;
use crate::paper::Paper;
use crate::reasons::Why;
use crate::robust::Robust;
use crate::sample::{Estimate, Sample};
use crate::settings::{Mode, Priors, Settings};
use crate::suspicion::Suspicion;

/// The modes behind one interface.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub enum Estimator {
    /// See [`Paper`].
    Paper(Box<Paper>),
    /// See [`Robust`].
    Robust(Box<Robust>),
}

impl Estimator {
    /// The estimator that the settings ask for, for samples every `period_s` seconds.
    ///
    /// # Errors
    /// The model contradicts itself, or names what does not exist.
    pub fn new(
        model: &Model,
        settings: &Settings,
        priors: &Priors,
        period_s: f64,
    ) -> Result<Estimator, Error> {
        model.check()?;
        if !(period_s > 0.0 && period_s.is_finite()) {
            return Err(Error(format!("period_s: expected a finite number > 0, got {period_s}")));
        }
        Ok(match settings.mode {
            Mode::Paper => Estimator::Paper(Box::new(Paper::new(model, settings, priors, period_s))),
            Mode::Robust => Estimator::Robust(Box::new(Robust::new(model, settings, priors, period_s)?)),
        })
    }

    /// The estimate at this sample, whatever floats it holds.
    ///
    /// `sequence` counts periods: a jump by more than one is a gap of whole periods.
    pub fn step(&mut self, sample: &Sample) -> Estimate {
        match self {
            Estimator::Paper(paper) => paper.step(sample),
            Estimator::Robust(robust) => robust.step(sample),
        }
    }

    fn robust(&self) -> Option<&Robust> {
        if let Estimator::Robust(robust) = self { Some(robust) } else { None }
    }

    fn robust_mut(&mut self) -> Option<&mut Robust> {
        if let Estimator::Robust(robust) = self { Some(robust) } else { None }
    }

    /// Forget everything that was learned.
    pub fn reset(&mut self) {
        match self {
            Estimator::Paper(paper) => paper.reset(),
            Estimator::Robust(robust) => robust.reset(),
        }
    }

    /// Positions may count from anywhere after this, as those of a drive that has restarted.
    ///
    /// The joint is the same: what was learned of it is kept, but for where its zeros are.
    pub fn lose_zeros(&mut self) {
        match self {
            Estimator::Paper(paper) => paper.reset(),
            Estimator::Robust(robust) => robust.lose_zeros(),
        }
    }

    /// The next sample may not be of its moment: use it, but learn nothing from it.
    pub fn distrust(&mut self) {
        self.robust_mut().into_iter().for_each(Robust::distrust);
    }

    /// The next sample is later than its period by so many seconds; no further one is.
    pub fn delay_next(&mut self, late_s: f64) {
        self.robust_mut().into_iter().for_each(|robust| robust.delay_next(late_s));
    }

    /// Standard deviation of the joint's flexibility torque at the last sample, N·m; NaN: unknown.
    #[must_use]
    pub fn flexibility_torque_std(&self) -> f64 {
        self.robust().map_or(f64::NAN, Robust::flexibility_torque_std)
    }

    /// What the model left unexplained of the torque balance at the last sample, N·m; NaN: unknown.
    #[must_use]
    pub fn residual(&self) -> f64 {
        self.robust().map_or(f64::NAN, Robust::residual)
    }

    /// What the world does to the link, by the last sample; `None` where no link dynamics are declared.
    #[must_use]
    pub fn external(&self) -> Option<External> {
        match self {
            Estimator::Paper(paper) => paper.external(),
            Estimator::Robust(robust) => robust.external(),
        }
    }

    /// rms of what the two sides' flexibility torques differ by and of the link's, over some seconds, N·m.
    #[must_use]
    pub fn consistency(&self) -> Option<[f64; 2]> {
        match self {
            Estimator::Paper(paper) => paper.consistency(),
            Estimator::Robust(robust) => robust.consistency(),
        }
    }

    /// The reading that is suspected, while something is.
    #[must_use]
    pub fn suspicion(&self) -> Option<Suspicion> {
        self.robust()?.suspicion()
    }

    /// Why the last estimate is not valid; `None`: it is, or nothing has been estimated.
    #[must_use]
    pub fn why(&self) -> Option<Why> {
        match self {
            Estimator::Paper(paper) => paper.why(),
            Estimator::Robust(robust) => robust.why(),
        }
    }

    /// Effects of one motor that nobody declared and evidence chose; `None`: the mode has none.
    pub fn undeclared(&self, motor: usize) -> Option<impl Iterator<Item = &'static str>> {
        Some(self.robust()?.undeclared(motor))
    }

    /// Current parameters of one motor's transmission and their standard deviations, and their law.
    ///
    /// Without a law: the paper's black box gives its stiffness alone, the robust one nothing.
    pub fn parameters(&self, motor: usize, values: &mut Vec<f64>, std: &mut Vec<f64>) -> Option<Law> {
        match self {
            Estimator::Paper(paper) => paper.parameters(motor, values, std),
            Estimator::Robust(robust) => robust.parameters(motor, values, std).cloned(),
        }
    }

    /// Dry friction of one motor beyond what is declared, and its standard deviation, N·m; `None`: not estimated.
    #[must_use]
    pub fn friction(&self, motor: usize) -> Option<(f64, f64)> {
        self.robust()?.friction(motor)
    }
}
