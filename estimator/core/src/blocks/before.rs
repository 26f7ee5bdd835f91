//! What goes on being known where the sum begins anew, and where a lost zero is.
//!
//! After a restart positions may count from anywhere, and the joint may be another one. Each place of the zero and
//! each of the two joints is held against the rows by its evidence.

use serde::{Deserialize, Serialize};

use super::Blocks;
use super::solve::{Rows, rarity};
use crate::choices::{ACCUSED, DRIFTED, REACHED, SURE, USEFUL};
use crate::gram::{Gram, Posterior, Prior, Set, UNKNOWNS, Vector, inverse, set, solve};
use crate::spring::{Projection, TERMS};
use crate::unknowns::{
    ACTIVE, CLIPS, DRY, DRY_LATE, ECCENTRIC, INERTIA, LOAD, OFFSET, RATE, SPRING, Spring, ZERO,
};

const ZEROS: i32 = 12; // that are tried to either side, over the deflection seen
const TRIED: usize = 2 * ZEROS as usize + 1;

/// What was known when the sum began anew, α and the zero as they are.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct Before {
    pub(super) x: Vector,
    pub(super) precision: [Vector; UNKNOWNS],
    pub(super) set: Set,
    deflection: f64, // the largest, until then
    pub(super) unexplained: f64,
}

impl Before {
    /// Whether anything is known of the spring.
    pub(super) fn knows_spring(&self) -> bool {
        self.set & set(SPRING) != 0
    }

    /// The others are open.
    pub(super) fn keep(&mut self, kept: Set) {
        let covariance = inverse(&self.precision, self.set);
        self.set &= kept;
        self.precision = inverse(&covariance, self.set);
    }
}

impl Blocks {
    /// What is known goes on, but for these unknowns.
    pub(super) fn carry_over(&mut self, opens: Set) {
        let Some(posterior) = &self.posterior else { return };
        let kept = posterior.set & !opens;
        let mut x = posterior.x;
        for (i, unknown) in SPRING.enumerate() {
            x[unknown] = self.spring.alpha[i];
        }
        x[ZERO] = self.spring.zero;
        let mut covariance = posterior.covariance;
        SPRING.for_each(|i| covariance[i][i] += (DRIFTED * x[i]).powi(2));
        self.before = Some(Before {
            x,
            precision: inverse(&covariance, kept),
            set: kept,
            deflection: self.deflection,
            unexplained: self.usual_unexplained().min(self.unexplained),
        });
    }

    /// Where the zero between the encoders is, is not known any more.
    pub fn lose_zero(&mut self) {
        let explained = self.is_explained();
        let found = self.located && !self.doubting && !self.is_unconfirmed() && explained;
        let guessed = self.zero_torque(self.spring.curve(0.0).1) > USEFUL * self.torque;
        // What was learned without a zero may be of another one.
        let before = self.before.as_ref().filter(|_| self.lost && !found);
        if self.are_few() && self.before.is_none() {
            self.spring.reset(); // a few blocks have taught nothing: their zero may have been another one, too
        } else if let Some(before) = before.filter(|before| before.knows_spring()) {
            self.spring.alpha[..TERMS].copy_from_slice(&before.x[SPRING]);
        } else if before.is_some() && !explained {
            self.spring.reset();
        } else {
            self.carry_over(1 << ZERO | 1 << DRY | set(DRY_LATE..LOAD.start) | !(anywhere() | set(SPRING)));
            if guessed {
                // What was learned by a zero that was another one is of another spring.
                self.before.iter_mut().for_each(|before| before.keep(1 << INERTIA));
                self.spring.reset();
            }
        }
        let (before, noise, own) = (self.before.take(), self.noise, self.own);
        self.forget_rows();
        (self.before, self.lost, self.posterior, self.located) = (before, true, None, false);
        self.spring.zero = 0.0; // deflections are counted from elsewhere
        if self.before.is_some() {
            (self.noise, self.own) = (noise, own);
        }
    }

    /// The deflections are counted from near the zero, from now on.
    pub fn recentre(&mut self) {
        self.lose_zero();
        self.located = true;
    }

    /// Evidence has said where the zero is: it is known when two blocks say so.
    ///
    /// One that is not lost is then so near that the last `step` of the iteration stays within a part of the motion. With one
    /// that was lost the spring is as it was a block before, `from`: few rows are explained by several zeros, each with a
    /// curve of its own.
    pub(super) fn place_zero(&mut self, moved: bool, step: f64, from: &Spring, chosen: &Posterior) {
        let near = |step: f64| f64::from(ZEROS) * step.abs() <= self.seen[1] - self.seen[0];
        let agree = |unknown: usize, step: f64| {
            let before = self.posterior.as_ref().map_or(0.0, |before| before.covariance[unknown][unknown]);
            step * step <= SURE * SURE * (chosen.covariance[unknown][unknown] + before)
        };
        self.placed = if self.lost {
            let off = self.spring.zero - from.zero;
            let alike = |(i, now): (usize, &f64)| {
                let change = now - from.alpha[i];
                change.abs() <= DRIFTED * now.abs() || agree(SPRING.start + i, change)
            };
            self.spring.parameters().iter().enumerate().all(alike)
                && (near(off) || agree(ZERO, off) || self.spring.is_constant())
        } else {
            near(step) && moved == self.moved
        };
        self.moved = moved;
    }

    /// How well a lost zero at each of some places explains the rows, by what was known before and linearised there, and
    /// where it is then.
    fn tried(&self, before: &Before, spring: &Spring, total: &Gram, step: f64) -> [(f64, f64); TRIED] {
        let ([low, high], mut tried) = (self.seen, spring.clone());
        let middle = 0.5 * (low + high);
        let powers =
            set(SPRING.start..SPRING.start + spring.least) | self.before.as_ref().map_or(0, |one| one.set);
        let asked = ACTIVE & !(set(SPRING) & !powers);
        let projection = Projection::between(&self.family, self.deflection, low, high);
        std::array::from_fn(|k| {
            tried.zero = step * (k as f64 - f64::from(ZEROS)) - middle;
            let nothing = (f64::NEG_INFINITY, tried.zero);
            if (tried.zero + low).abs().max((tried.zero + high).abs()) > REACHED * tried.reach() {
                return nothing;
            }
            let frame = tried.frame(&projection);
            let prior = self.prior_after(Some(before), &tried, total, &frame, self.deflection);
            let noise = self.noise.variance * self.correlated;
            solve(&frame.reduce(total), frame.set & asked, &prior, noise)
                .map_or(nothing, |one| (one.log_evidence, tried.zero + one.x[ZERO]))
        })
    }

    /// Where a lost zero is; `None`: all that explain the rows do not agree, be the joint as it was or another one.
    fn locate(&self, total: &Gram) -> Option<f64> {
        let (before, [low, high]) = (self.before.as_ref()?, self.seen);
        let step = before.deflection.max(high - low) / f64::from(ZEROS);
        let (other, spring) = self.another(before);
        let mut found =
            [self.tried(before, &self.spring, total, step), self.tried(&other, &spring, total, step)];
        found[1].iter_mut().for_each(|one| one.0 -= rarity());
        let found = found.as_flattened();
        let best = found.iter().copied().max_by(|a, b| a.0.total_cmp(&b.0))?;
        let rival = |one: &(f64, f64)| (one.1 - best.1).abs() > 2.0 * step && one.0 > best.0 - ACCUSED.ln();
        (best.0.is_finite() && !found.iter().any(rival)).then_some(best.1)
    }

    /// Whether the balance can be linearised where its zero is.
    pub(super) fn is_located(&mut self, total: &Gram) -> bool {
        if !self.lost || self.located || self.spring.is_constant() {
            return true;
        }
        if !self.before.as_ref().is_some_and(Before::knows_spring) {
            self.located = true; // nothing tells where it is but motion near where deflections are counted from
            return true;
        }
        let Some(zero) = self.locate(total) else { return false };
        self.located = true;
        if zero.abs() > self.deflection / f64::from(ZEROS) {
            self.off = zero;
            return false;
        }
        self.spring.zero = zero;
        true
    }

    /// The joint after a restart as another one, where that explains the rows better than what was known before.
    pub(super) fn anew(&self, rows: &Rows, prior: &Prior) -> Option<(Before, Spring)> {
        let Rows { frame, reduced, total, noise } = *rows;
        let before = self.before.as_ref().filter(|before| self.lost && before.knows_spring())?;
        let (other, spring) = self.another(before);
        let open = self.prior_after(Some(&other), &spring, total, frame, self.deflection);
        let (base, groups) = self.offered(frame);
        let found = self.chosen(reduced, base, &groups, prior, noise)?;
        let instead = self.chosen(reduced, base, &groups, &open, noise)?;
        let odds = instead.log_evidence - found.log_evidence;
        (odds > self.rarer(&instead, &found)).then_some((other, spring))
    }

    /// Of what was known before, what another joint with this motor has in common with it.
    fn another(&self, before: &Before) -> (Before, Spring) {
        let (mut other, mut spring) = (before.clone(), self.spring.clone());
        other.keep(1 << INERTIA | 1 << OFFSET);
        spring.forget();
        (other, spring)
    }
}

/// Unknowns that are the same wherever the zero is.
pub(super) fn anywhere() -> Set {
    set(1..SPRING.start + 1) | set(ZERO..LOAD.start) | set(RATE..CLIPS.start) | set(ECCENTRIC)
}

#[cfg(test)]
mod tests {
    use super::super::declared;
    use super::*;

    #[test]
    fn a_lost_zero_is_known_when_two_blocks_have_the_same_spring() {
        let mut blocks = declared();
        (blocks.lost, blocks.seen) = (true, [-0.1, 0.5]);
        let unknowns = set(SPRING.start..SPRING.start + 2) | set(ZERO..ZERO + 1);
        let mut covariance = [[0.0; UNKNOWNS]; UNKNOWNS];
        (0..UNKNOWNS).for_each(|i| covariance[i][i] = 1e-8);
        let known = Posterior::believed(unknowns, [0.0; UNKNOWNS], covariance);
        blocks.posterior = Some(known.clone());
        let from = blocks.spring.clone();
        for (factor, off, placed) in
            [(1.0, 0.0, true), (1.5, 0.0, false), (1.01, 0.0, true), (1.0, 0.2, false)]
        {
            (blocks.spring.alpha[0], blocks.spring.zero) = (factor * from.alpha[0], off);
            blocks.place_zero(false, 0.0, &from, &known);
            assert_eq!(blocks.placed, placed, "{factor} {off}");
        }
    }

    /// A VSA-II that has lost its zero, of which only the inertia is known from before.
    fn lost() -> Blocks {
        let mut blocks = declared();
        let (mut x, mut precision) = ([0.0; UNKNOWNS], [[0.0; UNKNOWNS]; UNKNOWNS]);
        (x[INERTIA], precision[INERTIA][INERTIA]) = (1e-3, 1e10);
        let before = Before { x, precision, set: 1 << INERTIA, deflection: 0.4, unexplained: 0.001 };
        (blocks.before, blocks.lost, blocks.deflection) = (Some(before), true, 0.9);
        blocks
    }

    #[test]
    fn a_lost_zero_is_sought_wherever_it_leaves_the_deflections_within_those_known() {
        let mut blocks = lost();
        for [low, high] in [[-0.66, -0.32], [-0.05, 0.01], [0.3, 0.5]] {
            blocks.seen = [low, high];
            let before = blocks.before.as_ref().unwrap();
            let step = before.deflection / f64::from(ZEROS);
            let tried = blocks.tried(before, &blocks.spring, &Gram::default(), step).map(|(_, zero)| zero);
            assert!(tried[0] < step - before.deflection - low, "{tried:?}");
            assert!(tried[TRIED - 1] > before.deflection - high - step, "{tried:?}");
        }
    }

    #[test]
    fn what_a_zero_that_explains_nothing_has_taught_is_not_carried_over() {
        for (unexplained, carried) in [(0.001, true), (0.5, false)] {
            let (mut blocks, set) = (lost(), 1 << INERTIA | set(SPRING));
            let mut covariance = [[0.0; UNKNOWNS]; UNKNOWNS];
            (0..UNKNOWNS).for_each(|i| covariance[i][i] = 1e-8);
            blocks.posterior = Some(Posterior::believed(set, [0.0; UNKNOWNS], covariance));
            (blocks.spring.alpha[0], blocks.unexplained, blocks.fluctuation) = (-0.6, unexplained, 1.0);
            blocks.lose_zero();
            assert_eq!(blocks.before.as_ref().unwrap().knows_spring(), carried);
            assert_eq!(blocks.spring.alpha[0] == 0.5, !carried);
        }
    }
}
