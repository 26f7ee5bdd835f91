//! Mode "robust": eq 5 as rows of columns, rows as blocks, and the estimate as algebra on their sum.
//!
//! Each tick: check the sample, correct it, bridge a gap, align the channels, filter them, add each motor's row;
//! a full block solves. Torque and stiffness are the law's at the deflection of this moment.

mod advance;
mod conclude;
mod zeros;

use serde::{Deserialize, Serialize};

use crate::align::{Alignment, Inputs, Positions};
use crate::choices::{BRIDGED, LATEST, LOOK_S, SAID_S, SETTLED};
use crate::corrections::Corrections;
use crate::effects::MotorEffects;
use crate::error::Error;
use crate::external::{External, LinkMomentum};
use crate::laws::Law;
use crate::library::Element;
use crate::model::{Arrangement, Model, Transmission};
use crate::noise::NoiseMeter;
use crate::reasons::Why;
use crate::rigid::RigidBalance;
use crate::sample::{Estimate, MOTORS, Sample};
use crate::sample_validator::{Accepted, SampleValidator};
use crate::settings::{Method, Priors, Settings};
use crate::side::Side;
use crate::signals::{Channel, Filters};
use crate::suspicion::{Reason, Suspicion};

/// See the module.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct Robust {
    arrangement: Arrangement,
    #[serde(deserialize_with = "crate::sample::motors")]
    motors: usize,
    flexible: bool,
    period: f64,
    filters: Filters,
    settle: i64,
    looks: u64,
    said_periods: i64,
    noise_gains: [f64; 3],
    valid_within: f64,
    validator: SampleValidator,
    corrections: Corrections,
    alignment: Alignment,
    sides: Vec<Side>,
    rigid: Vec<RigidBalance>, // of a joint whose motors carry nothing that is declared: none deflects, no link
    momentum: Option<LinkMomentum>,
    live: Live,
}

/// What begins anew with a reset.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
struct Live {
    link: Channel,
    external: Option<External>,
    measured: f64, // τ_k
    late: f64,     // the sample at hand, s
    noise: [NoiseMeter; MOTORS + 1],
    torque_noise: [NoiseMeter; MOTORS],
    zeros: Positions, // where the encoders' zeros have moved to
    last: Inputs,
    lever: f64,        // position of a serial joint's motor 2 for which its spring is learned, rad
    zeros_known: bool, // or what the next sample is held against
    begins: bool,      // with the next sample that the corrections let pass …
    jumped: Option<[f64; MOTORS + 1]>, // … after encoders moved their zeros
    started: bool,
    tick: u64,
    unsettled: i64, // periods for which the filters still hold something wrong
    said: i64,
    sequence: u64,                     // of the last sample that was used
    refused: Option<(Suspicion, i64)>, // what was wrong with a sample of late, and for how long that is said
    why: Option<Why>,
    estimate: Option<Estimate>,
}

impl Live {
    fn start() -> Live {
        Live { measured: f64::NAN, lever: f64::NAN, zeros_known: true, begins: true, ..Live::default() }
    }
}

impl Robust {
    /// For a model that has been checked.
    ///
    /// # Errors
    /// An effect is where it does not belong.
    pub fn new(model: &Model, settings: &Settings, priors: &Priors, period_s: f64) -> Result<Robust, Error> {
        let filters = Filters::new(settings.bandwidth, period_s);
        let effects: Vec<MotorEffects> =
            model.motors.iter().map(|motor| MotorEffects::new(&motor.effects)).collect::<Result<_, _>>()?;
        let corrections = Corrections::new(&effects, &model.link_effects, period_s)?;
        let looks = (LOOK_S / period_s).round().max(1.0) as u64;
        let alarms = settings.false_alarms_per_hour;
        let mut motors = model.motors.clone();
        if settings.method == Method::Bbe {
            // A black box: nothing of the law is used.
            let flexible = motors.iter_mut().filter(|motor| motor.flexible());
            flexible.for_each(|motor| motor.transmission = Transmission::Unknown);
        }
        let sides = (motors.iter().zip(effects))
            .map(|(motor, effects)| {
                Side::new(motor, effects, priors, &filters, period_s, looks as f64 * period_s, alarms)
            })
            .collect();
        let loaded = model.link.is_some() || model.link_effects.iter().any(Element::acts_on_link);
        let alone = !model.has_deflection() && !loaded;
        let rigid = if alone { &motors[..] } else { &[] };
        let rigid = rigid.iter().map(|motor| RigidBalance::new(motor.inertia)).collect();
        Ok(Robust {
            arrangement: model.arrangement,
            motors: model.motors.len(),
            flexible: model.has_deflection(),
            period: period_s,
            settle: (SETTLED * filters.delay / period_s).ceil() as i64,
            looks,
            said_periods: (SAID_S / period_s).round() as i64,
            validator: SampleValidator::new(model, period_s),
            corrections,
            alignment: Alignment::default(),
            sides,
            rigid,
            momentum: LinkMomentum::new(model, settings, priors, period_s),
            noise_gains: filters.noise_gains(period_s),
            valid_within: settings.valid_within,
            filters,
            live: Live::start(),
        })
    }

    /// Forget everything.
    pub fn reset(&mut self) {
        self.validator.reset();
        self.corrections.reset();
        self.alignment = Alignment::default();
        self.sides.iter_mut().for_each(Side::reset);
        self.rigid.iter_mut().for_each(RigidBalance::reset);
        self.momentum.iter_mut().for_each(LinkMomentum::reset);
        self.live = Live::start();
    }

    /// Positions may count from anywhere after this: nothing that depends on where their zeros are is known.
    pub fn lose_zeros(&mut self) {
        if self.sides.iter().all(Side::knows_nothing) {
            self.reset(); // as at a start: the zeros are those that are declared
            return self.momentum.iter_mut().for_each(LinkMomentum::lose_zero);
        }
        self.validator.lose_zeros();
        self.corrections.reset();
        self.momentum.iter_mut().for_each(LinkMomentum::lose_zero);
        (self.live.begins, self.live.zeros_known, self.live.jumped) = (true, false, None);
        (self.live.refused, self.live.external) = (None, None);
        (self.live.why, self.live.estimate) = (None, None);
    }

    /// The next sample may not be of its moment: learn nothing until the filters have forgotten it.
    pub fn distrust(&mut self) {
        self.live.unsettled = self.settle;
        self.momentum.iter_mut().for_each(LinkMomentum::distrust);
        self.sides.iter_mut().for_each(Side::cut);
    }

    /// The next sample is later than its period by so many seconds; no further one is.
    pub fn delay_next(&mut self, late_s: f64) {
        self.live.late = late_s;
    }

    /// What the world does to the link, by the last sample; `None` where no link dynamics are declared.
    #[must_use]
    pub fn external(&self) -> Option<External> {
        self.live.external
    }

    /// See [`crate::external::Said::consistency`].
    #[must_use]
    pub fn consistency(&self) -> Option<[f64; 2]> {
        self.momentum.as_ref()?.latest.consistency()
    }

    /// Largest misfit among the motors' balances, N·m; NaN until there is a model.
    #[must_use]
    pub fn residual(&self) -> f64 {
        self.sides.iter().map(|side| side.blocks.misfit()).fold(f64::NAN, f64::max)
    }

    /// Standard deviation of the joint's flexibility torque at the last sample that was used, N·m.
    #[must_use]
    pub fn flexibility_torque_std(&self) -> f64 {
        self.live.estimate.map_or(f64::NAN, |estimate| estimate.flexibility_torque_std)
    }

    /// Effects of one motor that nobody declared and evidence chose.
    pub fn undeclared(&self, motor: usize) -> impl Iterator<Item = &'static str> {
        self.sides[motor].undeclared()
    }

    /// Parameters of one motor's transmission and their standard deviations; the law they belong to.
    pub fn parameters(&self, motor: usize, values: &mut Vec<f64>, std: &mut Vec<f64>) -> Option<&Law> {
        self.sides[motor].parameters(values, std)
    }

    /// Dry friction of one motor beyond what is declared, and its standard deviation, N·m; `None` before any.
    #[must_use]
    pub fn friction(&self, motor: usize) -> Option<(f64, f64)> {
        self.sides[motor].friction()
    }

    /// Why the last estimate is not valid; `None`: it is.
    #[must_use]
    pub fn why(&self) -> Option<Why> {
        self.live.why
    }

    /// The reading that is suspected, while something is.
    #[must_use]
    pub fn suspicion(&self) -> Option<Suspicion> {
        let doubted = || Suspicion::of(self.sides.iter().map(|side| side.blocks.odds()));
        self.live.refused.map(|(refused, _)| refused).or_else(doubted)
    }

    /// The estimate at this sample, whatever floats it holds.
    pub fn step(&mut self, sample: &Sample) -> Estimate {
        // Can it be used, and how far is it from the last one that was?
        let accepted = self.validator.check(sample);
        let late = std::mem::take(&mut self.live.late);
        self.note(&accepted, late);
        if accepted.periods == 0 {
            return self.hold(sample.sequence, accepted.status);
        }
        self.live.begins |= accepted.restart;
        let Some(corrected) = self.corrections.correct(sample, accepted.restart) else {
            return self.hold(sample.sequence, accepted.status);
        };
        self.live.measured = corrected.present.external_torque;
        let (at, present) = (self.positions(&corrected.aligned), self.positions(&corrected.present));
        if let Some(jumps) = self.live.jumped.take() {
            self.move_zeros(jumps, &at, sample.sequence);
        }
        if !std::mem::replace(&mut self.live.zeros_known, true) {
            self.resume(&at);
        }
        self.live.sequence = sample.sequence;
        let mut torque = corrected.aligned.motor_torque;
        torque[self.motors..].fill(0.0);
        let (at, present) = (at.from_zeros(&self.live.zeros), present.from_zeros(&self.live.zeros));
        if accepted.frozen {
            self.distrust();
        }
        self.follow(&Inputs { at, torque, present, late }, accepted.periods);
        self.conclude(sample.sequence, accepted.status)
    }

    /// What is wrong with a sample, and by how much it says that zeros have moved.
    fn note(&mut self, accepted: &Accepted, late: f64) {
        // A sample of about the next moment is ahead in all positions: none of them is wrong.
        let another = |one: &Suspicion| one.reason == Reason::Jumped && late > LATEST * self.period;
        self.live.refused = match (accepted.suspicion.filter(|one| !another(one)), self.live.refused) {
            (Some(now), _) => Some((now, self.said_periods)),
            (None, before) => before.map(|(was, left)| (was, left - 1)).filter(|(_, left)| *left > 0),
        };
        if let Some(jumps) = accepted.jumps {
            let before = self.live.jumped.unwrap_or_default();
            self.live.jumped = Some(std::array::from_fn(|k| before[k] + jumps[k]));
        }
    }

    /// All channels as of one moment, and every period between the last sample and this one.
    fn follow(&mut self, inputs: &Inputs, passed: u32) {
        let begins = std::mem::take(&mut self.live.begins);
        let inputs = self.alignment.align(inputs, begins);
        if begins {
            return self.restart(&inputs);
        }
        let (from, periods) = (self.live.last, f64::from(passed));
        // A motion at the bandwidth w loses (w n T)²/12 of its amplitude by a straight line.
        let lost = periods > 2.0 && periods * self.period * self.filters.main.bandwidth > BRIDGED;
        if lost {
            self.distrust(); // before the line: none of its rows is learned
        }
        for k in 1..passed {
            self.advance(&from.towards(&inputs, f64::from(k) / periods));
        }
        self.advance(&inputs);
        if lost {
            self.live.unsettled = self.settle;
        }
    }

    /// Positions of a sample; 0 where the joint has none.
    fn positions(&self, sample: &Sample) -> Positions {
        let mut motor = sample.motor_position;
        motor[self.motors..].fill(0.0);
        Positions { link: if self.flexible { sample.link_position } else { 0.0 }, motor }
    }
}

#[cfg(test)]
mod tests;
