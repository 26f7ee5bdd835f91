//! Is the torque the joint's, or that of a controller which makes it from the motor's own reading?
//!
//! Where nothing but a hand at the link moves a motor that holds its position, its torque follows from its reading
//! alone: −τ = k_p θ + k_i ∫θ + k_d θ′ + d τ′ + constant, no gain negative, d the controller's delay. What such a
//! law leaves of the torque (s_c², over the memory of the regression) is all that separates the joint from the
//! controller. A torque that acts at the motor as a spring does (presliding friction, a share that a gear loses, a
//! cable) and that nobody declared then goes into the stiffness: in steady state it is off by a share b, and b s_c is
//! what the joint's balance leaves. So s_j/s_c bounds that error (closed-loop identification without an own
//! excitation: Ljung, System Identification, 1999, section 13.4).

const GAINS: usize = 4;
const TERMS: usize = GAINS + 2; // θ, ∫θ, θ′, τ′, then 1 and −τ
const ONE: usize = GAINS;
const TORQUE: usize = GAINS + 1;
const SINGULAR: f64 = 1e-10; // of a term's square, left by the others: it is made of them

/// See the module.
#[derive(Clone, Copy, Debug, Default)]
pub struct ControllerLaw {
    gram: [[f64; TERMS]; TERMS],
    equations: f64,
    integral: f64,
}

impl ControllerLaw {
    /// Some time of the motion.
    pub fn pass(&mut self, theta: f64, dt_s: f64) {
        self.integral += theta * dt_s;
    }

    /// One equation: motor and torque with their derivatives, filtered alike. `memory`: equations.
    pub fn take(&mut self, motor: &[f64], torque: &[f64], memory: f64) {
        let terms = [motor[0], self.integral, motor[1], torque[1], 1.0, -torque[0]];
        let keep = 1.0 - 1.0 / memory;
        for (row, a) in self.gram.iter_mut().zip(terms) {
            for (entry, b) in row.iter_mut().zip(terms) {
                *entry = keep * *entry + a * b;
            }
        }
        self.equations = keep * self.equations + 1.0;
    }

    /// Mean square of the torque that no such law explains, (N·m)²; 0 before there is any.
    #[must_use]
    pub fn left(&self) -> f64 {
        if self.equations == 0.0 {
            return 0.0;
        }
        let all = (0..1 << GAINS).map(|gains: usize| self.left_by(gains));
        all.fold(f64::INFINITY, f64::min).max(0.0) / self.equations
    }

    /// Sum of squares that the law with these gains (bits) leaves; infinite where one of them is negative.
    fn left_by(&self, gains: usize) -> f64 {
        let mut a = self.gram;
        let used = |term: &usize| *term == ONE || gains >> term & 1 == 1;
        for p in (0..=ONE).rev().filter(used) {
            if a[p][p] <= SINGULAR * self.gram[p][p] {
                return f64::INFINITY;
            }
            let row = a[p].map(|entry| entry / a[p][p]);
            for (i, other) in a.iter_mut().enumerate() {
                let share = if i == p { 0.0 } else { other[p] };
                (0..TERMS).for_each(|j| other[j] -= share * row[j]);
            }
            a[p] = row;
        }
        if (0..GAINS).filter(used).any(|gain| a[gain][TORQUE] < 0.0) {
            f64::INFINITY
        } else {
            a[TORQUE][TORQUE]
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const DT: f64 = 0.03;

    /// What a law leaves of a torque (value and rate of (θ, ∫θ, θ′, t)), over what varies of it: θ two sines.
    fn share_left(torque: impl Fn(f64, f64, f64, f64) -> f64) -> f64 {
        let (mut law, mut squares, mut sum, n) = (ControllerLaw::default(), 0.0, 0.0, 400);
        let theta = |t: f64| 0.1 * (1.3 * t).sin() + 0.04 * (4.1 * t).cos();
        let at = |t: f64| {
            let integral = -0.1 / 1.3 * (1.3 * t).cos() + 0.04 / 4.1 * (4.1 * t).sin();
            torque(theta(t), integral, 0.13 * (1.3 * t).cos() - 0.164 * (4.1 * t).sin(), t)
        };
        for k in 0..n {
            let t = DT * f64::from(k);
            law.pass(theta(t), DT);
            let motor = [theta(t), (theta(t + 1e-6) - theta(t - 1e-6)) / 2e-6];
            let tau = [at(t), (at(t + 1e-6) - at(t - 1e-6)) / 2e-6];
            law.take(&motor, &tau, 1e6);
            squares += tau[0] * tau[0];
            sum += tau[0];
        }
        let count = f64::from(n);
        (law.left() / (squares / count - (sum / count).powi(2))).sqrt()
    }

    #[test]
    fn a_controller_leaves_next_to_nothing() {
        assert!(share_left(|theta, _, rate, _| 3.0 - 80.0 * theta - 5.0 * rate) < 1e-6);
        assert!(share_left(|theta, integral, rate, _| -80.0 * theta - 40.0 * integral - 5.0 * rate) < 0.02);
    }

    #[test]
    fn a_torque_that_drives_the_motor_is_left() {
        // A motor that turns against a spring and friction has torque and motion the other way about.
        assert!(share_left(|theta, _, rate, _| 80.0 * theta + 5.0 * rate) > 0.9);
        assert!(share_left(|theta, _, _, t| -80.0 * theta + 8.0 * (2.3 * t).sin()) > 0.5);
    }

    #[test]
    fn before_any_equation_nothing_is_left() {
        assert!(ControllerLaw::default().left() == 0.0);
    }
}
