//! Units of the equation: they scale torque, deflection and velocity of any joint to about one.

use super::{CUT_OFF, DEFLECTION_OFFSET, OnlineIdentification};
use crate::kalman::{NUISANCES, SIZE, Vector};
use crate::linearisation::bound;
use crate::signals::Signals;

const GROWN: f64 = 1.5; // peaks over units, from which on the units are outgrown
const TINY: f64 = 1e-12;

/// What the equation is measured in: its largest values so far.
#[derive(Clone, Copy, Debug)]
pub(super) struct Units {
    pub(super) peaks: [f64; 3], // torque, deflection, velocity
    pub(super) torque: f64,
    pub(super) deflection: f64,
    pub(super) rate: f64,
    pub(super) of: Vector, // of the parameters
}

pub(super) const NO_UNITS: Units =
    Units { peaks: [0.0; 3], torque: 0.0, deflection: 0.0, rate: 0.0, of: [1.0; SIZE] };

impl OnlineIdentification {
    /// Follow the largest torque, deflection and velocity; change units when they have outgrown them.
    pub fn observe_scale(&mut self, signals: &Signals, link: &[f64; 4]) {
        let k = usize::from(self.black_box);
        let motor = &signals.position.main;
        let inertial = self.inertia * motor[k + 2].abs();
        let torque = self.balance(signals, k).abs().max(inertial).max(signals.torque.main[k].abs());
        let now = [torque, (link[k] - motor[k]).abs(), motor[k + 1].abs()];
        for (peak, now) in self.units.peaks.iter_mut().zip(now) {
            *peak = peak.max(now);
        }
        let units = [self.units.torque, self.units.deflection, self.units.rate];
        if self.kalman.is_some()
            && self.units.peaks.iter().zip(units).any(|(peak, unit)| *peak > GROWN * unit)
        {
            self.change_units();
        }
    }

    /// Largest torque, deflection and velocity so far.
    #[must_use]
    pub fn scale(&self) -> [f64; 3] {
        self.units.peaks
    }

    /// Those are the largest ones: what was larger since is not explained, and would be the unit for ever.
    pub fn recall_scale(&mut self, peaks: [f64; 3]) {
        self.units.peaks = peaks;
        if [self.units.torque, self.units.deflection, self.units.rate].iter().zip(peaks).any(|(x, y)| *x > y)
        {
            self.change_units();
        }
    }

    /// Noise of φ, rad: no prior of an offset is narrower.
    pub fn observe_noise(&mut self, resolution: f64) {
        self.resolution = resolution;
    }

    pub(super) fn set_units(&mut self) {
        let [torque, deflection, rate] = self.units.peaks.map(|peak| peak.max(TINY));
        (self.units.torque, self.units.deflection, self.units.rate) = (torque, deflection, rate);
        self.make_units();
    }

    pub(super) fn make_units(&mut self) {
        let Units { torque, deflection, rate, .. } = self.units;
        let n = self.law.size;
        self.units.of = [1.0; SIZE];
        if self.law.is_polynomial() {
            for h in 0..n {
                self.units.of[h] = torque / deflection.powi(2 * h as i32 + 1);
            }
        } else if self.law.alpha0[0] == 0.0 {
            self.units.of[0] = torque / self.law.law.at(deflection, &[1.0]).0.abs().max(1e-300);
        } else {
            for i in 0..n {
                self.units.of[i] = self.law.alpha0[i].abs();
            }
        }
        let nuisances = [self.inertia, torque / rate, torque, torque, self.period, deflection];
        self.units.of[n..n + NUISANCES].copy_from_slice(&nuisances);
    }

    fn change_units(&mut self) {
        let (old, old_std) = (self.units, self.nuisance_std());
        self.set_units();
        let n = self.law.size;
        let mut ratio = [1.0; SIZE];
        for i in 0..n + NUISANCES {
            ratio[i] = old.of[i] / self.units.of[i];
        }
        let new_std = self.nuisance_std();
        let noise = old.torque / self.units.torque;
        for kalman in [&mut self.kalman, &mut self.reference, &mut self.candidate].into_iter().flatten() {
            kalman.rescale(&ratio, noise);
            for i in 0..NUISANCES {
                kalman.inflate(n + i, (new_std[i].powi(2) - (old_std[i] * ratio[n + i]).powi(2)).max(0.0));
            }
            // The cut-off's prior, a share of the torque at the deflection reached then, is one of now.
            let (power, most) = (n - 1, CUT_OFF * CUT_OFF);
            let variance = kalman.p[power][power];
            if self.cut_off && variance > most {
                kalman.ceiling[power] = most;
                kalman.draw(power, most / variance);
            }
        }
        let columns = ratio.map(|ratio| noise / ratio);
        self.window.rescale(&columns, noise, n + DEFLECTION_OFFSET);
        self.law.remember_tangent(self.units.deflection);
    }

    /// α and the nuisances in SI, the shape where it can be.
    pub(super) fn unscale(&mut self) {
        let Some(kalman) = &self.kalman else { return };
        for i in 0..kalman.size() {
            self.values[i] = kalman.x[i] * self.units.of[i];
        }
        bound(&self.law.law, &mut self.values);
    }
}
