//! One period: filters, noise, and what each motor's row teaches.

use super::Robust;
use crate::align::{Inputs, Positions};
use crate::choices::LEVER_RAD;
use crate::external::Carried;
use crate::model::Arrangement;
use crate::noise::NoiseMeter;
use crate::sample::MOTORS;
use crate::side::{Moment, Shift};
use crate::signals::Channel;

impl Robust {
    /// Filters at rest where the joint is now; what has been learned is kept.
    pub(super) fn restart(&mut self, now: &Inputs) {
        self.live.link = Channel::rest(now.at.link);
        for (i, side) in self.sides.iter_mut().enumerate() {
            side.restart(now.at.motor[i], now.at.deflection(i), now.torque[i]);
        }
        self.live.noise.iter_mut().chain(&mut self.live.torque_noise).for_each(NoiseMeter::restart);
        let carried = self.carried(&now.present).map_or(0.0, |carried| carried.torque);
        self.momentum.iter_mut().for_each(|momentum| momentum.restart(now.present.link, carried));
        self.live.last = *now;
        self.live.unsettled = self.settle;
        self.live.said = if self.live.started { self.said_periods } else { 0 };
        self.live.started = true;
    }

    /// One period: filters, and each motor's row where the motion teaches something.
    pub(super) fn advance(&mut self, now: &Inputs) {
        let usable = self.live.unsettled <= 0;
        self.live.tick += 1;
        if self.arrangement == Arrangement::Serial {
            self.follow_lever(now.at.motor[1]);
        }
        self.live.link.smooth(&self.filters, now.at.link);
        self.measure_noise(now, usable);
        let shifts = self.learn(now, usable);
        self.feed_momentum(now);
        self.live.last = *now;
        self.live.unsettled -= 1;
        self.apply(&shifts);
    }

    /// Motor 2 of a serial joint sets the stiffness: where it goes, the spring is learned anew.
    fn follow_lever(&mut self, position: f64) {
        let moved = (position - self.live.lever).abs() > LEVER_RAD;
        if moved {
            self.sides[0].renew();
        }
        if moved || self.live.lever.is_nan() {
            self.live.lever = position;
        }
    }

    /// Each motor's row, and by what it says that inputs are to be shifted.
    fn learn(&mut self, now: &Inputs, usable: bool) -> [Option<Shift>; MOTORS] {
        let look = self.live.tick % self.looks == 0;
        let (look_s, time) = (self.looks as f64 * self.period, self.live.tick as f64 * self.period);
        let mut shifts = [None; MOTORS];
        for i in 0..self.motors {
            let (noise, step) = (self.noise_of(i), self.step_of(i));
            let torque_noise = self.live.torque_noise[i].variance(f64::INFINITY);
            let (side, link) = (&mut self.sides[i], &self.live.link);
            side.feed(&self.filters, i, &Moment { now, last: &self.live.last, link, time, usable, noise });
            if side.rigid {
                continue;
            }
            if look && usable {
                side.tune(link, noise);
            }
            if look {
                let gain = (self.noise_gains[1] * (noise[0] + noise[1])).sqrt();
                side.update_excitation(link, now.at.deflection(i), gain, usable, look_s);
            }
            if usable && side.excited {
                shifts[i] = side.learn(noise, step, torque_noise, &self.noise_gains);
            }
        }
        shifts
    }

    fn feed_momentum(&mut self, now: &Inputs) {
        if self.momentum.is_none() {
            return;
        }
        let carried = self.carried(&now.present).map(|carried| carried.torque);
        let lost = self.sides.iter().any(|side| side.blocks.is_lost());
        if let Some(momentum) = &mut self.momentum {
            momentum.note_zero(lost);
            momentum.feed(now.present.link, carried, self.live.measured, now.late);
        }
    }

    fn apply(&mut self, shifts: &[Option<Shift>; MOTORS]) {
        let (mut late, mut lost) = (None, [false; MOTORS]);
        for (i, shift) in shifts.iter().enumerate() {
            match *shift {
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
        see(&mut self.live.noise[self.motors], now.at.link);
        for i in 0..self.motors {
            see(&mut self.live.noise[i], now.at.motor[i]);
            see(&mut self.live.torque_noise[i], now.torque[i]);
        }
    }

    /// Variance of θ's and of q's noise, rad².
    pub(super) fn noise_of(&self, i: usize) -> [f64; 2] {
        let resolution = self.validator.resolution();
        [i, self.motors].map(|k| self.live.noise[k].variance(resolution[k]))
    }

    /// Step of a deflection's readings, rad: a reading that cuts off instead of rounding moves the zero by half of it.
    fn step_of(&self, i: usize) -> f64 {
        let resolution = self.validator.resolution();
        let [motor, link] = [i, self.motors].map(|k| self.live.noise[k].step(resolution[k]));
        motor.hypot(link)
    }

    /// What the transmissions do to the link; `None` where a curve is not trusted.
    pub(super) fn carried(&self, now: &Positions) -> Option<Carried> {
        let pulls = if self.arrangement == Arrangement::Antagonistic { self.motors } else { 1 };
        let mut all = Carried::default();
        for (i, side) in self.sides[..pulls].iter().enumerate() {
            all = all.and(side.carried(now.deflection(i), self.noise_of(i)[0])?);
        }
        Some(all)
    }
}
