//! Vectors and small matrices, padded with zeros to the size that a joint's parameters have at most.

use crate::kalman::{Matrix, SIZE, Vector};
use crate::laws::{Alpha, PARAMETERS};

/// a · b.
#[must_use]
pub fn dot(a: &Vector, b: &Vector) -> f64 {
    a.iter().zip(b).map(|(a, b)| a * b).sum()
}

/// M v.
#[must_use]
pub fn times(matrix: &Matrix, vector: &Vector) -> Vector {
    let mut out = [0.0; SIZE];
    for (out, row) in out.iter_mut().zip(matrix) {
        *out = dot(row, vector);
    }
    out
}

/// C M C'.
#[must_use]
pub fn congruent(change: &Matrix, matrix: &Matrix) -> Matrix {
    let mut half = [[0.0; SIZE]; SIZE]; // M C', row by row of C
    for (out, row) in half.iter_mut().zip(change) {
        *out = times(matrix, row);
    }
    let mut out = [[0.0; SIZE]; SIZE];
    for i in 0..SIZE {
        for j in 0..SIZE {
            out[i][j] = dot(&change[i], &half[j]);
        }
    }
    out
}

/// The upper triangle and the lower one become their mean.
pub fn symmetric(matrix: &mut Matrix, n: usize) {
    for i in 0..n {
        for j in 0..i {
            let mean = 0.5 * (matrix[i][j] + matrix[j][i]);
            (matrix[i][j], matrix[j][i]) = (mean, mean);
        }
    }
}

/// Whether a Cholesky factorisation succeeds; what is known exactly is no direction.
#[must_use]
pub fn is_positive(matrix: &Matrix, n: usize) -> bool {
    let mut lower = [[0.0; SIZE]; SIZE];
    for i in 0..n {
        for j in 0..=i {
            let rest: f64 = (0..j).map(|k| lower[i][k] * lower[j][k]).sum();
            let left = matrix[i][j] - rest;
            if i == j {
                if left <= 0.0 && matrix[i][i] != 0.0 {
                    return false;
                }
                lower[i][i] = left.max(0.0).sqrt();
            } else if lower[j][j] > 0.0 {
                lower[i][j] = left / lower[j][j];
            }
        }
    }
    true
}

/// x of A x = b, A symmetric and positive definite, n of it.
#[must_use]
pub fn solve(a: &[Alpha; PARAMETERS], b: &Alpha, n: usize) -> Alpha {
    let (mut lower, mut x) = ([[0.0; PARAMETERS]; PARAMETERS], [0.0; PARAMETERS]);
    for i in 0..n {
        for j in 0..=i {
            let rest: f64 = (0..j).map(|k| lower[i][k] * lower[j][k]).sum();
            let value = a[i][j] - rest;
            lower[i][j] = if i == j { value.max(1e-300).sqrt() } else { value / lower[j][j] };
        }
    }
    for i in 0..n {
        let rest: f64 = (0..i).map(|k| lower[i][k] * x[k]).sum();
        x[i] = (b[i] - rest) / lower[i][i];
    }
    for i in (0..n).rev() {
        let rest: f64 = (i + 1..n).map(|k| lower[k][i] * x[k]).sum();
        x[i] = (x[i] - rest) / lower[i][i];
    }
    x
}
