//! Recursive joint estimation with a covariance that is valid under coloured noise.
//!
//! A Kalman filter for constant parameters computes a covariance P that is valid for white noise only. Behind
//! a filter the noise is coloured. So a second covariance, Σ, is computed: that of the estimate with the same
//! gains under noise with the autocorrelation measured on the innovations (the sandwich of a misspecified
//! likelihood, White 1982, one equation at a time). P decides the gains, Σ is what is published.

use crate::consider::Considered;
use crate::friction::SHAPES;
use crate::laws::PARAMETERS;
use crate::linear_algebra::{congruent, dot, is_positive, symmetric, times};

/// Parameters besides the transmission's, see [`crate::transmission`].
pub const NUISANCES: usize = 6;
/// Parameters, at most.
pub const SIZE: usize = PARAMETERS + NUISANCES;
/// A vector of parameters, padded with zeros.
pub type Vector = [f64; SIZE];
/// A matrix of parameters, padded with zeros.
pub type Matrix = [Vector; SIZE];

const LAGS: usize = 16; // updates over which the noise is correlated …
const FILTERED: usize = 2; // … and over which it is by the filters alone
const MEMORY: f64 = 500.0; // updates over which the noise's autocorrelation is averaged
const QUICK: f64 = 3.0; // the noise is an average over this share, one in so many, of the updates so far
const HALVED: f64 = 6.0; // updates in which the noise assumed at the start may at most be halved
const LEAST_FREEDOM: f64 = 4.0; // independent errors that are left over parameters
/// Degrees of freedom of the noise's t distribution: an outlier in a few hundred.
pub const TAILS: f64 = 8.0;

/// Constant parameters x from scalar equations y = h x + e with coloured e; all in scaled units.
#[derive(Clone, Debug)]
pub struct Kalman {
    n: usize,
    /// Parameters.
    pub x: Vector,
    /// Their covariance if the noise were white: it decides the gains.
    pub p: Matrix,
    /// Their covariance under the noise that is seen.
    pub sigma: Matrix,
    /// No more variance than this is ever assumed (against wind-up).
    pub ceiling: Vector,
    /// Variance of e.
    pub noise: f64,
    /// How much larger a variance is than Σ has it, as it was estimated from few independent errors.
    pub caution: f64,
    growth: f64,
    grow: Vector, // √growth; 1 for what is not forgotten
    considered: Considered,
    gains: [Vector; LAGS], // what is left of past gains in the estimate, newest first
    past: [f64; LAGS],     // past innovations, newest first
    r: [f64; LAGS],
    assumed: f64,
    count: f64,
}

fn taper(lag: usize) -> f64 {
    (2.0 - 2.0 * (lag + 1) as f64 / (LAGS + 1) as f64).min(1.0)
}

impl Kalman {
    /// Before any data.
    ///
    /// `mean` and `std`: of x, of which no more uncertainty is ever assumed; `noise`: standard deviation of e
    /// assumed at the start; `growth`: of P from one update to the next, at least 1.
    #[must_use]
    pub fn new(mean: &[f64], std: &[f64], noise: f64, growth: f64) -> Kalman {
        let n = mean.len();
        let (mut x, mut p, mut ceiling) = ([0.0; SIZE], [[0.0; SIZE]; SIZE], [0.0; SIZE]);
        for i in 0..n {
            x[i] = mean[i];
            ceiling[i] = std[i] * std[i];
            p[i][i] = ceiling[i];
        }
        let mut made = Kalman {
            n,
            x,
            p,
            sigma: p,
            ceiling,
            noise: noise * noise,
            caution: 1.0,
            growth,
            grow: [growth.sqrt(); SIZE],
            considered: Considered::default(),
            gains: [[0.0; SIZE]; LAGS],
            past: [0.0; LAGS],
            r: [0.0; LAGS],
            assumed: noise * noise,
            count: 0.0,
        };
        made.caution = made.few();
        made
    }

    /// A parameter that is not forgotten.
    pub fn keep(&mut self, index: usize) {
        self.grow[index] = 1.0;
    }

    /// How many parameters.
    #[must_use]
    pub fn size(&self) -> usize {
        self.n
    }

    /// What y is beyond h x.
    #[must_use]
    pub fn innovation(&self, h: &Vector, y: f64) -> f64 {
        y - dot(h, &self.x)
    }

    /// Variance of h x as P has it.
    #[must_use]
    pub fn predicted_variance(&self, h: &Vector) -> f64 {
        dot(h, &times(&self.p, h)).max(0.0)
    }

    /// Weight of an innovation under noise with the tails of a t distribution: 1 on average, → 0 far out.
    #[must_use]
    pub fn weight(&self, innovation: f64, predicted_variance: f64) -> f64 {
        (TAILS + 1.0) / (TAILS + innovation * innovation / (self.noise + predicted_variance))
    }

    /// The share of an innovation that is noise, one that sticks out counting less.
    ///
    /// Of an innovation's variance, noise and what P predicts, the noise has its share:
    /// innovation² noise/(noise + predicted_variance) has the noise for its mean.
    fn noisy(&self, innovation: f64, predicted_variance: f64) -> f64 {
        let weight = self.weight(innovation, predicted_variance).min(1.0);
        innovation * (weight * self.noise / (self.noise + predicted_variance)).sqrt()
    }

    /// Take one innovation into the noise's autocorrelation.
    pub fn learn_noise(&mut self, innovation: f64, predicted_variance: f64) {
        self.count += 1.0;
        let gain = self.share();
        let e = self.noisy(innovation, predicted_variance);
        // As many parameters as there have been equations explain anything: the start is not believed.
        let least = self.assumed * 0.5f64.powf(self.count / HALVED);
        self.noise = (self.noise + gain * (e * e - self.noise)).max(least);
        for lag in 0..LAGS {
            self.r[lag] += gain * (e * self.past[lag] - self.r[lag]);
        }
    }

    /// Of one innovation in the averages.
    fn share(&self) -> f64 {
        (QUICK / (self.count + QUICK)).max(1.0 / MEMORY)
    }

    /// Variance that disturbances which are not estimated add to what has these slopes by x.
    #[must_use]
    pub fn considered_variance(&self, slopes: &Vector) -> f64 {
        // Root mean square of the autocorrelation beyond the filters', as far as so few innovations show it.
        let beyond = &self.r[FILTERED..];
        let square = beyond.iter().map(|r| r * r).sum::<f64>() / beyond.len() as f64;
        let correlated = (square + self.share() * self.noise * self.noise).sqrt().min(self.noise);
        self.considered.variance(slopes, correlated.max(1e-300))
    }

    /// Shift the record of past innovations; after `learn_noise`, which wants those before this one.
    pub fn remember(&mut self, innovation: f64, predicted_variance: f64) {
        self.past.copy_within(..LAGS - 1, 1);
        self.past[0] = self.noisy(innovation, predicted_variance);
    }

    /// Variance of the noise over the square of its scale, as its tails have it.
    #[must_use]
    pub fn tailed(&self) -> f64 {
        TAILS / (TAILS - 2.0)
    }

    /// How many equations there are to one independent error.
    #[must_use]
    pub fn correlation(&self) -> f64 {
        let sum: f64 = (0..LAGS).map(|lag| self.r[lag] * taper(lag)).sum();
        (1.0 + 2.0 * sum / self.noise.max(1e-300)).max(1.0)
    }

    /// What Σ is multiplied by: noise that is a t variable has a larger variance than its scale squared, and
    /// few independent errors determine either only roughly.
    #[must_use]
    pub fn variance_over_scale(&self) -> f64 {
        self.caution * self.tailed()
    }

    /// How much larger a variance estimated from few independent errors is: that of a t distribution.
    fn few(&self) -> f64 {
        let squares: f64 =
            (0..LAGS).map(|lag| (self.r[lag] * taper(lag) / self.noise.max(1e-300)).powi(2)).sum();
        let seen = self.count.min(2.0 / (self.growth - 1.0).max(1e-9));
        let freedom = (seen / (1.0 + 2.0 * squares) - self.n as f64).max(LEAST_FREEDOM);
        freedom / (freedom - 2.0)
    }

    /// One equation: its row, its innovation, the least noise variance to reckon with, and what it may hold besides.
    pub fn update(&mut self, h: &Vector, innovation: f64, floor: f64, disturbances: &[f64; SHAPES]) {
        let n = self.n;
        let mut ph = times(&self.p, h);
        let mut predicted_variance = dot(h, &ph);
        if predicted_variance < 0.0 {
            self.repair();
            ph = times(&self.p, h);
            predicted_variance = dot(h, &ph).max(0.0);
        }
        let noise = self.noise.max(floor) / self.weight(innovation, predicted_variance).min(1.0);
        let mut gain = [0.0; SIZE];
        for i in 0..n {
            gain[i] = ph[i] / (predicted_variance + noise);
            self.x[i] += gain[i] * innovation;
        }
        for i in 0..n {
            for j in 0..n {
                self.p[i][j] = self.grow[i] * self.grow[j] * (self.p[i][j] - gain[i] * ph[j]);
            }
        }
        self.carry(h, &gain, noise);
        let known = noise / (predicted_variance + noise);
        self.considered.update(h, &gain, disturbances, known, self.share());
        self.caution = self.few();
        self.keep_bounded();
    }

    /// Σ over one equation: x̃_k = A x̃_(k−1) + K e_k with A = 1 − K h, where e_k is correlated with x̃_(k−1)
    /// through the gains that past innovations had.
    fn carry(&mut self, h: &Vector, gain: &Vector, noise: f64) {
        let n = self.n;
        let seen = times(&self.sigma, h);
        let mut cross = [0.0; SIZE];
        for lag in 0..LAGS {
            let weight = self.r[lag] * taper(lag);
            for i in 0..n {
                cross[i] += weight * self.gains[lag][i];
            }
        }
        // A Σ A' + K noise K' + A c K' + K c' A', with c = Σ_m r_m gains_m the correlation of e and x̃.
        let weight = 0.5 * (dot(h, &seen) + noise) - dot(h, &cross);
        for i in 0..n {
            cross[i] += weight * gain[i] - seen[i];
        }
        for i in 0..n {
            for j in 0..n {
                self.sigma[i][j] += cross[i] * gain[j] + gain[i] * cross[j];
            }
        }
        for left in &mut self.gains {
            let seen = dot(h, left);
            for i in 0..n {
                left[i] -= seen * gain[i];
            }
        }
        self.gains.copy_within(..LAGS - 1, 1);
        self.gains[0] = *gain;
    }

    /// No parameter more uncertain than before any data, none much surer than P says.
    fn keep_bounded(&mut self) {
        let mut shrink = [1.0; SIZE];
        let mut wound_up = false;
        for i in 0..self.n {
            if self.p[i][i] > self.ceiling[i] {
                shrink[i] = (self.ceiling[i] / self.p[i][i]).sqrt();
                wound_up = true;
            }
        }
        if wound_up {
            for i in 0..self.n {
                for j in 0..self.n {
                    self.p[i][j] *= shrink[i] * shrink[j];
                }
            }
        }
        for i in 0..self.n {
            self.sigma[i][i] = self.sigma[i][i].max(1e-4 * self.p[i][i]);
        }
    }

    /// Whether parameters and covariances still are numbers.
    #[must_use]
    pub fn is_finite(&self) -> bool {
        (0..self.n).all(|i| self.x[i].is_finite() && self.p[i][i].is_finite() && self.sigma[i][i].is_finite())
    }

    /// P symmetric, as rounding leaves it only nearly, and no direction with a negative variance.
    pub fn keep_regular(&mut self) {
        symmetric(&mut self.p, self.n);
        symmetric(&mut self.sigma, self.n);
        if !is_positive(&self.p, self.n) {
            self.repair();
        }
    }

    /// Both covariances positive definite again: correlations are drawn towards zero until they are.
    fn repair(&mut self) {
        for matrix in [&mut self.p, &mut self.sigma] {
            symmetric(matrix, self.n);
            let largest = (0..self.n).map(|i| matrix[i][i].abs()).fold(0.0, f64::max);
            for i in 0..self.n {
                matrix[i][i] = matrix[i][i].abs().max(1e-14 * largest);
            }
            for _ in 0..40 {
                if is_positive(matrix, self.n) {
                    break;
                }
                for i in 0..self.n {
                    for j in 0..self.n {
                        if i != j {
                            matrix[i][j] *= 0.9;
                        }
                    }
                }
            }
        }
    }

    /// Add a variance to one parameter, in both covariances: it may have changed by so much.
    pub fn inflate(&mut self, index: usize, variance: f64) {
        self.p[index][index] += variance;
        self.sigma[index][index] += variance;
        self.ceiling[index] = self.ceiling[index].max(self.p[index][index]);
    }

    /// Add a covariance along one direction to both.
    pub fn inflate_along(&mut self, direction: &Vector) {
        for i in 0..self.n {
            for j in 0..self.n {
                self.p[i][j] += direction[i] * direction[j];
                self.sigma[i][j] += direction[i] * direction[j];
            }
            self.ceiling[i] = self.ceiling[i].max(self.p[i][i]);
        }
    }

    /// What goes on with other parameters, under the same noise.
    ///
    /// `mean`: the new parameters; `ceiling`: their largest variances; `change`: their slopes by the old ones.
    #[must_use]
    pub fn transformed(&self, mean: &[f64], ceiling: &[f64], change: &Matrix) -> Kalman {
        let mut new = self.clone();
        new.n = mean.len();
        // The last parameters are the same ones in both.
        new.grow = [self.growth.sqrt(); SIZE];
        for i in 1..=NUISANCES.min(new.n).min(self.n) {
            new.grow[new.n - i] = self.grow[self.n - i];
        }
        new.x = [0.0; SIZE];
        new.ceiling = [0.0; SIZE];
        new.x[..new.n].copy_from_slice(mean);
        new.ceiling[..new.n].copy_from_slice(ceiling);
        new.p = congruent(change, &self.p);
        new.sigma = congruent(change, &self.sigma);
        for (new, old) in new.gains.iter_mut().zip(&self.gains) {
            *new = times(change, old);
        }
        new.considered.transform(change);
        for i in 0..new.n {
            new.ceiling[i] = new.ceiling[i].max(new.p[i][i]);
        }
        new
    }

    /// Parameters in new units, x becomes ratio x; and equations, y, h x and e become `noise` times as large.
    pub fn rescale(&mut self, ratio: &Vector, noise: f64) {
        for i in 0..self.n {
            self.x[i] *= ratio[i];
            self.ceiling[i] *= ratio[i] * ratio[i];
            for j in 0..self.n {
                self.p[i][j] *= ratio[i] * ratio[j];
                self.sigma[i][j] *= ratio[i] * ratio[j];
            }
            self.gains.iter_mut().for_each(|gain| gain[i] *= ratio[i]);
        }
        // A gain is parameters over innovation.
        self.gains.iter_mut().flatten().for_each(|gain| *gain /= noise);
        self.considered.rescale(ratio, noise);
        self.noise *= noise * noise;
        self.assumed *= noise * noise;
        self.r.iter_mut().for_each(|r| *r *= noise * noise);
        self.past.iter_mut().for_each(|past| *past *= noise);
    }

    /// Draw one parameter towards zero, as an observation of zero with `share` of its variance does.
    pub fn draw(&mut self, index: usize, share: f64) {
        let n = self.n;
        let variance = share * self.sigma[index][index];
        let own = self.p[index];
        if own[index] <= 0.0 {
            return;
        }
        let (mut gain, value) = ([0.0; SIZE], self.x[index]);
        for i in 0..n {
            gain[i] = self.p[i][index] / ((1.0 + share) * own[index]);
            self.x[i] -= gain[i] * value;
        }
        // Σ becomes (1 − g e') Σ (1 − e g') + g g' variance.
        let (row, corner) = (self.sigma[index], self.sigma[index][index]);
        for i in 0..n {
            for j in 0..n {
                self.p[i][j] -= gain[i] * own[j];
                self.sigma[i][j] +=
                    gain[i] * gain[j] * (corner + variance) - gain[i] * row[j] - row[i] * gain[j];
            }
        }
        self.considered.draw(index, &gain);
        for left in &mut self.gains {
            let drawn = left[index];
            for i in 0..n {
                left[i] -= drawn * gain[i];
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn exact_equations_give_the_exact_parameters() {
        let mut kalman = Kalman::new(&[0.0, 0.0], &[30.0, 30.0], 0.01, 1.0);
        for k in 0..400 {
            let mut h = [0.0; SIZE];
            (h[0], h[1]) = ((0.3 * f64::from(k)).sin(), (0.7 * f64::from(k)).cos());
            let y = 2.0 * h[0] - 3.0 * h[1];
            let innovation = kalman.innovation(&h, y);
            let predicted_variance = kalman.predicted_variance(&h);
            kalman.learn_noise(innovation, predicted_variance);
            kalman.update(&h, innovation, 1e-10, &[0.0; SHAPES]);
            kalman.remember(innovation, predicted_variance);
        }
        assert!((kalman.x[0] - 2.0).abs() < 1e-4 && (kalman.x[1] + 3.0).abs() < 1e-4);
        assert!(kalman.sigma[0][0] < 1e-6);
    }

    #[test]
    fn with_white_noise_both_covariances_are_that_of_a_mean() {
        // Mean of n values of variance 1: variance 1/n. A fixed sequence of ±1 without correlation.
        let mut kalman = Kalman::new(&[0.0], &[100.0], 1.0, 1.0);
        let mut state = 1u64;
        for _ in 0..2000 {
            state ^= state << 13;
            state ^= state >> 7;
            state ^= state << 17;
            let y = if state & 1 == 0 { 1.0 } else { -1.0 };
            let mut h = [0.0; SIZE];
            h[0] = 1.0;
            let innovation = kalman.innovation(&h, y);
            let predicted_variance = kalman.predicted_variance(&h);
            kalman.learn_noise(innovation, predicted_variance);
            kalman.update(&h, innovation, 1e-10, &[0.0; SHAPES]);
            kalman.remember(innovation, predicted_variance);
        }
        assert!((kalman.p[0][0] * 2000.0 - 1.0).abs() < 0.15, "{}", kalman.p[0][0] * 2000.0);
        assert!((kalman.sigma[0][0] * 2000.0 - 1.0).abs() < 0.6, "{}", kalman.sigma[0][0] * 2000.0);
        assert!(kalman.x[0].abs() < 0.1);
    }

    #[test]
    fn other_units_change_no_prediction() {
        let mut kalman = Kalman::new(&[1.0, 2.0], &[1.0, 3.0], 0.1, 1.0);
        let mut h = [0.0; SIZE];
        (h[0], h[1]) = (0.4, -0.2);
        kalman.update(&h, 0.3, 1e-10, &[0.0; SHAPES]);
        let before = (dot(&h, &kalman.x), kalman.predicted_variance(&h));
        let mut ratio = [1.0; SIZE];
        (ratio[0], ratio[1]) = (2.0, 5.0);
        kalman.rescale(&ratio, 3.0);
        (h[0], h[1]) = (0.4 / 2.0, -0.2 / 5.0);
        assert!((dot(&h, &kalman.x) - before.0).abs() < 1e-12);
        assert!((kalman.predicted_variance(&h) - before.1).abs() < 1e-12);
    }
}
