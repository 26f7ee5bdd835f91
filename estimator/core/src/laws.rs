//! Transmission laws τ_e = f(φ, α) (eqs 17-21, 24): torque, stiffness σ = ∂f/∂φ, and their slopes by α.
//!
//! Every law is odd in φ (eq 2). α holds the linear coefficients first, then the shape parameters. All
//! laws but the polynomials have one linear coefficient: f = k g(φ, shape).

use serde::{Deserialize, Serialize};

use std::fmt::Debug;
use std::sync::Arc;

/// Entries of α, at most: the ninth order and the first power that it leaves out.
pub const PARAMETERS: usize = 10;

/// α of any law, padded with zeros.
pub type Alpha = [f64; PARAMETERS];

const STEEPEST: f64 = 50.0; // largest exponent at which an exponential spring is still a spring
const OVERFLOW: f64 = 600.0; // exponent that is still a number
const EDGE: f64 = 1.0 - 1e-9; // how near to its end the arcsine of the VSA-II is taken
const STEP: f64 = 6.0e-6; // relative step of central differences, about ε^(1/3)

/// A law that lives elsewhere: f = k g(φ, shape), evaluated over slices.
pub trait Foreign: Debug + Send + Sync {
    /// g and ∂g/∂φ at each φ; NaN where they cannot be had.
    fn evaluate(&self, phi: &[f64], shape: &[f64], torque: &mut [f64], stiffness: &mut [f64]);
}

/// A shape parameter: where it may be, and where a search for it begins.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Shape {
    /// Least value.
    pub low: f64,
    /// Largest value.
    pub high: f64,
    /// Usual value.
    pub start: f64,
}

/// g(φ) as a table for φ ≥ 0, from (0, 0) on, a cubic with the slopes of its neighbours between the points.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Table {
    deflection: Vec<f64>,
    torque: Vec<f64>,
    slope: Vec<f64>,
}

/// A transmission's law.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub enum Law {
    /// f = K φ; α = (K).
    Linear,
    /// Odd powers up to φ^(2p−1) (eqs 21, 24); α = their coefficients.
    Polynomial,
    /// One transmission of the VSA-II (eqs 19, 20): f = 2 k β β', β = arcsin(C sin(φ/2)) − φ/2; α = (k, C).
    VsaII,
    /// f = sign(φ) (k/b) (exp(b|φ|) − 1); α = (k, b).
    Exponential,
    /// f = k g(φ), g a table; α = (k).
    Tabulated(Arc<Table>),
    /// f = k g(φ, shape) of somebody else's making.
    #[serde(skip)]
    Foreign(Arc<dyn Foreign>, Arc<[Shape]>),
}

const VSA_II: [Shape; 1] = [Shape { low: 1.0, high: 20.0, start: 1.1 }];
const EXPONENTIAL: [Shape; 1] = [Shape { low: 1e-6, high: 1e6, start: 1.0 }];

impl Law {
    /// By its name in joint files; `None`: one of somebody else's making.
    #[must_use]
    pub fn named(name: &str) -> Option<Law> {
        Some(match name {
            "linear" => Law::Linear,
            "polynomial" => Law::Polynomial,
            "vsa-ii" => Law::VsaII,
            "exponential" => Law::Exponential,
            _ => return None,
        })
    }

    /// Its shape parameters, which enter nonlinearly.
    #[must_use]
    pub fn shapes(&self) -> &[Shape] {
        match self {
            Law::Linear | Law::Polynomial | Law::Tabulated(_) => &[],
            Law::VsaII => &VSA_II,
            Law::Exponential => &EXPONENTIAL,
            Law::Foreign(_, shapes) => shapes,
        }
    }

    /// Whether α is the coefficients of odd powers.
    #[must_use]
    pub fn is_polynomial(&self) -> bool {
        matches!(self, Law::Linear | Law::Polynomial)
    }

    /// Largest |φ| for which it is defined, rad.
    #[must_use]
    pub fn reach(&self, shape: &[f64]) -> f64 {
        match self {
            Law::VsaII if shape[0] > 1.0 => 2.0 * (1.0 / shape[0]).asin(),
            Law::VsaII => std::f64::consts::PI,
            Law::Exponential if shape[0] > 0.0 => STEEPEST / shape[0],
            Law::Tabulated(table) => table.reach(),
            _ => f64::INFINITY,
        }
    }

    /// (τ_e, σ) at one deflection (eqs 17, 18); α holds just this law's parameters.
    #[must_use]
    pub fn at(&self, phi: f64, alpha: &[f64]) -> (f64, f64) {
        match self {
            Law::Linear | Law::Polynomial => polynomial(phi, alpha),
            Law::VsaII => vsa_ii(phi, alpha[0], alpha[1]),
            Law::Exponential => {
                let (k, b, x) = (alpha[0], alpha[1], exponent(alpha[1], phi));
                (sign(phi) * (k / b) * x.exp_m1(), k * x.exp())
            }
            Law::Tabulated(table) => {
                let (torque, slope) = table.at(phi);
                (alpha[0] * torque, alpha[0] * slope)
            }
            Law::Foreign(law, _) => {
                let (mut torque, mut stiffness) = ([0.0], [0.0]);
                law.evaluate(&[phi], &alpha[1..], &mut torque, &mut stiffness);
                (alpha[0] * torque[0], alpha[0] * stiffness[0])
            }
        }
    }

    /// ∂f/∂α at one deflection (eq 25), one entry a parameter.
    pub fn jacobian(&self, phi: f64, alpha: &[f64], out: &mut [f64]) {
        match self {
            Law::Linear | Law::Polynomial => powers(phi, out),
            Law::VsaII => {
                let (k, c) = (alpha[0], alpha[1]);
                let Vsa { sine, cosine, root, beta, slope } = Vsa::at(phi, c);
                let slope_c = 0.5 * cosine / (root * root * root);
                out[0] = 2.0 * beta * slope;
                out[1] = 2.0 * k * (sine / (c * root) * slope + beta * slope_c);
            }
            Law::Exponential => {
                let (k, b, x) = (alpha[0], alpha[1], exponent(alpha[1], phi));
                out[0] = sign(phi) * x.exp_m1() / b;
                out[1] = sign(phi) * (k / (b * b)) * (x * x.exp() - x.exp_m1());
            }
            Law::Tabulated(table) => out[0] = table.at(phi).0,
            Law::Foreign(..) => self.jacobian_along(&[phi], alpha, out),
        }
    }

    /// ∂σ/∂α at one deflection into `out`; returns ∂σ/∂φ.
    pub fn stiffness_slopes(&self, phi: f64, alpha: &[f64], out: &mut [f64]) -> f64 {
        if self.is_polynomial() {
            let (square, mut power, mut bend) = (phi * phi, 1.0, 0.0);
            for (h, (slot, coefficient)) in out.iter_mut().zip(alpha).enumerate() {
                let odd = (2 * h + 1) as f64;
                *slot = odd * power;
                if h > 0 {
                    bend += odd * (2 * h) as f64 * coefficient * power / if phi == 0.0 { 1.0 } else { phi };
                }
                power *= square;
            }
            return bend;
        }
        let n = alpha.len();
        let step = STEP * phi.abs().max(1e-3);
        let bend = (self.at(phi + step, alpha).1 - self.at(phi - step, alpha).1) / (2.0 * step);
        let mut near: Alpha = [0.0; PARAMETERS];
        near[..n].copy_from_slice(alpha);
        for i in 0..n {
            let step = STEP * alpha[i].abs().max(1e-3);
            near[i] = alpha[i] + step;
            let more = self.at(phi, &near[..n]).1;
            near[i] = alpha[i] - step;
            out[i] = (more - self.at(phi, &near[..n]).1) / (2.0 * step);
            near[i] = alpha[i];
        }
        bend
    }

    /// τ_e and σ at each deflection.
    pub fn along(&self, phi: &[f64], alpha: &[f64], torque: &mut [f64], stiffness: &mut [f64]) {
        if let Law::Foreign(law, _) = self {
            law.evaluate(phi, &alpha[1..], torque, stiffness);
            torque.iter_mut().chain(stiffness).for_each(|value| *value *= alpha[0]);
            return;
        }
        for ((phi, torque), stiffness) in phi.iter().zip(torque).zip(stiffness) {
            (*torque, *stiffness) = self.at(*phi, alpha);
        }
    }

    /// ∂f/∂α at each deflection, row after row.
    pub fn jacobian_along(&self, phi: &[f64], alpha: &[f64], out: &mut [f64]) {
        let n = alpha.len();
        let Law::Foreign(law, _) = self else {
            for (phi, row) in phi.iter().zip(out.chunks_exact_mut(n)) {
                self.jacobian(*phi, alpha, row);
            }
            return;
        };
        let (mut torque, mut unused) = (vec![0.0; phi.len()], vec![0.0; phi.len()]);
        law.evaluate(phi, &alpha[1..], &mut torque, &mut unused);
        torque.iter().zip(out.chunks_exact_mut(n)).for_each(|(g, row)| row[0] = *g);
        self.differences(phi, alpha, 1, out, |law, alpha, torque| {
            law.along(phi, alpha, torque, &mut vec![0.0; phi.len()]);
        });
    }

    /// ∂σ/∂α at each deflection, row after row.
    pub fn stiffness_jacobian_along(&self, phi: &[f64], alpha: &[f64], out: &mut [f64]) {
        if let Law::Foreign(..) = self {
            return self.differences(phi, alpha, 0, out, |law, alpha, stiffness| {
                law.along(phi, alpha, &mut vec![0.0; phi.len()], stiffness);
            });
        }
        for (phi, row) in phi.iter().zip(out.chunks_exact_mut(alpha.len())) {
            self.stiffness_slopes(*phi, alpha, row);
        }
    }

    /// Central differences by each parameter from the `first` on, of what `evaluate` writes; row after row.
    fn differences(
        &self,
        phi: &[f64],
        alpha: &[f64],
        first: usize,
        out: &mut [f64],
        evaluate: impl Fn(&Law, &[f64], &mut [f64]),
    ) {
        let (mut more, mut less, mut near) = (vec![0.0; phi.len()], vec![0.0; phi.len()], alpha.to_vec());
        for i in first..alpha.len() {
            let step = STEP * alpha[i].abs().max(1e-3);
            near[i] = alpha[i] + step;
            evaluate(self, &near, &mut more);
            near[i] = alpha[i] - step;
            evaluate(self, &near, &mut less);
            near[i] = alpha[i];
            for ((more, less), row) in more.iter().zip(&less).zip(out.chunks_exact_mut(alpha.len())) {
                row[i] = (more - less) / (2.0 * step);
            }
        }
    }
}

fn sign(x: f64) -> f64 {
    if x == 0.0 { 0.0 } else { x.signum() }
}

fn exponent(b: f64, phi: f64) -> f64 {
    (b * phi.abs()).min(OVERFLOW)
}

/// φ, φ³, φ⁵ …
pub fn powers(phi: f64, out: &mut [f64]) {
    let (square, mut power) = (phi * phi, phi);
    for slot in out {
        *slot = power;
        power *= square;
    }
}

fn polynomial(phi: f64, alpha: &[f64]) -> (f64, f64) {
    let (square, mut torque, mut stiffness) = (phi * phi, 0.0, 0.0);
    for (h, coefficient) in alpha.iter().enumerate().rev() {
        torque = torque * square + coefficient;
        stiffness = stiffness * square + (2 * h + 1) as f64 * coefficient;
    }
    (torque * phi, stiffness)
}

/// What eqs 19 and 20 are made of; `slope` is β'.
struct Vsa {
    sine: f64,
    cosine: f64,
    root: f64,
    beta: f64,
    slope: f64,
}

impl Vsa {
    fn at(phi: f64, c: f64) -> Vsa {
        let half = 0.5 * phi;
        let (sine, cosine) = half.sin_cos();
        let sine = (c * sine).clamp(-EDGE, EDGE);
        let root = (1.0 - sine * sine).sqrt();
        Vsa { sine, cosine, root, beta: sine.asin() - half, slope: 0.5 * (c * cosine / root - 1.0) }
    }
}

fn vsa_ii(phi: f64, k: f64, c: f64) -> (f64, f64) {
    let Vsa { sine, root, beta, slope, .. } = Vsa::at(phi, c);
    let bend = 0.25 * (c * c - 1.0) * sine / (root * root * root);
    (2.0 * k * beta * slope, 2.0 * k * (slope * slope + beta * bend))
}

impl Table {
    /// A table of g at growing deflections, both beginning above 0; `None` where it is no spring's.
    #[must_use]
    pub fn new(deflection: &[f64], torque: &[f64]) -> Option<Table> {
        let sane = |values: &[f64]| values.iter().all(|v| v.is_finite() && *v > 0.0);
        let grows = deflection.windows(2).all(|pair| pair[0] < pair[1]);
        if deflection.is_empty() || deflection.len() != torque.len() || !grows || !sane(deflection) {
            return None;
        }
        if !torque.iter().all(|v| v.is_finite()) {
            return None;
        }
        let x: Vec<f64> = std::iter::once(0.0).chain(deflection.iter().copied()).collect();
        let y: Vec<f64> = std::iter::once(0.0).chain(torque.iter().copied()).collect();
        let n = x.len();
        let secant = |i: usize| (y[i + 1] - y[i]) / (x[i + 1] - x[i]);
        // An odd curve's secants are alike on both sides of zero; inside, the parabola through three points.
        let slope = (0..n)
            .map(|i| match i {
                0 => secant(0),
                i if i == n - 1 => secant(n - 2),
                i => {
                    let (before, after) = (x[i] - x[i - 1], x[i + 1] - x[i]);
                    (secant(i - 1) * after + secant(i) * before) / (before + after)
                }
            })
            .collect();
        Some(Table { deflection: x, torque: y, slope })
    }

    fn reach(&self) -> f64 {
        *self.deflection.last().unwrap_or(&0.0)
    }

    /// (g, ∂g/∂φ); beyond its end the table goes on straight.
    pub fn at(&self, phi: f64) -> (f64, f64) {
        let (x, y, slope, size) = (&self.deflection, &self.torque, &self.slope, phi.abs());
        let last = x.len() - 1;
        let i = x.partition_point(|at| *at <= size).saturating_sub(1);
        if i >= last {
            return (phi.signum() * (y[last] + slope[last] * (size - x[last])), slope[last]);
        }
        let width = x[i + 1] - x[i];
        let t = (size - x[i]) / width;
        let (rise, m0, m1) = (y[i + 1] - y[i], slope[i] * width, slope[i + 1] * width);
        let (c2, c3) = (3.0 * rise - 2.0 * m0 - m1, m0 + m1 - 2.0 * rise);
        let value = y[i] + t * (m0 + t * (c2 + t * c3));
        (phi.signum() * value, (m0 + t * (2.0 * c2 + 3.0 * t * c3)) / width)
    }
}

#[cfg(test)]
mod tests;
