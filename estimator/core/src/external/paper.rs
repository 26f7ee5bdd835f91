//! External torque in mode "paper": eqs 12 and 13 as printed.

use serde::{Deserialize, Serialize};

use super::contact::Judge;
use super::{External, Latest, SETTLED, TINY, gravity, status};
use crate::filters::first_order_pole;
use crate::model::{Link, Model};
use crate::noise::NoiseMeter;
use crate::sample::Sample;
use crate::settings::{Priors, Settings};

/// K s/(s + K) of one term of y, exact for a straight y.
#[derive(Clone, Copy, Debug, Default, Serialize, Deserialize)]
struct Term {
    value: f64,
    last: Option<f64>,
}

impl Term {
    fn update(&mut self, y: f64, pole: f64, span_s: f64) -> f64 {
        let before = self.last.replace(y).unwrap_or(y);
        self.value = pole * self.value + (1.0 - pole) * (y - before) / span_s;
        self.value
    }
}

/// Eq 12 as printed: r = K (p_q + D_q q − ∫(τ_k − g(q) + r)), which obeys eq 13.
///
/// y = M q′ + D_q q − ∫(τ_k − g) is a sum, and K s/(s + K) is linear: each term has its own residual, so that
/// what is uncertain of each is known. τ_k and g are smooth: their integrals are trapezoidal.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct PaperMomentum {
    link: Link,
    k: f64,
    period: f64,
    friction: f64, // of the motor side, as a share of the torque: eq 14 has it in τ_e
    settle: i64,
    unsettled: i64,
    momentum: Term,
    damped: Term,
    fallen: Term,
    pushed: Term,
    integrals: [f64; 2],    // of g and of τ_k
    last: Option<[f64; 3]>, // q, g, τ_k
    noise: NoiseMeter,
    judge: Judge,
    /// See [`Latest`].
    pub latest: Latest,
}

impl PaperMomentum {
    /// See [`LinkMomentum::new`].
    #[must_use]
    pub fn new(model: &Model, settings: &Settings, priors: &Priors, period_s: f64) -> Option<PaperMomentum> {
        let link = model.link?;
        Some(PaperMomentum {
            link,
            k: settings.k_tau,
            period: period_s,
            friction: priors.coulomb_friction,
            settle: (SETTLED / (settings.k_tau * period_s)).ceil() as i64,
            unsettled: 0,
            momentum: Term::default(),
            damped: Term::default(),
            fallen: Term::default(),
            pushed: Term::default(),
            integrals: [0.0; 2],
            last: None,
            noise: NoiseMeter::default(),
            judge: Judge::new(settings, settings.k_tau, period_s),
            latest: Latest::nothing(),
        })
    }

    /// Forget everything.
    pub fn reset(&mut self) {
        self.judge.reset();
        self.latest = Latest::nothing();
        self.restart();
    }

    /// Integrals and residuals begin anew.
    pub fn restart(&mut self) {
        for term in [&mut self.momentum, &mut self.damped, &mut self.fallen, &mut self.pushed] {
            *term = Term::default();
        }
        (self.integrals, self.last) = ([0.0; 2], None);
        self.noise.restart();
        self.judge.test.reset();
        self.unsettled = self.settle;
    }

    /// Where y begins; without a measured velocity the momentum begins with the first difference.
    fn begin(&mut self, sample: &Sample) -> External {
        let measured = Some(sample.link_velocity).filter(|velocity| velocity.is_finite());
        self.momentum.last = measured.map(|velocity| self.link.inertia * velocity);
        self.damped.last = Some(self.link.damping * sample.link_position);
        (self.fallen.last, self.pushed.last) = (Some(0.0), Some(0.0));
        self.latest.repeat(sample.sequence)
    }

    /// One sample that was used, so many periods after the last one.
    ///
    /// `internal`: r of eq 14 for the whole joint; `balance`: its y; `valid`: whether the estimate is.
    pub fn update(
        &mut self,
        sample: &Sample,
        periods: u32,
        internal: f64,
        balance: f64,
        valid: bool,
    ) -> External {
        let span = self.period * f64::from(periods);
        let q = sample.link_position;
        let tau = if sample.external_torque.is_finite() { sample.external_torque } else { 0.0 };
        let g = gravity(&self.link, q);
        let Some(before) = self.last.replace([q, g, tau]) else {
            return self.begin(sample);
        };
        let velocity =
            if sample.link_velocity.is_finite() { sample.link_velocity } else { (q - before[0]) / span };
        self.integrals[0] += 0.5 * span * (g + before[1]);
        self.integrals[1] += 0.5 * span * (tau + before[2]);
        let pole = first_order_pole(self.k, span);
        let (p, damped) = (self.link.inertia * velocity, self.link.damping * q);
        let inertial = self.momentum.update(p, pole, span);
        let viscous = self.damped.update(damped, pole, span);
        let weight = self.fallen.update(self.integrals[0], pole, span);
        let known = self.pushed.update(self.integrals[1], pole, span);
        self.noise.update(p + damped + self.integrals[0] + balance, span);
        self.unsettled -= i64::from(periods);
        let sum = internal + inertial + viscous + weight;
        let link = &self.link;
        let uncertain = (link.inertia_std / link.inertia * inertial).powi(2)
            + (link.damping_std / link.damping.max(TINY) * viscous).powi(2)
            + link.gravity_std.powi(2)
            + (self.friction * internal).powi(2);
        let gain = 2.0 * ((1.0 - pole) / span).powi(2) / (1.0 + pole);
        let white = gain * self.noise.variance(f64::INFINITY);
        let valid = valid && self.unsettled <= 0 && (sum + uncertain + white).is_finite();
        let (torque, contact) = self.judge.judge(sum, internal, uncertain, white, valid);
        let external = External {
            sequence: sample.sequence,
            status: if valid { status::VALID } else { 0 } | if contact { status::CONTACT } else { 0 },
            torque,
            torque_std: (uncertain + white).sqrt(),
            link_torque: known - inertial - viscous - weight,
            difference: sum - known,
        };
        self.latest.publish(external, span)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::model::Arrangement;
    use crate::sample::MOTORS;

    #[test]
    fn a_push_of_a_free_link_is_its_acceleration_behind_the_pole() {
        let link = Link {
            inertia: 0.5,
            damping: 0.0,
            gravity: 0.0,
            gravity_phase: 0.0,
            inertia_std: 0.0,
            damping_std: 0.0,
            gravity_std: 0.0,
        };
        let model = Model {
            arrangement: Arrangement::Single,
            motors: vec![],
            link: Some(link),
            link_effects: vec![],
        };
        let settings = Settings { k_tau: 100.0, ..Settings::default() };
        let mut momentum = PaperMomentum::new(&model, &settings, &Priors::USUAL, 1e-3).unwrap();
        let acceleration = 6.0; // of 3 N·m
        for k in 0..60u32 {
            let t = 1e-3 * f64::from(k);
            let sample = Sample {
                sequence: u64::from(k),
                motor_position: [f64::NAN; MOTORS],
                motor_velocity: [f64::NAN; MOTORS],
                motor_torque: [f64::NAN; MOTORS],
                link_position: 0.5 * acceleration * t * t,
                link_velocity: acceleration * t,
                external_torque: f64::NAN,
            };
            let found = momentum.update(&sample, 1, 0.0, 0.0, true);
            if k > 0 {
                let expected = 3.0 * (1.0 - (-100.0 * t).exp());
                assert!((found.torque - expected).abs() < 1e-9, "{} is not {expected}", found.torque);
                assert!((found.link_torque + expected).abs() < 1e-9);
            }
        }
        let nothing = Model { link: None, ..model };
        assert!(PaperMomentum::new(&nothing, &settings, &Priors::USUAL, 1e-3).is_none());
    }
}
