//! Rows into blocks: how much each tells, and whether the latest are like what was explained before.

use super::{Blocks, Closed};
use crate::balance;
use crate::choices::{EARLY, LOOK_S, UNUSUAL};
use crate::gram::{Gram, Row, dot};
use crate::unknowns::{DRY, LOAD};

impl Blocks {
    /// One row, and how much of it is open as the motor stood ([`balance::Balance::resting`]); what happened where it fills a
    /// block.
    pub fn add(&mut self, row: &Row, resting: [f64; 2]) -> Option<Closed> {
        let weight = self.weight(row, resting);
        let row = &row.map(|value| weight.sqrt() * value);
        if self.follow() {
            return Some(Closed::Reformed);
        }
        let settled = self.doubting || self.skipped == 0;
        if settled && self.is_reference() {
            let left = dot(row, &self.residual);
            self.quick += (self.period / LOOK_S).min(1.0) * (left * left - self.quick);
            if !self.doubting && self.is_beyond(row) {
                return Some(self.begin_doubt());
            }
            self.peak = self.peak.max(self.quick);
        }
        if self.skipped > 0 {
            self.skipped -= 1;
            return None;
        }
        self.open.add_row(row);
        self.open.rows += weight - 1.0;
        self.filled += if self.is_reference() { weight } else { 1.0 - resting[0] };
        if self.filled < self.rows {
            return None;
        }
        let block = self.take_open();
        Some(self.close(block))
    }

    pub(super) fn take_open(&mut self) -> Gram {
        self.filled = 0.0;
        std::mem::take(&mut self.open)
    }

    /// What a row tells beside others: dry friction at rest is anything up to what it is in motion, and up to what is
    /// believed of it before rows have shown it; rounding at rest is an error that does not change.
    fn weight(&self, row: &Row, resting: [f64; 2]) -> f64 {
        let [share, declared] = resting;
        let known = self.posterior.as_ref().filter(|_| self.is_reference());
        let open = known.map_or(share * self.priors.coulomb_friction / EARLY, |known| {
            let of_load = LOAD.zip(balance::SPRING).map(|(found, spring)| known.x[found] * row[spring].abs());
            (share * (known.x[DRY] + of_load.sum::<f64>()) + declared) / self.noise.variance.sqrt()
        });
        let rounding = known.map_or(0.0, |_| self.readings.rounding);
        (1.0 + open * open + rounding).recip()
    }

    /// Whether the latest rows are neither noise, nor as large as what explained blocks have held, nor uncertain.
    fn is_beyond(&self, row: &Row) -> bool {
        let usual = self.quick_limit * self.readings.white.max(self.own * self.own);
        if self.quick <= usual {
            return false;
        }
        let held = self.ring.iter().fold(0.0, |most: f64, (_, peak)| most.max(*peak));
        let (Some(frame), Some(known)) = (&self.frame, &self.posterior) else { return false };
        let along = frame.directions.map(|direction| dot(row, &direction));
        self.quick > usual.max(UNUSUAL * held) + self.quick_limit * known.variance_along(&along)
    }
}
