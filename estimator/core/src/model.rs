//! What an estimator is told about a joint: the known terms of eqs 4-7.

use crate::error::Error;

/// How the transmissions act on the link.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Arrangement {
    /// One motor.
    Single,
    /// Both transmissions pull at the link: torques and stiffnesses add (eqs 9, 11).
    Antagonistic,
    /// The first moves the link, the second sets the stiffness.
    Serial,
}

/// The link side, eq 4 or 6, with g(q) = gravity · sin(q + gravity_phase).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Link {
    /// M, kg·m².
    pub inertia: f64,
    /// D_q, N·m·s/rad.
    pub damping: f64,
    /// Amplitude of the gravity torque, N·m.
    pub gravity: f64,
    /// Where gravity vanishes, as an angle added to q, rad.
    pub gravity_phase: f64,
}

/// A joint; see [`crate::estimator::Estimator::new`].
#[derive(Clone, Debug)]
pub struct Model {
    /// See [`Arrangement`].
    pub arrangement: Arrangement,
    /// One motor, or two.
    pub motors: Vec<Motor>,
    /// The link dynamics where they are known.
    pub link: Option<Link>,
}

/// The motor side of one transmission, eq 5 or 7, reflected to the joint.
#[derive(Clone, Debug)]
pub struct Motor {
    /// B, kg·m².
    pub inertia: f64,
    /// D_θ, N·m·s/rad.
    pub damping: f64,
}

impl Model {
    /// Whether its parts agree with each other.
    ///
    /// # Errors
    /// The number of motors is not that of the arrangement.
    pub fn check(&self) -> Result<(), Error> {
        let expected = if self.arrangement == Arrangement::Single { 1 } else { 2 };
        if self.motors.len() == expected {
            return Ok(());
        }
        Err(Error(format!("expected {expected} motor(s), got {}", self.motors.len())))
    }
}
