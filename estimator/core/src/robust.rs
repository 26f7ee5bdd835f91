//! Mode "robust": eq 5 as rows of columns, rows as blocks, and the estimate as algebra on their sum.
//!
//! Each tick: check the sample, correct it, bridge a gap, align the channels, filter them, add each motor's row;
//! a full block solves. Torque and stiffness are the law's at the deflection of this moment.

mod conclude;
mod zeros;

use serde::{Deserialize, Serialize};

use crate::align::{Alignment, Inputs, Positions};
use crate::choices::{BRIDGED, LOOK_S, SAID_S, SETTLED};
use crate::corrections::Corrections;
use crate::effects::MotorEffects;
use crate::error::Error;
use crate::external::{Carried, External, LinkMomentum};
use crate::laws::Law;
use crate::model::{Arrangement, Model, Transmission};
use crate::noise::NoiseMeter;
use crate::reasons::Why;
use crate::rigid::RigidBalance;
use crate::sample::{Estimate, MOTORS, Sample};
use crate::sample_validator::SampleValidator;
use crate::settings::{Method, Priors, Settings};
use crate::side::{Moment, Shift, Side};
use crate::signals::{Channel, Filters};
use crate::suspicion::Suspicion;

/// See the module.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct Robust {
    arrangement: Arrangement,
    motors: usize,
    flexible: bool,
    period: f64,
    filters: Filters,
    rate_gain: f64,
    settle: i64,
    looks: u64,
    said_periods: i64,
    validator: SampleValidator,
    corrections: Corrections,
    alignment: Alignment,
    sides: Vec<Side>,
    rigid: Vec<RigidBalance>, // of a joint whose motors carry nothing that is declared: none deflects, no link
    link: Channel,
    momentum: Option<LinkMomentum>,
    external: Option<External>,
    measured: f64, // τ_k
    late: f64,     // the sample at hand, s
    noise: [NoiseMeter; MOTORS + 1],
    torque_noise: [NoiseMeter; MOTORS],
    noise_gains: [f64; 3],
    zeros: Positions, // where the encoders' zeros have moved to
    last: Inputs,
    zeros_known: bool,                 // or what the next sample is held against
    begins: bool,                      // with the next sample that the corrections let pass …
    jumped: Option<[f64; MOTORS + 1]>, // … after encoders moved their zeros
    started: bool,
    tick: u64,
    unsettled: i64, // periods for which the filters still hold something wrong
    said: i64,
    rejected: i64,
    sequence: u64,                     // of the last sample that was used
    refused: Option<(Suspicion, i64)>, // what was wrong with a sample of late, and for how long that is said
    valid_within: f64,
    why: Option<Why>,
    estimate: Option<Estimate>,
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
        let alone = !model.has_deflection() && model.link.is_none();
        let rigid = if alone { &motors[..] } else { &[] };
        let rigid = rigid.iter().map(|motor| RigidBalance::new(motor.inertia)).collect();
        Ok(Robust {
            arrangement: model.arrangement,
            motors: model.motors.len(),
            flexible: model.has_deflection(),
            period: period_s,
            rate_gain: filters.rate_gain(period_s),
            settle: (SETTLED * filters.delay / period_s).ceil() as i64,
            filters,
            looks,
            said_periods: (SAID_S / period_s).round() as i64,
            validator: SampleValidator::new(model, period_s),
            corrections,
            alignment: Alignment::default(),
            sides,
            rigid,
            link: Channel::rest(0.0),
            momentum: LinkMomentum::new(model, settings, priors, period_s),
            external: None,
            measured: f64::NAN,
            late: 0.0,
            noise: [NoiseMeter::default(); MOTORS + 1],
            torque_noise: [NoiseMeter::default(); MOTORS],
            noise_gains: filters.noise_gains(period_s),
            zeros: Positions::default(),
            last: Inputs::default(),
            begins: true,
            zeros_known: true,
            jumped: None,
            started: false,
            tick: 0,
            unsettled: 0,
            said: 0,
            rejected: 0,
            sequence: 0,
            refused: None,
            valid_within: settings.valid_within,
            why: None,
            estimate: None,
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
        self.noise = [NoiseMeter::default(); MOTORS + 1];
        self.torque_noise = [NoiseMeter::default(); MOTORS];
        (self.zeros, self.last, self.begins, self.jumped) =
            (Positions::default(), Inputs::default(), true, None);
        self.zeros_known = true;
        (self.started, self.tick, self.unsettled, self.said, self.rejected) = (false, 0, 0, 0, 0);
        (self.sequence, self.refused, self.external, self.why, self.estimate) = (0, None, None, None, None);
    }

    /// Positions may count from anywhere after this: nothing that depends on where their zeros are is known.
    pub fn lose_zeros(&mut self) {
        if self.sides.iter().all(Side::knows_nothing) {
            return self.reset(); // as at a start: the zeros are those that are declared
        }
        self.validator.reset();
        self.corrections.reset();
        self.momentum.iter_mut().for_each(LinkMomentum::reset);
        (self.begins, self.zeros_known, self.jumped) = (true, false, None);
        (self.rejected, self.refused, self.external, self.why, self.estimate) = (0, None, None, None, None);
    }

    /// The next sample may not be of its moment: learn nothing until the filters have forgotten it.
    pub fn distrust(&mut self) {
        self.unsettled = self.settle;
        self.momentum.iter_mut().for_each(LinkMomentum::distrust);
        self.sides.iter_mut().for_each(Side::cut);
    }

    /// The next sample is later than its period by so many seconds; no further one is.
    pub fn delay_next(&mut self, late_s: f64) {
        self.late = late_s;
    }

    /// What the world does to the link, by the last sample; `None` where no link dynamics are declared.
    #[must_use]
    pub fn external(&self) -> Option<External> {
        self.external
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
        self.estimate.map_or(f64::NAN, |estimate| estimate.flexibility_torque_std)
    }

    /// Effects of one motor that nobody declared and evidence chose.
    pub fn undeclared(&self, motor: usize) -> impl Iterator<Item = &'static str> {
        self.sides[motor].blocks.undeclared()
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
        self.why
    }

    /// The reading that is suspected, while something is.
    #[must_use]
    pub fn suspicion(&self) -> Option<Suspicion> {
        let doubted = || Suspicion::of(self.sides.iter().map(|side| side.blocks.odds()));
        self.refused.map(|(refused, _)| refused).or_else(doubted)
    }

    /// The estimate at this sample, whatever floats it holds.
    pub fn step(&mut self, sample: &Sample) -> Estimate {
        // Can it be used, and how far is it from the last one that was?
        let accepted = self.validator.check(sample);
        let late = std::mem::take(&mut self.late);
        self.refused = match (accepted.suspicion, self.refused) {
            (Some(now), _) => Some((now, self.said_periods)),
            (None, before) => before.map(|(was, left)| (was, left - 1)).filter(|(_, left)| *left > 0),
        };
        if accepted.periods == 0 {
            return self.hold(sample.sequence, accepted.status);
        }
        self.begins |= accepted.restart;
        if let Some(jumps) = accepted.jumps {
            let before = self.jumped.unwrap_or_default();
            self.jumped = Some(std::array::from_fn(|k| before[k] + jumps[k]));
        }
        let Some(corrected) = self.corrections.correct(sample, accepted.restart) else {
            return self.hold(sample.sequence, accepted.status);
        };
        self.rejected = 0;
        self.measured = corrected.present.external_torque;
        let (at, present) = (self.positions(&corrected.aligned), self.positions(&corrected.present));
        if let Some(jumps) = self.jumped.take() {
            self.move_zeros(jumps, &at, sample.sequence);
        }
        if !std::mem::replace(&mut self.zeros_known, true) {
            self.resume(&at);
        }
        self.sequence = sample.sequence;
        let mut torque = corrected.aligned.motor_torque;
        torque[self.motors..].fill(0.0);
        let (at, present) = (at.from_zeros(&self.zeros), present.from_zeros(&self.zeros));
        let inputs = Inputs { at, torque, present, late };
        if accepted.frozen {
            self.distrust();
        }
        // All channels as of one moment, and every period between the last sample and this one.
        let begins = std::mem::take(&mut self.begins);
        let inputs = self.alignment.align(&inputs, begins);
        if begins {
            self.restart(&inputs);
        } else {
            let (from, periods) = (self.last, f64::from(accepted.periods));
            for k in 1..accepted.periods {
                self.advance(&from.towards(&inputs, f64::from(k) / periods));
            }
            self.advance(&inputs);
            // A motion at the bandwidth w loses (w n T)²/12 of its amplitude by a straight line.
            if periods > 2.0 && periods * self.period * self.filters.main.bandwidth > BRIDGED {
                self.distrust();
            }
        }
        self.conclude(sample.sequence, accepted.status)
    }

    /// Positions of a sample; 0 where the joint has none.
    fn positions(&self, sample: &Sample) -> Positions {
        let mut motor = sample.motor_position;
        motor[self.motors..].fill(0.0);
        Positions { link: if self.flexible { sample.link_position } else { 0.0 }, motor }
    }

    /// Filters at rest where the joint is now; what has been learned is kept.
    fn restart(&mut self, now: &Inputs) {
        self.link = Channel::rest(now.at.link);
        for (i, side) in self.sides.iter_mut().enumerate() {
            side.restart(now.at.motor[i], now.at.deflection(i), now.torque[i]);
        }
        self.noise.iter_mut().chain(&mut self.torque_noise).for_each(NoiseMeter::restart);
        let carried = self.carried(&now.present).map_or(0.0, |carried| carried.torque);
        self.momentum.iter_mut().for_each(|momentum| momentum.restart(now.present.link, carried));
        self.last = *now;
        self.unsettled = self.settle;
        self.said = if self.started { self.said_periods } else { 0 };
        self.started = true;
    }

    /// One period: filters, and each motor's row where the motion teaches something.
    fn advance(&mut self, now: &Inputs) {
        let usable = self.unsettled <= 0;
        self.tick += 1;
        self.link.smooth(&self.filters, now.at.link);
        self.measure_noise(now, usable);
        let period = self.period;
        let (look, time) = (self.tick % self.looks == 0, self.tick as f64 * period);
        let mut shifts = [None; MOTORS];
        for i in 0..self.motors {
            let noise = self.noise_of(i);
            let torque_noise = self.torque_noise[i].variance(f64::INFINITY);
            let side = &mut self.sides[i];
            let moment = Moment { now, last: &self.last, link: &self.link, time, usable };
            side.feed(&self.filters, i, &moment);
            if side.rigid {
                continue;
            }
            if look && usable {
                side.tune(&self.link, noise);
            }
            if look {
                let gain = self.rate_gain * (noise[0] + noise[1]).sqrt();
                side.update_excitation(
                    &self.link,
                    now.at.deflection(i),
                    gain,
                    usable,
                    self.looks as f64 * period,
                );
            }
            if usable && side.excited {
                side.blocks.spoilt = self.refused.is_some();
                shifts[i] = side.learn(&self.link, noise, torque_noise, &self.noise_gains);
            }
        }
        if self.momentum.is_some() {
            let (measured, late) = (self.measured, now.late);
            let now = &now.present;
            let carried = self.carried(now).map(|carried| carried.torque);
            let lost = self.sides.iter().any(|side| side.blocks.is_lost());
            if let Some(momentum) = &mut self.momentum {
                momentum.note_zero(lost);
                momentum.feed(now.link, carried, measured, late);
            }
        }
        self.last = *now;
        self.unsettled -= 1;
        let (mut late, mut lost) = (None, [false; MOTORS]);
        for (i, shift) in shifts.into_iter().enumerate() {
            match shift {
                Some(Shift::Late(periods)) => late = Some(periods),
                Some(Shift::Zero(off)) => self.recentre(i, off),
                Some(Shift::Lost) => lost[i] = true,
                None => {}
            }
        }
        if lost.contains(&true) {
            self.lose_here(lost);
        } else if let Some(periods) = late {
            self.shift(periods);
        }
    }

    /// Noise is that of usual times: what lies is not measured by it.
    fn measure_noise(&mut self, now: &Inputs, usable: bool) {
        let doubtful = !usable || self.sides.iter().any(|side| side.doubtful);
        let period = self.period;
        let see = |meter: &mut NoiseMeter, value: f64| {
            if doubtful && meter.is_known() { meter.restart() } else { meter.update(value, period) }
        };
        see(&mut self.noise[self.motors], now.at.link);
        for i in 0..self.motors {
            see(&mut self.noise[i], now.at.motor[i]);
            see(&mut self.torque_noise[i], now.torque[i]);
        }
    }

    /// Variance of θ's and of q's noise, rad².
    fn noise_of(&self, i: usize) -> [f64; 2] {
        let resolution = self.validator.resolution();
        [i, self.motors].map(|k| self.noise[k].variance(resolution[k]))
    }

    /// What the transmissions do to the link; `None` where a curve is not trusted.
    fn carried(&self, now: &Positions) -> Option<Carried> {
        let pulls = if self.arrangement == Arrangement::Antagonistic { self.motors } else { 1 };
        let mut all = Carried::default();
        for (i, side) in self.sides[..pulls].iter().enumerate() {
            all = all.and(side.carried(now.deflection(i), self.noise_of(i)[0])?);
        }
        Some(all)
    }
}
