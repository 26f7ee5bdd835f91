//! Discretised filters: exact for a held torque, with exact ratios between derivatives for a position.
//!
//! A torque command is held over a period (zero-order hold); a position is interpolated linearly between
//! samples (first-order hold). Filters built on these assumptions give a signal and its derivatives without
//! differentiating samples.

use serde::{Deserialize, Serialize};

const TERMS: usize = 18; // of the exponential's series: at a norm of 1/2 the next one is below rounding

/// Pole exp(−K T) of K/(s + K), discretised exactly.
#[must_use]
pub fn first_order_pole(k_rad_s: f64, period_s: f64) -> f64 {
    (-k_rad_s * period_s).exp()
}

/// x_k = A x_(k−1) + old u_(k−1) + new u_k.
#[derive(Clone, Copy, Debug, Serialize, Deserialize)]
pub struct Step<const N: usize> {
    #[serde(with = "crate::snapshot::rows")]
    advance: [[f64; N]; N],
    #[serde(with = "crate::snapshot::array")]
    old: [f64; N],
    #[serde(with = "crate::snapshot::array")]
    new: [f64; N],
}

impl<const N: usize> Step<N> {
    /// The state one period later.
    #[inline]
    pub fn apply(&self, state: &mut [f64; N], before: f64, now: f64) {
        let mut next = [0.0; N];
        for i in 0..N {
            let mut sum = self.old[i] * before + self.new[i] * now;
            for j in 0..N {
                sum += self.advance[i][j] * state[j];
            }
            next[i] = sum;
        }
        *state = next;
    }

    /// The same for many signals side by side: `state[i][l]` is state i of signal l.
    #[inline]
    pub fn apply_lanes<const L: usize>(&self, state: &mut [[f64; L]; N], before: &[f64; L], now: &[f64; L]) {
        let last = *state;
        for i in 0..N {
            let next = &mut state[i];
            for l in 0..L {
                next[l] = self.old[i] * before[l] + self.new[i] * now[l];
            }
            for (a, from) in self.advance[i].iter().zip(&last) {
                for l in 0..L {
                    next[l] += a * from[l];
                }
            }
        }
    }
}

/// F(s) = wⁿ/(s + w)ⁿ with the derivatives s^i F as its states, i = 0 … n−1.
///
/// As the derivatives come from one filter on one interpolated signal, their ratios are those of (jω)^i
/// exactly; only the interpolation itself acts on the amplitude, by 1 − (ωT)²/12, the same for every
/// derivative.
#[derive(Clone, Copy, Debug, Serialize, Deserialize)]
pub struct StateVariableFilter<const N: usize> {
    /// w, rad/s.
    pub bandwidth: f64,
    /// For an input that is straight between samples.
    pub smooth: Step<N>,
    /// For an input that is held from each sample to the next.
    pub held: Step<N>,
}

impl<const N: usize> StateVariableFilter<N> {
    /// A filter of this bandwidth, or what the sampling can represent of it.
    #[must_use]
    pub fn new(bandwidth_rad_s: f64, period_s: f64) -> StateVariableFilter<N> {
        let bandwidth = bandwidth_rad_s.min(1.0 / period_s);
        // The companion form of (s + w)ⁿ, its input and the input's slope as two more states; time in
        // periods keeps the numbers near one.
        let w = bandwidth * period_s;
        let size = N + 2;
        let mut companion = vec![vec![0.0; size]; size];
        let mut binomial = 1.0;
        for i in 0..N {
            if i + 1 < N {
                companion[i][i + 1] = 1.0;
            }
            companion[N - 1][i] = -binomial * w.powi((N - i) as i32);
            binomial = binomial * (N - i) as f64 / (i + 1) as f64;
        }
        companion[N - 1][N] = w.powi(N as i32);
        companion[N][N + 1] = 1.0;
        let over_a_period = exponential(&companion);
        let unit = |i: usize| period_s.powi(-(i as i32));
        let (mut advance, mut level, mut ramp) = ([[0.0; N]; N], [0.0; N], [0.0; N]);
        for i in 0..N {
            for j in 0..N {
                advance[i][j] = over_a_period[i][j] * unit(i) / unit(j);
            }
            level[i] = over_a_period[i][N] * unit(i);
            ramp[i] = over_a_period[i][N + 1] * unit(i);
        }
        let mut straight = level;
        for i in 0..N {
            straight[i] -= ramp[i];
        }
        StateVariableFilter {
            bandwidth,
            smooth: Step { advance, old: straight, new: ramp },
            held: Step { advance, old: level, new: [0.0; N] },
        }
    }

    /// The states of a whole recording from rest, state after state: `out[i]` is s^i F of the signal.
    pub fn along(&self, signal: &[f64], held: bool, out: &mut [&mut [f64]]) {
        let step = if held { &self.held } else { &self.smooth };
        let (mut state, mut before) = ([0.0; N], 0.0);
        for (k, now) in signal.iter().enumerate() {
            step.apply(&mut state, before, *now);
            before = *now;
            out.iter_mut().zip(state).for_each(|(column, x)| column[k] = x);
        }
    }

    /// The state in which a constant input has been forever.
    #[must_use]
    pub fn rest(value: f64) -> [f64; N] {
        let mut state = [0.0; N];
        state[0] = value;
        state
    }
}

/// exp of a small matrix by its series, halved until that is short and squared back.
fn exponential(matrix: &[Vec<f64>]) -> Vec<Vec<f64>> {
    let n = matrix.len();
    let norm = matrix.iter().map(|row| row.iter().map(|x| x.abs()).sum::<f64>()).fold(0.0, f64::max);
    let halvings = (norm.max(1e-300).log2().ceil() + 1.0).max(0.0) as i32;
    let product = |a: &[Vec<f64>], b: &[Vec<f64>]| -> Vec<Vec<f64>> {
        (0..n).map(|i| (0..n).map(|j| (0..n).map(|k| a[i][k] * b[k][j]).sum()).collect()).collect()
    };
    let scaled: Vec<Vec<f64>> =
        matrix.iter().map(|row| row.iter().map(|x| x / 2f64.powi(halvings)).collect()).collect();
    let one: Vec<Vec<f64>> =
        (0..n).map(|i| (0..n).map(|j| if i == j { 1.0 } else { 0.0 }).collect()).collect();
    let (mut term, mut total) = (one.clone(), one);
    for k in 1..TERMS {
        term = product(&term, &scaled);
        for (row, sums) in term.iter_mut().zip(&mut total) {
            for (x, sum) in row.iter_mut().zip(sums) {
                *x /= k as f64;
                *sum += *x;
            }
        }
    }
    for _ in 0..halvings {
        total = product(&total, &total);
    }
    total
}

/// (b, a) of (n0 s² + n1 s + n2)/(s² + d1 s + d2) by the bilinear transform, a[0] = 1.
#[must_use]
pub fn tustin_biquad(numerator: [f64; 3], denominator: [f64; 3], period_s: f64) -> ([f64; 3], [f64; 3]) {
    let c = 2.0 / period_s;
    let transform = |p: [f64; 3]| {
        let (s2, s1, s0) = (p[0] * c * c, p[1] * c, p[2]);
        [s2 + s1 + s0, 2.0 * (s0 - s2), s2 - s1 + s0]
    };
    let (b, a) = (transform(numerator), transform(denominator));
    (b.map(|x| x / a[0]), a.map(|x| x / a[0]))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_held_step_is_filtered_exactly() {
        // w²/(s + w)² answers a step with 1 − exp(−wt)(1 + wt).
        let (w, period) = (60.0, 1e-3);
        let filter = StateVariableFilter::<2>::new(w, period);
        let mut state = [0.0; 2];
        for k in 1..200 {
            filter.held.apply(&mut state, 1.0, 1.0);
            let t = k as f64 * period;
            assert!((state[0] - (1.0 - (-w * t).exp() * (1.0 + w * t))).abs() < 1e-12);
        }
    }

    #[test]
    fn a_ramp_comes_out_late_by_n_over_w_and_its_slope_is_exact() {
        let (w, period) = (60.0, 1e-3);
        let filter = StateVariableFilter::<4>::new(w, period);
        let mut state = [0.0; 4];
        for k in 1..2000 {
            filter.smooth.apply(&mut state, (k - 1) as f64 * period, k as f64 * period);
        }
        assert!((state[0] - (1999.0 * period - 4.0 / w)).abs() < 1e-9);
        assert!((state[1] - 1.0).abs() < 1e-9 && state[2].abs() < 1e-6);
    }

    #[test]
    fn derivatives_of_a_sine_have_their_exact_ratios() {
        // What acts on the amplitude is the straight line between samples, 1 − (ωT)²/12, alike in all.
        let (w, bandwidth, period) = (10.0, 60.0, 1e-3);
        let filter = StateVariableFilter::<4>::new(bandwidth, period);
        let signal: Vec<f64> = (0..4000).map(|k| (w * period * f64::from(k)).sin()).collect();
        let mut states = vec![vec![0.0; signal.len()]; 4];
        filter.along(&signal, false, &mut states.iter_mut().map(Vec::as_mut_slice).collect::<Vec<_>>());
        let gain = (1.0 + (w / bandwidth).powi(2)).powi(-2) * (1.0 - (w * period).powi(2) / 12.0);
        let late = 4.0 * (w / bandwidth).atan();
        for k in 3000..4000 {
            let phase = w * period * k as f64 - late;
            for (i, state) in states.iter().enumerate() {
                let expected =
                    gain * w.powi(i as i32) * (phase + 0.5 * i as f64 * std::f64::consts::PI).sin();
                assert!((state[k] - expected).abs() < 1e-5 * w.powi(i as i32));
            }
        }
    }

    #[test]
    fn a_bilinear_biquad_has_the_gain_at_rest() {
        let (b, a) = tustin_biquad([0.0, 0.0, 300.0], [1.0, 20.0, 300.0], 1e-3);
        assert!((b.iter().sum::<f64>() / a.iter().sum::<f64>() - 1.0).abs() < 1e-9);
    }
}
