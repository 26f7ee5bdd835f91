//! Delay of the link encoder: candidate delays run in parallel, each with its own balance.
//!
//! On a stiff joint one period of delay moves q by more than the transmission deflects, so a linear
//! correction fails: φ is computed for each candidate. It and its cube pass the regression's filter; a small
//! least-squares problem is accumulated per candidate, and the delay is the candidate with the smallest
//! residual, refined by a parabola.

use crate::filters::StateVariableFilter;

const LATEST: usize = 3; // periods to either side
const CANDIDATES: usize = 4 * LATEST + 1; // in steps of half a period
const COLUMNS: usize = 5; // φ, φ³, θ″, θ′, 1
const LOOKS_S: [f64; 3] = [2.0, 6.0, 20.0]; // of rows, after a start or the last look
const ROW_S: f64 = 0.01;
const GAIN: f64 = 0.8; // the error has to fall to this share, else no delay is assumed …
const LATER_GAIN: f64 = 0.5; // … to this one once there has been a look
const NOISE: f64 = 1e-3; // share of the balance's variance taken for noise, until it is known what no delay leaves
const OFFSET: f64 = 1.0; // prior std of a constant torque, as a share of the balance

type Gram = [[f64; COLUMNS + 1]; COLUMNS + 1];

/// See the module.
#[derive(Clone, Debug)]
pub struct DelaySearch {
    inertia: f64,
    damping: f64,
    inertia_std: f64,
    damping_std: f64,
    damping_share: f64,
    filter: StateVariableFilter<4>,
    every: u32,
    period: f64,
    // The last values of link, motor and torque, newest first: the newest link meets the oldest motor.
    link: [f64; 2 * LATEST + 1],
    motor: [f64; LATEST + 1],
    torque: [f64; LATEST + 1],
    theta: [f64; 4],
    tau: [f64; 4],
    phi: [([f64; 4], [f64; 4]); CANDIDATES],
    last: [f64; CANDIDATES],
    grams: [Gram; CANDIDATES],
    rate: f64,
    ticks: u32,
    rows: u32,
    looks: usize,
}

/// The motor's part of the balance and how well it is known: standard deviations of B and D relative to what
/// is declared, and of D as a share of the torque at the largest velocity.
#[derive(Clone, Copy, Debug)]
pub struct Known {
    /// B.
    pub inertia: f64,
    /// D.
    pub damping: f64,
    /// Relative.
    pub inertia_std: f64,
    /// Relative.
    pub damping_std: f64,
    /// Of the torque at the largest velocity.
    pub damping_share: f64,
}

impl DelaySearch {
    /// For one motor's balance behind a filter of this bandwidth.
    #[must_use]
    pub fn new(known: &Known, bandwidth_rad_s: f64, period_s: f64) -> DelaySearch {
        DelaySearch {
            inertia: known.inertia,
            damping: known.damping,
            inertia_std: known.inertia_std,
            damping_std: known.damping_std,
            damping_share: known.damping_share,
            filter: StateVariableFilter::new(bandwidth_rad_s, period_s),
            every: (ROW_S / period_s).round().max(1.0) as u32,
            period: period_s,
            link: [0.0; 2 * LATEST + 1],
            motor: [0.0; LATEST + 1],
            torque: [0.0; LATEST + 1],
            theta: [0.0; 4],
            tau: [0.0; 4],
            phi: [([0.0; 4], [0.0; 4]); CANDIDATES],
            last: [0.0; CANDIDATES],
            grams: [[[0.0; COLUMNS + 1]; COLUMNS + 1]; CANDIDATES],
            rate: 0.0,
            ticks: 0,
            rows: 0,
            looks: 0,
        }
    }

    /// Everything is at rest here; looks that have been taken stay taken.
    pub fn restart(&mut self, link: f64, motor: f64, torque: f64) {
        (self.link, self.motor) = ([link; 2 * LATEST + 1], [motor; LATEST + 1]);
        self.torque = [torque; LATEST + 1];
        self.theta = StateVariableFilter::<4>::rest(motor);
        self.tau = StateVariableFilter::<4>::rest(torque);
        let phi = link - motor;
        self.phi =
            [(StateVariableFilter::<4>::rest(phi), StateVariableFilter::<4>::rest(phi.powi(3))); CANDIDATES];
        self.last = [phi; CANDIDATES];
        self.begin();
    }

    /// The channels have been shifted: collect anew.
    pub fn begin(&mut self) {
        self.grams = [[[0.0; COLUMNS + 1]; COLUMNS + 1]; CANDIDATES];
        (self.rate, self.rows) = (0.0, 0);
    }

    /// Forget everything.
    pub fn reset(&mut self) {
        self.looks = 0;
        self.begin();
    }

    /// Whether there has been a look since the start.
    #[must_use]
    pub fn looked(&self) -> bool {
        self.looks > 0
    }

    /// One period; the delay of the link in periods when one has been found. `usable`: whether the filters
    /// hold nothing wrong.
    pub fn see(&mut self, link: f64, motor: f64, torque: f64, usable: bool) -> Option<f64> {
        if self.looks == LOOKS_S.len() {
            return None;
        }
        let (theta, tau) = (self.motor[LATEST], self.torque[LATEST]);
        self.link.copy_within(..2 * LATEST, 1);
        self.motor.copy_within(..LATEST, 1);
        self.torque.copy_within(..LATEST, 1);
        (self.link[0], self.motor[0], self.torque[0]) = (link, motor, torque);
        self.filter.smooth.apply(&mut self.theta, theta, self.motor[LATEST]);
        self.filter.held.apply(&mut self.tau, tau, 0.0);
        for (c, (first, third)) in self.phi.iter_mut().enumerate() {
            // A link that is late by c/2 − LATEST periods reads now what it was so long ago.
            let at = 2 * LATEST - c / 2;
            let q = if c % 2 == 0 { self.link[at] } else { 0.5 * (self.link[at] + self.link[at - 1]) };
            let (old, new) = (self.last[c], q - self.motor[LATEST]);
            self.filter.smooth.apply(first, old, new);
            self.filter.smooth.apply(third, old * old * old, new * new * new);
            self.last[c] = new;
        }
        self.ticks += 1;
        if !usable || self.ticks < self.every {
            return None;
        }
        self.ticks = 0;
        self.take_row();
        if f64::from(self.rows * self.every) * self.period < LOOKS_S[self.looks] {
            return None;
        }
        let gain = if self.looked() { LATER_GAIN } else { GAIN };
        self.looks += 1;
        let found = self.look(gain);
        self.begin();
        found
    }

    fn take_row(&mut self) {
        let [_, rate, acceleration, _] = self.theta;
        let balance = self.inertia * acceleration + self.damping * rate - self.tau[0];
        self.rate = self.rate.max(rate.abs());
        self.rows += 1;
        for (gram, (first, third)) in self.grams.iter_mut().zip(&self.phi) {
            let row = [first[0], third[0], acceleration, rate, 1.0, balance];
            for i in 0..=COLUMNS {
                for j in 0..=i {
                    gram[i][j] += row[i] * row[j];
                }
            }
        }
    }

    /// The candidate that leaves least of the balance, if it leaves less than `gain` of what no delay does.
    fn look(&self, gain: f64) -> Option<f64> {
        let mut best = 2 * LATEST;
        // What no delay leaves is the noise that all candidates are judged by.
        let rows = f64::from(self.rows);
        let none = &self.grams[best];
        let (first, _) = self.cost(none, NOISE * none[COLUMNS][COLUMNS] / rows);
        let noise = first / rows;
        let (none, _) = self.cost(none, noise);
        let mut costs = [f64::INFINITY; CANDIDATES];
        for (cost, gram) in costs.iter_mut().zip(&self.grams) {
            if let (least, true) = self.cost(gram, noise) {
                *cost = least;
            }
        }
        for c in 0..CANDIDATES {
            if costs[c] < costs[best] {
                best = c;
            }
        }
        let (mut periods, mut least) = (0.5 * best as f64 - LATEST as f64, costs[best]);
        if best > 0 && best + 1 < CANDIDATES {
            let (before, after) = (costs[best - 1] - least, costs[best + 1] - least);
            if before + after > 0.0 && (before + after).is_finite() {
                let share = 0.5 * (before - after) / (before + after);
                periods += 0.5 * share;
                least -= 0.25 * share * (before - after);
            }
        }
        (least.max(0.0) < gain * gain * none).then_some(periods)
    }

    /// Squared error of the motor's own parameters and of the balance, at its least: -2 log of the posterior
    /// times the noise's variance, so that no delay pays by a motor that nobody declared. And whether the
    /// transmission pulls back.
    fn cost(&self, gram: &Gram, noise: f64) -> (f64, bool) {
        let rows = f64::from(self.rows);
        let square = gram[COLUMNS][COLUMNS];
        let mean = gram[COLUMNS][4] / rows;
        let size = (square / rows - mean * mean).max(0.0).sqrt();
        let damping = self.damping_std * self.damping + self.damping_share * size / (self.rate + 1e-12);
        let prior = [f64::INFINITY, f64::INFINITY, self.inertia_std * self.inertia, damping, OFFSET * size];
        let mut scale = [0.0; COLUMNS];
        for i in 0..COLUMNS {
            scale[i] = gram[i][i].sqrt() + 1e-300;
        }
        // Cholesky of the scaled normal equations, then |y|² − x·b.
        let (mut lower, mut x) = ([[0.0; COLUMNS]; COLUMNS], [0.0; COLUMNS]);
        for i in 0..COLUMNS {
            for j in 0..=i {
                let held = if i == j { 1e-12 + noise / (prior[i] * scale[i]).powi(2) } else { 0.0 };
                let rest: f64 = (0..j).map(|k| lower[i][k] * lower[j][k]).sum();
                let value = gram[i][j] / (scale[i] * scale[j]) + held - rest;
                lower[i][j] = if i == j { value.max(1e-300).sqrt() } else { value / lower[j][j] };
            }
        }
        let b = |i: usize| gram[COLUMNS][i] / scale[i];
        for i in 0..COLUMNS {
            let rest: f64 = (0..i).map(|k| lower[i][k] * x[k]).sum();
            x[i] = (b(i) - rest) / lower[i][i];
        }
        for i in (0..COLUMNS).rev() {
            let rest: f64 = (i + 1..COLUMNS).map(|k| lower[k][i] * x[k]).sum();
            x[i] = (x[i] - rest) / lower[i][i];
        }
        let cost = square - (0..COLUMNS).map(|i| x[i] * b(i)).sum::<f64>(); // at the least
        (cost.max(1e-12 * square), x[0] > 0.0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// What the search finds of a link that is late by so many periods.
    ///
    /// A linear spring between prescribed motions; τ = B θ″ + D θ′ − K φ, which acts over the next period.
    /// `spin`: rad/s that the motor turns at beside its motion; `lost`: damping of that motion alone, N·m·s/rad.
    fn found([k, b, d]: [f64; 3], load: f64, late: f64, [spin, lost]: [f64; 2]) -> Option<f64> {
        let period = 1e-3;
        let known =
            Known { inertia: b, damping: d, inertia_std: 0.05, damping_std: 0.2, damping_share: 0.02 };
        let mut search = DelaySearch::new(&known, 60.0, period);
        let theta = |t: f64| spin * t + 0.5 * (3.0 * t).sin() + 0.1 * (11.0 * t).sin();
        let phi = |t: f64| load / k * ((5.0 * t).sin() + 0.5 * (13.0 * t).cos());
        let rate = |t: f64| 1.5 * (3.0 * t).cos() + 1.1 * (11.0 * t).cos();
        let acceleration = |t: f64| -4.5 * (3.0 * t).sin() - 12.1 * (11.0 * t).sin();
        search.restart(phi(0.0), 0.0, 0.0);
        let mut found = None;
        for n in 1..4000 {
            let t = f64::from(n) * period;
            let acting = t + 0.5 * period;
            let damping = d * (spin + rate(acting)) + lost * rate(acting);
            let torque = b * acceleration(acting) + damping - k * phi(acting);
            let read = t - late * period;
            let now = search.see(theta(read) + phi(read), theta(t), torque, n > 300);
            found = found.or(now);
        }
        found
    }

    #[test]
    fn a_late_encoder_is_found_to_a_fraction_of_a_period() {
        for late in [0.0, 1.0, 2.3, -1.5, 3.0] {
            let found = found([9000.0, 0.7, 5.0], 18.0, late, [0.0, 0.0]);
            assert!((found.unwrap_or(0.0) - late).abs() < 0.1, "{found:?} is not {late}");
        }
    }

    #[test]
    fn no_late_encoder_is_made_of_a_torque_that_a_spinning_shaft_does_not_have() {
        // A delay T explains what is lost by K T θ′, and asks for K T times the spin as well: 14 N·m.
        let [k, spin, lost] = [35.0, 200.0, 0.07];
        assert!(found([k, 0.009, 0.003], 0.3, 0.0, [0.0, lost]).is_some());
        assert_eq!(found([k, 0.009, 0.003], 0.3, 0.0, [spin, lost]), None);
    }
}
