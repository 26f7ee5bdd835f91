//! The reference: parameters estimated some time ago while the balance was explained, and their test on the
//! last seconds.

use super::{COULOMB, DEFLECTION_OFFSET, DELAY, OFFSET, OnlineIdentification};
use crate::change_detection::{LEAST_IN_WINDOW, UPDATES};
use crate::isolation::{CHANGES, Change, Explanation, Isolation, Layout, READINGS, Verdict};
use crate::kalman::{Kalman, SIZE, TAILS, Vector};
use crate::linear_algebra::{dot, times};
use crate::linearisation::bound;
use crate::signals::Signals;

const REOPENED: f64 = 0.1; // std of a deflection's offset after an encoder has moved its zero
const FAR: f64 = 1e3; // times what an equation is measured in: it says nothing of what has changed
const REFERENCE_S: f64 = 5.0; // of updates, from one reference to the next
const SETTLED_S: f64 = 2.0; // of updates, until there is a first one
// Prior standard deviations of the amplitudes of changes, in the units of their columns: stiffness, friction
// and offsets relative, delays in periods, scales relative, a drift relative a second.
const CHANGE_STD: [f64; CHANGES] = [0.0, 0.5, 0.1, 0.3, 0.3, 3.0, 0.3, 0.3, 0.3, 3.0, 3.0, 0.3, 0.3];

impl OnlineIdentification {
    /// There is nothing to hold the balance against.
    pub fn forget_reference(&mut self) {
        (self.reference, self.candidate) = (None, None);
        self.refresh_at = self.updates.saturating_add(self.updates_in(SETTLED_S));
        self.window.clear();
    }

    /// Hold what has been learned, while all is well: the reference is as old as one to two of its turns.
    ///
    /// Whether it was time to.
    pub fn keep_reference(&mut self) -> bool {
        if self.black_box || self.updates < self.refresh_at {
            return false;
        }
        self.refresh_at = self.updates + self.updates_in(REFERENCE_S);
        let Some(kalman) = &self.kalman else { return false };
        if let (Some(old), Some(new)) = (&self.reference, &self.candidate) {
            let mut change = [0.0; SIZE];
            (0..SIZE).for_each(|i| change[i] = new.x[i] - old.x[i]);
            self.window.rebase(&change);
        }
        self.reference = self.candidate.take().or_else(|| Some(kalman.clone()));
        self.candidate = Some(kalman.clone());
        true
    }

    /// s² of an equation that the reference foresees.
    fn reference_noise(reference: &Kalman) -> f64 {
        reference.noise * reference.tailed() + LEAST_IN_WINDOW * LEAST_IN_WINDOW
    }

    /// Take an equation into the window; what the reference leaves, and what is left of that where `suspect`
    /// explains it, squared and over what is foreseen.
    pub fn observe(
        &mut self,
        signals: &Signals,
        link: &[f64; 4],
        h: &Vector,
        y: f64,
        window: f64,
        suspect: Option<(Change, Explanation)>,
    ) -> Option<[f64; 2]> {
        let reference = self.reference.as_ref()?;
        // What a change does follows from the curve that is held against the window, not from the one that
        // is being looked for in the meantime.
        let mut known = [0.0; SIZE];
        (0..reference.size()).for_each(|i| known[i] = reference.x[i] * self.units.of[i]);
        bound(&self.law.law, &mut known);
        let (n, mut row) = (self.law.size, *h);
        let stiffness = self.law.filtered_stiffness(&signals.basis, 0, &known);
        let late = self.law.law.at(link[0] - signals.position.main[0], &known[..n]).1 * link[1];
        row[n + DELAY] = late * self.units.of[n + DELAY] / self.units.torque;
        row[n + DEFLECTION_OFFSET] = stiffness * self.units.of[n + DEFLECTION_OFFSET] / self.units.torque;
        let h = &row;
        let readings = self.readings(signals, link, stiffness);
        let left = reference.innovation(h, y);
        // No motion of this joint, and no number that others may be added to.
        if !h.iter().chain(&readings).chain([&left]).all(|value| value.abs() < FAR) {
            return None;
        }
        let zero = n + DEFLECTION_OFFSET;
        self.window.take(h, &readings, left, window, zero, self.dt);
        let foreseen = Self::reference_noise(reference)
            + reference.variance_over_scale() * dot(h, &times(&reference.sigma, h)).max(0.0);
        let explained = suspect.map_or(0.0, |(change, explanation)| {
            Isolation::effect(change, &explanation, h, &readings, reference, &self.layout())
        });
        Some([left * left / foreseen, (left - explained).powi(2) / foreseen])
    }

    /// What the balance of this moment gains with each reading that is not what it was, to first order.
    fn readings(&self, signals: &Signals, link: &[f64; 4], stiffness: f64) -> [f64; READINGS] {
        let (theta, torque) = (&signals.position.main, &signals.torque.main);
        let (b, d, t) = (self.inertia, self.damping, self.period);
        let si = [
            b * theta[2] + d * theta[1] + stiffness * theta[0], // θ (1 + c)
            -stiffness * link[0],                               // q (1 + c)
            -torque[0],                                         // τ (1 + c)
            -t * (b * theta[3] + d * theta[2] + stiffness * theta[1]), // θ late by c T
            t * torque[1],                                      // τ late by c T
            0.0,                                                // q − c t: nowhere else now
            d * self.units.deflection,                          // θ + c t
        ];
        si.map(|value| value / self.units.torque)
    }

    fn layout(&self) -> Layout {
        Layout {
            law: self.law.size,
            linear: self.law.linear(),
            places: [COULOMB, OFFSET, DEFLECTION_OFFSET, DELAY],
            std: CHANGE_STD,
        }
    }

    /// What the window says of every change; `None` without a reference.
    #[must_use]
    pub fn judge(&self) -> Option<Verdict> {
        let reference = self.reference.as_ref()?;
        let (noise, correlated) =
            (Self::reference_noise(reference), reference.correlation().max(UPDATES as f64));
        Some(self.window.judge(reference, &self.layout(), noise, correlated, TAILS))
    }

    /// What was learned since the reference is void.
    pub fn restore_reference(&mut self) {
        self.window.clear();
        let Some(reference) = &self.reference else { return };
        self.kalman = Some(reference.clone());
        self.candidate = Some(reference.clone());
        self.refresh_at = self.updates.saturating_add(self.updates_in(REFERENCE_S));
    }

    /// SI units (s for delays) in which a change's amplitude is counted.
    #[must_use]
    pub fn unit_of(&self, change: Change) -> f64 {
        match change {
            Change::TorqueZero | Change::Friction => self.units.torque,
            Change::PositionZero | Change::LinkDrift | Change::MotorDrift => self.units.deflection,
            Change::LinkDelay | Change::MotorDelay | Change::TorqueDelay => self.period,
            _ => 1.0,
        }
    }

    /// What has been found changed is changed; the reference is another one from now on.
    pub fn accept(&mut self, change: Change, verdict: &Verdict) {
        let place = match change {
            Change::Friction => COULOMB,
            Change::TorqueZero => OFFSET,
            Change::PositionZero => DEFLECTION_OFFSET,
            Change::LinkDelay => DELAY,
            _ => return self.renew_reference(), // the stiffness has been followed
        };
        self.restore_reference();
        let (explanation, index) = (verdict.of(change), self.law.size + place);
        if let Some(kalman) = &mut self.kalman {
            kalman.x[index] += explanation.amplitude;
            kalman.inflate(index, 4.0 * explanation.std * explanation.std);
        }
        self.renew_reference();
    }

    fn renew_reference(&mut self) {
        (self.reference, self.candidate) = (self.kalman.clone(), self.kalman.clone());
        self.refresh_at = self.updates.saturating_add(self.updates_in(REFERENCE_S));
        self.window.clear();
    }

    /// The window begins anew.
    pub fn look_again(&mut self) {
        self.window.clear();
    }

    /// An encoder has moved its zero: the deflection's offset is not what it was to the last digit (`known`),
    /// or anywhere within the largest deflection.
    pub fn reopen_deflection_offset(&mut self, known: bool) {
        let place = self.law.size + DEFLECTION_OFFSET;
        let std = if known { REOPENED } else { 1.0 };
        for kalman in [&mut self.kalman, &mut self.reference, &mut self.candidate].into_iter().flatten() {
            kalman.inflate(place, std * std);
        }
        self.window.clear();
    }
}
