//! Friction and hysteresis with memory: one element of the Dahl, Bouc-Wen and elastic-slip family.

use serde::{Deserialize, Serialize};

use crate::library::{Element, Law};

/// From this exponent on an element is elastic up to its limit and then slips (Jenkins).
pub const STOP_EXPONENT: f64 = 50.0;

/// The state z of an element with memory: friction or hysteresis that builds up over a displacement.
///
/// dz/du = 1 − |z|ⁿ (β sgn(u′ z) + 1 − β), |z| ≤ 1, with u = x/d. n = 1, β = 1 is Dahl's law, n ≥ 1, β = 0.5
/// is Bouc-Wen's, n ≥ [`STOP_EXPONENT`] an elastic-slip element. Between two reversals y = z sgn(u′) moves
/// along one curve y(s), whatever the increments: an increment is a look-up on it. The curve is kept as
/// w = −ln(1 − y) over s, which is straight for Dahl's law.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct Memory {
    displacement: f64,
    arc: Vec<f64>, // s at each of equally spaced w; empty: elastic up to the limit
    state: f64,
}

const REVERSED: f64 = -std::f64::consts::LN_2; // w at y = −1: full sliding the other way
const SLIDING: f64 = 20.0; // w at which an element slides: y is 1 but for 2e-9
const POINTS: usize = 1024; // of w: errors of y are below 1e-4 up to the exponent 20

impl Memory {
    /// Begun at z = 0; of an element without one, what never moves.
    #[must_use]
    pub fn of(element: &Element) -> Memory {
        let [_, displacement, exponent, shape] = element.values;
        let elastic = !matches!(element.kind.law, Law::Memory { .. }) || exponent >= STOP_EXPONENT;
        let arc = if elastic { Vec::new() } else { Memory::curve(exponent.max(1.0), shape) };
        Memory { displacement, arc, state: 0.0 }
    }

    fn curve(exponent: f64, shape: f64) -> Vec<f64> {
        // dw/ds = (dy/ds)/(1 − y); its reciprocal, integrated over w.
        let slowness = |w: f64| {
            let gap = (-w).exp();
            let (y, size) = (1.0 - gap, (1.0 - gap).abs());
            let slope = 1.0 - size.powf(exponent - 1.0) * (shape * y + (1.0 - shape) * size);
            gap / slope.max(1e-3 * gap)
        };
        let mut arc = Vec::with_capacity(POINTS);
        let (mut s, mut before) = (0.0, slowness(REVERSED));
        arc.push(s);
        for k in 1..POINTS {
            let now = slowness(REVERSED + k as f64 * WIDTH);
            s += 0.5 * WIDTH * (before + now);
            before = now;
            arc.push(s);
        }
        arc
    }

    /// z after a further displacement.
    pub fn advance(&mut self, displacement: f64) -> f64 {
        if displacement == 0.0 {
            return self.state;
        }
        let (sign, u) = (1f64.copysign(displacement), displacement.abs() / self.displacement);
        let y = self.state * sign;
        let y = if self.arc.is_empty() { (y + u).min(1.0) } else { self.along(y, u) };
        self.state = sign * y;
        self.state
    }

    fn along(&self, y: f64, u: f64) -> f64 {
        let last = POINTS - 1;
        let place = ((-(1.0 - y).ln() - REVERSED) / WIDTH).clamp(0.0, last as f64);
        let k = (place as usize).min(last - 1);
        let s = self.arc[k] + (place - k as f64) * (self.arc[k + 1] - self.arc[k]) + u;
        let k = self.arc.partition_point(|arc| *arc <= s).clamp(1, last) - 1;
        let share = ((s - self.arc[k]) / (self.arc[k + 1] - self.arc[k])).min(1.0);
        1.0 - (-(REVERSED + (k as f64 + share) * WIDTH)).exp()
    }

    /// Begin at z = 0 again.
    pub fn reset(&mut self) {
        self.state = 0.0;
    }
}

const WIDTH: f64 = (SLIDING - REVERSED) / (POINTS - 1) as f64;

#[cfg(test)]
mod tests {
    use super::*;

    fn memory(exponent: f64, shape: f64) -> Memory {
        Memory::of(&Element::new("hysteresis", &[1.0, 1.0, exponent, shape]).unwrap())
    }

    #[test]
    fn dahl_friction_is_exact_for_any_increment() {
        let mut dahl = memory(1.0, 1.0);
        let mut exact = 0.0;
        for step in [0.2, 3.0, -0.4, -2.0, 1e-4, 0.7] {
            let y: f64 = exact * f64::signum(step);
            exact = f64::signum(step) * (1.0 - (1.0 - y) * (-f64::abs(step)).exp());
            assert!((dahl.advance(step) - exact).abs() < 1e-9);
        }
    }

    #[test]
    fn bouc_wen_of_the_second_order_is_straight_and_then_a_hyperbolic_tangent() {
        // β = 1/2: dy/ds is 1 below zero and 1 − y² above it.
        let mut law = memory(2.0, 0.5);
        for _ in 0..10 {
            law.advance(0.08);
        }
        assert!((law.state - 0.8f64.tanh()).abs() < 1e-4);
        assert!((law.advance(-0.3) - (0.8f64.tanh() - 0.3)).abs() < 1e-4);
    }

    #[test]
    fn an_elastic_element_slips_at_its_limit() {
        let mut law = memory(80.0, 1.0);
        assert!((law.advance(0.4) - 0.4).abs() < 1e-12 && (law.advance(-0.3) - 0.1).abs() < 1e-12);
        assert!((law.advance(5.0) - 1.0).abs() < 1e-12);
        assert!((law.advance(-0.5) - 0.5).abs() < 1e-12);
    }

    #[test]
    fn a_path_in_large_steps_ends_where_it_ends_in_small_ones() {
        for (exponent, shape) in [(1.5, 0.7), (2.0, 0.5), (20.0, 1.0), (3.0, 0.05)] {
            let (mut large, mut small) = (memory(exponent, shape), memory(exponent, shape));
            for step in [0.9, -2.5, 1.4, 0.3, -0.1] {
                large.advance(step);
                (0..100).for_each(|_| {
                    small.advance(step / 100.0);
                });
                assert!((large.state - small.state).abs() < 1e-9, "{exponent} {shape}");
                assert!(large.state.abs() <= 1.0);
            }
        }
    }
}
