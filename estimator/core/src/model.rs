//! The declared model of a joint: the known terms of eqs 4-7.

use serde::{Deserialize, Serialize};

use crate::error::Error;
use crate::laws::{Law, PARAMETERS};
use crate::library::Element;

/// How the transmissions act on the link.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum Arrangement {
    /// One motor.
    Single,
    /// Both transmissions pull at the link, φ_i = q − θ_i: torques and stiffnesses add (eqs 9, 11).
    Antagonistic,
    /// The first motor moves the link through its transmission, the second one, in series with it, only sets
    /// the lever that makes the stiffness (as in the AwAS, Jafari et al., IROS 2010): the joint's torque and
    /// stiffness are the first transmission's, and the second's is rigid.
    Serial,
}

/// A transmission as it is declared.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub enum Transmission {
    /// No deflection: the torque is what the motor's balance leaves.
    Rigid,
    /// Flexible, but no law of it: black-box estimation.
    Unknown,
    /// A law, the order of a polynomial's that is declared, and α where it is known.
    Elastic {
        /// The law.
        law: Law,
        /// p of eq 24; `None`: chosen from the data.
        order: Option<usize>,
        /// Known parameters; empty: estimated from nothing.
        parameters: Vec<f64>,
        /// Covariance of α, row by row, where a fit has written it.
        covariance: Option<Vec<f64>>,
    },
}

/// The motor side of one transmission, eq 5 or 7, reflected to the joint.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct Motor {
    /// B, kg·m².
    pub inertia: f64,
    /// Standard deviation of B as a share of it, where it is declared.
    pub inertia_std: Option<f64>,
    /// D_θ, N·m·s/rad.
    pub damping: f64,
    /// Standard deviation of D_θ, N·m·s/rad, where it is declared.
    pub damping_std: Option<f64>,
    /// Standard deviation of the zero between the encoders, rad, where it is fitted; else 0.
    pub zero_std: f64,
    /// rms of what the model leaves of the torque where it is fitted to a recording, and of that torque, N·m.
    pub fit_rms: Option<(f64, f64)>,
    /// See [`Transmission`].
    pub transmission: Transmission,
    /// What the model has been given besides.
    pub effects: Vec<Element>,
}

/// The link side, eq 4 or 6, with g(q) = gravity · sin(q + gravity_phase).
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Link {
    /// M, kg·m².
    pub inertia: f64,
    /// D_q, N·m·s/rad.
    pub damping: f64,
    /// Amplitude of the gravity torque, N·m.
    pub gravity: f64,
    /// Where gravity vanishes, as an angle added to q, rad.
    pub gravity_phase: f64,
    /// Standard deviation of M, kg·m².
    pub inertia_std: f64,
    /// Of D_q, N·m·s/rad.
    pub damping_std: f64,
    /// Of gravity, N·m, in amount and direction alike.
    pub gravity_std: f64,
}

/// A joint.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct Model {
    /// See [`Arrangement`].
    pub arrangement: Arrangement,
    /// One motor, or two.
    pub motors: Vec<Motor>,
    /// The link dynamics where they are known.
    pub link: Option<Link>,
    /// Effects at the link or in its encoder.
    pub link_effects: Vec<Element>,
}

impl Motor {
    /// Whether its transmission deflects.
    #[must_use]
    pub fn flexible(&self) -> bool {
        !matches!(self.transmission, Transmission::Rigid)
    }
}

impl Model {
    /// Whether any transmission is flexible, so that a link position is needed.
    #[must_use]
    pub fn has_deflection(&self) -> bool {
        self.motors.iter().any(Motor::flexible)
    }

    /// Whether its parts agree with each other.
    ///
    /// # Errors
    /// The number of motors is not that of the arrangement; in a serial one the second is flexible; a law has
    /// another number of parameters.
    pub fn check(&self) -> Result<(), Error> {
        let expected = if self.arrangement == Arrangement::Single { 1 } else { 2 };
        if self.motors.len() != expected {
            return Err(Error(format!("motors: expected {expected}, got {}", self.motors.len())));
        }
        if self.arrangement == Arrangement::Serial && self.motors[1].flexible() {
            let why = "the second motor sets the stiffness of the first";
            return Err(Error(format!(
                "arrangement = \"serial\": motor[2].transmission.model: expected \"none\" ({why})"
            )));
        }
        for motor in &self.motors {
            let Transmission::Elastic { law, order, parameters, covariance } = &motor.transmission else {
                continue;
            };
            let (got, fixed) = (parameters.len(), 1 + law.shapes().len());
            let fits = match law {
                Law::Polynomial => got < PARAMETERS && order.unwrap_or(1) < PARAMETERS,
                _ => got == 0 || got == fixed,
            };
            if !fits || fixed > PARAMETERS {
                return Err(Error(format!("transmission: parameters: got {got}, expected {fixed}")));
            }
            if let Some(numbers) = covariance.as_ref().map(Vec::len).filter(|n| *n != got * got) {
                return Err(Error(format!(
                    "transmission: covariance: got {numbers}, expected {}",
                    got * got
                )));
            }
        }
        Ok(())
    }
}

#[cfg(test)]
impl Motor {
    /// One without effects, of which nothing more is declared.
    pub fn bare(inertia: f64, damping: f64, transmission: Transmission) -> Motor {
        let (inertia_std, damping_std, fit_rms) = (None, None, None);
        Motor {
            inertia,
            inertia_std,
            damping,
            damping_std,
            zero_std: 0.0,
            fit_rms,
            transmission,
            effects: vec![],
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn motor(transmission: Transmission) -> Motor {
        Motor::bare(0.1, 0.0, transmission)
    }

    fn elastic(law: Law, parameters: &[f64], covariance: Option<Vec<f64>>) -> Transmission {
        Transmission::Elastic { law, order: None, parameters: parameters.to_vec(), covariance }
    }

    fn checked(arrangement: Arrangement, motors: Vec<Motor>) -> String {
        let model = Model { arrangement, motors, link: None, link_effects: vec![] };
        model.check().map_or_else(|error| error.to_string(), |()| "right".into())
    }

    #[test]
    fn parts_that_contradict_each_other_are_one_line() {
        let linear = || motor(elastic(Law::Linear, &[100.0], None));
        let rigid = || motor(Transmission::Rigid);
        assert!(linear().flexible() && !rigid().flexible());
        assert_eq!(checked(Arrangement::Single, vec![linear()]), "right");
        assert_eq!(checked(Arrangement::Serial, vec![linear(), rigid()]), "right");
        assert_eq!(checked(Arrangement::Antagonistic, vec![linear()]), "motors: expected 2, got 1");
        let serial = checked(Arrangement::Serial, vec![linear(), linear()]);
        assert!(serial.contains("motor[2].transmission.model: expected \"none\""), "{serial}");
        let wrong = elastic(Law::VsaII, &[1.0], None);
        assert!(checked(Arrangement::Single, vec![motor(wrong)]).contains("got 1, expected 2"));
        let wrong = elastic(Law::VsaII, &[1.0, 1.5], Some(vec![1.0; 3]));
        assert!(checked(Arrangement::Single, vec![motor(wrong)]).contains("covariance: got 3, expected 4"));
    }
}
