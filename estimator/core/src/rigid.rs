//! What the balance of a rigid joint leaves: without a transmission that deflects there is no spring to learn.

use crate::choices::{SLOW_S, USUAL_S};
use serde::{Deserialize, Serialize};

/// Mean and mean square, older values forgotten.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
struct Spread {
    mean: f64,
    square: f64,
}

impl Spread {
    fn add(&mut self, value: f64, share: f64) {
        self.mean += share * (value - self.mean);
        self.square += share * (value * value - self.square);
    }

    fn variance(&self) -> f64 {
        (self.square - self.mean * self.mean).max(0.0)
    }
}

/// Torque that inertia, damping and declared effects leave of the motor's, and that torque, over the last seconds.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct RigidBalance {
    inertia: f64,
    left: Spread,
    torque: Spread,
    usual: f64, // variance of the torque in motion
    seen_s: f64,
}

impl RigidBalance {
    /// Of a motor of this inertia, kg·m².
    #[must_use]
    pub fn new(inertia: f64) -> RigidBalance {
        RigidBalance { inertia, ..RigidBalance::default() }
    }

    /// Forget what was seen.
    pub fn reset(&mut self) {
        *self = RigidBalance::new(self.inertia);
    }

    /// One sample.
    pub fn add(&mut self, left: f64, torque: f64, period_s: f64) {
        if !(left.is_finite() && torque.is_finite()) {
            return;
        }
        self.seen_s = (self.seen_s + period_s).min(SLOW_S);
        let share = period_s / self.seen_s;
        self.left.add(left, share);
        self.torque.add(torque, share);
        self.usual = (self.usual * (1.0 - period_s / USUAL_S)).max(self.torque.variance());
    }

    /// The share of the torque that is left, where it is more than `valid_within` and than noise.
    ///
    /// `noise`: variances of torque (N²·m²) and acceleration (rad²/s⁴).
    #[must_use]
    pub fn unexplained(&self, valid_within: f64, noise: [f64; 2]) -> Option<f64> {
        let noise = noise[0] + self.inertia * self.inertia * noise[1];
        let share = (self.left.variance() / self.usual).sqrt();
        (share > valid_within && self.left.variance() > noise).then_some(share)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_share_of_the_torque_beyond_what_is_asked_for_and_beyond_noise_is_unexplained() {
        let of = |left: f64, noise: f64| {
            let mut balance = RigidBalance::new(2.0);
            for k in 0..20_000 {
                let wave = (0.01 * f64::from(k)).sin();
                balance.add(3.0 + left * wave, 5.0 * wave, 1e-3); // a constant is an offset
            }
            balance.unexplained(0.2, [0.0, noise])
        };
        assert_eq!(of(0.5, 0.0), None);
        assert!((0.3..0.5).contains(&of(2.0, 0.0).unwrap()));
        assert_eq!(of(2.0, 1.0), None);
        let mut stands = RigidBalance::new(2.0);
        for k in 0..60_000 {
            let (slow, moves) = ((0.001 * f64::from(k)).sin(), k < 20_000);
            let wave = if moves { (0.01 * f64::from(k)).sin() } else { 0.1 * slow };
            stands.add(if moves { 0.0 } else { 5.0 * wave }, 5.0 * wave, 1e-3); // friction holds it
        }
        assert_eq!(stands.unexplained(0.2, [0.0; 2]), None);
        assert_eq!(RigidBalance::new(2.0).unexplained(0.2, [0.0; 2]), None);
    }
}
