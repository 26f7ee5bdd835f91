//! What one motor says of its transmission at this moment.

use super::Side;
use crate::causes::{CAUSES, Cause};
use crate::choices::{DRIFT, DRIFTED, GROWN, REACHED};
use crate::deflection::Present;
use crate::external::Carried;
use crate::gram::Vector;
use crate::laws::Law;
use crate::reasons::Reason;
use crate::sample::TransmissionEstimate;
use crate::unknowns::{DRY, SPRING};

impl Side {
    /// The estimate at the present deflection; `delay`: of the filters.
    #[must_use]
    pub fn estimate(&self, present: &Present, delay: f64) -> TransmissionEstimate {
        let nothing = TransmissionEstimate::NOTHING;
        let left = || self.balance_torque(delay + present.behind_s + present.ahead_s);
        if self.rigid {
            return TransmissionEstimate { flexibility_torque: left(), ..nothing };
        }
        let (read, of_read) = self.deflection.now(present, self.noise.iter().sum());
        let of_read = of_read + self.balance.rounding(self.noise, 0.0); // an error that stays is in every reading
        let phi = read + self.effects.kinematic_error(self.theta - self.effects.offset);
        let Some(at) = self.blocks.at(phi, self.deflection.link_rate(), &self.balance) else {
            return TransmissionEstimate { flexibility_torque: left(), deflection: read, ..nothing };
        };
        let more = self.effects.spring(phi);
        let stiffness = at.stiffness + more.1;
        let held = (DRIFT * self.held_s).min(DRIFTED);
        // A curve is as uncertain as its parameters, and as φ is where it bends; the stiffness, as its zero is there too.
        let std = |by: &Vector, slope: f64, of_phi: f64, value: f64| {
            let variance = self.blocks.posterior.as_ref().map_or(f64::NAN, |known| known.variance_along(by));
            (variance + slope.powi(2) * of_phi + (held * value).powi(2)).sqrt()
        };
        let of_zero = (self.blocks.zero_torque(stiffness) / stiffness).powi(2);
        let stiffness_std =
            std(&at.by_stiffness, at.bend, of_read + of_zero, stiffness).hypot(at.within_piece.sqrt());
        let (flexibility_torque, flexibility_torque_std) = if self.fits && at.stiffness > 0.0 {
            let torque = at.torque + more.0;
            (torque, std(&at.by_torque, stiffness, of_read, torque))
        } else {
            (left(), f64::NAN)
        };
        TransmissionEstimate {
            flexibility_torque,
            flexibility_torque_std,
            stiffness,
            stiffness_std,
            deflection: read + self.blocks.spring.zero,
        }
    }

    /// Why the stiffness at this moment may not be used, and why the torque may not.
    #[must_use]
    pub fn reasons(
        &self,
        part: &TransmissionEstimate,
        valid_within: f64,
        settled: bool,
    ) -> [Option<Reason>; 2] {
        if let Some(reason) = self.unusable(part, settled) {
            return [Some(reason); 2];
        }
        if self.rigid {
            return [None; 2];
        }
        let lost = self.blocks.is_lost();
        let usual = self.blocks.torque_rms();
        let size = if usual.is_nan() { part.flexibility_torque.abs() } else { usual }; // no rows, no recording yet
        let least = valid_within * size;
        let imprecise = part.flexibility_torque_std >= least || part.flexibility_torque_std.is_nan();
        let guessed = self.blocks.zero_torque(part.stiffness) >= least || self.blocks.is_zero_guessed();
        let elsewhere = lost || guessed || part.stiffness * self.blocks.zero_std() >= least;
        let why = |reason| if elsewhere { Reason::Lost } else { reason };
        let share = part.flexibility_torque_std / size;
        let torque = (imprecise || guessed).then(|| why(Reason::TorqueImprecise(share)));
        let stiffness = Reason::of_precision(part.stiffness, part.stiffness_std, valid_within);
        [stiffness.map(why), torque]
    }

    /// Why none of the numbers at this moment may be used.
    fn unusable(&self, part: &TransmissionEstimate, settled: bool) -> Option<Reason> {
        if self.rigid {
            return (!part.flexibility_torque.is_finite()).then_some(Reason::Settling);
        }
        if self.deflection.unsettled > 0 || self.unconfirmed_s > 0.0 {
            return Some(Reason::Settling);
        }
        let nothing = self.blocks.posterior.is_none();
        if nothing || self.blocks.is_unconfirmed() {
            return Some(match self.renewed {
                _ if !settled => Reason::Settling,
                _ if self.blocks.is_lost() || self.blocks.moved => Reason::Lost,
                true => Reason::Lever,
                false => Reason::Unmoved,
            });
        }
        if self.doubtful {
            return Some(if self.blocks.is_suspected() { Reason::Lost } else { Reason::Changed });
        }
        if !self.fits {
            return Some(Reason::Unexplained(self.unexplained));
        }
        let reach = (GROWN * self.balance.largest()).min(REACHED * self.blocks.spring.reach());
        let phi = part.deflection - self.blocks.spring.zero;
        let within = phi.abs() < if reach > 0.0 { reach } else { f64::INFINITY };
        (!within).then_some(Reason::Beyond)
    }

    /// Which causes the window does not tell from the likeliest one.
    #[must_use]
    pub fn likely_causes(&self) -> [bool; CAUSES] {
        let Some(odds) = self.blocks.odds() else { return [false; CAUSES] };
        let named = |cause: Cause| !matches!(cause, Cause::Nothing | Cause::Noise);
        odds.likely(named)
    }

    /// What it does to the link at a deflection as it is measured; `None` where no curve is trusted.
    ///
    /// `noise`: variance of θ's noise, rad².
    #[must_use]
    pub fn carried(&self, phi: f64, noise: f64) -> Option<Carried> {
        if self.rigid || !self.fits || self.blocks.is_unconfirmed() {
            return None;
        }
        let at = self.blocks.at(phi, 0.0, &self.balance)?;
        let stiffness = at.stiffness + self.effects.spring(phi).1;
        let variance = self.blocks.posterior.as_ref()?.variance_along(&at.by_torque);
        let (late, late_std) = self.blocks.lateness();
        Some(Carried {
            torque: at.torque + self.declared.transmission,
            variance,
            skew: stiffness * late,
            skew_std: stiffness * late_std,
            stiffness,
            reading: stiffness * stiffness * noise,
        })
    }

    /// The law's parameters with their standard deviations; `None` before any.
    pub fn parameters(&self, values: &mut Vec<f64>, std: &mut Vec<f64>) -> Option<&Law> {
        let known = self.blocks.posterior.as_ref().filter(|_| !self.rigid)?;
        let spring = &self.blocks.spring;
        for (i, unknown) in SPRING.enumerate().take(spring.size).filter(|(_, u)| known.set >> u & 1 == 1) {
            values.push(spring.alpha[i]);
            std.push(known.covariance[unknown][unknown].sqrt());
        }
        Some(&spring.law)
    }

    /// Dry friction beyond what is declared, and its standard deviation, N·m; `None` before any.
    pub fn friction(&self) -> Option<(f64, f64)> {
        let known = self.blocks.posterior.as_ref()?;
        Some((known.x[DRY], known.covariance[DRY][DRY].sqrt()))
    }
}
