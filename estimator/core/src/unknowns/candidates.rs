//! Effects that the joint file need not name.

use super::{ASYMMETRY, CLIPS, DRY_LATE, ECCENTRIC, LOAD, RATE, SOFT, STOPS, TORQUE_LATE};

/// One effect that the joint file need not name.
pub struct Candidate {
    /// Its unknowns.
    pub unknowns: std::ops::Range<usize>,
    /// Its name in `report.json`.
    pub name: &'static str,
}

/// The groups of unknowns that evidence chooses.
pub const CANDIDATES: [Candidate; 9] = [
    Candidate { unknowns: TORQUE_LATE..DRY_LATE, name: "torque_delay" },
    Candidate { unknowns: DRY_LATE..SOFT, name: "coulomb_friction" },
    Candidate { unknowns: SOFT..SOFT + 1, name: "stribeck_friction" },
    Candidate { unknowns: LOAD, name: "load_dependent_friction" },
    Candidate { unknowns: RATE..RATE + 1, name: "transmission_damping" },
    Candidate { unknowns: STOPS, name: "hysteresis" },
    Candidate { unknowns: CLIPS, name: "backlash" },
    Candidate { unknowns: ASYMMETRY, name: "asymmetric_stiffness" },
    Candidate { unknowns: ECCENTRIC, name: "encoder_eccentricity" },
];
