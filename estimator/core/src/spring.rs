//! A spring's curve over the columns of a balance.
//!
//! F f(φ) ≈ Σ aₖ F bₖ(u) + Σ cₖ F bₖ′(u), u = φ over the deflection's size: five functions of a family that holds
//! the law, and their slopes, which a moved zero needs. A law, its slopes by its parameters and by φ become such
//! sums by least squares over the range of u; nothing that was filtered has to be filtered again.

use serde::{Deserialize, Serialize};

use crate::choices::{MARGIN, REACHED};
use crate::gram::{Cholesky, UNKNOWNS, set};
use crate::laws::Law;

/// Functions of a family.
pub const TERMS: usize = 5;

/// a, then c.
pub type Coefficients = [f64; 2 * TERMS];

pub(crate) const NODES: usize = 41; // of the least squares: four for each function
/// Slopes with which the link's position is multiplied.
pub const FIRST: usize = 2;
const RIDGE: f64 = 1e-12; // of the diagonal: two functions may be one

/// The functions that a curve is a sum of.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
pub enum Family {
    /// u, u³, u⁵, u⁷, u⁹.
    #[default]
    Smooth,
    /// sign(u) |u|ᵏ: a spring whose stiffness has a corner at zero.
    Kinked,
    /// g |u|ᵏ⁻¹, or g u^(2k−2) of a law without a corner; g the law's torque with this shape.
    Near(Law, f64),
}

impl Family {
    /// The one that holds a law.
    #[must_use]
    pub fn of(law: Option<&Law>) -> Family {
        match law {
            Some(Law::Exponential) => Family::Kinked,
            Some(law @ Law::Tabulated(_)) => Family::Near(law.clone(), 0.0),
            _ => Family::Smooth,
        }
    }

    /// bₖ and their slopes by u at a deflection of u times `size`.
    #[must_use]
    pub fn at(&self, u: f64, size: f64) -> Coefficients {
        let mut out = [0.0; 2 * TERMS];
        match self {
            Family::Smooth => {
                let mut power = 1.0;
                for k in 0..TERMS {
                    (out[k], out[TERMS + k]) = (power * u, (2 * k + 1) as f64 * power);
                    power *= u * u;
                }
            }
            Family::Kinked => {
                let mut power = 1.0;
                for k in 0..TERMS {
                    (out[k], out[TERMS + k]) = (power * u, (k + 1) as f64 * power);
                    power *= u.abs();
                }
            }
            Family::Near(..) => {
                let ((torque, slope), (whole, _)) = (self.law(u * size), self.law(size));
                let (torque, slope) = (torque / whole, slope * size / whole);
                let (powers, mut power) = (self.powers(), 1.0);
                let step = u.abs().powf(powers[1] - 1.0);
                for k in 0..TERMS {
                    let bend = (powers[k] - 1.0) * torque * power / if u == 0.0 { 1.0 } else { u };
                    (out[k], out[TERMS + k]) = (torque * power, slope * power + bend);
                    power *= step;
                }
            }
        }
        out
    }

    /// Torque and stiffness of the law that they are near to, with a k of 1; beyond its end as there.
    fn law(&self, phi: f64) -> (f64, f64) {
        let Family::Near(law, shape) = self else { return (phi, 1.0) };
        let end =
            if matches!(law, Law::Tabulated(_)) { f64::INFINITY } else { REACHED * law.reach(&[*shape]) };
        law.at(phi.clamp(-end, end), &[1.0, *shape])
    }

    /// Powers of u that the functions are, or nearly are.
    #[must_use]
    pub fn powers(&self) -> [f64; TERMS] {
        std::array::from_fn(|k| match self {
            Family::Kinked | Family::Near(Law::Exponential, _) => (k + 1) as f64,
            _ => (2 * k + 1) as f64,
        })
    }

    /// By what bₖ and bₖ′ are multiplied where the size grows.
    #[must_use]
    pub fn factors(&self, from: f64, to: f64) -> Coefficients {
        let (powers, ratio) = (self.powers(), from / to);
        let (less, whole) = match self {
            Family::Near(..) => (1, self.law(from).0 / self.law(to).0),
            _ => (0, 1.0),
        };
        let mut out = [0.0; 2 * TERMS];
        for k in 0..TERMS {
            out[k] = whole * ratio.powi(powers[k] as i32 - less);
            out[TERMS + k] = out[k] / ratio;
        }
        out
    }
}

/// Least squares of functions of φ over a family, at one size of the deflection.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct Projection {
    #[serde(with = "crate::snapshot::array")]
    nodes: [f64; NODES], // φ
    #[serde(with = "crate::snapshot::rows")]
    weights: [[f64; NODES]; 2 * TERMS],
    #[serde(with = "crate::snapshot::rows")]
    of_slopes: [[f64; NODES]; TERMS],
    #[serde(with = "crate::snapshot::rows")]
    of_first: [[f64; NODES]; FIRST], // by the first slopes alone
}

impl Projection {
    /// Over |φ| up to a little more than `size`, and no further than `reach`.
    #[must_use]
    pub fn new(family: &Family, size: f64, reach: f64) -> Projection {
        let edge = (MARGIN * size).min(reach);
        Projection::between(family, size, -edge, edge)
    }

    /// Over the deflections from `low` to `high`, by columns that are scaled by `size`.
    #[must_use]
    pub fn between(family: &Family, size: f64, low: f64, high: f64) -> Projection {
        let mut nodes = [0.0; NODES];
        for (k, node) in nodes.iter_mut().enumerate() {
            *node = low + (high - low) * k as f64 / (NODES - 1) as f64;
        }
        let rows = nodes.map(|phi| family.at(phi / size, size));
        let weights = least_squares(&rows, 0);
        let (of_slopes, of_first) = (least_squares(&rows, TERMS), least_squares(&rows, TERMS));
        Projection { nodes, weights, of_slopes, of_first }
    }

    /// The deflections at which a function is to be known, rad.
    #[must_use]
    pub fn nodes(&self) -> &[f64; NODES] {
        &self.nodes
    }

    /// Coefficients of the function that has these values at the nodes.
    #[must_use]
    pub fn fit(&self, values: &[f64]) -> Coefficients {
        std::array::from_fn(|i| self.weights[i].iter().zip(values).map(|(w, v)| w * v).sum())
    }

    /// Coefficients of a function of φ by slopes, and by the first ones alone, with which the link's signals are multiplied.
    #[must_use]
    pub fn of_slopes(&self, function: impl Fn(f64) -> f64) -> ([f64; TERMS], [f64; FIRST]) {
        let values = self.nodes.map(function);
        let sum = |weights: &[f64; NODES]| weights.iter().zip(&values).map(|(w, v)| w * v).sum();
        (self.of_slopes.each_ref().map(sum), self.of_first.each_ref().map(sum))
    }

    /// Coefficients of a function of φ.
    #[must_use]
    pub fn of(&self, function: impl Fn(f64) -> f64) -> Coefficients {
        self.fit(&self.nodes.map(function))
    }
}

/// By what values at the nodes are multiplied for the coefficients of N functions, from the one at `from` on.
fn least_squares<const N: usize>(rows: &[Coefficients; NODES], from: usize) -> [[f64; NODES]; N] {
    let mut normal = [[0.0; UNKNOWNS]; UNKNOWNS];
    for row in rows {
        for i in 0..N {
            (0..N).for_each(|j| normal[1 + i][1 + j] += row[from + i] * row[from + j]);
        }
    }
    (1..=N).for_each(|i| normal[i][i] *= 1.0 + RIDGE);
    let factors = Cholesky::new(set(1..N + 1), &normal);
    let mut weights = [[0.0; NODES]; N];
    for (k, row) in rows.iter().enumerate() {
        let mut right = [0.0; UNKNOWNS];
        right[1..=N].copy_from_slice(&row[from..from + N]);
        let solved = factors.solve(&right);
        weights.iter_mut().zip(&solved[1..]).for_each(|(weights, value)| weights[k] = *value);
    }
    weights
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::laws::Table;
    use std::sync::Arc;

    fn worst(law: &Law, alpha: &[f64], size: f64, zero: f64) -> f64 {
        let family = Family::of(Some(law));
        let projection = Projection::new(&family, size, f64::INFINITY);
        let found = projection.of(|phi| law.at(phi + zero, alpha).0);
        let mut worst: f64 = 0.0;
        for k in -50..=50 {
            let u = f64::from(k) / 50.0;
            let sum: f64 = family.at(u, size).iter().zip(&found).map(|(b, a)| b * a).sum();
            worst = worst.max((sum - law.at(u * size + zero, alpha).0).abs());
        }
        worst / law.at(size, alpha).0.abs()
    }

    #[test]
    fn slopes_hold_the_stiffness_of_a_law_that_bends_and_two_of_them_do_not() {
        let (law, alpha, size): (Law, &[f64], f64) = (Law::Exponential, &[100.0, 9.0], 0.2);
        let family = Family::of(Some(&law));
        let projection = Projection::new(&family, size, f64::INFINITY);
        let (all, first) = projection.of_slopes(|phi| law.at(phi, alpha).1);
        let worst = |weights: &[f64]| {
            let off = |k: i32| {
                let u = f64::from(k) / 50.0;
                let sum: f64 = family.at(u, size)[TERMS..].iter().zip(weights).map(|(b, a)| b * a).sum();
                (sum / law.at(u * size, alpha).1 - 1.0).abs()
            };
            (-50..=50).map(off).fold(0.0, f64::max)
        };
        assert!(worst(&all) < 0.01 && worst(&first) > 0.1, "{} {}", worst(&all), worst(&first));
    }

    #[test]
    fn each_family_holds_its_laws() {
        assert!(worst(&Law::Polynomial, &[100.0, 2000.0, 5e4], 0.2, 0.0) < 1e-7);
        assert!(worst(&Law::Polynomial, &[100.0, 2000.0], 0.2, 0.07) < 1e-7); // the zero is elsewhere
        assert!(worst(&Law::VsaII, &[500.0, 1.6], 0.3, 0.0) < 1e-5);
        assert!(worst(&Law::Exponential, &[100.0, 8.0], 0.2, 0.0) < 1e-3);
        let table = Arc::new(Table::new(&[0.05, 0.1, 0.2], &[3.0, 8.0, 30.0]).unwrap());
        assert!(worst(&Law::Tabulated(table), &[1.0], 0.15, 0.0) < 1e-6);
    }

    #[test]
    fn functions_near_a_law_hold_it_where_powers_do_not() {
        for (law, alpha, near, size) in
            [(Law::VsaII, [500.0, 1.75], 1.74, 1.1), (Law::Exponential, [100.0, 8.0], 7.0, 1.0)]
        {
            let left = |family: &Family| {
                let projection = Projection::new(family, size, f64::INFINITY);
                let sum = projection.of(|phi| law.at(phi, &alpha).0);
                let at = |phi: f64| -> f64 {
                    family.at(phi / size, size).iter().zip(&sum).map(|(b, a)| b * a).sum()
                };
                projection
                    .nodes()
                    .iter()
                    .map(|phi| (at(*phi) - law.at(*phi, &alpha).0).abs())
                    .fold(0.0, f64::max)
            };
            let most = 1e-3 * law.at(size, &alpha).0;
            assert!(left(&Family::Near(law.clone(), near)) < most);
            assert!(left(&Family::of(Some(&law))) > 10.0 * most);
        }
    }

    #[test]
    fn a_larger_size_is_a_factor_of_each_function() {
        let table = Arc::new(Table::new(&[0.05, 0.1, 0.2], &[3.0, 8.0, 30.0]).unwrap());
        let near = [(Law::Tabulated(table), 0.0), (Law::VsaII, 1.7), (Law::Exponential, 8.0)]
            .map(|(law, shape)| Family::Near(law, shape));
        for family in [Family::Smooth, Family::Kinked].into_iter().chain(near) {
            let (before, factors) = (family.at(0.8, 0.1), family.factors(0.1, 0.2));
            let after = family.at(0.4, 0.2);
            assert!((0..2 * TERMS).all(|k| (before[k] * factors[k] - after[k]).abs() < 1e-12));
        }
    }
}
