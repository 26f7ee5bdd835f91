//! Mode "paper": eqs 14, 28, 32, 33 as printed, correctly discretised, one tick at a time.
//!
//! As printed: regressors are not filtered like the residual, velocities are the drive's (else differences of
//! positions). The robust mode avoids the resulting errors on real drives.

mod recursive;

use serde::{Deserialize, Serialize};

use crate::choices::{MEAN_S, TAUGHT_RAD2_S2};
use crate::external::{External, PaperMomentum};
use crate::filters::{first_order_pole, tustin_biquad};
use crate::laws::{Law, PARAMETERS, powers};
use crate::model::{Arrangement, Model, Motor, Transmission};
use crate::reasons::{Reason, Why};
use crate::sample::{Estimate, MOTORS, Sample, TransmissionEstimate, joint_estimate, status};
use crate::sample_validator::SampleValidator;
use crate::settings::{Method, Priors, Settings};

pub use recursive::RecursiveLeastSquares;

const SIGMA_95: f64 = 1.96; // a 95 % interval, which may not hold zero

/// y = B θ′ + D θ − ∫τ, whose derivative is τ_e (from eq 5); the torque is held from sample to sample.
#[derive(Clone, Debug, Serialize, Deserialize)]
struct Balance {
    inertia: f64,
    damping: f64,
    period: f64,
    origin: Option<f64>,
    integral: f64,
    torque: f64,
}

impl Balance {
    fn update(&mut self, position: f64, velocity: f64, torque: f64, periods: f64) -> f64 {
        self.integral += self.torque * self.period * periods;
        self.torque = torque;
        let value = self.inertia * velocity + self.damping * position - self.integral;
        value - *self.origin.get_or_insert(value)
    }
}

/// r_τe of eq 14, K s/(s + K) y: r_k = a r_(k−1) + (1 − a)(y_k − y_(k−1))/T, exact for a straight y.
#[derive(Clone, Debug, Serialize, Deserialize)]
struct FirstOrder {
    balance: Balance,
    k: f64,
    value: f64,
    last: f64,
}

impl FirstOrder {
    fn update(&mut self, position: f64, velocity: f64, torque: f64, periods: f64) -> f64 {
        let y = self.balance.update(position, velocity, torque, periods);
        let span = self.balance.period * periods;
        let a = first_order_pole(self.k, span);
        self.value = a * self.value + (1.0 - a) * (y - self.last) / span;
        self.last = y;
        self.value
    }
}

/// r_σ of eq 28, K1 s²/(s² + K2 s + K1) y by the bilinear transform; a gap is bridged along a straight y.
#[derive(Clone, Debug, Serialize, Deserialize)]
struct SecondOrder {
    balance: Balance,
    b: [f64; 3],
    a: [f64; 3],
    value: f64,
    last: f64,
    w: [f64; 2],
}

impl SecondOrder {
    fn update(&mut self, position: f64, velocity: f64, torque: f64, periods: u32) -> f64 {
        let y = self.balance.update(position, velocity, torque, f64::from(periods));
        let slope = (y - self.last) / f64::from(periods);
        for k in 1..=periods {
            let u = self.last + f64::from(k) * slope;
            self.value = self.b[0] * u + self.w[0];
            self.w[0] = self.b[1] * u - self.a[1] * self.value + self.w[1];
            self.w[1] = self.b[2] * u - self.a[2] * self.value;
        }
        self.last = y;
        self.value
    }
}

/// σ(k+1) = σ(k) + K_R (r_σ φ′ − σ(k) φ′²) (eq 32); eq 33 limits the product K_R φ′² of this step only:
/// read literally, it would lower K_R for good.
#[must_use]
pub fn regressor_step(stiffness: f64, residual: f64, rate: f64, k_r: f64, k_max: f64) -> f64 {
    let energy = rate * rate;
    let k_r = if k_r * energy > k_max { k_max / energy } else { k_r };
    stiffness + k_r * (residual * rate - stiffness * energy)
}

/// One motor with its transmission.
#[derive(Clone, Debug, Serialize, Deserialize)]
struct Part {
    period: f64,
    rigid: bool,
    settings: Settings,
    torque: FirstOrder,
    slope: SecondOrder,
    squares: RecursiveLeastSquares,
    by_model: bool,
    stiffness: f64,
    mean: f64, // of the stiffness, and its mean square about it
    scatter: f64,
    energy: f64,
    theta: f64,
    q: f64,
    held: TransmissionEstimate,
}

impl Part {
    fn new(motor: &Motor, settings: &Settings, period: f64) -> Part {
        let balance = Balance {
            inertia: motor.inertia,
            damping: motor.damping,
            period,
            origin: None,
            integral: 0.0,
            torque: 0.0,
        };
        let (polynomial, order) = match &motor.transmission {
            Transmission::Elastic { law: Law::Linear, .. } => (true, 1),
            Transmission::Elastic { law, order, .. } => (law.is_polynomial(), order.unwrap_or(2)),
            _ => (false, 2),
        };
        let (k1, k2) = (settings.k_sigma_1, settings.k_sigma_2);
        let (b, a) = tustin_biquad([k1, 0.0, 0.0], [1.0, k2, k1], period);
        Part {
            period,
            rigid: !motor.flexible(),
            settings: *settings,
            torque: FirstOrder { balance: balance.clone(), k: settings.k_tau, value: 0.0, last: 0.0 },
            slope: SecondOrder { balance, b, a, value: 0.0, last: 0.0, w: [0.0; 2] },
            squares: RecursiveLeastSquares::new(order),
            by_model: polynomial && settings.method == Method::Mbe,
            stiffness: 0.0,
            mean: 0.0,
            scatter: 0.0,
            energy: 0.0,
            theta: f64::NAN,
            q: f64::NAN,
            held: TransmissionEstimate::NOTHING,
        }
    }

    fn reset(&mut self) {
        self.stiffness = 0.0;
        (self.mean, self.scatter) = (0.0, 0.0);
        self.energy = 0.0;
        self.squares = RecursiveLeastSquares::new(self.squares.size);
        self.restart();
    }

    fn restart(&mut self) {
        for balance in [&mut self.torque.balance, &mut self.slope.balance] {
            (balance.origin, balance.integral, balance.torque) = (None, 0.0, 0.0);
        }
        (self.torque.value, self.torque.last) = (0.0, 0.0);
        (self.slope.value, self.slope.last, self.slope.w) = (0.0, 0.0, [0.0; 2]);
        (self.theta, self.q) = (f64::NAN, f64::NAN);
        self.held = TransmissionEstimate::NOTHING;
    }

    fn update(&mut self, theta: f64, omega: f64, tau: f64, q: f64, q_rate: f64, periods: u32) {
        let span = self.period * f64::from(periods);
        let omega = if omega.is_finite() { omega } else { (theta - self.theta) / span };
        if omega.is_nan() {
            // The first position alone gives no velocity to start from.
            (self.theta, self.q) = (theta, q);
            return;
        }
        let torque = self.torque.update(theta, omega, tau, f64::from(periods)); // eq 14
        self.theta = theta;
        if self.rigid {
            self.held = TransmissionEstimate { flexibility_torque: torque, ..TransmissionEstimate::NOTHING };
            return;
        }
        let difference = if self.q.is_nan() { 0.0 } else { (q - self.q) / span };
        let q_rate = if q_rate.is_finite() { q_rate } else { difference };
        self.q = q;
        let (phi, rate) = (q - theta, q_rate - omega);
        let slope = self.slope.update(theta, omega, tau, periods); // eq 28
        self.energy += (span / MEAN_S).min(1.0) * (rate * rate - self.energy);
        if self.by_model {
            let (mut row, n) = ([0.0; PARAMETERS], self.squares.size);
            powers(phi, &mut row[..n]);
            self.squares.update(&row, torque); // eqs 22, 23
            let alpha = self.squares.alpha();
            self.stiffness = Law::Polynomial.at(phi, &alpha[..n]).1;
        } else {
            let (k_r, k_max) = (self.settings.k_r, self.settings.k_max);
            let next = regressor_step(self.stiffness, slope, rate, k_r, k_max); // eqs 32, 33
            self.stiffness = if next.is_finite() { next } else { 0.0 };
        }
        let (gain, off) = ((span / MEAN_S).min(1.0), self.stiffness - self.mean);
        self.mean += gain * off;
        self.scatter += gain * (off * off - self.scatter);
        self.held = TransmissionEstimate {
            flexibility_torque: torque,
            stiffness: self.stiffness,
            stiffness_std: f64::NAN,
            flexibility_torque_std: f64::NAN,
            deflection: phi,
        };
    }

    /// Whether the torque is finite and the stiffness is known to be positive.
    ///
    /// The paper's stiffness has no standard deviation. Its scatter is the least that it is uncertain by: where
    /// mean and scatter leave zero inside 95 %, not even the sign is known.
    fn of_use(&self) -> bool {
        let significant = self.stiffness > 0.0 && self.mean > SIGMA_95 * self.scatter.sqrt();
        self.held.flexibility_torque.is_finite() && (self.rigid || significant)
    }

    fn reason(&self) -> Option<Reason> {
        if self.of_use() {
            None
        } else if self.held.flexibility_torque.is_finite() {
            Some(Reason::Open)
        } else {
            Some(Reason::Settling)
        }
    }

    fn observable(&self) -> bool {
        !self.rigid && self.energy > TAUGHT_RAD2_S2
    }
}

/// The paper's estimator for a whole joint.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct Paper {
    arrangement: Arrangement,
    validator: SampleValidator,
    parts: Vec<Part>,
    link: Option<PaperMomentum>,
    external: Option<External>,
}

impl Paper {
    /// For a model that has been checked.
    #[must_use]
    pub fn new(model: &Model, settings: &Settings, priors: &Priors, period_s: f64) -> Paper {
        Paper {
            arrangement: model.arrangement,
            validator: SampleValidator::new(model, period_s),
            parts: model.motors.iter().map(|motor| Part::new(motor, settings, period_s)).collect(),
            link: PaperMomentum::new(model, settings, priors, period_s),
            external: None,
        }
    }

    /// Forget everything.
    pub fn reset(&mut self) {
        self.validator.reset();
        self.parts.iter_mut().for_each(Part::reset);
        self.link.iter_mut().for_each(PaperMomentum::reset);
        self.external = None;
    }

    /// What the world does to the link, by the last sample; `None` where no link dynamics are declared.
    #[must_use]
    pub fn external(&self) -> Option<External> {
        self.external
    }

    /// See [`PaperMomentum::consistency`].
    #[must_use]
    pub fn consistency(&self) -> Option<[f64; 2]> {
        self.link.as_ref()?.latest.consistency()
    }

    /// The coefficients of each transmission's polynomial with their standard deviations, or the black box's
    /// stiffness alone.
    pub fn parameters(&self, motor: usize, values: &mut Vec<f64>, std: &mut Vec<f64>) -> Option<Law> {
        let part = &self.parts[motor];
        if !part.by_model {
            values.push(part.stiffness);
            return None;
        }
        let n = part.squares.size;
        values.extend_from_slice(&part.squares.alpha()[..n]);
        for i in 0..n {
            let mut one = [0.0; PARAMETERS];
            one[i] = 1.0;
            std.push(part.squares.std(&one[..n]));
        }
        Some(Law::Polynomial)
    }

    /// Why the last estimate is not valid; `None`: it is.
    #[must_use]
    pub fn why(&self) -> Option<Why> {
        let mut reasons = self.parts.iter().enumerate();
        reasons.find_map(|(i, part)| Some(Why::new(part.reason()?, Some(i))))
    }

    /// The estimate at this sample, whatever floats it holds.
    pub fn step(&mut self, sample: &Sample) -> Estimate {
        let accepted = self.validator.check(sample);
        let mut flags = accepted.status;
        if accepted.restart {
            self.parts.iter_mut().for_each(Part::restart);
            self.link.iter_mut().for_each(PaperMomentum::restart);
        }
        if accepted.periods > 0 {
            for (i, part) in self.parts.iter_mut().enumerate() {
                let (theta, omega) = (sample.motor_position[i], sample.motor_velocity[i]);
                let (tau, q) = (sample.motor_torque[i], sample.link_position);
                part.update(theta, omega, tau, q, sample.link_velocity, accepted.periods);
            }
        }
        let flexible = self.parts.iter().any(|part| !part.rigid);
        if self.parts.iter().all(Part::of_use) {
            flags |= if flexible { status::USABLE } else { status::VALID | status::TORQUE_VALID };
        }
        if accepted.periods > 0 && flexible && self.parts.iter().all(|p| p.rigid || p.observable()) {
            flags |= status::OBSERVABLE;
        }
        let mut held = [TransmissionEstimate::NOTHING; MOTORS];
        self.parts.iter().zip(&mut held).for_each(|(part, held)| *held = part.held);
        let estimate = joint_estimate(self.arrangement, sample.sequence, flags, held, self.parts.len());
        if let Some(link) = &mut self.link {
            let pulls = if self.arrangement == Arrangement::Antagonistic { self.parts.len() } else { 1 };
            let balance = self.parts[..pulls].iter().map(|part| part.torque.last).sum();
            let valid = flags & status::VALID != 0;
            self.external = Some(if accepted.periods > 0 {
                link.update(sample, accepted.periods, estimate.flexibility_torque, balance, valid)
            } else {
                link.latest.repeat(sample.sequence)
            });
        }
        estimate
    }
}

#[cfg(test)]
mod tests;
