//! A transmission's law linear in α: by itself, or by its tangent at α0 (eq 25).

use crate::kalman::{Matrix, NUISANCES, SIZE, Vector};
use crate::laws::{Alpha, Law, PARAMETERS, powers};
use crate::linear_algebra::{dot, solve, times};
use crate::signals::{COLUMNS, Channel};

const OFF_TANGENT: f64 = 0.3; // standard deviations that a law's curve leaves its tangent by, at most
const LOOKED_AT: [f64; 2] = [0.4, 0.9]; // of the largest deflection: where a curve is held against its tangent
const POINTS: usize = 16; // deflections that a nonlinear law is linearised anew over
const RIDGE: f64 = 1e-12; // relative, in the normal equations of that …
const STEPS: usize = 3; // … and Gauss-Newton steps for that

/// A law, how many parameters it has here, and where it is linearised.
#[derive(Clone, Debug)]
pub struct Linearisation {
    /// f(φ, α).
    pub law: Law,
    /// Entries of α.
    pub size: usize,
    /// Where a nonlinear law is linearised; of no meaning for a polynomial.
    pub alpha0: Alpha,
    tangent: [(f64, f64, Alpha); LOOKED_AT.len()], // deflection, torque and slopes at α0
}

impl Linearisation {
    /// Of this law with so many parameters.
    #[must_use]
    pub fn new(law: Law, size: usize, alpha0: Alpha) -> Linearisation {
        Linearisation { law, size, alpha0, tangent: [(0.0, 0.0, [0.0; PARAMETERS]); LOOKED_AT.len()] }
    }

    /// Whether it is linear in α by itself.
    #[must_use]
    pub fn is_polynomial(&self) -> bool {
        self.law.is_polynomial()
    }

    /// How many of α are linear coefficients: with them, by one factor, the curve's scale changes.
    #[must_use]
    pub fn linear(&self) -> usize {
        if self.is_polynomial() { self.size } else { 1 }
    }

    /// What the basis channels take in at a deflection: the slopes of f by α, and that of g by φ (or φ²).
    pub fn columns(&self, phi: f64, out: &mut [f64; COLUMNS]) {
        if self.is_polynomial() {
            powers(phi, &mut out[..self.size]);
            out[PARAMETERS] = phi * phi;
            return;
        }
        let mut alpha = self.alpha0;
        alpha[0] = 1.0;
        self.law.jacobian(phi, &alpha[..self.size], &mut out[..self.size]);
        out[PARAMETERS] = self.law.at(phi, &alpha[..self.size]).1;
    }

    /// The k-th derivative of F[∂f/∂α] into `row`; returns what refers y to the point of linearisation.
    pub fn fill_row(&self, basis: &[Channel; COLUMNS], k: usize, row: &mut Vector) -> f64 {
        for i in 0..self.size {
            row[i] = basis[i].main[k];
        }
        let mut referred = 0.0;
        if !self.is_polynomial() {
            // f ≈ k g + k0 (c − c0) ∂g/∂c
            for i in 1..self.size {
                row[i] *= self.alpha0[0];
                referred += row[i] * self.alpha0[i];
            }
        }
        referred
    }

    /// F[σ], or its derivative (k = 1), from the channel of φ², or of ∂g/∂φ.
    #[must_use]
    pub fn filtered_stiffness(&self, basis: &[Channel; COLUMNS], k: usize, values: &Vector) -> f64 {
        let last = &basis[PARAMETERS].main;
        if !self.is_polynomial() {
            return values[0] * last[k];
        }
        if k == 1 {
            return 3.0 * values[1] * last[1]; // of the black box, whose curve has two powers
        }
        let (mut sum, mut power) = (0.0, 1.0);
        for h in 0..self.size {
            sum += (2 * h + 1) as f64 * values[h] * power;
            power *= last[0];
        }
        sum
    }

    /// Where the tangent is to be looked at, for `leaves_tangent`; `deflection`: the largest.
    pub fn remember_tangent(&mut self, deflection: f64) {
        if self.is_polynomial() || self.alpha0[0] == 0.0 {
            return;
        }
        let n = self.size;
        for (place, part) in self.tangent.iter_mut().zip(LOOKED_AT) {
            place.0 = part * deflection;
            place.1 = self.law.at(place.0, &self.alpha0[..n]).0;
            self.law.jacobian(place.0, &self.alpha0[..n], &mut place.2[..n]);
        }
    }

    /// Whether the law's curve has left its tangent by more than a share of the curve's uncertainty.
    ///
    /// `covariance`: of the parameters in their `units`.
    #[must_use]
    pub fn leaves_tangent(&self, values: &Vector, units: &Vector, covariance: &Matrix, caution: f64) -> bool {
        let n = self.size;
        self.tangent.iter().any(|(phi, torque, slopes)| {
            let (mut row, mut on_tangent) = ([0.0; SIZE], *torque);
            for i in 0..n {
                on_tangent += slopes[i] * (values[i] - self.alpha0[i]);
                row[i] = slopes[i] * units[i];
            }
            let variance = caution * dot(&row, &times(covariance, &row));
            let off = self.law.at(*phi, &values[..n]).0 - on_tangent;
            off * off > OFF_TANGENT * OFF_TANGENT * variance
        })
    }

    /// Linearise anew where the parameters are; returns their slopes by the old ones, in their units.
    ///
    /// What has been learned is the curve, as far as the tangent at the old parameters goes. It is held: the
    /// new parameters are those of the curve nearest to it, and their covariance is that of the curve.
    /// Holding the parameters' covariance instead would make certain what no data have shown: the tangent
    /// turns, so along the direction in which parameters compensate each other, old and new seem to cross.
    pub fn relinearise(&mut self, values: &Vector, units: &Vector, deflection: f64) -> Matrix {
        let n = self.size;
        let (mut tangent, mut curve) = ([[0.0; PARAMETERS]; POINTS], [0.0; POINTS]);
        let at = |p: usize| deflection * (p + 1) as f64 / POINTS as f64;
        for p in 0..POINTS {
            self.law.jacobian(at(p), &self.alpha0[..n], &mut tangent[p][..n]);
            curve[p] = self.law.at(at(p), &self.alpha0[..n]).0;
            for i in 0..n {
                curve[p] += tangent[p][i] * (values[i] - self.alpha0[i]);
            }
        }
        let mut alpha: Vector = *values;
        let (mut normal, mut right) = ([[0.0; PARAMETERS]; PARAMETERS], [[0.0; PARAMETERS]; PARAMETERS]);
        for _ in 0..STEPS {
            (normal, right) = ([[0.0; PARAMETERS]; PARAMETERS], [[0.0; PARAMETERS]; PARAMETERS]);
            let (mut slopes, mut down) = ([0.0; PARAMETERS], [0.0; PARAMETERS]);
            for p in 0..POINTS {
                self.law.jacobian(at(p), &alpha[..n], &mut slopes[..n]);
                let left = curve[p] - self.law.at(at(p), &alpha[..n]).0;
                for i in 0..n {
                    slopes[i] *= units[i];
                }
                for i in 0..n {
                    down[i] += slopes[i] * left;
                    for j in 0..n {
                        normal[i][j] += slopes[i] * slopes[j];
                        right[i][j] += slopes[i] * (tangent[p][j] * units[j] - slopes[j]);
                    }
                }
            }
            // What the curve does not determine stays as it is.
            let ridge = RIDGE * (0..n).map(|i| normal[i][i]).sum::<f64>();
            (0..n).for_each(|i| normal[i][i] += ridge);
            let steps = solve(&normal, &down, n);
            for i in 0..n {
                alpha[i] += units[i] * steps[i];
            }
            bound(&self.law, &mut alpha);
        }
        let mut change: Matrix = [[0.0; SIZE]; SIZE];
        for j in 0..n {
            let mut column = [0.0; PARAMETERS];
            (0..n).for_each(|i| column[i] = right[i][j]);
            let solved = solve(&normal, &column, n);
            (0..n).for_each(|i| change[i][j] = solved[i]);
            change[j][j] += 1.0;
        }
        for i in n..n + NUISANCES {
            change[i][i] = 1.0;
        }
        self.alpha0[..n].copy_from_slice(&alpha[..n]);
        self.remember_tangent(deflection);
        change
    }
}

/// Shape parameters where they can be.
pub fn bound(law: &Law, values: &mut Vector) {
    for (i, shape) in law.shapes().iter().enumerate() {
        values[1 + i] = values[1 + i].max(shape.low * (1.0 + 1e-6)).min(shape.high);
    }
}
