//! Converts an estimated polynomial to the nonlinear law it approximates, with slopes.

use crate::laws::{Alpha, Law, PARAMETERS, powers};
use crate::linear_algebra::solve;

const POINTS: usize = 24;
const MARGIN: f64 = 1.02; // how far beyond the deflections a law has to go on
const ENOUGH: f64 = 0.1; // relative std of the higher coefficients below which the shape is determined
const GRID: usize = 30; // of a search over one shape parameter
const SECTIONS: usize = 60; // of the golden section that refines it
const ITERATIONS: usize = 60; // of damped Gauss-Newton over several of them

/// α of a law k g(φ, shape) and its slopes by the polynomial's coefficients; `None`: too early, or no shape
/// reaches so far.
///
/// The shape is searched, k follows linearly (variable projection), over |φ| ≤ reach.
#[must_use]
pub fn polynomial_to_law(
    law: &Law,
    coefficients: &[f64],
    std: &[f64],
    reach: f64,
) -> Option<(Alpha, [Alpha; PARAMETERS])> {
    let n = 1 + law.shapes().len();
    let determined = std.iter().zip(coefficients).enumerate().all(|(i, (std, coefficient))| match i {
        0 => *coefficient > 0.0 && *std <= 0.5 * ENOUGH * coefficient,
        i if i < n => *std <= ENOUGH * coefficient.abs(),
        _ => true,
    });
    if !determined {
        return None;
    }
    let mut phi = [0.0; POINTS];
    let mut curve = [0.0; POINTS];
    for p in 0..POINTS {
        phi[p] = reach * (p + 1) as f64 / POINTS as f64;
        curve[p] = Law::Polynomial.at(phi[p], coefficients).0;
    }
    let project = |shape: &[f64]| -> (f64, f64) {
        let (mut alpha, mut g, mut unused) = ([1.0; PARAMETERS], [0.0; POINTS], [0.0; POINTS]);
        alpha[1..n].copy_from_slice(shape);
        law.along(&phi, &alpha[..n], &mut g, &mut unused);
        let power: f64 = g.iter().map(|g| g * g).sum();
        let along: f64 = g.iter().zip(&curve).map(|(g, torque)| g * torque).sum();
        let k = if power > 0.0 { along / power } else { 0.0 };
        let cost: f64 = g.iter().zip(&curve).map(|(g, torque)| (k * g - torque).powi(2)).sum();
        (if cost.is_finite() { cost } else { f64::INFINITY }, k)
    };
    let mut alpha = [0.0; PARAMETERS];
    if n == 2 {
        alpha[1] = search(law, MARGIN * reach, |shape| project(&[shape]).0)?;
    } else {
        descend(law, &mut alpha[1..n], |shape| project(shape).0);
    }
    alpha[0] = project(&alpha[1..n]).1;
    if alpha[0].is_nan() || alpha[0] <= 0.0 {
        return None;
    }
    // Slopes: pinv(∂f/∂α) times the polynomial's Jacobian, by the normal equations in units of α.
    let (mut normal, mut right) = ([[0.0; PARAMETERS]; PARAMETERS], [[0.0; PARAMETERS]; PARAMETERS]);
    for phi in phi {
        let (mut row, mut old) = ([0.0; PARAMETERS], [0.0; PARAMETERS]);
        law.jacobian(phi, &alpha[..n], &mut row[..n]);
        powers(phi, &mut old[..coefficients.len()]);
        for i in 0..n {
            for j in 0..n {
                normal[i][j] += row[i] * alpha[i] * row[j] * alpha[j];
            }
            for j in 0..coefficients.len() {
                right[j][i] += row[i] * alpha[i] * old[j];
            }
        }
    }
    let mut slopes = [[0.0; PARAMETERS]; PARAMETERS];
    for j in 0..coefficients.len() {
        let solved = solve(&normal, &right[j], n);
        for i in 0..n {
            slopes[i][j] = solved[i] * alpha[i];
        }
    }
    Some((alpha, slopes))
}

/// The one shape parameter of least cost: a grid in decades from its lower bound, then a golden section.
fn search(law: &Law, reach: f64, cost: impl Fn(f64) -> f64) -> Option<f64> {
    let shape = law.shapes()[0];
    let span = if shape.start > shape.low { shape.start - shape.low } else { shape.high - shape.low };
    let (least, most) = (1e-3 * span, shape.high - shape.low);
    let value = |i: usize| shape.low + least * (most / least).powf(i as f64 / (GRID - 1) as f64);
    let reaches = |i: usize| law.reach(&[value(i)]) > reach;
    let (mut best, mut lowest) = (None, f64::INFINITY);
    for i in (0..GRID).filter(|i| reaches(*i)) {
        let now = cost(value(i));
        if now < lowest {
            (best, lowest) = (Some(i), now);
        }
    }
    let best = best?;
    let low = value(best.saturating_sub(1));
    let next = (best + 1).min(GRID - 1);
    let high = if reaches(next) { value(next) } else { value(best) };
    let ratio = 0.5 * (5f64.sqrt() - 1.0);
    let (mut a, mut b) = (low, high);
    let (mut c, mut d) = (b - ratio * (b - a), a + ratio * (b - a));
    let (mut at_c, mut at_d) = (cost(c), cost(d));
    for _ in 0..SECTIONS {
        if at_c < at_d {
            (b, d, at_d) = (d, c, at_c);
            c = b - ratio * (b - a);
            at_c = cost(c);
        } else {
            (a, c, at_c) = (c, d, at_d);
            d = a + ratio * (b - a);
            at_d = cost(d);
        }
    }
    Some(0.5 * (a + b))
}

/// Several shape parameters: one after the other, in steps that shrink where they do not help.
fn descend(law: &Law, shape: &mut [f64], cost: impl Fn(&[f64]) -> f64) {
    let bounds = law.shapes();
    let mut steps = [0.0; PARAMETERS];
    for (i, bound) in bounds.iter().enumerate() {
        shape[i] = bound.start;
        steps[i] = 0.2 * bound.start.abs().max(1e-3 * (bound.high - bound.low));
    }
    let mut lowest = cost(shape);
    for _ in 0..ITERATIONS {
        for i in 0..shape.len() {
            let here = shape[i];
            let mut helped = false;
            for step in [steps[i], -steps[i]] {
                shape[i] = (here + step).max(bounds[i].low).min(bounds[i].high);
                let now = cost(shape);
                if now < lowest {
                    (lowest, helped) = (now, true);
                    break;
                }
                shape[i] = here;
            }
            steps[i] *= if helped { 1.5 } else { 0.4 };
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_exponential_spring_is_found_from_its_series() {
        // f = (k/b) sinh-like odd series: k φ + k b φ|φ|/2 is not odd-polynomial, so fit the law's own curve.
        let (k, c) = (0.5, 1.75);
        let reach = 0.6;
        // Odd powers through the law by least squares on a fine grid.
        let n = 5;
        let (mut normal, mut right) = ([[0.0; PARAMETERS]; PARAMETERS], [0.0; PARAMETERS]);
        for p in 1..=200 {
            let phi: f64 = reach * f64::from(p) / 200.0;
            let mut row = [0.0; PARAMETERS];
            powers(phi, &mut row[..n]);
            for i in 0..n {
                right[i] += row[i] * Law::VsaII.at(phi, &[k, c]).0;
                for j in 0..n {
                    normal[i][j] += row[i] * row[j];
                }
            }
        }
        let coefficients = solve(&normal, &right, n);
        let found = polynomial_to_law(&Law::VsaII, &coefficients[..n], &[0.0; 5], reach).unwrap().0;
        assert!((found[0] / k - 1.0).abs() < 0.01 && (found[1] / c - 1.0).abs() < 0.01, "{found:?}");
    }
}
