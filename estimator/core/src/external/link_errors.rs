//! Identifies the errors of the declared link from its balance.

use serde::{Deserialize, Serialize};

use super::{MEMORY_S, TINY};
use crate::choices::{MEAN_S, NOISE_S, ONE_WAY, SLOW, SLOW_S, SURE};
use crate::model::Link;

const PARAMETERS: usize = 6;
const CONSTANT: usize = 0;
const DAMPING: usize = 2;
pub(super) const DRY: usize = PARAMETERS - 1;

/// How far the declared link is off: identified from the link's own balance, where that is as expected.
///
/// Parameters: a constant torque, inertia, viscous damping, gravity's sine and cosine, dry friction. The
/// declared uncertainties are the priors. Recursive least squares with exponential forgetting in information
/// form, Λ = Λ₀ + Σ e^(−t/25 s) x xᵀ/r, each balance with the weight of Student's distribution: what is left of a push
/// has little.
///
/// The constant may be a push: it is identified with a flat prior so that the others have to explain what varies
/// with the motion, and it is not taken off: a load on a link at rest is no gravity. Of a link that turns one way
/// only, a load and friction are the same even so, since the load changes the speed: no friction is identified
/// there. A skew between the encoders makes σ d q′, which looks like damping; from the motor's side it looks like
/// the motor's friction.
#[derive(Clone, Copy, Debug, Default, Serialize, Deserialize)]
pub(super) struct LinkErrors {
    information: [[f64; PARAMETERS]; PARAMETERS], // of the data alone; the lower triangle
    vector: [f64; PARAMETERS],
    fastest: f64,
    seen_s: f64, // time of motion, and of balances that it was learned from
    learned_s: f64,
    direction: f64,    // its mean over the memory: ±1 one way only, 0 to and fro
    whole: [f64; 2],   // what all parameters make of the last row, the constant too, and its variance
    load: f64,         // mean of what they leave of late, N·m …
    slow: f64,         // … and pushes apart …
    left: Option<f64>, // … its mean square …
    unexplained: f64,  // … and the share of the time for which what varies is not what is expected
}

/// Gain of a mean over so many seconds, or over all that have passed.
fn lately(passed_s: &mut f64, period_s: f64, span_s: f64) -> f64 {
    *passed_s += period_s;
    period_s / passed_s.min(span_s)
}

pub(super) type Row = [f64; PARAMETERS];

impl LinkErrors {
    /// What the parameters multiply.
    pub(super) fn row(&mut self, link: &Link, [q, velocity, acceleration]: [f64; 3]) -> Row {
        self.fastest = self.fastest.max(velocity.abs());
        let dry = (velocity / (SLOW * self.fastest).max(TINY)).tanh();
        let (sine, cosine) = (q + link.gravity_phase).sin_cos();
        [1.0, acceleration, velocity, sine, cosine, dry]
    }

    /// One period of motion in this direction (−1 to 1) passes.
    pub(super) fn forget(&mut self, direction: f64, period_s: f64) {
        let kept = 1.0 - period_s / MEMORY_S;
        self.direction += lately(&mut self.seen_s, period_s, MEMORY_S) * (direction - self.direction);
        self.information.iter_mut().flatten().chain(&mut self.vector).for_each(|x| *x *= kept);
    }

    /// The torque that these errors make, and its variance: as identified, and as before any data; `damping`: its error then;
    /// `brakes`: whether no friction is declared.
    ///
    /// Torques of a hand that guides the link are as smooth as errors of the link. What was identified is believed where
    /// it explains the balance for more than half of the time; pushes are shorter.
    pub(super) fn at(&mut self, row: &Row, prior: &Row, damping: f64, brakes: bool) -> (f64, f64) {
        let (torque, variance) = self.identified(row, prior, damping, brakes);
        let expected = row[DAMPING] * damping;
        let before: f64 = (CONSTANT + 1..PARAMETERS).map(|i| row[i] * row[i] * prior[i]).sum();
        let believed = (2.0 * (1.0 - self.unexplained)).min(1.0);
        let between = believed * (1.0 - believed) * (torque - expected).powi(2);
        let mean = expected + believed * (torque - expected);
        (mean, believed * variance + (1.0 - believed) * before + between)
    }

    /// Whether errors of the link, or a load that stays, may leave so much; `expected`: variance of the rest.
    pub(super) fn is_usual(&self, left: f64, expected: f64) -> bool {
        let [torque, variance] = self.whole;
        (left - torque).abs() <= SURE * (variance + expected).sqrt()
    }

    /// How much noisier a balance seems than expected, 1 or more, by what is left of it; `expected`: its variance.
    ///
    /// A load that has come to stay is no error of the link, and no doubt about what was identified: only what varies is.
    pub(super) fn doubt(&mut self, left: f64, expected: f64, period_s: f64) -> f64 {
        // What is expected counts as one motion.
        let before = self.left.unwrap_or(expected * MEAN_S / (2.0 * NOISE_S));
        if self.left.is_none() {
            self.learned_s = MEAN_S;
        }
        let gain = lately(&mut self.learned_s, period_s, SLOW_S);
        let left = left - self.whole[0];
        let doubt_of = |left: f64| 1.0 + left * left / expected.max(TINY * TINY);
        let doubt = doubt_of(left);
        self.slow += period_s / NOISE_S * (left / doubt.sqrt() - self.slow);
        self.left = Some(before + gain * (self.slow * self.slow - before));
        self.load += period_s / NOISE_S * (left - self.load);
        let varying = doubt.min(doubt_of(left - self.load));
        self.unexplained += gain * (1.0 - varying.recip() - self.unexplained);
        doubt
    }

    fn identified(&mut self, row: &Row, prior: &Row, damping: f64, brakes: bool) -> (f64, f64) {
        let mut factor = self.information;
        let least = prior.map(|variance| if variance > 0.0 { 1.0 / variance } else { 1.0 });
        for i in 0..PARAMETERS {
            factor[i][i] += least[i];
        }
        // Cholesky, and L⁻¹ of both sides on the way. No pivot is less than what was known before any data.
        let mut own = *row;
        own[CONSTANT] = 0.0;
        let mut vector = self.vector;
        vector[DAMPING] += damping * least[DAMPING];
        let (mut torque, mut variance, mut level) = (0.0, 0.0, [0.0; PARAMETERS]);
        level[CONSTANT] = row[CONSTANT];
        self.whole = [0.0; 2];
        for i in 0..PARAMETERS {
            for j in 0..=i {
                let sum: f64 = (0..j).map(|k| factor[i][k] * factor[j][k]).sum();
                let left = factor[i][j] - sum;
                factor[i][j] =
                    if i == j { left.max(least[i]).max(TINY * TINY).sqrt() } else { left / factor[j][j] };
            }
            for k in 0..i {
                own[i] -= factor[i][k] * own[k];
                level[i] -= factor[i][k] * level[k];
                vector[i] -= factor[i][k] * vector[k];
            }
            own[i] /= factor[i][i];
            level[i] /= factor[i][i];
            vector[i] /= factor[i][i];
            // Friction that nobody declared brakes: what pushes the link on is a hand.
            if i == DRY && brakes && vector[i] > 0.0 {
                break;
            }
            torque += own[i] * vector[i];
            let all = own[i] + level[i];
            self.whole = [self.whole[0] + all * vector[i], self.whole[1] + all * all];
            variance += own[i] * own[i];
        }
        (torque, variance)
    }

    /// Spectral density at rest of what these errors leave of late, (N·m)² s: of its mean over [`NOISE_S`].
    pub(super) fn lasting(&self) -> f64 {
        2.0 * NOISE_S * self.left.unwrap_or(0.0)
    }

    /// What the declared link leaves of one balance; `noise`: its variance, as if errors were independent.
    pub(super) fn identify(&mut self, row: &Row, left: f64, noise: f64) {
        let weight = 1.0 / noise.max(TINY * TINY);
        let mut row = *row;
        if self.direction.abs() > ONE_WAY {
            (row[DAMPING], row[DRY]) = (0.0, 0.0);
        }
        for i in 0..PARAMETERS {
            self.vector[i] += weight * row[i] * left;
            for j in 0..=i {
                self.information[i][j] += weight * row[i] * row[j];
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn errors_of_the_link_are_found_from_its_balance_and_a_constant_is_not_taken_off() {
        let link = Link {
            inertia: 0.4,
            damping: 0.1,
            gravity: 6.0,
            gravity_phase: 0.0,
            inertia_std: 0.04,
            damping_std: 0.02,
            gravity_std: 0.6,
        };
        let truth: Row = [0.7, 0.03, -0.05, 0.5, -0.1, -0.2];
        let prior: Row = [1e6; PARAMETERS];
        let mut errors = LinkErrors { seen_s: MEMORY_S, ..LinkErrors::default() }; // to and fro
        let mut row = [0.0; PARAMETERS];
        for k in 0..4000 {
            let t = 5e-3 * f64::from(k);
            let (a, b) = (0.8 * (2.0 * t).sin(), 0.3 * (7.0 * t).sin());
            let speed = 1.6 * (2.0 * t).cos() + 2.1 * (7.0 * t).cos();
            row = errors.row(&link, [a + b, speed, -4.0 * a - 49.0 * b]);
            let left = row.iter().zip(truth).map(|(x, p)| x * p).sum();
            errors.forget(speed.signum(), 1e-6);
            errors.identify(&row, left, 1e-4);
        }
        let (torque, variance) = errors.at(&row, &prior, 0.0, true);
        let expected: f64 = row.iter().zip(truth).skip(1).map(|(x, p)| x * p).sum();
        assert!((torque - expected).abs() < 1e-4, "{torque} is not {expected}");
        assert!(variance > 0.0 && variance < 1e-4);
        // A torque along the motion is no friction.
        let push: Row = std::array::from_fn(|i| if i == DRY { 0.2 } else { 0.0 });
        let mut errors = LinkErrors { seen_s: MEMORY_S, ..LinkErrors::default() };
        for k in 0..4000 {
            let phase = 1e-2 * f64::from(k);
            row = errors.row(&link, [phase.sin(), phase.cos(), -phase.sin()]);
            errors.identify(&row, row[DRY] * push[DRY], 1e-4);
        }
        let known: Row = std::array::from_fn(|i| if i == DRY { 1e6 } else { 0.0 });
        let only: Row = std::array::from_fn(|i| if i == DRY { row[i] } else { 0.0 });
        assert!(errors.at(&only, &known, 0.0, true).0 == 0.0);
        assert!((errors.at(&only, &known, 0.0, false).0 - row[DRY] * push[DRY]).abs() < 0.02);
        // What is declared without doubt stays.
        assert!(LinkErrors::default().at(&row, &prior, 0.0, true).0 == 0.0);
    }
}
