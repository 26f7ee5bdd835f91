//! Where a law of which no shape is known begins.

use super::Spring;
use crate::laws::Law;

const SHAPES: usize = 12; // of a law that are tried before any is known
const NARROWEST: f64 = 0.05; // of them: the bend that a shape makes over the deflection seen …
const WIDEST: f64 = 6.0; // … and the largest

impl Spring {
    /// Whether nothing is declared of a law's shape.
    #[must_use]
    pub fn is_searched(&self) -> bool {
        !self.anchored && !self.law.shapes().is_empty()
    }

    /// A usual shape parameter above its least value: an angle's of the VSA-II, else of a bend over this deflection.
    pub(super) fn bend_scale(&self, deflection: f64) -> f64 {
        if matches!(self.law, Law::VsaII) { 1.0 } else { deflection.recip() }
    }

    /// The shapes from which a law of one shape parameter may begin: the declared one; else some that reach as far.
    pub fn starts(&self, deflection: f64) -> impl Iterator<Item = f64> {
        let shape = self.law.shapes().first().copied().filter(|_| self.size == 2);
        let (law, scale) = (self.law.clone(), self.bend_scale(deflection));
        let declared = self.anchored.then_some(self.alpha[1]);
        let many = if self.anchored { 1 } else { SHAPES };
        (0..many).filter_map(move |k| {
            let shape = shape?;
            let bend = NARROWEST * (WIDEST / NARROWEST).powf(k as f64 / (SHAPES - 1) as f64);
            let value = declared.unwrap_or((shape.low + bend * scale).min(shape.high));
            (law.reach(&[value]) > deflection).then_some(value)
        })
    }

    /// The same law with this shape, of a k of 1 where none is declared: its torque is then its slope by k.
    #[must_use]
    pub fn shaped(&self, shape: f64) -> Spring {
        let mut other = self.clone();
        if !self.anchored {
            (other.alpha[0], other.alpha[1]) = (1.0, shape);
        }
        other
    }
}
