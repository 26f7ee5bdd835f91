//! Mode "robust": the estimator for real drives' signals.
//!
//! Each tick, in order: validate the input, correct the readings, bridge gaps, align the channels, filter them,
//! track the deflection; at intervals of the errors' correlation time update the recursive estimation with a
//! motor's balance; evaluate torque and stiffness on the curve.

use crate::align::{Alignment, Inputs, Positions};
use crate::deflection::Present;
use crate::delay::{DelaySearch, Known};
use crate::effects::{Corrections, MotorEffects};
use crate::error::Error;
use crate::external::{Carried, External, LinkMomentum};
use crate::isolation::Verdict;
use crate::laws::Law;
use crate::model::{Arrangement, Model, Motor};
use crate::noise::NoiseMeter;
use crate::reasons::{Reason, Why};
use crate::sample::{Estimate, MOTORS, Sample, TransmissionEstimate, joint_estimate, status};
use crate::sample_validator::SampleValidator;
use crate::settings::{Priors, Settings};
use crate::signals::{Channel, Filters};
use crate::suspicion::{Suspicion, suspected};
use crate::transmission::{Moment, TransmissionEstimator};

const SAID_S: f64 = 0.5; // how long a restart is reported
const TRUST_S: f64 = 0.02; // how long an estimate is carried over rejected samples
const FORESEEN_S: f64 = 0.04; // how far ahead a deflection is extrapolated
const HOME: f64 = 0.01; // of a jump: what is as near to the first zero is that zero again
const UPDATE_S: f64 = 0.03; // between two equations of a motor, at the usual bandwidth; shorter above it …
const UPDATE_PHASE: f64 = 1.8; // … so that the bandwidth turns by no more than this, rad
const SETTLE_DELAYS: f64 = 4.5; // filter delays after which a wrong start is forgotten
const BRIDGED: f64 = 0.4; // rad that the filter turns by in a gap: a longer one is not learned from
const SMALL_DELAY: f64 = 0.1; // periods: left to the regression

/// See the module.
#[derive(Clone, Debug)]
pub struct Robust {
    arrangement: Arrangement,
    flexible: bool,
    motors: usize,
    period: f64,
    filters: Filters,
    every: u64, // periods between two equations of a motor
    settle: i64,
    validator: SampleValidator,
    corrections: Corrections,
    alignment: Alignment,
    search: DelaySearch,
    lead: usize, // the motor whose balance determines the link encoder's delay
    transmissions: Vec<TransmissionEstimator>,
    link: Channel,
    momentum: Option<LinkMomentum>,
    external: Option<External>,
    noise: [NoiseMeter; MOTORS + 1],
    zeros: Positions, // where the encoders' zeros have moved to
    last: Inputs,
    begins: bool,                      // with the next sample that the corrections let pass …
    jumped: Option<[f64; MOTORS + 1]>, // … after encoders moved their zeros
    measured: f64,                     // τ_k
    tick: u64,
    unsettled: i64, // periods for which the filters still hold something wrong
    said: i64,
    rejected: i64,
    started: bool,
    sequence: u64,                     // of the last sample that was used
    refused: Option<(Suspicion, i64)>, // what was wrong with a sample of late, and for how long that is said
    estimate: Option<Estimate>,
    why: Option<(Reason, Option<usize>)>, // of the last estimate
}

impl Robust {
    /// For a model that has been checked.
    ///
    /// # Errors
    /// An effect is where it does not belong.
    pub fn new(model: &Model, settings: &Settings, priors: &Priors, period_s: f64) -> Result<Robust, Error> {
        let filters = Filters::new(settings.bandwidth, period_s);
        let update_s = UPDATE_S.min(UPDATE_PHASE / settings.bandwidth);
        let every = 2 * (0.5 * update_s / period_s).round().max(1.0) as u64;
        let effects: Vec<MotorEffects> =
            model.motors.iter().map(|motor| MotorEffects::new(&motor.effects)).collect::<Result<_, _>>()?;
        let corrections = Corrections::new(&effects, &model.link_effects, period_s)?;
        let dt = every as f64 * period_s;
        let own = |motor: &Motor| Priors {
            motor_inertia: motor.inertia_std.unwrap_or(priors.motor_inertia),
            ..*priors
        };
        let transmissions: Vec<TransmissionEstimator> = (model.motors.iter().zip(effects))
            .map(|(motor, effects)| {
                TransmissionEstimator::new(motor, effects, settings, &own(motor), &filters, period_s, dt)
            })
            .collect();
        let lead = model.motors.iter().position(|motor| motor.flexible()).unwrap_or(0);
        let known = Known {
            inertia: model.motors[lead].inertia,
            damping: model.motors[lead].damping,
            inertia_std: own(&model.motors[lead]).motor_inertia,
            damping_std: priors.viscous_damping,
            damping_share: priors.viscous_damping_floor,
        };
        let mut made = Robust {
            arrangement: model.arrangement,
            flexible: model.has_deflection(),
            motors: model.motors.len(),
            period: period_s,
            filters,
            every,
            settle: (SETTLE_DELAYS * filters.delay / period_s).ceil() as i64,
            validator: SampleValidator::new(model, period_s),
            corrections,
            alignment: Alignment::default(),
            search: DelaySearch::new(&known, filters.main.bandwidth, period_s),
            lead,
            transmissions,
            link: Channel::rest(0.0),
            momentum: LinkMomentum::new(model, settings, priors, period_s),
            external: None,
            noise: [NoiseMeter::default(); MOTORS + 1],
            zeros: Positions::default(),
            last: Inputs::default(),
            begins: true,
            jumped: None,
            measured: f64::NAN,
            tick: 0,
            unsettled: 0,
            said: 0,
            rejected: 0,
            started: false,
            sequence: 0,
            refused: None,
            estimate: None,
            why: None,
        };
        made.reset();
        Ok(made)
    }

    /// Forget everything.
    pub fn reset(&mut self) {
        self.validator.reset();
        self.corrections.reset();
        self.alignment = Alignment::default();
        self.search.reset();
        self.transmissions.iter_mut().for_each(TransmissionEstimator::reset);
        self.momentum.iter_mut().for_each(LinkMomentum::reset);
        self.external = None;
        self.noise = [NoiseMeter::default(); MOTORS + 1];
        (self.zeros, self.last) = (Positions::default(), Inputs::default());
        (self.begins, self.jumped) = (true, None);
        (self.tick, self.unsettled, self.said, self.rejected) = (0, self.settle, 0, 0);
        (self.started, self.sequence, self.refused, self.estimate) = (false, 0, None, None);
        self.why = None;
    }

    /// The next sample may not be of its moment: learn nothing until the filters have forgotten it.
    pub fn distrust(&mut self) {
        self.unsettled = self.settle;
        self.momentum.iter_mut().for_each(LinkMomentum::distrust);
        self.search.begin();
    }

    /// What the world does to the link, by the last sample; `None` where no link dynamics are declared.
    #[must_use]
    pub fn external(&self) -> Option<External> {
        self.external
    }

    /// See [`crate::external::Said::consistency`].
    #[must_use]
    pub fn consistency(&self) -> Option<[f64; 2]> {
        self.momentum.as_ref()?.said.consistency()
    }

    /// Largest misfit among the motors' balances at the last update, N·m; NaN until there is a model.
    #[must_use]
    pub fn residual(&self) -> f64 {
        self.transmissions.iter().map(|transmission| transmission.misfit().abs()).fold(f64::NAN, f64::max)
    }

    /// The reading that is suspected, while something is.
    #[must_use]
    pub fn suspicion(&self) -> Option<Suspicion> {
        self.refused.map(|(refused, _)| refused).or_else(|| suspected(&self.transmissions))
    }

    /// Why the last estimate is not valid; `None`: it is.
    #[must_use]
    pub fn why(&self) -> Option<Why> {
        let (reason, motor) = self.why?;
        let mut why = Why::new(reason, motor);
        if let (Reason::Changed, Some(motor)) = (reason, motor) {
            why.changes = self.transmissions[motor].likely_changes();
        }
        Some(why)
    }

    /// What the window of one motor's balance says of all changes; `None` before there is a reference.
    #[must_use]
    pub fn verdict(&self, motor: usize) -> Option<&Verdict> {
        self.transmissions[motor].verdict()
    }

    /// Parameters of one motor's transmission and their standard deviations; the law they belong to.
    pub fn parameters(&self, motor: usize, values: &mut Vec<f64>, std: &mut Vec<f64>) -> Option<&Law> {
        self.transmissions[motor].parameters(values, std)
    }

    /// The estimate at this sample, whatever floats it holds.
    pub fn step(&mut self, sample: &Sample) -> Estimate {
        // Can it be used, and how far is it from the last one that was?
        let accepted = self.validator.check(sample);
        self.refused = match (accepted.suspicion, self.refused) {
            (Some(now), _) => Some((now, (SAID_S / self.period).round() as i64)),
            (None, before) => before.map(|(was, left)| (was, left - 1)).filter(|(_, left)| *left > 0),
        };
        if accepted.periods == 0 {
            return self.carry(sample.sequence, accepted.status);
        }
        self.begins |= accepted.restart;
        if let Some(jumps) = accepted.jumps {
            let before = self.jumped.unwrap_or_default();
            self.jumped = Some(std::array::from_fn(|k| before[k] + jumps[k]));
        }
        let Some(corrected) = self.corrections.correct(sample, accepted.restart) else {
            return self.carry(sample.sequence, accepted.status);
        };
        self.rejected = 0;
        self.measured = corrected.present.external_torque;
        let (at, present) = (self.positions(&corrected.aligned), self.positions(&corrected.present));
        if let Some(jumps) = self.jumped.take() {
            self.move_zeros(jumps, &at, sample.sequence);
        }
        self.sequence = sample.sequence;
        let mut torque = corrected.aligned.motor_torque;
        torque[self.motors..].fill(0.0);
        let inputs =
            Inputs { at: at.from_zeros(&self.zeros), torque, present: present.from_zeros(&self.zeros) };
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

    /// One period: filters, deflections, and, when its turn has come, what a motor's balance teaches.
    fn advance(&mut self, now: &Inputs) {
        let usable = self.unsettled <= 0;
        self.tick += 1;
        self.link.smooth(&self.filters, now.at.link);
        // Noise is that of usual times: what lies is not measured by it.
        let doubtful = !usable || self.transmissions.iter().any(TransmissionEstimator::changed);
        let mut see = |place: usize, value: f64| {
            if doubtful && self.noise[place].is_known() {
                self.noise[place].restart();
            } else {
                self.noise[place].see(value, self.period);
            }
        };
        see(self.motors, now.at.link);
        let time = self.tick as f64 * self.period;
        for (i, transmission) in self.transmissions.iter_mut().enumerate() {
            let (theta, torque, before) = (now.at.motor[i], now.torque[i], self.last.torque[i]);
            transmission.feed(&self.filters, theta, now.at.deflection(i), torque, before, usable);
            transmission.feed_effects(&self.filters, &self.link, time);
            see(i, theta);
        }
        if self.momentum.is_some() {
            let (now, measured) = (&now.present, self.measured);
            let carried = self.carried(now).map(|carried| carried.torque);
            self.momentum.iter_mut().for_each(|momentum| momentum.feed(now.link, carried, measured));
        }
        self.last = *now;
        self.unsettled -= 1;
        let turn = self.every / self.motors as u64;
        if self.tick % turn == 0 {
            let i = (self.tick / turn % self.motors as u64) as usize;
            self.update(i, usable);
        }
        if self.flexible {
            let (motor, torque) = (now.at.motor[self.lead], now.torque[self.lead]);
            if let Some(late) = self.search.see(now.at.link, motor, torque, usable) {
                self.realign(late);
            }
        }
    }

    /// What the transmissions do to the link; `None` where a curve is not trusted.
    fn carried(&self, now: &Positions) -> Option<Carried> {
        let pulls = if self.arrangement == Arrangement::Antagonistic { self.motors } else { 1 };
        let mut all = Carried::default();
        for (i, transmission) in self.transmissions[..pulls].iter().enumerate() {
            let noise = self.noise[i].variance(self.validator.resolution()[i]);
            all = all.and(transmission.carried(now.deflection(i), noise)?);
        }
        Some(all)
    }

    /// One equation of one motor, and what follows from it.
    fn update(&mut self, i: usize, usable: bool) {
        let resolution = *self.validator.resolution();
        let m = self.motors;
        let noise = [self.noise[i].variance(resolution[i]), self.noise[m].variance(resolution[m])];
        let transmission = &mut self.transmissions[i];
        if transmission.is_rigid() {
            return;
        }
        if transmission.update(&self.filters, &Moment { link: self.link.main, usable, noise }) {
            self.unsettled = self.settle;
            return;
        }
        if !usable || !self.search.looked() {
            return;
        }
        if let Some(late) = transmission.take_delay() {
            let taken = self.alignment.shift(late);
            transmission.shift_delay(taken);
            self.distrust(); // which of the channels waits for which has changed
        }
    }

    /// The link encoder has been found late by so many periods: what was learned is void.
    fn realign(&mut self, late: f64) {
        if late.abs() < SMALL_DELAY || self.transmissions.iter().any(TransmissionEstimator::changed) {
            return;
        }
        self.alignment.shift(late);
        self.unsettled = self.settle;
        self.momentum.iter_mut().for_each(LinkMomentum::distrust);
        for (i, transmission) in self.transmissions.iter_mut().enumerate() {
            transmission.relearn();
            transmission.deflection.restart(self.last.at.motor[i], self.last.at.deflection(i));
        }
    }

    /// Everything that has a past begins anew where the joint is now; what has been learned is kept.
    fn restart(&mut self, now: &Inputs) {
        self.link = Channel::rest(now.at.link);
        for (i, transmission) in self.transmissions.iter_mut().enumerate() {
            transmission.restart(now.at.motor[i], now.at.deflection(i), now.torque[i]);
        }
        self.noise.iter_mut().for_each(NoiseMeter::restart);
        let carried = self.carried(&now.present).map_or(0.0, |carried| carried.torque);
        self.momentum.iter_mut().for_each(|momentum| momentum.restart(now.present.link, carried));
        self.search.restart(now.at.link, now.at.motor[self.lead], now.torque[self.lead]);
        self.last = *now;
        self.unsettled = self.settle;
        self.said = if self.started { (SAID_S / self.period).round() as i64 } else { 0 };
        self.started = true;
    }

    /// Encoders have moved their zeros: go on as if they had not.
    fn move_zeros(&mut self, mut jumps: [f64; MOTORS + 1], at: &Positions, sequence: u64) {
        let m = self.motors;
        let ahead =
            (sequence.wrapping_sub(self.sequence) as f64 + self.alignment.periods.abs()) * self.period;
        // A deflection that went on as it was measures a jump; the validator is coarse.
        let now = at.from_zeros(&self.zeros);
        for i in 0..m {
            let transmission = &self.transmissions[i];
            if ahead > FORESEEN_S || transmission.is_rigid() || transmission.deflection.unsettled > 0 {
                continue;
            }
            let off = now.deflection(i) - transmission.deflection.at(ahead);
            if jumps[i] != 0.0 && jumps[m] == 0.0 {
                jumps[i] = -off;
            } else if jumps[m] != 0.0 && jumps[i] == 0.0 {
                jumps[m] = off;
            }
        }
        let moved = |zero: f64, jump: f64| {
            // One that jumps back has come home exactly.
            let moved = zero + jump;
            if moved.abs() < HOME * jump.abs() { 0.0 } else { moved }
        };
        for i in 0..m {
            self.zeros.motor[i] = moved(self.zeros.motor[i], jumps[i]);
        }
        if self.flexible {
            self.zeros.link = moved(self.zeros.link, jumps[m]);
        }
        let now = at.from_zeros(&self.zeros);
        for (i, transmission) in self.transmissions.iter_mut().enumerate() {
            let known = !transmission.is_beyond(now.deflection(i));
            if !known {
                self.zeros.motor[i] = at.motor[i] - now.link; // in the middle of where it can be
            }
            transmission.reopen_deflection_offset(known);
        }
    }

    /// What is said of a sample that was used.
    fn conclude(&mut self, sequence: u64, flags: u32) -> Estimate {
        let (mut flags, mut observable) = (flags, self.flexible && self.unsettled <= 0);
        let (parts, why) = self.read(0.0);
        self.why = why;
        for transmission in &self.transmissions {
            if !transmission.is_rigid() {
                observable &= transmission.excited();
                if transmission.changed() {
                    flags |= status::CHANGED;
                }
            }
        }
        if flags & status::INPUT_REJECTED != 0 {
            self.why = Some((Reason::Rejected, None));
        }
        if self.why.is_none() {
            flags |= status::VALID;
            if observable {
                flags |= status::OBSERVABLE;
            }
        }
        if self.said > 0 {
            self.said -= 1;
            flags |= status::RESTARTED;
        }
        if self.momentum.is_some() {
            let valid = flags & status::VALID != 0;
            let carried = self.carried(&self.last.present).unwrap_or_default();
            let noise = self.noise[self.motors].variance(self.validator.resolution()[self.motors]);
            self.external =
                self.momentum.as_mut().map(|momentum| momentum.conclude(sequence, &carried, noise, valid));
        }
        let estimate = joint_estimate(self.arrangement, sequence, flags, parts, self.motors);
        self.estimate = Some(estimate);
        estimate
    }

    /// What is said where the sample cannot be used: the last estimate, for a while.
    fn carry(&mut self, sequence: u64, flags: u32) -> Estimate {
        self.rejected += 1;
        self.external = self.momentum.as_ref().map(|momentum| momentum.said.carry(sequence));
        let since = self.rejected as f64 * self.period;
        let Some(last) = self.estimate else {
            let (parts, _) = self.read(0.0);
            self.why = Some((Reason::Rejected, None));
            return joint_estimate(self.arrangement, sequence, flags, parts, self.motors);
        };
        let mut flags = flags | last.status & (status::CHANGED | status::RESTARTED);
        if since > TRUST_S {
            self.why = Some((Reason::Rejected, None));
            return Estimate { sequence, status: flags, ..last };
        }
        let (parts, why) = self.read(since);
        self.why = if last.status & status::VALID == 0 { self.why } else { why };
        if self.why.is_none() {
            flags |= status::VALID;
        }
        joint_estimate(self.arrangement, sequence, flags, parts, self.motors)
    }

    /// Each transmission's estimate, so long after the last sample, and why one of them is of no use.
    fn read(&mut self, since_s: f64) -> ([TransmissionEstimate; MOTORS], Option<(Reason, Option<usize>)>) {
        // What has been waited for the latest channel, declared late or found to be.
        let waited = self.corrections.age_s() + self.alignment.periods.abs() * self.period;
        let (mut parts, mut why) = ([TransmissionEstimate::NOTHING; MOTORS], None);
        for (i, transmission) in self.transmissions.iter_mut().enumerate() {
            let present = Present {
                phi: self.last.present.deflection(i),
                behind_s: self.corrections.behind_s(),
                ahead_s: since_s + waited,
            };
            let (part, reason) = transmission.estimate(&present, self.filters.delay);
            parts[i] = part;
            let unsettled = !transmission.is_rigid() && transmission.deflection.unsettled > 0;
            let starting = reason == Some(Reason::Unmoved) && self.unsettled > 0;
            let reason = if unsettled || starting { Some(Reason::Settling) } else { reason };
            why = why.or(reason.map(|reason| (reason, Some(i))));
        }
        (parts, why)
    }
}
