//! Cholesky factorisation of a few unknowns out of many, to which others are added and taken away again.

use super::{Matrix, PIVOT, Set, UNKNOWNS, Vector, product, unknowns};

/// A positive definite matrix of some unknowns as Uᵀ U, scaled by its diagonal.
pub(crate) struct Cholesky {
    index: [usize; UNKNOWNS],
    n: usize,
    scale: Vector, // 1/√ of the diagonal
    factor: Matrix,
    logs: Vector, // ln of the determinant of the first ones
}

impl Cholesky {
    pub(crate) fn new(set: Set, matrix: &Matrix) -> Cholesky {
        let mut made = Cholesky {
            index: [0; UNKNOWNS],
            n: 0,
            scale: [0.0; UNKNOWNS],
            factor: [[0.0; UNKNOWNS]; UNKNOWNS],
            logs: [0.0; UNKNOWNS],
        };
        made.add(set, matrix);
        made
    }

    /// More unknowns, of the same matrix.
    pub(super) fn add(&mut self, set: Set, matrix: &Matrix) {
        for unknown in unknowns(set) {
            let (n, row) = (self.n, &matrix[unknown]);
            let scale = row[unknown].max(f64::MIN_POSITIVE).sqrt().recip();
            let mut column = [0.0; UNKNOWNS];
            for k in 0..n {
                column[k] = row[self.index[k]] * self.scale[k] * scale;
            }
            self.substitute(&mut column);
            let rest = product(&column[..n], &column[..n]);
            let pivot = (row[unknown] * scale * scale - rest).max(PIVOT).sqrt();
            for (above, value) in self.factor[..n].iter_mut().zip(&column) {
                above[n] = *value;
            }
            self.factor[n][n] = pivot;
            (self.index[n], self.scale[n], self.n) = (unknown, scale, n + 1);
            self.logs[n] = self.log_of(n) + 2.0 * (pivot / scale).ln();
        }
    }

    /// As it was with so many unknowns less.
    pub(super) fn take_away(&mut self, count: usize) {
        self.n -= count;
    }

    fn log_of(&self, n: usize) -> f64 {
        if n == 0 { 0.0 } else { self.logs[n - 1] }
    }

    /// ln of the determinant.
    pub(super) fn log_determinant(&self) -> f64 {
        self.log_of(self.n)
    }

    /// U⁻ᵀ of a vector, in its place.
    fn substitute(&self, vector: &mut Vector) {
        for k in 0..self.n {
            let (done, rest) = vector[k..self.n].split_at_mut(1);
            let value = done[0] / self.factor[k][k];
            done[0] = value;
            rest.iter_mut().zip(&self.factor[k][k + 1..]).for_each(|(v, u)| *v -= u * value);
        }
    }

    /// U⁻ᵀ of a scaled vector.
    pub(super) fn whiten(&self, b: &Vector) -> Vector {
        let mut out = [0.0; UNKNOWNS];
        for k in 0..self.n {
            out[k] = b[self.index[k]] * self.scale[k];
        }
        self.substitute(&mut out);
        out
    }

    /// U⁻¹ of a whitened vector, by unknowns.
    pub(super) fn unwhiten(&self, white: &Vector) -> Vector {
        let (mut scaled, mut out, n) = (*white, [0.0; UNKNOWNS], self.n);
        for i in (0..n).rev() {
            let rest = product(&self.factor[i][i + 1..n], &scaled[i + 1..n]);
            scaled[i] = (scaled[i] - rest) / self.factor[i][i];
            out[self.index[i]] = scaled[i] * self.scale[i];
        }
        out
    }

    /// The solution for one right side, by unknowns.
    pub(crate) fn solve(&self, b: &Vector) -> Vector {
        self.unwhiten(&self.whiten(b))
    }

    /// The inverse, by unknowns.
    pub(super) fn inverse(&self) -> Matrix {
        let (mut lower, mut sums, mut out) =
            ([[0.0; UNKNOWNS]; UNKNOWNS], [[0.0; UNKNOWNS]; UNKNOWNS], [[0.0; UNKNOWNS]; UNKNOWNS]);
        for i in 0..self.n {
            let (above, rest) = lower.split_at_mut(i);
            let row: &mut Vector = &mut rest[0];
            for (k, one) in above.iter().enumerate() {
                let factor = self.factor[k][i];
                row[..=k].iter_mut().zip(one).for_each(|(v, l)| *v -= factor * l);
            }
            row[i] = 1.0;
            let pivot = self.factor[i][i].recip();
            row[..=i].iter_mut().for_each(|v| *v *= pivot);
            for j in 0..=i {
                let factor = row[j];
                sums[j][..=j].iter_mut().zip(&*row).for_each(|(sum, l)| *sum += factor * l);
            }
        }
        for i in 0..self.n {
            for j in 0..=i {
                let value = sums[i][j] * self.scale[i] * self.scale[j];
                out[self.index[i]][self.index[j]] = value;
                out[self.index[j]][self.index[i]] = value;
            }
        }
        out
    }
}
