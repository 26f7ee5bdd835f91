//! Where positions are counted from: what jumps, restarts and delays do to it.

use super::Robust;
use crate::align::Positions;
use crate::choices::AHEAD_S;
use crate::external::LinkMomentum;
use crate::sample::MOTORS;

impl Robust {
    /// The link is later than was assumed: what was learned is of other moments.
    pub(super) fn shift(&mut self, periods: f64) {
        if self.alignment.shift(periods) == 0.0 {
            return;
        }
        self.live.unsettled = self.settle;
        self.momentum.iter_mut().for_each(LinkMomentum::shift);
        let last = &self.live.last.at;
        for (i, side) in self.sides.iter_mut().enumerate() {
            side.relearn(last.motor[i], last.deflection(i));
        }
    }

    /// The zero of one motor has been found so far from where its deflections are counted from.
    pub(super) fn recentre(&mut self, i: usize, off: f64) {
        self.count_from(i, off);
        let at = &self.live.last.at;
        self.sides[i].recentre(at.motor[i], at.deflection(i), self.live.last.torque[i]);
    }

    /// Positions of one motor are counted from so far on.
    fn count_from(&mut self, i: usize, off: f64) {
        self.live.zeros.motor[i] += off;
        self.live.last.at.motor[i] -= off;
        self.live.last.present.motor[i] -= off;
        self.live.unsettled = self.settle;
    }

    /// Positions may count from anywhere: each motor's from where they did, if blocks bear it out, or from here.
    pub(super) fn resume(&mut self, at: &Positions) {
        let now = at.from_zeros(&self.live.zeros);
        for (i, side) in self.sides.iter_mut().enumerate() {
            if side.may_be_as_before(now.deflection(i)) {
                side.suspect_zero();
            } else {
                self.live.zeros.motor[i] -= if self.flexible { now.deflection(i) } else { 0.0 };
                side.move_zero(false);
            }
        }
    }

    /// Blocks say that a motor's zero is not where it was before a restart; nor are those of which they say nothing yet.
    pub(super) fn lose_here(&mut self, lost: [bool; MOTORS]) {
        for i in 0..self.motors {
            if !lost[i] && !self.sides[i].blocks.is_suspected() {
                continue;
            }
            self.count_from(i, if self.flexible { -self.live.last.at.deflection(i) } else { 0.0 });
            let at = &self.live.last.at;
            self.sides[i].move_zero(false);
            self.sides[i].restart(at.motor[i], at.deflection(i), self.live.last.torque[i]);
        }
    }

    /// Encoders have moved their zeros: go on as if they had not.
    pub(super) fn move_zeros(&mut self, jumps: [f64; MOTORS + 1], at: &Positions, sequence: u64) {
        let ahead =
            (sequence.wrapping_sub(self.live.sequence) as f64 + self.alignment.periods.abs()) * self.period;
        for i in 0..self.motors {
            self.live.zeros.motor[i] += jumps[i];
        }
        if self.flexible {
            self.live.zeros.link += jumps[self.motors];
        }
        let now = at.from_zeros(&self.live.zeros);
        for (i, side) in self.sides.iter_mut().enumerate() {
            let known = ahead <= AHEAD_S && side.is_within(now.deflection(i));
            if !known {
                self.live.zeros.motor[i] = at.motor[i] - now.link; // in the middle of where it can be
            }
            side.move_zero(known);
        }
    }
}
