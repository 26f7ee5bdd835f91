//! The present deflection, without the delay of the regression's filter.
//!
//! An extended Kalman filter with the states [θ, θ′, φ, φ′, φ″]: the motor moves by its own equation (eq 5, with
//! the spring's curve that has been estimated, and its slope where it is), the deflection by a random third
//! derivative, and θ and q = θ + φ are measured. With coarse encoders it relies on the torque balance, with fine
//! ones on the encoders.
//!
//! That covariance assumes white noise and a white third derivative. Fine encoders violate it. So the
//! innovations of φ are compared with it: where their mean square e² is more than the S = P + R it foresees,
//! the covariance is e²/S times as large (the normalised innovation squared of Bar-Shalom, Li, Kirubarajan,
//! "Estimation with Applications to Tracking and Navigation", 2001, section 5.4). Likewise where the encoders
//! turn out to be noisier than assumed: the state has taken up that noise already, so its covariance grows
//! with the noise's.

use crate::choices::{AHEAD_S, DAMPED, FAR, HIDDEN, MEAN_S, PEAK_S, PLAIN, SETTLED, SLOWEST, STIFF};
use serde::{Deserialize, Serialize};

const STATES: usize = 5;
type State = [f64; STATES];
type Covariance = [State; STATES];

/// See the module; fed every tick, tuned at every update.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
pub struct DeflectionFilter {
    inertia: f64,
    damping: f64,
    w: f64,
    period: f64,
    average: f64,
    fade: f64,
    settling: i64,
    plain: [State; 2],
    gains: [State; 2], // by θ and by φ
    x: State,
    p: Option<Covariance>,
    tuned: bool,    // whether noise and motion are known
    modelled: bool, // whether the motor's equation is of use
    drift: f64,     // spectral density of what it leaves, rad²/s³
    motor_noise: f64,
    motion: Motion,
    foreseen: f64,
    noise: f64,  // R, the variance of φ's noise that p assumes, rad²
    wander: f64, // spectral density of φ‴, rad²/s⁵
    /// Periods until the last start is forgotten.
    pub unsettled: i64,
}

/// How the joint moves, and how well that is foreseen.
#[derive(Clone, Copy, Debug, Default, Serialize, Deserialize)]
pub struct Motion {
    jerk: f64,   // mean square of φ‴ …
    peak: f64,   // … and its largest value of late
    missed: f64, // mean square of φ's innovation, over what is foreseen
}

/// Nothing has been seen.
pub const AT_REST: Motion = Motion { jerk: 0.0, peak: 0.0, missed: 1.0 };

/// What is known of the deflection since the moment of the torque.
#[derive(Clone, Copy, Debug)]
pub struct Present {
    /// φ as it was last measured, rad.
    pub phi: f64,
    /// By how much the torque is older than that, s.
    pub behind_s: f64,
    /// How long ago that was, s.
    pub ahead_s: f64,
}

/// What one update of the estimation gives a deflection filter.
#[derive(Clone, Copy, Debug)]
pub struct Tuning {
    /// φ‴ of the regression's filter.
    pub jerk: f64,
    /// Variance of θ.
    pub motor_noise: f64,
    /// Variance of q.
    pub link_noise: f64,
    /// B as it has turned out to be.
    pub inertia: f64,
    /// D likewise.
    pub damping: f64,
    /// The transmission's likewise.
    pub rate_damping: f64,
    /// rms of what the motor's equation leaves unexplained; ∞: it is not used at all.
    pub unmodelled: f64,
}

impl DeflectionFilter {
    /// Of a motor with this inertia and damping; `bandwidth`: of the regression's filter; `dt_s`: between
    /// two updates.
    #[must_use]
    pub fn new(inertia: f64, damping: f64, bandwidth: f64, period: f64, dt_s: f64) -> DeflectionFilter {
        // Before anything is known: both positions through g-h-k filters.
        let p = (-PLAIN * bandwidth * period).exp();
        let (g, h) = (1.0 - p * p * p, 1.5 * (1.0 - p) * (1.0 - p) * (1.0 + p) / period);
        let k = (1.0 - p).powi(3) / (period * period);
        let plain = [[g, h, 0.0, 0.0, 0.0], [0.0, 0.0, g, h, k]];
        let settling = (3.0 * SETTLED / (PLAIN * bandwidth * period)).ceil() as i64;
        let mut made = DeflectionFilter {
            inertia,
            damping,
            w: bandwidth,
            period,
            average: (dt_s / MEAN_S).min(1.0),
            fade: (-dt_s / PEAK_S).exp(),
            settling,
            plain,
            ..DeflectionFilter::default()
        };
        made.reset();
        made
    }

    /// Forget everything.
    pub fn reset(&mut self) {
        (self.motion, self.p, self.noise, self.tuned) = (AT_REST, None, 0.0, false);
        (self.gains, self.foreseen) = (self.plain, f64::INFINITY);
        self.restart(0.0, 0.0);
    }

    /// At rest here, as far as one knows: until the rates have been found, plain filters.
    pub fn restart(&mut self, theta: f64, phi: f64) {
        self.x = [theta, 0.0, phi, 0.0, 0.0];
        self.unsettled = self.settling;
    }

    /// φ, a little ahead of the last sample.
    #[must_use]
    pub fn at(&self, ahead_s: f64) -> f64 {
        self.x[2] + ahead_s * (self.x[3] + 0.5 * ahead_s * self.x[4])
    }

    /// φ now, and its variance, rad²: foreseen from the moment of the torque, and corrected by the latest reading, whose
    /// noise is R; before anything is known of the motion, as noisy as that.
    ///
    /// What is foreseen has the variance that P grows to by the random third derivative.
    #[must_use]
    pub fn now(&self, present: &Present, noise: f64) -> (f64, f64) {
        let (read, now) = (present.behind_s, present.behind_s + present.ahead_s);
        let [by_then, by_now] = [read, now].map(|t| self.p.map(|p| self.grown(&p, t)));
        let share = by_then.map_or(1.0, |by_then| by_then / (by_then + noise));
        let share = if read > 0.0 { share } else { 0.0 };
        let phi = self.at(now) + share * (present.phi - self.at(read));
        (phi, by_now.zip(by_then).map_or(noise, |(now, then)| (now - share * then).max(0.0)))
    }

    /// Variance of φ, so long after the moment of the torque, as the filter's own innovations bear it out, rad².
    fn grown(&self, p: &Covariance, t: f64) -> f64 {
        let slope = [1.0, t, 0.5 * t * t];
        let pairs = (0..3).flat_map(|i| (0..3).map(move |j| (i, j)));
        let all = pairs.map(|(i, j)| slope[i] * p[2 + i][2 + j] * slope[j]).sum::<f64>();
        self.motion.missed.max(1.0) * (all + self.wander * t.powi(5) / 20.0)
    }

    /// φ′ at the last sample, rad/s.
    #[must_use]
    pub fn rate(&self) -> f64 {
        self.x[3]
    }

    /// Velocity of the link at the last sample, rad/s.
    #[must_use]
    pub fn link_rate(&self) -> f64 {
        self.x[1] + self.x[3]
    }

    /// One period later: measured θ and φ, the torque that acted, τ + τ_e − x, N·m, and the stiffness where it did; 0: it is
    /// not known.
    pub fn update(&mut self, theta: f64, phi: f64, torque: f64, stiffness: f64) {
        let t = self.period;
        let [x0, x1, x2, x3, x4] = self.x;
        let (plain, c) = (self.unsettled > 0, stiffness.max(0.0) / self.inertia);
        let modelled = self.tuned && self.modelled && 0.0 < c && c * t * t < STIFF;
        let a = if modelled && !plain {
            // Eq 5, with φ and θ′ of the middle of the period.
            let half = 0.5 * t;
            (torque - self.damping * x1 + half * stiffness * x3) / (self.inertia + half * self.damping)
        } else {
            0.0
        };
        let ahead = [x0 + t * (x1 + 0.5 * t * a), x1 + t * a, x2 + t * (x3 + 0.5 * t * x4), x3 + t * x4, x4];
        let (e, f) = (theta - ahead[0], phi - ahead[2]);
        if !(f.abs() < FAR * (1.0 + phi.abs()) && e.is_finite()) {
            self.tuned = false; // a stiffness that cannot be has made the motion model unstable
            self.restart(theta, phi);
            return;
        }
        if self.tuned && !plain {
            self.correct(self.moved(if modelled { c } else { 0.0 }));
        }
        let [g, h] = if plain { &self.plain } else { &self.gains };
        for i in 0..STATES {
            self.x[i] = ahead[i] + g[i] * e + h[i] * f;
        }
        if plain {
            self.unsettled -= 1;
        } else {
            self.motion.missed += t / MEAN_S * (f * f / self.foreseen - self.motion.missed);
        }
    }

    /// How the joint moves, to be recalled.
    #[must_use]
    pub fn motion(&self) -> Motion {
        self.motion
    }

    /// What has been read since may be no motion: the joint moves as it did.
    pub fn recall(&mut self, motion: Motion) {
        self.motion = motion;
    }

    /// How large the motion is.
    fn watch(&mut self, jerk: f64) {
        let motion = &mut self.motion;
        motion.jerk += self.average * (HIDDEN * jerk * jerk - motion.jerk);
        motion.peak = (self.fade * motion.peak).max(motion.jerk);
    }

    /// What the covariance grows by, and noise.
    pub fn tune(&mut self, tuning: &Tuning) {
        let (t, w) = (self.period, self.w);
        (self.inertia, self.damping) = (tuning.inertia, tuning.damping);
        self.watch(tuning.jerk);
        let noise = tuning.motor_noise + tuning.link_noise;
        self.tuned = noise > 0.0 && self.motion.peak > 0.0 && tuning.unmodelled < f64::INFINITY;
        if !self.tuned {
            return; // the motor's balance is unknown: it cannot predict its motion
        }
        let density = noise * t;
        let natural = (self.motion.jerk.max(0.1 * self.motion.peak) * AHEAD_S / density).powf(1.0 / 6.0);
        let natural = natural.clamp(SLOWEST * w, FAR * w);
        // Where the link is held, D and the transmission's damping may be large and cancel each other.
        let damped = (tuning.damping.abs() + tuning.rate_damping.abs()) * t / self.inertia;
        self.drift = (tuning.unmodelled / self.inertia).powi(2) * AHEAD_S;
        self.modelled = damped < DAMPED && self.drift < noise * w.powi(4) * 1e6;
        // Noise is measured late: the state has errors of its size by now.
        let grown = if noise > self.noise && self.noise > 0.0 { noise / self.noise } else { 1.0 };
        self.p.iter_mut().flatten().flatten().for_each(|entry| *entry *= grown);
        (self.noise, self.motor_noise) = (noise, tuning.motor_noise);
        self.wander = density * natural.powi(6);
    }

    /// Kalman gains for measured θ and φ = q − θ, whose noises share θ's, from P before the readings.
    fn correct(&mut self, moved: Covariance) {
        let (s00, s01, s11) =
            (moved[0][0] + self.motor_noise, moved[0][2] - self.motor_noise, moved[2][2] + self.noise);
        let determinant = s00 * s11 - s01 * s01;
        if !(determinant > 0.0 && determinant < f64::INFINITY) {
            self.p = None;
            return;
        }
        let mut after = moved;
        for i in 0..STATES {
            let (theta, phi) = (moved[i][0], moved[i][2]);
            self.gains[0][i] = (s11 * theta - s01 * phi) / determinant;
            self.gains[1][i] = (s00 * phi - s01 * theta) / determinant;
            for j in 0..=i {
                let left = moved[i][j] - self.gains[0][i] * moved[0][j] - self.gains[1][i] * moved[2][j];
                (after[i][j], after[j][i]) = (left, left);
            }
        }
        self.foreseen = s11;
        self.p = (0..STATES).all(|i| after[i][i] > 0.0).then_some(after); // else rounding has eaten it: it begins anew
    }

    /// F P F' + Q over one period; `c`: σ/B, 0: the motor's equation is not used.
    fn moved(&self, c: f64) -> Covariance {
        let (t, quick) = (self.period, self.noise * self.w.powi(4));
        let p = self.p.unwrap_or_else(|| {
            let mut start = [[0.0; STATES]; STATES];
            for (i, power) in [0, 2, 0, 2, 4].into_iter().enumerate() {
                start[i][i] = self.noise * self.w.powi(power);
            }
            start
        });
        let (damping, drift) = if c > 0.0 { (self.damping, self.drift) } else { (0.0, quick) };
        let pull = c * t;
        let step = |x: &State| {
            [
                x[0] + t * (x[1] + 0.5 * pull * x[2]),
                x[1] - t * damping / self.inertia * x[1] + pull * x[2],
                x[2] + t * (x[3] + 0.5 * t * x[4]),
                x[3] + t * x[4],
                x[4],
            ]
        };
        let half = p.map(|row| step(&row)); // P F'
        let mut out = [[0.0; STATES]; STATES];
        for j in 0..STATES {
            let column = step(&std::array::from_fn(|k| half[k][j]));
            (j..STATES).for_each(|i| (out[i][j], out[j][i]) = (column[i], column[i]));
        }
        out[1][1] += drift * t;
        out[4][4] += self.wander * t;
        out
    }
}

#[cfg(test)]
mod tests;
