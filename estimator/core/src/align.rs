//! Shifts late channels back to a common time.

use serde::{Deserialize, Serialize};

use crate::sample::MOTORS;

const LONGEST: usize = 12; // periods

/// Positions of a joint at one moment.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Positions {
    /// q, rad.
    pub link: f64,
    /// θ, rad.
    pub motor: [f64; MOTORS],
}

impl Positions {
    fn towards(&self, to: &Positions, share: f64) -> Positions {
        Positions {
            link: self.link + share * (to.link - self.link),
            motor: std::array::from_fn(|i| self.motor[i] + share * (to.motor[i] - self.motor[i])),
        }
    }

    /// φ of one transmission.
    #[must_use]
    pub fn deflection(&self, i: usize) -> f64 {
        self.link - self.motor[i]
    }

    /// The same from other zeros.
    #[must_use]
    pub fn from_zeros(&self, zeros: &Positions) -> Positions {
        Positions {
            link: self.link - zeros.link,
            motor: std::array::from_fn(|i| self.motor[i] - zeros.motor[i]),
        }
    }
}

/// What is measured of a joint at one tick.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Inputs {
    /// q and θ as of the moment of the torques.
    pub at: Positions,
    /// τ, N·m.
    pub torque: [f64; MOTORS],
    /// q and θ as of now, where the torques are later.
    pub present: Positions,
    /// By how much the sample is later than its period, s.
    pub late: f64,
}

impl Inputs {
    /// Everything a share of the way to `to`.
    #[must_use]
    pub fn towards(&self, to: &Inputs, share: f64) -> Inputs {
        Inputs {
            at: self.at.towards(&to.at, share),
            torque: std::array::from_fn(|i| self.torque[i] + share * (to.torque[i] - self.torque[i])),
            present: self.present.towards(&to.present, share),
            late: self.late + share * (to.late - self.late),
        }
    }
}

/// Delays the motors' channels (or the link's) by a fraction of periods, so that all are equally late.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct Alignment {
    /// By how many periods the link is later than the motors.
    pub periods: f64,
    past: [Inputs; LONGEST + 2], // a ring
    newest: usize,
}

impl Default for Alignment {
    fn default() -> Alignment {
        Alignment { periods: 0.0, past: [Inputs::default(); LONGEST + 2], newest: 0 }
    }
}

impl Alignment {
    /// The link is so many periods later than has been assumed so far; returns how much of it is taken on.
    pub fn shift(&mut self, periods: f64) -> f64 {
        let new = (self.periods + periods).clamp(-(LONGEST as f64), LONGEST as f64);
        let taken = new - self.periods;
        self.periods = new;
        taken
    }

    /// All channels as of the same (past) time; after a restart as if they had been there forever.
    pub fn align(&mut self, inputs: &Inputs, restart: bool) -> Inputs {
        let length = self.past.len();
        self.newest = (self.newest + 1) % length;
        self.past[self.newest] = *inputs;
        if restart {
            self.past = [*inputs; LONGEST + 2];
        }
        let lag = self.periods.abs();
        let whole = lag as usize;
        let newer = &self.past[(self.newest + length - whole) % length];
        let older = &self.past[(self.newest + length - whole - 1) % length];
        let late = newer.towards(older, lag - whole as f64);
        let (link, motor) = if self.periods > 0.0 { (inputs, &late) } else { (&late, inputs) };
        Inputs {
            at: Positions { link: link.at.link, motor: motor.at.motor },
            torque: motor.torque,
            present: Positions { link: link.present.link, motor: motor.present.motor },
            late: inputs.late,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_ramp_is_delayed_by_fractions_of_periods() {
        let mut alignment = Alignment::default();
        alignment.shift(2.25);
        let mut out = Inputs::default();
        for k in 0..20 {
            let k = f64::from(k);
            let at = Positions { link: k, motor: [k; 2] };
            out = alignment.align(&Inputs { at, torque: [k; 2], present: at, late: 0.0 }, k == 0.0);
        }
        assert!((out.at.motor[0] - 16.75).abs() < 1e-12 && (out.at.link - 19.0).abs() < 1e-12);
    }
}
