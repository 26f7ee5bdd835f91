//! Friction that nobody declared and that no parameter stands for: what it may add to the motor's balance.

use crate::signals::Signals;

/// Shapes that it may have: [`Friction::torques`].
pub const SHAPES: usize = 3;
const END: f64 = 2.0; // standard deviations from the middle to an end of the motion; sliding, friction grows no more

/// Means and variances of the motor's position and torque over the memory of the regression.
#[derive(Clone, Copy, Debug, Default)]
pub struct Friction {
    equations: f64,
    mean: [f64; 2],
    variance: [f64; 2],
}

impl Friction {
    /// Take one equation's position and torque. `memory`: equations.
    pub fn see(&mut self, signals: &Signals, memory: f64) {
        self.equations = (self.equations + 1.0).min(memory);
        let share = 1.0 / self.equations;
        for (i, now) in [signals.position.main[0], signals.torque.main[0]].into_iter().enumerate() {
            let off = now - self.mean[i];
            self.mean[i] += share * off;
            self.variance[i] = (1.0 - share) * (self.variance[i] + share * off * off);
        }
    }

    /// The k-th derivative (0 or 1) of each shape at the torque's own size, N·m (1/s).
    ///
    /// Before dry friction slides it is an odd function of the position x: its first two terms, x and
    /// (x³ − 3x)/√6 of the position in standard deviations, which are orthogonal for a normal one. And what a
    /// gear loses, |τ| sign θ′.
    #[must_use]
    pub fn torques(&self, signals: &Signals, k: usize) -> [f64; SHAPES] {
        let (motor, torque, sign) = (&signals.position.main, &signals.torque.main, &signals.friction.main);
        let [spread, level] = self.variance.map(f64::sqrt);
        let x = (motor[0] - self.mean[0]) / spread;
        if !x.is_finite() {
            return [0.0; SHAPES]; // it has not moved
        }
        let (at, root) = (x.clamp(-END, END), 6f64.sqrt());
        if k == 0 {
            return [level * at, level * (at.powi(3) - 3.0 * at) / root, torque[0].abs() * sign[0]];
        }
        let rate = if x.abs() < END { level * motor[1] / spread } else { 0.0 };
        let lost = torque[0].abs() * sign[1] + torque[1].copysign(torque[0] * torque[1]) * sign[0];
        [rate, rate * (3.0 * at * at - 3.0) / root, lost]
    }
}
