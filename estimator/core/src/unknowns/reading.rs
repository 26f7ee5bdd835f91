//! Torque and stiffness that the unknowns make at a deflection.

use super::{ASYMMETRY, CLIPS, CORNER, ECCENTRIC, LATE, SPRING, STOPS, Spring, ZERO};
use crate::balance;
use crate::balance::Balance;
use crate::gram::{Set, UNKNOWNS, Vector};
use crate::laws::PARAMETERS;

/// See [`Spring::at`].
#[derive(Clone, Debug)]
pub struct Reading {
    /// τ_e, N·m.
    pub torque: f64,
    /// σ, N·m/rad.
    pub stiffness: f64,
    /// Slopes of τ_e by the unknowns.
    pub by_torque: Vector,
    /// Slopes of σ by the unknowns.
    pub by_stiffness: Vector,
    /// ∂σ/∂φ, N·m/rad².
    pub bend: f64,
    /// Variance of σ that a free curve of few pieces leaves, (N·m/rad)².
    pub within_piece: f64,
}

impl Spring {
    /// τ_e and σ at a deflection as it is measured, with their slopes by the unknowns.
    ///
    /// `late_s` and `link_rate`: the position that was read late is brought up by them.
    #[must_use]
    pub fn at(&self, phi: f64, x: &Vector, set: Set, link_rate: f64, balance: &Balance) -> Reading {
        let waves = balance.waves();
        let eccentric: f64 = x[ECCENTRIC].iter().zip(waves).map(|(x, wave)| x * wave).sum();
        let now = phi + x[LATE] * link_rate + eccentric;
        let (mut torque, mut stiffness) = self.curve(now);
        let at = now + self.zero;
        let (mut by_torque, mut by_stiffness) = ([0.0; UNKNOWNS], [0.0; UNKNOWNS]);
        let (mut f, mut s) = ([0.0; PARAMETERS], [0.0; PARAMETERS]);
        let near = &self.linearised[..self.size];
        self.law.jacobian(at, near, &mut f[..self.size]);
        let bend =
            self.law.stiffness_slopes(at, near, &mut s[..self.size]) + 2.0 * self.corner * now.signum();
        by_torque[SPRING.start..SPRING.start + self.size].copy_from_slice(&f[..self.size]);
        by_stiffness[SPRING.start..SPRING.start + self.size].copy_from_slice(&s[..self.size]);
        if set & crate::gram::set(CORNER) != 0 {
            let square = balance.size.deflection.powi(2);
            by_torque[CORNER.start] = now * now.abs() / square;
            by_stiffness[CORNER.start] = 2.0 * now.abs() / square;
        }
        let size = balance.size.deflection;
        let uneven = [(now.abs() / size, now.signum() / size), (now * now, 2.0 * now)];
        for (unknown, (more, stiffer)) in ASYMMETRY.zip(uneven).filter(|(unknown, _)| set >> unknown & 1 == 1)
        {
            (by_torque[unknown], by_stiffness[unknown]) = (more, stiffer);
            torque += x[unknown] * more;
            stiffness += x[unknown] * stiffer;
        }
        (by_torque[ZERO], by_stiffness[ZERO]) = (stiffness, bend);
        (by_torque[LATE], by_stiffness[LATE]) = (stiffness * link_rate, bend * link_rate);
        for (unknown, wave) in ECCENTRIC.zip(waves) {
            (by_torque[unknown], by_stiffness[unknown]) = (stiffness * wave, bend * wave);
        }
        if set & (crate::gram::set(STOPS) | crate::gram::set(CLIPS)) != 0 {
            let (more, stiffer) = balance.extras(phi);
            for (unknown, column) in STOPS.zip(balance::STOPS).chain(CLIPS.zip(balance::CLIPS)) {
                (by_torque[unknown], by_stiffness[unknown]) = (more[column], stiffer[column]);
                torque += x[unknown] * more[column];
                stiffness += x[unknown] * stiffer[column];
            }
        }
        let within_piece = if set & crate::gram::set(CLIPS) != 0 {
            balance.within_piece(phi, &x[CLIPS], stiffness)
        } else {
            0.0
        };
        Reading { torque, stiffness, by_torque, by_stiffness, bend, within_piece }
    }
}
