//! Sums of products of a balance's columns, and the linear algebra that every question to them is.
//!
//! A row z of [`crate::balance`] obeys z · left = Σ xⱼ z · dⱼ + ε, with directions dⱼ of the unknowns xⱼ in the
//! space of the columns. Rows are summed into blocks G = Σ z zᵀ; blocks are summed. Estimates, their covariance,
//! the evidence of a sub-model and the misfit of a block follow from sums.

mod cholesky;
mod frame;

use std::ops::Range;

use serde::{Deserialize, Serialize};

pub(crate) use cholesky::Cholesky;
pub use frame::{Frame, Reduced};

/// Columns of a row.
pub const COLUMNS: usize = 42;

/// One value a column.
pub type Row = [f64; COLUMNS];

/// Unknowns of a balance, with index 0 for what they explain.
pub const UNKNOWNS: usize = 31;

/// One value an unknown.
pub type Vector = [f64; UNKNOWNS];

/// One value a pair of unknowns.
pub type Matrix = [Vector; UNKNOWNS];

/// A set of unknowns, one bit each.
pub type Set = u32;

const PIVOT: f64 = 1e-13; // of a scaled diagonal of 1: rounding of sums of products

/// COLUMNS, as a number that the compiler does not see: unrolled, 42 columns are 1764 statements a loop.
fn all() -> usize {
    std::hint::black_box(COLUMNS)
}

/// The bits of some unknowns.
#[must_use]
pub fn set(unknowns: Range<usize>) -> Set {
    unknowns.fold(0, |set, unknown| set | 1 << unknown)
}

/// z · c.
#[must_use]
pub fn dot(z: &Row, c: &Row) -> f64 {
    product(z, c)
}

/// Σ a b, in four sums side by side.
pub fn product(a: &[f64], b: &[f64]) -> f64 {
    let (fours, rest) = (a.chunks_exact(4).zip(b.chunks_exact(4)), a.len() / 4 * 4..a.len());
    let mut sums = [0.0; 4];
    fours.for_each(|(a, b)| (0..4).for_each(|k| sums[k] += a[k] * b[k]));
    let rest: f64 = a[rest.clone()].iter().zip(&b[rest]).map(|(a, b)| a * b).sum();
    sums.iter().sum::<f64>() + rest
}

/// Σ z zᵀ of rows, and how many rows.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Gram {
    #[serde(with = "crate::snapshot::rows")]
    sums: [Row; COLUMNS],
    /// Number of rows.
    pub rows: f64,
}

impl Default for Gram {
    fn default() -> Gram {
        Gram { sums: [[0.0; COLUMNS]; COLUMNS], rows: 0.0 }
    }
}

impl Gram {
    /// Add one row.
    pub fn add_row(&mut self, row: &Row) {
        for i in 0..all() {
            for (sum, z) in self.sums[i].iter_mut().zip(row) {
                *sum += row[i] * z;
            }
        }
        self.rows += 1.0;
    }

    /// Add the rows of another one; with a weight of −1 they are left out again.
    pub fn add(&mut self, other: &Gram, weight: f64) {
        for i in 0..all() {
            for (sum, z) in self.sums[i].iter_mut().zip(&other.sums[i]) {
                *sum += weight * z;
            }
        }
        self.rows += weight * other.rows;
    }

    /// The same rows with each column times a factor.
    pub fn scale(&mut self, factors: &Row) {
        for i in 0..all() {
            for (sum, factor) in self.sums[i].iter_mut().zip(factors) {
                *sum *= factors[i] * factor;
            }
        }
    }

    /// The noise in functions of signals that have this covariance of it: each with the column of its slope, by what that is
    /// multiplied, and its signal.
    #[must_use]
    pub fn noise<const N: usize>(
        &self,
        functions: &[(usize, usize, f64, usize)],
        covariance: &[[f64; N]; N],
    ) -> Gram {
        let mut out = Gram { rows: self.rows, ..Gram::default() };
        for (i, slope, factor, signal) in functions {
            for (j, other, more, with) in functions {
                out.sums[*i][*j] = covariance[*signal][*with] * factor * more * self.at(*slope, *other);
            }
        }
        out
    }

    /// One entry.
    #[must_use]
    pub fn at(&self, i: usize, j: usize) -> f64 {
        self.sums[i][j]
    }

    /// Root mean square of one column.
    #[must_use]
    pub fn rms(&self, column: usize) -> f64 {
        (self.sums[column][column] / self.rows.max(1.0)).max(0.0).sqrt()
    }

    /// G c.
    #[must_use]
    pub fn times(&self, c: &Row) -> Row {
        let mut out = [0.0; COLUMNS];
        for i in (0..all()).filter(|i| c[*i] != 0.0) {
            out.iter_mut().zip(&self.sums[i]).for_each(|(out, sum)| *out += sum * c[i]);
        }
        out
    }

    /// cᵀ G c: the sum of the squares of z · c.
    #[must_use]
    pub fn quadratic(&self, c: &Row) -> f64 {
        dot(&self.times(c), c).max(0.0)
    }
}

/// The unknowns of a set, in order.
pub fn unknowns(set: Set) -> impl Iterator<Item = usize> {
    (1..UNKNOWNS).filter(move |unknown| set >> unknown & 1 == 1)
}

/// Gaussian prior of the unknowns.
#[derive(Clone, Copy, Debug, Serialize, Deserialize)]
pub struct Prior {
    /// Expected values.
    pub mean: Vector,
    /// Inverse covariance.
    pub precision: Matrix,
}

impl Prior {
    /// Independent unknowns of these standard deviations, > 0.
    #[must_use]
    pub fn independent(mean: Vector, std: &Vector) -> Prior {
        let mut precision = [[0.0; UNKNOWNS]; UNKNOWNS];
        (0..UNKNOWNS).for_each(|i| precision[i][i] = std[i].powi(-2));
        Prior { mean, precision }
    }
}

/// Maximum a posteriori unknowns of a set, and what is known of them.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct Posterior {
    /// The unknowns that there are.
    pub set: Set,
    /// Their values; 0 outside the set.
    pub x: Vector,
    /// Their covariance; 0 outside the set.
    pub covariance: Matrix,
    /// ln of the marginal likelihood, but for what all sets have in common.
    pub log_evidence: f64,
    /// The square of what is left over the noise.
    pub square: f64,
}

impl Posterior {
    /// What is believed before any rows.
    #[must_use]
    pub fn believed(set: Set, x: Vector, covariance: Matrix) -> Posterior {
        Posterior { set, x, covariance, log_evidence: 0.0, square: 0.0 }
    }

    /// gᵀ C g.
    #[must_use]
    pub fn variance_along(&self, g: &Vector) -> f64 {
        let mut sum = 0.0;
        for i in unknowns(self.set).filter(|i| g[*i] != 0.0) {
            sum += g[i] * self.covariance[i].iter().zip(g).map(|(v, b)| v * b).sum::<f64>();
        }
        if sum < 0.0 { f64::INFINITY } else { sum } // rounding has left nothing of it: it is not known
    }
}

/// The inverse of a set's part of a positive definite matrix.
#[must_use]
pub fn inverse(matrix: &Matrix, set: Set) -> Matrix {
    Cholesky::new(set, matrix).inverse()
}

/// Information of a set's unknowns before and after the rows.
struct System<'a> {
    reduced: &'a Reduced,
    prior: &'a Prior,
    noise: f64,
    information: Matrix,
    set: Set,
    before: Cholesky,
    after: Cholesky,
}

impl System<'_> {
    fn new<'a>(reduced: &'a Reduced, set: Set, prior: &'a Prior, noise: f64) -> System<'a> {
        let mut information = prior.precision;
        for (i, row) in information.iter_mut().enumerate() {
            row.iter_mut().zip(&reduced[i]).for_each(|(value, sum)| *value += sum / noise);
        }
        let before = Cholesky::new(set, &prior.precision);
        let after = Cholesky::new(set, &information);
        System { reduced, prior, noise, information, set, before, after }
    }

    fn add(&mut self, more: Set) {
        self.before.add(more, &self.prior.precision);
        self.after.add(more, &self.information);
        self.set |= more;
    }

    fn take_away(&mut self, less: Set) {
        self.before.take_away(less.count_ones() as usize);
        self.after.take_away(less.count_ones() as usize);
        self.set &= !less;
    }

    /// ln of the marginal likelihood, and the square of what is left over the noise.
    ///
    /// A set with a weaker spring leaves less of the noise that is in the deflection: that speaks for none.
    fn evidence(&self) -> (f64, f64) {
        let (vector, explained) = self.vector();
        let white = self.after.whiten(&vector);
        let left = self.reduced.left_noise(&self.after.unwhiten(&white), self.set);
        let square = explained - product(&white, &white) - left / self.noise;
        (0.5 * (self.before.log_determinant() - self.after.log_determinant() - square), square)
    }

    /// What the rows and the prior say together, and the square of it.
    fn vector(&self) -> (Vector, f64) {
        let (mut vector, mut square) = ([0.0; UNKNOWNS], self.reduced[0][0] / self.noise);
        for i in unknowns(self.set) {
            vector[i] += self.reduced[i][0] / self.noise;
            let mean = self.prior.mean[i];
            if mean == 0.0 {
                continue;
            }
            for j in unknowns(self.set) {
                let pull = self.prior.precision[i][j] * mean;
                vector[j] += pull;
                square += self.prior.mean[j] * pull;
            }
        }
        (vector, square)
    }
}

/// ln of the marginal likelihood of a set's unknowns, but for what all sets have in common.
///
/// `noise`: variance of a row times the rows that an independent one is worth.
#[must_use]
pub fn log_evidence(reduced: &Reduced, set: Set, prior: &Prior, noise: f64) -> f64 {
    System::new(reduced, set, prior, noise).evidence().0
}

/// Posterior of a set's unknowns; `None`: a number is not finite. `noise`: see [`log_evidence`].
#[must_use]
pub fn solve(reduced: &Reduced, set: Set, prior: &Prior, noise: f64) -> Option<Posterior> {
    let system = System::new(reduced, set, prior, noise);
    let (covariance, (vector, _)) = (system.after.inverse(), system.vector());
    let mut x = [0.0; UNKNOWNS];
    unknowns(set).for_each(|i| x[i] = product(&covariance[i], &vector));
    let (log_evidence, square) = system.evidence();
    let finite = log_evidence.is_finite() && x.iter().all(|x| x.is_finite());
    finite.then_some(Posterior { set, x, covariance, log_evidence, square })
}

/// The groups of unknowns that the evidence adds to a base, one after the other.
///
/// A group is added if it raises the evidence by more than the number of groups: the odds against each before
/// any data. Of two that explain the same, one of the `usual` unknowns is as much likelier.
#[must_use]
pub fn choose(reduced: &Reduced, base: Set, groups: &[Set], usual: Set, prior: &Prior, noise: f64) -> Set {
    let threshold = (groups.iter().filter(|group| **group != 0).count().max(1) as f64).ln();
    let mut system = System::new(reduced, base, prior, noise);
    let mut best = system.evidence().0;
    loop {
        let mut next = (0, best, 0.0);
        for group in groups {
            let more = group & !system.set;
            if more == 0 {
                continue;
            }
            system.add(more);
            let tried = system.evidence().0;
            system.take_away(more);
            let odds = tried - best - threshold;
            let odds = if odds > 0.0 && more & !usual == 0 { odds + threshold } else { odds };
            if odds > next.2 {
                next = (more, tried, odds);
            }
        }
        if next.0 == 0 {
            return system.set;
        }
        system.add(next.0);
        best = next.1;
    }
}

/// Replace the covariance by the one that is robust to correlation inside blocks.
///
/// A⁻¹ (n/(n−p) Σ s sᵀ + P) A⁻¹ with the blocks' scores s over the noise and the prior's precision P: correlation
/// inside a block is in its score. p: the unknowns that the data decide, Σ(1 − P C). Needs more blocks than those;
/// returns the degrees of freedom, n − p, or `None`.
pub fn cluster(posterior: &mut Posterior, scores: &[Vector], prior: &Prior, noise: f64) -> Option<f64> {
    let (set, bread) = (posterior.set, posterior.covariance);
    let by_prior: f64 = unknowns(set)
        .map(|i| unknowns(set).map(|j| prior.precision[i][j] * bread[j][i]).sum::<f64>().clamp(0.0, 1.0))
        .sum();
    let freedom = scores.len() as f64 - (f64::from(set.count_ones()) - by_prior);
    if freedom < 2.0 {
        return None;
    }
    let weight = scores.len() as f64 / freedom / (noise * noise);
    let mut middle = prior.precision;
    for score in scores {
        for i in unknowns(set) {
            let scaled = weight * score[i];
            middle[i].iter_mut().zip(score).for_each(|(m, s)| *m += scaled * s);
        }
    }
    posterior.covariance = sandwich(&bread, &middle, set);
    Some(freedom)
}

/// C M C of a set's unknowns.
fn sandwich(bread: &Matrix, middle: &Matrix, set: Set) -> Matrix {
    let (mut half, mut out) = ([[0.0; UNKNOWNS]; UNKNOWNS], [[0.0; UNKNOWNS]; UNKNOWNS]);
    for i in unknowns(set) {
        for k in unknowns(set) {
            let factor = bread[i][k];
            half[i].iter_mut().zip(&middle[k]).for_each(|(h, m)| *h += factor * m);
        }
    }
    for i in unknowns(set) {
        for j in unknowns(set) {
            out[i][j] = unknowns(set).map(|k| half[i][k] * bread[k][j]).sum();
        }
    }
    out
}

/// C P C: what the prior leaves uncertain.
#[must_use]
pub fn by_prior(posterior: &Posterior, prior: &Prior) -> Matrix {
    sandwich(&posterior.covariance, &prior.precision, posterior.set)
}

#[cfg(test)]
mod tests;
