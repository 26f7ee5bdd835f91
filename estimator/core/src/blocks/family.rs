//! The functions that a spring's curve is a sum of, and where that sum is the law.

use super::Blocks;
use crate::balance::Balance;
use crate::choices::{EXACT, MARGIN, REACHED, SURE};
use crate::gram::{Row, set};
use crate::laws::Law;
use crate::spring::{Family, NODES, Projection};
use crate::unknowns::{CORNER, SPRING, ZERO};

impl Blocks {
    /// The spring's columns have grown by these factors.
    pub fn grow(&mut self, factors: &Row, balance: &Balance) {
        let ring = self.ring.iter_mut().map(|(block, _)| block);
        for gram in ring.chain(&mut self.waiting).chain([&mut self.open]) {
            gram.scale(factors);
        }
        self.deflection = balance.size.deflection;
        let reach = REACHED * self.spring.widest_reach(self.deflection);
        self.projection = Some(Projection::new(&self.family, self.deflection, reach));
        if !self.ring.is_empty() {
            self.solve();
        } else if self.frame.is_some() {
            self.fit_projection();
            self.restate();
        }
    }

    /// The law is known over the deflections that the joint has had: near its end, or beyond it, no sum of few functions
    /// is the law. Where the zero is elsewhere, they are not as far to either side.
    pub(super) fn fit_projection(&mut self) {
        let [low, high] = self.seen;
        if high <= low {
            return;
        }
        let (low, high) = if self.is_elsewhere() {
            let (ends, zero) = (REACHED * self.spring.reach(), self.spring.zero);
            let more = (MARGIN - 1.0) * (high - low);
            ((low - more).max(-ends - zero), (high + more).min(ends - zero))
        } else {
            let largest = high.max(-low);
            let edge = (MARGIN * largest).min(REACHED * self.spring.widest_reach(largest));
            (-edge, edge)
        };
        self.projection = Some(Projection::between(&self.family, self.deflection, low, high));
    }

    /// Where a deflection goes further than any before, the law is fitted anew; whether its functions are others now.
    pub(super) fn follow(&mut self) -> bool {
        let follows = !self.is_elsewhere() && self.frame.is_some();
        let Some(projection) = self.projection.as_ref().filter(|_| follows) else { return false };
        let [low, high] = self.seen;
        let (largest, end) = (high.max(-low), projection.nodes()[NODES - 1]);
        if !self.is_shaped() || largest <= end || end >= REACHED * self.spring.reach() {
            return false;
        }
        let reformed = self.reform();
        if !reformed {
            self.restate();
        }
        reformed
    }

    /// Functions near the law as it is known, where the present ones do not hold it: what follows is learned with them.
    ///
    /// What has been learned of all but the spring is before over; rows are sums of the functions before, and are
    /// forgotten. Whether that has been done.
    pub(super) fn reform(&mut self) -> bool {
        if self.is_elsewhere() || self.doubting {
            return false;
        }
        self.fit_projection();
        let possible = self.is_shaped() && self.seen[1].max(-self.seen[0]) < REACHED * self.spring.reach();
        let known = possible && self.is_shape_known() && !self.are_few();
        let Some(projection) = self.projection.as_ref().filter(|_| known) else { return false };
        if self.is_held(projection) {
            return false;
        }
        self.family = Family::Near(self.spring.law.clone(), self.spring.parameters()[1]);
        let usual = self.usual_unexplained();
        self.carry_over(set(SPRING) | set(CORNER) | 1 << ZERO);
        if let Some(before) = &mut self.before {
            before.unexplained = usual; // the joint is as it was, but goes further: it may leave more
        }
        self.ring.clear();
        self.skipped = self.settle;
        self.take_open();
        self.fit_projection();
        self.restate();
        true
    }

    /// Whether the zero is not where it is declared, or lost.
    fn is_elsewhere(&self) -> bool {
        self.lost || self.moved
    }

    /// Whether no sum of few powers is the law, and functions near it are quickly had.
    fn is_shaped(&self) -> bool {
        matches!(self.spring.law, Law::VsaII | Law::Exponential)
    }

    /// Whether the law that explains the rows has this shape, and no other.
    fn is_shape_known(&self) -> bool {
        let (shape, least) = (SPRING.start + 1, self.spring.law.shapes()[0].low);
        let known =
            self.posterior.as_ref().filter(|known| known.set >> shape & 1 == 1 && self.is_explained());
        known.is_some_and(|known| {
            self.spring.parameters()[1] - least > SURE * known.covariance[shape][shape].sqrt()
        })
    }

    /// Whether the sum of the functions is the law where it is fitted.
    fn is_held(&self, projection: &Projection) -> bool {
        let (sum, mut left, mut all) = (self.spring.torque(projection), 0.0, 0.0);
        for phi in projection.nodes() {
            let terms = self.family.at(phi / self.deflection, self.deflection);
            let torque = self.spring.curve(*phi).0;
            left += (terms.iter().zip(&sum).map(|(b, a)| b * a).sum::<f64>() - torque).powi(2);
            all += torque * torque;
        }
        left <= EXACT * EXACT * all
    }

    /// What is known, in the present functions.
    fn restate(&mut self) {
        let (Some(projection), Some(known)) = (&self.projection, &mut self.posterior) else { return };
        let frame = self.spring.frame(projection);
        for unknown in SPRING.chain([ZERO]) {
            known.x[unknown] = 0.0; // counted from where it is
        }
        self.residual = frame.residual(&known.x, known.set);
        self.frame = Some(frame);
    }

    /// The functions that hold any law, near which none is known.
    pub(super) fn unform(&mut self) {
        if self.is_shaped() && matches!(self.family, Family::Near(..)) {
            self.family = Family::of(Some(&self.spring.law));
            self.skipped = self.settle;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::declared;
    use super::*;
    use crate::balance;
    use crate::gram::{COLUMNS, Posterior, UNKNOWNS, dot};
    use crate::unknowns::ASYMMETRY;

    #[test]
    fn one_side_does_not_tell_a_spring_that_is_stiffer_to_the_other_from_another_curve() {
        let mut blocks = declared();
        let asked = |blocks: &mut Blocks, seen: [f64; 2]| {
            blocks.seen = seen;
            let frame = blocks.spring.frame(&Projection::new(&blocks.family, 0.5, f64::INFINITY));
            blocks.groups(&frame).1.contains(&set(ASYMMETRY))
        };
        assert!(asked(&mut blocks, [-0.1, 0.5]));
        assert!(!asked(&mut blocks, [0.1, 0.5]) && !asked(&mut blocks, [-0.5, -0.1]));
    }

    #[test]
    fn what_is_known_grows_with_the_columns_before_any_block_too() {
        let (mut blocks, mut balance) = (declared(), Balance::new(Family::Near(Law::VsaII, 1.7)));
        balance.grow(0.6);
        blocks.family = balance.family.clone();
        blocks.grow(&[1.0; COLUMNS], &balance);
        blocks.seen = [-0.7, 0.9];
        let covariance = [[0.0; UNKNOWNS]; UNKNOWNS];
        blocks.posterior = Some(Posterior::believed(0, [0.0; UNKNOWNS], covariance));
        blocks.fit_projection();
        blocks.restate();
        let row = |size: f64| {
            let (mut row, columns) = ([0.0; COLUMNS], balance::SPRING.start..balance::SLOPE.end);
            row[balance::TORQUE] = 0.5;
            let terms = Family::Near(Law::VsaII, 1.7).at(0.8 / size, size);
            row[columns].iter_mut().zip(terms).for_each(|(value, term)| *value = -term);
            row
        };
        let before = dot(&row(0.6), &blocks.residual);
        let factors = balance.grow(0.9);
        blocks.grow(&factors, &balance);
        assert!(before.abs() > 0.1);
        assert!((dot(&row(0.9), &blocks.residual) - before).abs() < EXACT * before.abs());
    }

    #[test]
    fn what_a_scale_makes_of_the_torque_is_a_sum_of_functions_near_a_law() {
        let (spring, family, size) = (declared().spring, Family::Near(Law::VsaII, 1.74), 0.9);
        let turn = spring.turn(&Projection::new(&family, size, f64::INFINITY));
        let most = size * spring.curve(size).1;
        for phi in [-0.85, -0.3, 0.1, 0.6, 0.9] {
            let sum: f64 = family.at(phi / size, size).iter().zip(&turn).map(|(b, a)| b * a).sum();
            assert!((sum - phi * spring.curve(phi).1).abs() < 0.01 * most, "{sum} at {phi}");
        }
    }

    #[test]
    fn a_law_is_known_where_the_joint_is_however_large_a_deflection_has_seemed() {
        let [low, high] = [-0.6, 0.15]; // it ends at 1.2 rad
        for size in [1.8, 1.05] {
            let mut blocks = declared();
            (blocks.deflection, blocks.seen, blocks.spring.zero) = (size, [low, high], 0.05);
            let off = |blocks: &Blocks| {
                let curve = blocks.spring.torque(blocks.projection.as_ref().unwrap());
                let error = |k: i32| {
                    let phi = low + (high - low) * f64::from(k) / 50.0;
                    let terms = blocks.family.at(phi / size, size);
                    let sum: f64 = terms.iter().zip(&curve).map(|(b, a)| b * a).sum();
                    (sum - blocks.spring.law.at(phi + 0.05, &[0.5, 1.75]).0).abs()
                };
                (0..=50).map(error).fold(0.0, f64::max)
            };
            let torque = blocks.spring.law.at(low, &[0.5, 1.75]).0.abs();
            blocks.projection = Some(Projection::new(&blocks.family, size, f64::INFINITY));
            assert!(off(&blocks) > EXACT * torque);
            blocks.lost = true;
            blocks.fit_projection();
            assert!(off(&blocks) < EXACT * torque, "{} of {torque}", off(&blocks));
        }
    }
}
