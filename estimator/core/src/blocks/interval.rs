//! The interval: what other explanations may change, what noise in the positions takes off, errors of the model.

use super::Blocks;
use super::solve::{ALONE, Rows};
use crate::choices::{ALIKE, EVEN, EXACT, FEWEST, UNLIKE};
use crate::gram::{
    Frame, Matrix, Posterior, Prior, UNKNOWNS, by_prior, cluster, log_evidence, set, solve, unknowns,
};
use crate::student::t_95;
use crate::unknowns::{DRY, INERTIA, LATE, OFFSET, SPRING, ZERO};

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

    /// Errors in variables: noise of the positions is in the columns, and takes its share off all that multiplies them: its
    /// power over what tells of their scale. Where the torque is hardly more than what is measured of the motion makes
    /// it, as of a joint that is guided by hand, that is much of it.
    pub(super) fn attenuated(&self, chosen: &Posterior, rows: f64, noise: f64) -> Matrix {
        let mut scale = chosen.x;
        for (i, unknown) in SPRING.enumerate() {
            scale[unknown] =
                if i == 0 || self.spring.law.is_polynomial() { self.spring.alpha[i] } else { 0.0 };
        }
        (scale[ZERO], scale[LATE]) = (0.0, 0.0);
        let open = chosen.covariance[INERTIA][INERTIA] / chosen.x[INERTIA].powi(2);
        let share = (self.readings.positions * rows / noise * open).min(1.0);
        let mut out = [[0.0; UNKNOWNS]; UNKNOWNS];
        for i in unknowns(chosen.set) {
            unknowns(chosen.set).for_each(|j| out[i][j] = share * share * scale[i] * scale[j]);
        }
        out
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
