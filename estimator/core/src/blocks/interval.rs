//! The interval: what other explanations may change, what noise in the positions takes off, errors of the model.

use super::Blocks;
use super::solve::{ALONE, Rows};
use crate::choices::{ALIKE, EVEN, EXACT, FEWEST, UNLIKE};
use crate::gram::{
    Frame, Matrix, Posterior, Prior, UNKNOWNS, by_prior, cluster, log_evidence, product, set, solve, unknowns,
};
use crate::student::t_95;
use crate::unknowns::{DRY, OFFSET, ZERO};

impl Blocks {
    /// What the groups that were not chosen, or a zero elsewhere, may change: the covariance between models, by their
    /// probabilities.
    ///
    /// Hoeting et al., "Bayesian model averaging: a tutorial", Statistical Science 14(4), 1999.
    pub(super) fn omitted(&self, rows: &Rows, chosen: &Posterior, prior: &Prior) -> Matrix {
        let Rows { frame, reduced, total, noise } = *rows;
        let mut between = [[0.0; UNKNOWNS]; UNKNOWNS];
        let (_, groups) = self.groups(frame);
        let many = groups.iter().filter(|group| **group != 0).count() as f64;
        let elsewhere = self.prior(total, frame, self.deflection);
        let offset = (elsewhere.precision[OFFSET][OFFSET] * reduced[ZERO][ZERO] / total.rows).sqrt().recip();
        let as_offset = self.prior(total, frame, offset);
        let left_out = groups[..ALONE].iter().filter(|group| *group & !chosen.set & frame.set != 0);
        // A constant torque is an offset or a zero elsewhere, as likely.
        let zeros = [(chosen.set, &elsewhere), (chosen.set & !set(OFFSET..DRY), &as_offset)];
        let rivals = left_out.map(|group| (chosen.set | group, prior)).chain(zeros);
        for (set, prior) in rivals {
            let (more, less) = (set & !chosen.set, chosen.set & !set);
            // An effect is as rare as there are many; that a series goes on where it is cut off is as likely as not.
            let usual = if less == 0 && more & self.spring.shape() == 0 { many.recip() } else { 1.0 };
            let odds = usual * (log_evidence(reduced, set, prior, noise) - chosen.log_evidence).exp();
            let probability = odds / (1.0 + odds);
            if probability < EVEN {
                continue;
            }
            let other = solve(reduced, set, prior, noise);
            let Some(other) = other.filter(|other| self.impossible(other) == 0) else { continue };
            for i in unknowns(chosen.set) {
                for j in unknowns(chosen.set) {
                    let moved = (other.x[i] - chosen.x[i]) * (other.x[j] - chosen.x[j]);
                    let wider =
                        if less == 0 { other.covariance[i][j] - chosen.covariance[i][j] } else { 0.0 };
                    between[i][j] += probability * (moved + wider);
                }
            }
        }
        between
    }

    /// Errors in variables: noise of the positions is in the columns, and takes off what multiplies them, more where few rows
    /// tell one from another.
    pub(super) fn attenuated(&self, rows: &Rows, chosen: &Posterior) -> Matrix {
        let pull = rows.reduced.pull(&chosen.x, chosen.set);
        let moved = chosen.covariance.map(|row| product(&row, &pull) / rows.noise);
        moved.map(|a| moved.map(|b| a * b))
    }

    /// What the chosen unknowns leave beyond the noise is an error of the model: scores of blocks hold it.
    pub(super) fn widen(
        &mut self,
        frame: &Frame,
        chosen: &mut Posterior,
        prior: &Prior,
        noise: f64,
        own: f64,
    ) {
        let residual = self.residual;
        self.score(frame, &residual, chosen.set);
        // What no noise explains is an effect that is missing: what it does to a block is in the blocks' scores, what it
        // does to all of them alike is not. Nor is rounding, where the readings have too little noise to spread it.
        let (rounded, unlike) = (EXACT * EXACT * self.fluctuation, UNLIKE * self.friction);
        let bare = (rounded - self.readings.white).max(0.0);
        let missing = (own - self.readings.white - rounded).max(0.0) + bare + unlike * unlike;
        let by_prior = by_prior(chosen, prior);
        let blocks = self.ring.len() as f64;
        let clustered =
            if self.ring.len() >= FEWEST { cluster(chosen, &self.scores, prior, noise) } else { None };
        let (wider, freedom) = match clustered {
            Some(freedom) => (1.0, freedom),
            None => ((own / self.noise.variance).max(1.0), blocks.max(3.0)),
        };
        let (alike, wider) = (ALIKE * blocks * missing / own, wider * t_95(freedom).powi(2));
        let entries = chosen.covariance.iter_mut().flatten().zip(by_prior.iter().flatten());
        entries.for_each(|(v, prior)| *v = wider * (*v + alike * (*v - prior)));
    }
}
