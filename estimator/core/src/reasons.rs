//! Why an estimate is not valid. The sentences are in `estimator/reasons.py`, by the names here.

use serde::{Deserialize, Serialize};

use crate::causes::{CAUSES, TABLE};

/// Why one transmission's numbers, or the joint's, may not be used.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub enum Reason {
    /// The filters still hold what was before the start, a gap or a jump.
    Settling,
    /// The samples cannot be used.
    Rejected,
    /// No motion has been learned from yet.
    Unmoved,
    /// The stiffness's standard deviation is not below the stiffness, or there is none.
    Open,
    /// The relative standard deviation of the stiffness, above what was asked for.
    Imprecise(f64),
    /// The standard deviation of the torque over the torque's rms, above what was asked for.
    TorqueImprecise(f64),
    /// The stiffness is not above zero.
    NotPositive,
    /// The rms share of the balance that the curve leaves, above what is of use.
    Unexplained(f64),
    /// The deflection is beyond any that was learned from.
    Beyond,
    /// The joint or a reading has changed.
    Changed,
    /// Where the zero between the encoders is has not been found again.
    Lost,
    /// Motor 2 of a serial joint has set another stiffness, of which nothing has been learned yet.
    Lever,
}

impl Reason {
    /// Its name in the table of sentences.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Reason::Settling => "settling",
            Reason::Rejected => "rejected",
            Reason::Unmoved => "unmoved",
            Reason::Open => "open",
            Reason::Imprecise(_) => "imprecise",
            Reason::TorqueImprecise(_) => "torque_imprecise",
            Reason::NotPositive => "not_positive",
            Reason::Unexplained(_) => "unexplained",
            Reason::Beyond => "beyond",
            Reason::Changed => "changed",
            Reason::Lost => "lost",
            Reason::Lever => "lever",
        }
    }

    /// The number in its sentence, a fraction; NaN where it has none.
    #[must_use]
    pub fn share(self) -> f64 {
        match self {
            Reason::Imprecise(share) | Reason::TorqueImprecise(share) | Reason::Unexplained(share) => share,
            _ => f64::NAN,
        }
    }

    /// Judge a stiffness by its standard deviation; `None`: as precise as asked for.
    #[must_use]
    pub fn of_precision(stiffness: f64, std: f64, valid_within: f64) -> Option<Reason> {
        if std > 0.0 && std < valid_within * stiffness {
            None
        } else if stiffness <= 0.0 {
            Some(Reason::NotPositive)
        } else if std > 0.0 && std < stiffness {
            Some(Reason::Imprecise(std / stiffness))
        } else {
            Some(Reason::Open)
        }
    }
}

/// A reason, whose it is, and what may have changed.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Why {
    /// See [`Reason`].
    pub reason: Reason,
    /// Motor, counted from 0; `None`: the joint's.
    pub motor: Option<usize>,
    /// For [`Reason::Changed`]: which rows of [`TABLE`] the data do not tell apart; none: not known yet.
    pub changes: [bool; CAUSES],
}

impl Why {
    /// Without a change.
    #[must_use]
    pub fn new(reason: Reason, motor: Option<usize>) -> Why {
        Why { reason, motor, changes: [false; CAUSES] }
    }

    /// The names of what may have changed.
    pub fn changed(&self) -> impl Iterator<Item = &'static str> + '_ {
        TABLE.iter().zip(self.changes).filter(|(_, may)| *may).map(|(entry, _)| entry.name)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_stiffness_is_valid_within_what_was_asked_for() {
        assert_eq!(Reason::of_precision(100.0, 10.0, 0.2), None);
        assert_eq!(Reason::of_precision(100.0, 44.0, 0.2), Some(Reason::Imprecise(0.44)));
        assert_eq!(Reason::of_precision(100.0, 44.0, 0.5), None);
        assert_eq!(Reason::of_precision(100.0, 120.0, 0.5), Some(Reason::Open));
        assert_eq!(Reason::of_precision(-100.0, 1.0, 0.5), Some(Reason::NotPositive));
        assert_eq!(Reason::of_precision(f64::NAN, f64::NAN, 0.5), Some(Reason::Open));
        assert_eq!(Reason::of_precision(100.0, f64::INFINITY, 0.5), Some(Reason::Open));
    }
}
