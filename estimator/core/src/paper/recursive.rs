//! Recursive least squares (eqs 22, 23).

use serde::{Deserialize, Serialize};

use crate::laws::{Alpha, PARAMETERS};

/// Least squares in α one row at a time (eqs 22, 23), the same answer as the batch.
///
/// Kept as the triangular square root of the normal equations (QR by Givens rotations), so that columns of
/// very different size (φ, φ³, φ⁵ …) cost no more accuracy than they do in a batch QR.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct RecursiveLeastSquares {
    /// How many coefficients.
    pub size: usize,
    r: [[f64; PARAMETERS + 1]; PARAMETERS],
    error: f64,
    rows: f64,
}

impl RecursiveLeastSquares {
    /// For so many coefficients.
    #[must_use]
    pub fn new(size: usize) -> RecursiveLeastSquares {
        RecursiveLeastSquares { size, r: [[0.0; PARAMETERS + 1]; PARAMETERS], error: 0.0, rows: 0.0 }
    }

    /// Take in one row J_j and its right-hand side r_j.
    pub fn update(&mut self, row: &[f64], value: f64) {
        let n = self.size;
        let mut new = [0.0; PARAMETERS + 1];
        new[..n].copy_from_slice(&row[..n]);
        new[n] = value;
        for i in 0..n {
            if new[i] == 0.0 {
                continue;
            }
            let old = &mut self.r[i];
            let norm = old[i].hypot(new[i]);
            let (c, s) = (old[i] / norm, new[i] / norm);
            for j in i..=n {
                (old[j], new[j]) = (c * old[j] + s * new[j], c * new[j] - s * old[j]);
            }
        }
        self.error += new[n] * new[n];
        self.rows += 1.0;
    }

    /// Coefficients; 0 where the rows so far do not determine them.
    #[must_use]
    pub fn alpha(&self) -> Alpha {
        let mut alpha = [0.0; PARAMETERS];
        for i in (0..self.size).rev() {
            let row = &self.r[i];
            if row[i] > 0.0 {
                let rest: f64 = (i + 1..self.size).map(|j| row[j] * alpha[j]).sum();
                alpha[i] = (row[self.size] - rest) / row[i];
            }
        }
        alpha
    }

    /// Standard deviation of slopes · α if the rows' errors were independent; NaN where it is undetermined.
    #[must_use]
    pub fn std(&self, slopes: &[f64]) -> f64 {
        let n = self.size;
        if self.rows <= n as f64 {
            return f64::NAN;
        }
        // |R^-T slopes|, by forward substitution.
        let (mut solved, mut square) = ([0.0; PARAMETERS], 0.0);
        for i in 0..n {
            let rest: f64 = (0..i).map(|j| self.r[j][i] * solved[j]).sum();
            solved[i] = (slopes[i] - rest) / self.r[i][i];
            square += solved[i] * solved[i];
        }
        (square * self.error / (self.rows - n as f64)).sqrt()
    }
}
