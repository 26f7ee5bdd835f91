//! Blocks that what is known does not explain: has the joint changed, or a reading, or the zero?

use super::{Blocks, Closed};
use crate::balance;
use crate::causes::{Cause, Known, Noise, Odds, TABLE};
use crate::choices::{BLOCKS, CONVINCING, EVEN, FEWEST, REST, UNUSUAL};
use crate::gram::{Gram, Set, UNKNOWNS, inverse, set};
use crate::unknowns::{ASYMMETRY, CORNER, DAMPING, INERTIA, SPRING, ZERO};

impl Blocks {
    /// Something has changed: rows are of use again when the filters have forgotten what was before.
    pub(super) fn begin_doubt(&mut self) -> Closed {
        (self.doubting, self.good, self.doubted) = (true, 0, 0);
        self.skipped = self.settle;
        self.take_open();
        self.waiting.clear();
        Closed::Unexplained
    }

    pub(super) fn end_doubt(&mut self) {
        self.waiting.clear();
        (self.odds, self.doubting, self.doubted, self.quick) = (None, false, 0, 0.0);
        self.suspected = false;
    }

    /// Whether the causes say of a block that something has changed.
    pub(super) fn is_unexplained(&self, block: &Gram) -> bool {
        self.weigh(block, self.per_block).is_some_and(|odds| odds.of(Cause::Nothing).probability < 0.5)
    }

    /// Whether the last blocks together, each of which was explained, show a change: it may be slow. Noise that no cause
    /// explains is none. From where it began blocks are left out of the sum, and wait.
    pub(super) fn doubts_latest(&mut self) -> bool {
        if self.ring.len() < 2 * FEWEST {
            return false;
        }
        let block = |age: usize| &self.ring[self.ring.len() - 1 - age].0;
        let mut window = block(0).clone();
        let shows = |k: &usize| {
            window.add(block(k - 1), 1.0);
            self.weigh(&window, self.per_block).is_some_and(|odds| {
                odds.of(Cause::Nothing).probability + odds.of(Cause::Noise).probability < 0.5
            })
        };
        let Some(began) = (2..=FEWEST).find(shows) else { return false };
        self.begin_doubt();
        self.skipped = 0;
        self.waiting.extend(self.ring.drain(self.ring.len() - began..).map(|(block, _)| block));
        self.solve();
        true
    }

    /// Blocks since a restart that what was known explains: a zero as before is believed where these say so, as a zero
    /// elsewhere was as likely; a motion that does not tell the two apart says nothing.
    pub(super) fn bear_out(&mut self, block: Gram) -> Closed {
        self.waiting.push(block);
        let mut window = Gram::default();
        self.waiting.iter().for_each(|one| window.add(one, 1.0));
        let elsewhere =
            self.weigh(&window, 0.5).map_or(0.0, |odds| odds.against_nothing(Cause::PositionZero));
        if elsewhere > 1.0 {
            self.end_doubt();
            return Closed::Lost;
        }
        if self.waiting.len() < CONVINCING || elsewhere > EVEN {
            if self.waiting.len() >= FEWEST {
                self.waiting.remove(0);
            }
            return Closed::Unexplained;
        }
        for block in std::mem::take(&mut self.waiting) {
            self.push(block);
        }
        self.end_doubt();
        self.solve();
        Closed::Added
    }

    /// The probability of each cause for some rows; `None`: nothing is known to hold them against.
    ///
    /// `before`: that something has changed, before any of them.
    fn weigh(&self, rows: &Gram, before: f64) -> Option<Odds> {
        let (frame, posterior) = (self.frame.as_ref()?, self.posterior.as_ref()?);
        let projection = self.projection.as_ref().filter(|_| self.is_reference())?;
        let known = Known {
            frame,
            residual: &self.residual,
            set: posterior.set,
            precision: &inverse(&posterior.covariance, posterior.set),
            torque: &self.spring.torque(projection),
            slope: &projection.of(|phi| self.spring.curve(phi).1),
            slopes: &self.spring.slope(projection),
            turn: &self.spring.turn(projection),
            motor: (posterior.x[INERTIA], posterior.x[DAMPING]),
            torque_rms: balance::variance(rows, balance::TORQUE).sqrt(),
            deflection: self.deflection,
            period_s: self.period,
        };
        // Each block has a level of its own.
        let tails = self.noise.tails * (rows.rows / self.rows).max(1.0);
        let noise = Noise { variance: self.own * self.own, tails, ..self.noise };
        Some(known.judge(rows, &noise, before))
    }

    /// Whether a change of the joint explains what waits.
    fn is_change(&self, odds: &Odds) -> bool {
        let Some(best) = odds.best(|cause| cause.entry().opens != 0) else { return false };
        // A zero that goes on moving is nearly explained by one that has moved; a spring that bends is explained.
        let bends = matches!(best, Cause::Stiffness | Cause::Shape | Cause::Friction);
        let rest = if bends { REST * odds.of(Cause::Nothing).misfit } else { 0.0 };
        let of_joint: f64 =
            TABLE.iter().filter(|entry| entry.opens != 0).map(|e| odds.of(e.cause).probability).sum();
        of_joint > 1.0 - EVEN && odds.of(best).misfit < UNUSUAL.max(rest)
    }

    /// What the causes say of the blocks that wait, the first of which may be of both sides of a change.
    fn weigh_waiting(&mut self) -> Option<Odds> {
        let mut window = Gram::default();
        self.waiting.iter().for_each(|one| window.add(one, 1.0));
        let odds = self.weigh(&window, self.per_block)?;
        if self.waiting.len() > 2 && !self.is_change(&odds) {
            window.add(&self.waiting[0], -1.0);
            if let Some(later) = self.weigh(&window, self.per_block).filter(|later| self.is_change(later)) {
                self.waiting.remove(0);
                return Some(later);
            }
        }
        Some(odds)
    }

    /// What waits is not explained: is it the joint that has changed, or a reading?
    pub(super) fn decide(&mut self) -> Closed {
        self.doubted += 1;
        let Some(odds) = self.weigh_waiting() else { return Closed::Unexplained };
        self.odds = Some(odds);
        if self.waiting.len() >= 2 && self.is_change(&odds) && !self.is_unconfirmed() {
            // All that the window does not tell apart is open.
            let likely = odds.likely(|cause| cause.entry().opens != 0);
            let opens = TABLE.iter().zip(likely).filter(|(_, likely)| *likely).map(|(entry, _)| entry.opens);
            self.restart(opens.fold(0, |all, one| all | one));
            return Closed::Begun;
        }
        if self.lost && self.doubted >= FEWEST {
            self.lose_zero(); // it was located wrongly
            return Closed::Unexplained;
        }
        if self.doubted >= BLOCKS {
            // Nothing in the table, for as long as anything is remembered: another joint.
            self.restart(set(1..UNKNOWNS));
            return Closed::Begun;
        }
        if self.waiting.len() >= FEWEST {
            self.waiting.remove(0);
        }
        Closed::Unexplained
    }

    /// What is known begins with the window: the unknowns that have changed are open again, the others are as before.
    pub(super) fn restart(&mut self, opens: Set) {
        self.carry_over(opens | set(CORNER.start..ASYMMETRY.end)); // they are of one size
        self.ring.clear();
        for k in 0..self.waiting.len() {
            let block = self.waiting[k].clone();
            self.push(block);
        }
        self.end_doubt();
        (self.doubting, self.good) = (true, CONVINCING - 1); // until another block bears it out
        if opens & set(SPRING) != 0 {
            self.spring.open();
        }
        (self.lost, self.located) = (self.lost || opens >> ZERO & 1 == 1, true); // it is not far
        self.solve();
    }

    /// Positions may count from elsewhere since a restart: blocks tell.
    pub fn suspect_zero(&mut self) {
        self.begin_doubt();
        self.suspected = true;
    }
}
