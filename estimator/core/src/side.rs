//! One motor and its transmission on line: its balance, what that has taught, and what it says at this moment.

mod estimate;

use serde::{Deserialize, Serialize};

use crate::align::Inputs;
use crate::balance::Balance;
use crate::blocks::{Blocks, Closed, Readings};
use crate::choices::{AHEAD_S, GROWN, REACHED, SAID_S, SETTLED, SURE};
use crate::deflection::{AT_REST, DeflectionFilter, Motion, Tuning};
use crate::effects::{Coordinates, Declared, MotorEffects};
use crate::model::Motor;
use crate::settings::Priors;
use crate::signals::{Channel, Excitation, Filters};
use crate::spring::Family;
use crate::unknowns::{DAMPING, INERTIA, RATE};

/// What a period brings to every motor.
#[derive(Clone, Copy, Debug)]
pub struct Moment<'a> {
    /// What is measured now …
    pub now: &'a Inputs,
    /// … and what was, a period before.
    pub last: &'a Inputs,
    /// q behind the filters.
    pub link: &'a Channel,
    /// Since the start, s.
    pub time: f64,
    /// Whether the filters hold nothing wrong.
    pub usable: bool,
    /// Variances of the noise of θ and q, rad².
    pub noise: [f64; 2],
}

/// What the inputs are shifted by, before anything is learned from them.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Shift {
    /// The link is so many periods late.
    Late(f64),
    /// The zero is at this deflection, rad.
    Zero(f64),
    /// The zero is not where it was.
    Lost,
}

/// One motor: its columns, what they have taught, and its declared effects.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct Side {
    /// Whether its transmission is rigid.
    pub rigid: bool,
    inertia: f64,
    damping: f64,
    period: f64,
    balance: Balance,
    /// The deflection of this moment.
    pub deflection: DeflectionFilter,
    acting: f64, // torque of the transmission at the last sample
    stiffness: f64,
    usual: Motion, // of blocks that were explained
    /// What has been learned.
    pub blocks: Blocks,
    effects: MotorEffects,
    theta: f64,         // of the last sample
    noise: [f64; 2],    // variances of θ's and q's, rad²
    declared: Declared, // what they do at this moment
    excitation: Excitation,
    /// Whether the motion reveals the stiffness.
    pub excited: bool,
    held_s: f64,
    /// Whether the last block is not explained.
    pub doubtful: bool,
    /// How long it is still said that a change has been followed, s.
    pub followed_s: f64,
    fits: bool,
    unexplained: f64,
    unconfirmed_s: f64, // of rows after an encoder has moved its zero
    renewed: bool,      // a lever has been moved
}

impl Side {
    /// Of one motor of a model that has been checked; `look_s`: between two looks at its motion.
    #[must_use]
    pub fn new(
        motor: &Motor,
        effects: MotorEffects,
        priors: &Priors,
        filters: &Filters,
        period_s: f64,
        look_s: f64,
        alarms_per_hour: f64,
    ) -> Side {
        let rows = filters.correlated_rows(period_s);
        let settle = (SETTLED * filters.delay / period_s).ceil() as u32;
        let blocks = Blocks::new(motor, priors, period_s, rows, settle, alarms_per_hour);
        let family = Family::of(Some(&blocks.spring.law));
        let mut made = Side {
            rigid: !motor.flexible(),
            inertia: motor.inertia,
            damping: motor.damping,
            period: period_s,
            balance: Balance::new(family),
            deflection: DeflectionFilter::new(
                motor.inertia,
                motor.damping,
                filters.main.bandwidth,
                period_s,
                look_s,
            ),
            usual: AT_REST,
            acting: 0.0,
            stiffness: 0.0,
            blocks,
            effects,
            theta: 0.0,
            noise: [0.0; 2],
            declared: Declared::default(),
            excitation: Excitation::default(),
            excited: false,
            held_s: 0.0,
            doubtful: false,
            followed_s: 0.0,
            fits: false,
            unexplained: f64::NAN,
            unconfirmed_s: 0.0,
            renewed: false,
        };
        made.reset();
        made
    }

    /// Forget everything.
    pub fn reset(&mut self) {
        self.balance.reset();
        self.deflection.reset();
        self.blocks.clear();
        self.effects.motor.reset();
        self.effects.transmission.reset();
        self.excitation = Excitation::default();
        self.declared = Declared::default();
        (self.acting, self.stiffness) = (0.0, 0.0);
        (self.excited, self.held_s, self.doubtful) = (false, 0.0, false);
        (self.followed_s, self.unconfirmed_s, self.renewed) = (0.0, 0.0, false);
        self.judge();
    }

    /// A lever has been moved: neither what has been learned of the spring nor what is declared is of this one.
    pub fn renew(&mut self) {
        self.blocks.relearn();
        self.blocks.spring.open();
        self.blocks.posterior = None;
        self.renewed = true;
        self.judge();
    }

    /// What follows is not as what was before.
    pub fn cut(&mut self) {
        self.blocks.close_early();
        self.judge();
    }

    /// Filters at rest where the joint is now; what has been learned is kept.
    pub fn restart(&mut self, theta: f64, phi: f64, torque: f64) {
        self.blocks.close_early();
        self.balance.restart(theta, phi, torque);
        self.deflection.restart(theta, phi);
        self.judge();
    }

    /// What has been learned is of other moments.
    pub fn relearn(&mut self, theta: f64, phi: f64) {
        self.blocks.relearn();
        self.deflection.restart(theta, phi);
        self.judge();
    }

    /// An encoder has moved its zero, `known`: by so much, or somewhere.
    pub fn move_zero(&mut self, known: bool) {
        self.unconfirmed_s = AHEAD_S;
        if known {
            self.blocks.close_early();
        } else {
            self.blocks.lose_zero();
            self.balance.forget_range();
        }
        self.judge();
    }

    /// Whether nothing has been learned, and no zero has been lost.
    #[must_use]
    pub fn knows_nothing(&self) -> bool {
        self.rigid || self.blocks.knows_nothing()
    }

    /// Whether a deflection after a restart can be told from one with another zero.
    #[must_use]
    pub fn may_be_as_before(&self, phi: f64) -> bool {
        self.rigid || self.blocks.is_reference() && self.is_within(phi)
    }

    /// The zero is believed again when blocks bear it out.
    pub fn suspect_zero(&mut self) {
        if !self.rigid {
            self.blocks.suspect_zero();
            self.judge();
        }
    }

    /// Whether the joint has changed, or has lately.
    #[must_use]
    pub fn has_changed(&self) -> bool {
        self.doubtful && !self.blocks.is_suspected() || self.followed_s > 0.0
    }

    /// Where its deflections are counted from has been moved to near the zero.
    pub fn recentre(&mut self, theta: f64, phi: f64, torque: f64) {
        self.restart(theta, phi, torque);
        self.blocks.recentre();
        self.balance.forget_range();
        self.balance.size.deflection = 0.0; // those before were as large as the zero was far
    }

    /// Whether a deflection is one that the joint can have.
    #[must_use]
    pub fn is_within(&self, phi: f64) -> bool {
        let largest = self.balance.largest();
        largest == 0.0 || phi.abs() <= GROWN * largest
    }

    /// One period of all channels of motor `i`.
    pub fn feed(&mut self, filters: &Filters, i: usize, moment: &Moment) {
        let Moment { now, last, link, time, usable, noise } = *moment;
        let (theta, phi, torque) = (now.at.motor[i], now.at.deflection(i), now.torque[i]);
        let few = self.blocks.are_few();
        // No spring is deflected beyond where its law ends.
        let can_be = few || !self.doubtful && phi.abs() < REACHED * self.blocks.spring.reach();
        if !self.rigid && can_be && self.balance.outgrown(phi) {
            let factors = self.balance.grow(phi);
            self.blocks.grow(&factors, &self.balance);
            self.judge();
        }
        (self.theta, self.noise) = (theta, noise);
        self.balance.read(filters, theta, torque);
        self.feed_effects(phi, link, time);
        self.balance.feed(filters, phi, link, &self.declared);
        self.balance.feed_rounding(filters, link.light[1], noise);
        self.followed_s -= self.period;
        self.held_s += self.period;
        if !self.rigid {
            let late_s = self.blocks.torque_lateness().0;
            let late = last.torque[i] + late_s * self.balance.light_torque()[1];
            let torque = late + self.acting - self.declared.formed + self.declared.elastic;
            self.deflection.update(theta, phi, torque, self.stiffness);
            self.balance.observe(phi, usable && can_be);
        }
    }

    /// The declared effects at this moment.
    fn feed_effects(&mut self, read_phi: f64, link: &Channel, time: f64) {
        if self.effects.is_empty() {
            return;
        }
        let light = *self.balance.light();
        let phi = link.light[0] - light[0];
        let known = self.blocks.at(phi, 0.0, &self.balance);
        let (flexibility_torque, stiffness) =
            known.map_or((0.0, 0.0), |known| (known.torque, known.stiffness));
        let c = Coordinates {
            position: light[0] - self.effects.offset,
            velocity: light[1],
            acceleration: light[2],
            deflection: phi,
            deflection_rate: link.light[1] - light[1],
            flexibility_torque,
            stiffness,
            torque: self.balance.light_torque()[0],
            time,
            ..Coordinates::default()
        };
        self.declared = self.effects.balance(&c, read_phi, self.period);
    }

    /// Does the motion reveal the stiffness? `gain`: standard deviation of the deflection's rate.
    pub fn update_excitation(&mut self, link: &Channel, phi: f64, gain: f64, usable: bool, dt: f64) {
        if self.blocks.are_few() {
            self.balance.fit_widths(phi);
        }
        let rate = link.main[1] - self.balance.rate();
        self.excited = self.excitation.update(rate, gain, usable, !self.doubtful, dt);
    }

    /// One step of the deflection's filter; `noise`: variances of θ and q.
    pub fn tune(&mut self, link: &Channel, noise: [f64; 2]) {
        let known = self.blocks.posterior.as_ref().filter(|known| known.set >> INERTIA & 1 == 1);
        let (inertia, damping, rate_damping) = known.map_or((self.inertia, self.damping, 0.0), |known| {
            (known.x[INERTIA], known.x[DAMPING], known.x[RATE])
        });
        self.deflection.tune(&Tuning {
            jerk: link.main[3] - self.balance.filtered().0[3],
            motor_noise: noise[0],
            link_noise: noise[1],
            inertia: if inertia > 0.0 { inertia } else { self.inertia },
            damping,
            rate_damping,
            unmodelled: if self.fits { self.blocks.unmodelled() } else { f64::INFINITY },
        });
    }

    /// The row of this moment; what has been found to be shifted.
    ///
    /// `noise`: variances of θ and q; `step`: of the deflection's readings; `torque_noise`: of τ; `gains`: of the
    /// filters for white noise.
    pub fn learn(
        &mut self,
        noise: [f64; 2],
        step: f64,
        torque_noise: f64,
        gains: &[f64; 3],
    ) -> Option<Shift> {
        self.held_s = 0.0;
        self.unconfirmed_s -= self.period;
        let positions = noise[0] + noise[1];
        self.blocks.seen = self.balance.seen();
        let [deflection, both, acceleration] =
            [gains[0] * positions, gains[1] * noise[0], gains[2] * noise[0]];
        let in_columns = self.stiffness.powi(2) * deflection + self.inertia.powi(2) * acceleration;
        let rounding = self.balance.rounding(noise, gains[0]);
        self.blocks.readings = Readings {
            white: in_columns + gains[0] * torque_noise,
            noise: [[deflection, both], [both, acceleration]],
            rounding: if rounding > 0.0 { rounding / deflection } else { 0.0 },
            resolution: 0.5 * step,
        };
        let row = self.balance.row();
        let closed = self.blocks.add(&row, self.balance.resting())?;
        let doubted = self.doubtful;
        self.judge();
        match closed {
            Closed::Begun => self.followed_s = SAID_S,
            Closed::Added if doubted => self.deflection.recall(self.usual), // what was read since may be no motion
            Closed::Added => self.usual = self.deflection.motion(),
            Closed::Unexplained | Closed::Reformed => {}
            Closed::Lost => return Some(Shift::Lost),
        }
        let off = std::mem::take(&mut self.blocks.off);
        if off != 0.0 {
            return Some(Shift::Zero(off));
        }
        if self.doubtful || self.blocks.is_lost() {
            return None; // a zero that is elsewhere looks late
        }
        let (late, std) = self.blocks.delay()?;
        let beyond = late.abs() - 0.5 * self.period > SURE * std;
        beyond.then(|| Shift::Late((late / self.period).round()))
    }

    /// Names of the effects that nobody declared. A drive that samples or averages its torque is a period late, and one
    /// that reports what it is told to make is as early.
    pub fn undeclared(&self) -> impl Iterator<Item = &'static str> {
        let (late, std) = self.blocks.torque_lateness();
        let late = late.abs() - self.period > SURE * std;
        self.blocks.undeclared().chain(late.then_some("torque_delay"))
    }

    /// What the blocks say of themselves, at their ends.
    fn judge(&mut self) {
        self.doubtful = self.blocks.is_doubting();
        self.unexplained = self.blocks.unexplained();
        self.fits = self.blocks.is_explained();
        self.balance.family = self.blocks.family.clone();
    }

    /// The torque and stiffness that the deflection's filter goes on with.
    pub fn predict(&mut self) {
        if self.rigid {
            return;
        }
        let known = self.blocks.at(self.deflection.at(0.0), 0.0, &self.balance);
        match known.filter(|known| self.fits && known.stiffness > 0.0) {
            Some(known) => {
                (self.stiffness, self.acting) =
                    (known.stiffness, known.torque + self.blocks.damping_and_offset(self.deflection.rate()));
            }
            None => (self.stiffness, self.acting) = (0.0, self.balance_torque(0.0)),
        }
    }

    /// What the motor's balance leaves as the transmission's torque (eq 14), brought up by its slope.
    fn balance_torque(&self, ahead_s: f64) -> f64 {
        let ((motor, x), tau) = (self.balance.filtered(), self.balance.torque());
        let value = self.inertia * motor[2] + self.damping * motor[1] + x[0] - tau[0];
        let rate = self.inertia * motor[3] + self.damping * motor[2] + x[1] - tau[1];
        value + ahead_s * rate
    }
}
