//! What is believed of the unknowns before any data.

use super::{
    CORNER, DAMPING, DRY, DRY_LATE, ECCENTRIC, INERTIA, LATE, LOAD, OFFSET, SPRING, Scale, Spring,
    TORQUE_BEND, TORQUE_LATE, USUAL, ZERO,
};
use crate::balance;
use crate::gram::{Frame, Gram, Prior, UNKNOWNS, inverse, set};
use crate::model::Motor;
use crate::settings::Priors;

impl Spring {
    /// What is believed of the unknowns before any data, in the scale of these rows.
    ///
    /// `total`: rows that say how large the torque and the columns are.
    #[must_use]
    pub fn prior(&self, motor: &Motor, priors: &Priors, total: &Gram, frame: &Frame, scale: &Scale) -> Prior {
        let Scale { zero_std, deflection, period_s } = *scale;
        let torque = balance::variance(total, balance::TORQUE).max(f64::MIN_POSITIVE).sqrt();
        let rms =
            |unknown: usize| (total.quadratic(&frame.directions[unknown]) / total.rows).sqrt().max(1e-12);
        let fluctuation = |unknown: usize| {
            let mean = total.times(&frame.directions[unknown])[balance::OFFSET] / total.rows;
            (rms(unknown).powi(2) - mean * mean).max(0.0).sqrt().max(1e-12)
        };
        let (mut mean, mut std) = ([0.0; UNKNOWNS], [1.0; UNKNOWNS]);
        for unknown in DRY_LATE..UNKNOWNS {
            let gear = LOAD.contains(&unknown);
            let share = if gear { priors.load_dependent_friction } else { priors.undeclared };
            std[unknown] = share * torque / rms(unknown);
        }
        // Both are believed of it: what an encoder reads wrong, and what an effect makes of a torque.
        for value in &mut std[ECCENTRIC] {
            *value = value.recip().hypot(priors.encoder_eccentricity.recip()).recip();
        }
        if self.series {
            std[CORNER.start] = priors.spring * torque / rms(CORNER.start);
        }
        let inertia = motor.inertia_std.unwrap_or(priors.motor_inertia);
        (mean[INERTIA], std[INERTIA]) = (motor.inertia, inertia * motor.inertia);
        mean[DAMPING] = motor.damping;
        std[DAMPING] = motor.damping_std.unwrap_or_else(|| {
            priors.viscous_damping * motor.damping + priors.viscous_damping_floor * torque / rms(DAMPING)
        });
        std[OFFSET] = priors.torque_offset * torque;
        std[DRY] = priors.coulomb_friction * torque;
        let base = self.base();
        let shapes = self.law.shapes();
        for (i, unknown) in SPRING.enumerate().take(self.size) {
            let shape = i.checked_sub(1).and_then(|k| shapes.get(k));
            // A shape that small deflections do not show stays where it began; its k would be anything.
            mean[unknown] = if self.anchored || shape.is_some() { self.start[i] - base[i] } else { 0.0 };
            let undeclared = i >= if self.series { USUAL } else { self.least };
            std[unknown] = match (self.anchored, shape) {
                _ if undeclared => priors.undeclared * torque / rms(unknown),
                (true, Some(shape)) => priors.law * (self.start[i] - shape.low),
                (true, None) if self.start[i] != 0.0 => priors.law * self.start[i].abs(),
                (false, Some(shape)) => (2.0 * (self.start[i] - shape.low)).max(self.bend_scale(deflection)),
                _ => priors.spring * torque / fluctuation(unknown), // its mean may be a zero that is elsewhere
            };
        }
        (mean[ZERO], std[ZERO]) = (-self.zero, zero_std);
        std[LATE] = priors.encoder_delay * period_s;
        std[TORQUE_LATE] = priors.late.hypot(0.5 * period_s); // filtered; held, sampled, or averaged over a period
        std[TORQUE_BEND] = 0.5 * std[TORQUE_LATE].powi(2);
        self.with_declared(Prior::independent(mean, &std))
    }

    /// With the covariance of what is declared, where it is and holds.
    fn with_declared(&self, mut prior: Prior) -> Prior {
        if let Some(covariance) = self.declared_covariance() {
            let precision = inverse(&covariance, set(SPRING.start..SPRING.start + self.least));
            for i in SPRING.take(self.least) {
                prior.precision[i] = precision[i];
            }
        }
        prior
    }
}
