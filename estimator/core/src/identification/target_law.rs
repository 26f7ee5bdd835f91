//! The switch from polynomial to the declared nonlinear law, and its linearisation as parameters move.

use super::OnlineIdentification;
use crate::kalman::{Kalman, Matrix, NUISANCES, SIZE, Vector};
use crate::laws::{Alpha, PARAMETERS};
use crate::linear_algebra::times;
use crate::linearisation::Linearisation;
use crate::model_switch::polynomial_to_law;

const HANDED_OVER: f64 = 3.0; // by which the covariance of parameters from a polynomial grows

impl OnlineIdentification {
    /// Go over from the polynomial to the law, or linearise that anew; whether the basis is another one now.
    pub fn switch_model(&mut self) -> bool {
        if self.law.is_polynomial() {
            return self.adopt_target();
        }
        self.unscale();
        let Some(kalman) = &self.kalman else { return false };
        if !self.law.leaves_tangent(&self.values, &self.units.of, &kalman.sigma, kalman.caution) {
            return false;
        }
        let change = self.law.relinearise(&self.values, &self.units.of, self.units.deflection);
        let (old, mut mean) = (kalman.x, kalman.x);
        for i in 0..self.law.size {
            mean[i] = self.law.alpha0[i] / self.units.of[i];
        }
        let all = self.law.size + NUISANCES;
        for kalman in [&mut self.kalman, &mut self.reference, &mut self.candidate].into_iter().flatten() {
            let (mut own, mut off) = (mean, [0.0; SIZE]);
            (0..all).for_each(|i| off[i] = kalman.x[i] - old[i]);
            let off = times(&change, &off);
            (0..all).for_each(|i| own[i] += off[i]);
            *kalman = kalman.transformed(&own[..all], &kalman.ceiling[..all], &change);
        }
        true
    }

    /// From the polynomial to the nonlinear law that it approximates; false where it is too early.
    fn adopt_target(&mut self) -> bool {
        let (Some(kalman), Some(target)) = (&self.kalman, &self.target) else { return false };
        let n_old = self.law.size;
        let mut std = [0.0; PARAMETERS];
        for i in 0..n_old {
            std[i] = (kalman.caution * kalman.sigma[i][i].max(0.0)).sqrt() * self.units.of[i];
        }
        let coefficients = &self.values[..n_old];
        let Some((alpha, slopes)) =
            polynomial_to_law(target, coefficients, &std[..n_old], self.units.deflection)
        else {
            return false;
        };
        let (old_units, kalman) = (self.units.of, kalman.clone());
        let target = target.clone();
        self.forget_reference();
        let size = 1 + target.shapes().len();
        self.law = Linearisation::new(target, size, alpha);
        self.make_units();
        let (mean, ceiling, change) = self.adopted(&kalman, &alpha, &slopes, &old_units, n_old);
        let n = self.law.size;
        let mut adopted = kalman.transformed(&mean[..n + NUISANCES], &ceiling[..n + NUISANCES], &change);
        for i in 0..n {
            for j in 0..n {
                let wider = HANDED_OVER * adopted.sigma[i][j];
                adopted.p[i][j] += wider;
                adopted.sigma[i][j] += wider;
            }
            adopted.ceiling[i] = adopted.ceiling[i].max(adopted.p[i][i]);
        }
        self.kalman = Some(adopted);
        self.law.remember_tangent(self.units.deflection);
        true
    }

    /// The law's parameters, their largest variances, and their slopes by the polynomial's, all scaled.
    fn adopted(
        &self,
        kalman: &Kalman,
        alpha: &Alpha,
        slopes: &[Alpha; PARAMETERS],
        old_units: &Vector,
        n_old: usize,
    ) -> (Vector, Vector, Matrix) {
        let (mut mean, mut ceiling, mut change) = ([0.0; SIZE], [1.0; SIZE], [[0.0; SIZE]; SIZE]);
        let n = self.law.size;
        for i in 0..n {
            mean[i] = alpha[i] / self.units.of[i];
            for j in 0..n_old {
                change[i][j] = slopes[i][j] * old_units[j] / self.units.of[i];
            }
        }
        for i in 0..NUISANCES {
            mean[n + i] = kalman.x[n_old + i];
            ceiling[n + i] = kalman.ceiling[n_old + i];
            change[n + i][n_old + i] = 1.0;
        }
        (mean, ceiling, change)
    }
}
