//! Cholesky factorisation of a few unknowns out of many.

use super::{Matrix, PIVOT, Set, UNKNOWNS, Vector, unknowns};

/// A positive definite matrix of a set's unknowns as L Lᵀ, scaled by its diagonal.
pub(super) struct Cholesky {
    index: [usize; UNKNOWNS],
    n: usize,
    scale: Vector, // 1/√ of the diagonal
    factor: Matrix,
    pub(super) log_determinant: f64,
}

impl Cholesky {
    pub(super) fn new(set: Set, at: impl Fn(usize, usize) -> f64) -> Cholesky {
        let mut made = Cholesky {
            index: [0; UNKNOWNS],
            n: 0,
            scale: [0.0; UNKNOWNS],
            factor: [[0.0; UNKNOWNS]; UNKNOWNS],
            log_determinant: 0.0,
        };
        for unknown in unknowns(set) {
            made.index[made.n] = unknown;
            made.scale[made.n] = at(unknown, unknown).max(f64::MIN_POSITIVE).sqrt().recip();
            made.n += 1;
        }
        for i in 0..made.n {
            for j in 0..=i {
                let rest: f64 = (0..j).map(|k| made.factor[i][k] * made.factor[j][k]).sum();
                let value = at(made.index[i], made.index[j]) * made.scale[i] * made.scale[j] - rest;
                made.factor[i][j] = if i == j { value.max(PIVOT).sqrt() } else { value / made.factor[j][j] };
            }
            made.log_determinant += 2.0 * (made.factor[i][i].ln() - made.scale[i].ln());
        }
        made
    }

    /// L⁻¹ of a scaled vector.
    pub(super) fn whiten(&self, b: &Vector) -> Vector {
        let mut out = [0.0; UNKNOWNS];
        for i in 0..self.n {
            let rest: f64 = (0..i).map(|k| self.factor[i][k] * out[k]).sum();
            out[i] = (b[self.index[i]] * self.scale[i] - rest) / self.factor[i][i];
        }
        out
    }

    /// L⁻ᵀ of a whitened vector, by unknowns.
    pub(super) fn unwhiten(&self, white: &Vector) -> Vector {
        let (mut scaled, mut out) = (*white, [0.0; UNKNOWNS]);
        for i in (0..self.n).rev() {
            let rest: f64 = (i + 1..self.n).map(|k| self.factor[k][i] * scaled[k]).sum();
            scaled[i] = (scaled[i] - rest) / self.factor[i][i];
            out[self.index[i]] = scaled[i] * self.scale[i];
        }
        out
    }

    /// The inverse, by unknowns.
    pub(super) fn inverse(&self) -> Matrix {
        let (mut lower, mut out) = ([[0.0; UNKNOWNS]; UNKNOWNS], [[0.0; UNKNOWNS]; UNKNOWNS]);
        for i in 0..self.n {
            lower[i][i] = self.factor[i][i].recip();
            for j in 0..i {
                let rest: f64 = (j..i).map(|k| self.factor[i][k] * lower[k][j]).sum();
                lower[i][j] = -rest / self.factor[i][i];
            }
        }
        for i in 0..self.n {
            for j in 0..=i {
                let c: f64 = (i..self.n).map(|k| lower[k][i] * lower[k][j]).sum();
                let value = c * self.scale[i] * self.scale[j];
                out[self.index[i]][self.index[j]] = value;
                out[self.index[j]][self.index[i]] = value;
            }
        }
        out
    }
}
