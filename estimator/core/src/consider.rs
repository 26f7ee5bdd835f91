//! Disturbances that are not estimated and still err: consider parameters (Schmidt, "Application of state-space
//! methods to navigation problems", Advances in Control Systems 3, 1966).
//!
//! y = h x + a c + e, with c known but for its size a. To estimate a would ascribe to that shape what is not of
//! it. The gains K are those without it, so x is off by a b, b ← b + K (c − h b), and the innovations hold
//! a d, d = c − h b. What is left of the balance bounds a: were it all the disturbance's, coherent over the
//! whole memory, it would be one observation of a with the variance s²/D, D the mean of d². So
//! var a = 1/(1 + D/s²) of what it is before any data, and s² is that part of the noise which is correlated
//! for longer than by the filters: white noise is no friction.

use crate::friction::SHAPES;
use crate::kalman::{Matrix, Vector};
use crate::linear_algebra::{dot, times};

/// What disturbances of one standard deviation have made of x, and of the innovations.
#[derive(Clone, Debug, Default)]
pub struct Considered {
    bias: [Vector; SHAPES],
    shown: [f64; SHAPES],
}

impl Considered {
    /// One equation with the gain that it has had.
    ///
    /// `known`: the noise's share of the innovation's variance, as the rest is for x to explain; `share`: of this
    /// equation in the averages.
    pub fn update(
        &mut self,
        h: &Vector,
        gain: &Vector,
        disturbances: &[f64; SHAPES],
        known: f64,
        share: f64,
    ) {
        for ((bias, shown), disturbance) in self.bias.iter_mut().zip(&mut self.shown).zip(disturbances) {
            let left = disturbance - dot(h, bias);
            bias.iter_mut().zip(gain).for_each(|(bias, gain)| *bias += gain * left);
            *shown += share * (known * left * left - *shown);
        }
    }

    /// Variance of what has these slopes by x; `noise`: s².
    #[must_use]
    pub fn variance(&self, slopes: &Vector, noise: f64) -> f64 {
        let of = |(bias, shown): (&Vector, &f64)| dot(slopes, bias).powi(2) * noise / (noise + shown);
        self.bias.iter().zip(&self.shown).map(of).sum()
    }

    /// x has become `change` x.
    pub fn transform(&mut self, change: &Matrix) {
        self.bias = self.bias.map(|bias| times(change, &bias));
    }

    /// x has become ratio x, and equations `noise` times as large.
    pub fn rescale(&mut self, ratio: &Vector, noise: f64) {
        self.shown.iter_mut().for_each(|shown| *shown *= noise * noise);
        for bias in &mut self.bias {
            bias.iter_mut().zip(ratio).for_each(|(bias, ratio)| *bias *= ratio);
        }
    }

    /// A parameter has been drawn towards zero with this gain.
    pub fn draw(&mut self, index: usize, gain: &Vector) {
        for bias in &mut self.bias {
            let drawn = bias[index];
            bias.iter_mut().zip(gain).for_each(|(bias, gain)| *bias -= drawn * gain);
        }
    }
}

#[cfg(test)]
mod tests {
    use crate::kalman::{Kalman, SIZE};

    /// Standard deviation of one parameter, from equations that hold this much of the disturbance.
    fn std(row: impl Fn(f64) -> f64, disturbance: impl Fn(f64) -> f64, held: f64) -> f64 {
        let mut kalman = Kalman::new(&[0.0], &[10.0], 0.01, 1.0);
        for k in 0..400 {
            let t = 0.03 * f64::from(k);
            let (mut h, c) = ([0.0; SIZE], disturbance(t));
            h[0] = row(t);
            let innovation = kalman.innovation(&h, held * c);
            let predicted_variance = kalman.predicted_variance(&h);
            kalman.learn_noise(innovation, predicted_variance);
            kalman.update(&h, innovation, 1e-10, &[c, 0.0, 0.0]);
            kalman.remember(innovation, predicted_variance);
        }
        let mut slopes = [0.0; SIZE];
        slopes[0] = 1.0;
        kalman.considered_variance(&slopes).sqrt()
    }

    #[test]
    fn a_disturbance_along_the_row_makes_all_of_its_size_uncertain() {
        assert!((std(|t| (3.0 * t).sin(), |t| 0.1 * (3.0 * t).sin(), 0.0) - 0.1).abs() < 0.005);
    }

    #[test]
    fn one_that_the_balance_would_show_is_bounded_by_what_is_left() {
        let other = |t: f64| 0.1 * ((3.0 * t).sin() + (5.0 * t).sin());
        let (absent, present) = (std(|t| (3.0 * t).sin(), other, 0.0), std(|t| (3.0 * t).sin(), other, 1.0));
        assert!(absent < 0.01 && present > 0.05, "{absent} {present}");
    }
}
