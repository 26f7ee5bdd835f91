//! Mode "balance": eq 5 as rows of columns, rows as blocks, and the estimate as algebra on their sum.
//!
//! Each tick: check the sample, correct it, bridge a gap, align the channels, filter them, add each motor's row;
//! a full block solves. Torque and stiffness are the curve's at the deflection of this moment.

use crate::align::{Alignment, Inputs, Positions};
use crate::balance::{Balance, Size, correlated_rows};
use crate::blocks::{Blocks, Closed};
use crate::corrections::Corrections;
use crate::deflection::{DeflectionFilter, Present, Tuning};
use crate::effects::{Coordinates, MotorEffects};
use crate::error::Error;
use crate::gram::Row;
use crate::model::{Arrangement, Model, Motor};
use crate::noise::NoiseMeter;
use crate::reasons::{Reason, Why};
use crate::sample::{Estimate, MOTORS, Sample, TransmissionEstimate, joint_estimate, status};
use crate::sample_validator::SampleValidator;
use crate::settings::{Priors, Settings};
use crate::signals::{Channel, Excitation, Filters};

const SETTLE_DELAYS: f64 = 4.5; // filter delays after which a wrong start is forgotten
const LOOK_S: f64 = 0.03; // between two looks at the excitation: the filters' correlation time at 60 rad/s
const BRIDGED: f64 = 0.4; // rad that the filter turns by in a gap: a longer one is not learned from
const USEFUL: f64 = 0.2; // share of the torque that a curve may leave unexplained
const BEYOND: f64 = 1.5; // times the largest deflection: no more is known of the curve
const HALF: f64 = 0.5; // periods: what is later is shifted, the rest is a column

/// One motor: its columns, what they have taught, and its declared effects.
#[derive(Clone, Debug)]
struct Side {
    rigid: bool,
    inertia: f64,
    damping: f64,
    balance: Balance,
    deflection: DeflectionFilter,
    acting: f64, // torque of the transmission at the last sample
    stiffness: f64,
    blocks: Blocks,
    effects: MotorEffects,
    effect: f64,
    excitation: Excitation,
    excited: bool,
    doubtful: bool,
    fits: bool,
}

/// See the module.
#[derive(Clone, Debug)]
pub struct Balanced {
    arrangement: Arrangement,
    motors: usize,
    flexible: bool,
    period: f64,
    filters: Filters,
    rate_gain: f64,
    settle: i64,
    looks: u64,
    validator: SampleValidator,
    corrections: Corrections,
    alignment: Alignment,
    sides: Vec<Side>,
    link: Channel,
    noise: [NoiseMeter; MOTORS + 1],
    last: Inputs,
    begins: bool,
    tick: u64,
    unsettled: i64,
    valid_within: f64,
    why: Option<Why>,
    estimate: Option<Estimate>,
}

impl Balanced {
    /// For a model that has been checked.
    ///
    /// # Errors
    /// An effect is where it does not belong.
    pub fn new(
        model: &Model,
        settings: &Settings,
        priors: &Priors,
        period_s: f64,
    ) -> Result<Balanced, Error> {
        let filters = Filters::new(settings.bandwidth, period_s);
        let effects: Vec<MotorEffects> =
            model.motors.iter().map(|motor| MotorEffects::new(&motor.effects)).collect::<Result<_, _>>()?;
        let corrections = Corrections::new(&effects, &model.link_effects, period_s)?;
        let rows = correlated_rows(&filters.main, period_s);
        let looks = (LOOK_S / period_s).round().max(1.0) as u64;
        let side = |(motor, effects): (&Motor, MotorEffects)| Side {
            rigid: !motor.flexible(),
            inertia: motor.inertia,
            damping: motor.damping,
            balance: Balance::new(),
            deflection: DeflectionFilter::new(
                motor.inertia,
                motor.damping,
                filters.main.bandwidth,
                period_s,
                looks as f64 * period_s,
            ),
            acting: 0.0,
            stiffness: 0.0,
            blocks: Blocks::new(motor, priors, period_s, rows, settings.false_alarms_per_hour),
            effects,
            effect: 0.0,
            excitation: Excitation::default(),
            excited: false,
            doubtful: false,
            fits: false,
        };
        let settle = (SETTLE_DELAYS * filters.delay / period_s).ceil() as i64;
        Ok(Balanced {
            arrangement: model.arrangement,
            motors: model.motors.len(),
            flexible: model.has_deflection(),
            period: period_s,
            filters,
            rate_gain: filters.rate_gain(period_s),
            settle,
            looks,
            validator: SampleValidator::new(model, period_s),
            corrections,
            alignment: Alignment::default(),
            sides: model.motors.iter().zip(effects).map(side).collect(),
            link: Channel::rest(0.0),
            noise: [NoiseMeter::default(); MOTORS + 1],
            last: Inputs::default(),
            begins: true,
            tick: 0,
            unsettled: settle,
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
        self.noise = [NoiseMeter::default(); MOTORS + 1];
        (self.begins, self.tick, self.estimate) = (true, 0, None);
        for side in &mut self.sides {
            (side.balance, side.excitation, side.effect) = (Balance::new(), Excitation::default(), 0.0);
            (side.excited, side.doubtful, side.fits) = (false, false, false);
            side.blocks.clear();
            side.deflection.reset();
            (side.acting, side.stiffness) = (0.0, 0.0);
            side.effects.motor.reset();
            side.effects.transmission.reset();
        }
    }

    /// The next sample may not be of its moment: learn nothing until the filters have forgotten it.
    pub fn distrust(&mut self) {
        self.unsettled = self.settle;
        self.sides.iter_mut().for_each(|side| side.blocks.cut());
    }

    /// Effects of one motor that nobody declared and evidence chose.
    pub fn undeclared(&self, motor: usize) -> impl Iterator<Item = &'static str> {
        self.sides[motor].blocks.undeclared()
    }

    /// Why the last estimate is not valid; `None`: it is.
    #[must_use]
    pub fn why(&self) -> Option<Why> {
        self.why
    }

    /// The estimate at this sample, whatever floats it holds.
    pub fn step(&mut self, sample: &Sample) -> Estimate {
        let accepted = self.validator.check(sample);
        let corrected = (accepted.periods > 0).then(|| self.corrections.correct(sample, accepted.restart));
        let Some(corrected) = corrected.flatten() else {
            return self.carry(sample.sequence, accepted.status);
        };
        let mut torque = corrected.aligned.motor_torque;
        torque[self.motors..].fill(0.0);
        let (at, present) = (self.positions(&corrected.aligned), self.positions(&corrected.present));
        let begins = std::mem::take(&mut self.begins) || accepted.restart;
        let inputs = self.alignment.align(&Inputs { at, torque, present }, begins);
        if accepted.frozen {
            self.distrust();
        }
        if begins {
            self.restart(&inputs);
        } else {
            let (from, periods) = (self.last, f64::from(accepted.periods));
            for k in 1..accepted.periods {
                self.advance(&from.towards(&inputs, f64::from(k) / periods));
            }
            self.advance(&inputs);
            if periods > 2.0 && periods * self.period * self.filters.main.bandwidth > BRIDGED {
                self.distrust();
            }
        }
        self.conclude(sample.sequence, accepted.status)
    }

    fn positions(&self, sample: &Sample) -> Positions {
        let mut motor = sample.motor_position;
        motor[self.motors..].fill(0.0);
        Positions { link: if self.flexible { sample.link_position } else { 0.0 }, motor }
    }

    /// Filters at rest where the joint is now; what has been learned is kept.
    fn restart(&mut self, now: &Inputs) {
        self.link = Channel::rest(now.at.link);
        for (i, side) in self.sides.iter_mut().enumerate() {
            side.balance.restart(now.at.motor[i], now.at.deflection(i), now.torque[i]);
            side.blocks.cut();
            side.deflection.restart(now.at.motor[i], now.at.deflection(i));
        }
        self.noise.iter_mut().for_each(NoiseMeter::restart);
        self.last = *now;
        self.unsettled = self.settle;
    }

    /// One period: filters, and each motor's row where the motion teaches something.
    fn advance(&mut self, now: &Inputs) {
        let usable = self.unsettled <= 0;
        self.tick += 1;
        self.link.smooth(&self.filters, now.at.link);
        self.noise[self.motors].see(now.at.link, self.period);
        let look = self.tick % self.looks == 0;
        let mut shift = None;
        for i in 0..self.motors {
            self.noise[i].see(now.at.motor[i], self.period);
            let resolution = self.validator.resolution();
            let noises = [i, self.motors].map(|k| self.noise[k].variance(resolution[k]));
            let noise = noises[0] + noises[1];
            let (theta, phi) = (now.at.motor[i], now.at.deflection(i));
            let side = &mut self.sides[i];
            side.effect(&self.link, self.tick as f64 * self.period, self.period);
            side.balance.feed(&self.filters, theta, phi, now.torque[i], &self.link, side.effect);
            if side.rigid {
                continue;
            }
            let acted = self.last.torque[i] + side.acting - side.effect;
            side.deflection.update(theta, phi, acted);
            if look && usable {
                side.tune(&self.link, noises);
            }
            if look {
                let rate = self.link.main[1] - side.balance.rate();
                let (gain, dt) = (self.rate_gain * noise.sqrt(), self.looks as f64 * self.period);
                side.excited = side.excitation.update(rate, gain, usable, !side.doubtful, dt);
            }
            side.balance.observe(phi, usable && side.excited);
            if look && usable && side.excited && side.blocks.are_few() && side.balance.outgrown() {
                side.balance.scale(phi);
                side.blocks.rescale(side.balance.size.deflection);
                self.unsettled = self.settle;
            } else if usable && side.excited && side.balance.size != Size::default() {
                side.blocks.resolution = (12.0 * noise).sqrt();
                shift = side.learn(&self.link, self.period).or(shift);
            }
        }
        self.last = *now;
        self.unsettled -= 1;
        if let Some(periods) = shift {
            self.shift(periods);
        }
    }

    /// The link is later than was assumed: what was learned is of other moments.
    fn shift(&mut self, periods: f64) {
        self.alignment.shift(periods);
        self.unsettled = self.settle;
        self.sides.iter_mut().for_each(|side| side.blocks.clear());
    }

    fn conclude(&mut self, sequence: u64, flags: u32) -> Estimate {
        let (mut flags, settled) = (flags, self.unsettled <= 0);
        let parts = self.read();
        for side in self.sides.iter_mut().filter(|side| !side.rigid) {
            let at = side.read(side.deflection.at(0.0));
            let known = side.fits && at.stiffness > 0.0;
            side.stiffness = if known { at.stiffness } else { 0.0 };
            side.acting = if known { at.flexibility_torque - side.blocks.offset() } else { side.left() };
        }
        let elastic = |side: &&Side| !side.rigid;
        let rejected = flags & status::INPUT_REJECTED != 0;
        let why = |(i, side): (usize, &Side)| {
            Some(Why::new(side.reason(&parts[i], self.valid_within, settled)?, Some(i)))
        };
        self.why = self.sides.iter().enumerate().find_map(why);
        if rejected {
            self.why = Some(Why::new(Reason::Rejected, None));
        }
        if self.sides.iter().any(|side| side.doubtful) {
            flags |= status::CHANGED;
        }
        if self.why.is_none() {
            flags |= status::VALID;
            if settled && self.flexible && self.sides.iter().filter(elastic).all(|side| side.excited) {
                flags |= status::OBSERVABLE;
            }
        }
        let estimate = joint_estimate(self.arrangement, sequence, flags, parts, self.motors);
        self.estimate = Some(estimate);
        estimate
    }

    fn carry(&mut self, sequence: u64, flags: u32) -> Estimate {
        self.why = Some(Why::new(Reason::Rejected, None));
        match self.estimate {
            Some(last) => Estimate { sequence, status: flags | last.status & status::CHANGED, ..last },
            None => joint_estimate(self.arrangement, sequence, flags, self.read(), self.motors),
        }
    }

    fn read(&self) -> [TransmissionEstimate; MOTORS] {
        let waited = self.corrections.age_s() + self.alignment.periods.abs() * self.period;
        let behind_s = self.corrections.behind_s();
        let mut parts = [TransmissionEstimate::NOTHING; MOTORS];
        for (i, side) in self.sides.iter().enumerate() {
            let present = Present { phi: self.last.present.deflection(i), behind_s, ahead_s: waited };
            parts[i] = side.read(if side.rigid { present.phi } else { side.deflection.now(&present) });
        }
        parts
    }
}

impl Side {
    /// x_motor − x_transmission of the declared effects at this moment, N·m.
    fn effect(&mut self, link: &Channel, time: f64, period_s: f64) {
        if self.effects.is_empty() {
            return;
        }
        let light = *self.balance.light();
        let phi = link.light[0] - light[0];
        let known = self.read(phi);
        let number = |x: f64| if x.is_finite() { x } else { 0.0 };
        let c = Coordinates {
            position: light[0] - self.effects.offset,
            velocity: light[1],
            acceleration: light[2],
            deflection: phi,
            deflection_rate: link.light[1] - light[1],
            flexibility_torque: number(known.flexibility_torque),
            stiffness: number(known.stiffness),
            torque: self.balance.light_torque(),
            time,
            ..Coordinates::default()
        };
        let (motor, transmission) = self.effects.balance(&c, period_s);
        self.effect = motor - transmission;
    }

    /// Add the row of this moment; by how many periods the link has been found late.
    fn learn(&mut self, link: &Channel, period_s: f64) -> Option<f64> {
        let row: Row = self.balance.row(link);
        let closed = self.blocks.add(&row)?;
        self.doubtful = closed != Closed::Added;
        self.fits = self.blocks.unexplained() < USEFUL;
        let (late, std) = self.blocks.delay()?;
        let periods = late / period_s;
        (periods.abs() > HALF && periods.abs() - HALF > 3.0 * std / period_s).then(|| periods.round())
    }

    /// What the motor's balance leaves as the transmission's torque (eq 14), late by the filters.
    fn left(&self) -> f64 {
        let light = self.balance.light();
        self.inertia * light[2] + self.damping * light[1] + self.effect - self.balance.light_torque()
    }

    fn tune(&mut self, link: &Channel, noise: [f64; 2]) {
        self.deflection.tune(&Tuning {
            jerk: link.main[3] - self.balance.jerk(),
            motor_noise: noise[0],
            link_noise: noise[1],
            inertia: self.inertia,
            damping: self.damping,
            stiffness: self.stiffness,
            unmodelled: if self.fits { self.blocks.unmodelled() } else { f64::INFINITY },
        });
    }

    /// Why the estimate at this moment may not be used.
    fn reason(&self, part: &TransmissionEstimate, valid_within: f64, settled: bool) -> Option<Reason> {
        if self.rigid {
            return None;
        }
        if self.blocks.posterior.is_none() {
            return Some(if settled { Reason::Unmoved } else { Reason::Settling });
        }
        if self.doubtful {
            return Some(Reason::Changed);
        }
        if !self.fits {
            return Some(Reason::Unexplained(self.blocks.unexplained()));
        }
        let within = part.deflection.abs() < BEYOND * self.balance.largest();
        Reason::of_precision(part.stiffness, part.stiffness_std, valid_within)
            .or((!within).then_some(Reason::Beyond))
    }

    /// Torque, stiffness and its standard deviation at a deflection.
    fn read(&self, phi: f64) -> TransmissionEstimate {
        let mut part = TransmissionEstimate { deflection: phi, ..TransmissionEstimate::NOTHING };
        if self.rigid {
            part.flexibility_torque = self.left();
        } else if let Some(known) = &self.blocks.posterior {
            let (torque, stiffness) = self.balance.slopes(phi, known.set);
            let along = |g: &Row| -g.iter().zip(&known.residual).map(|(g, c)| g * c).sum::<f64>();
            part.flexibility_torque = along(&torque);
            part.stiffness = along(&stiffness);
            // A stiffness that changes with φ is as uncertain as φ is.
            let near = self.balance.slopes(phi + self.deflection.variance().sqrt(), known.set).1;
            part.stiffness_std = known.variance_along(&stiffness).sqrt().hypot(along(&near) - part.stiffness);
        }
        part
    }
}
