//! Settings of an estimator.

use serde::{Deserialize, Serialize};

/// Which estimator.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum Mode {
    /// The default: sums of blocks of one balance; see [`crate::robust`].
    Robust,
    /// Eqs 14, 28, 32, 33 as printed, correctly discretised.
    Paper,
}

/// Where the stiffness comes from.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum Method {
    /// Robust: the transmission's model wherever it has one. Paper: black box.
    Auto,
    /// The transmission's model.
    Mbe,
    /// Black box.
    Bbe,
}

/// Settings of both modes; each mode reads its own. Units as in the names of the Python class.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "python", derive(pyo3::FromPyObject))]
pub struct Settings {
    /// See [`Mode`].
    pub mode: Mode,
    /// See [`Method`].
    pub method: Method,
    /// Of the filter that all channels share in robust mode, rad/s.
    #[cfg_attr(feature = "python", pyo3(attribute("bandwidth_rad_s")))]
    pub bandwidth: f64,
    /// K_τe of eq 14, rad/s.
    #[cfg_attr(feature = "python", pyo3(attribute("k_tau_rad_s")))]
    pub k_tau: f64,
    /// K_σ,1 of eq 28, rad²/s².
    #[cfg_attr(feature = "python", pyo3(attribute("k_sigma_1_rad2_s2")))]
    pub k_sigma_1: f64,
    /// K_σ,2 of eq 28, rad/s.
    #[cfg_attr(feature = "python", pyo3(attribute("k_sigma_2_rad_s")))]
    pub k_sigma_2: f64,
    /// K_R of eq 32, s²/rad².
    #[cfg_attr(feature = "python", pyo3(attribute("k_r_s2_rad2")))]
    pub k_r: f64,
    /// K_max < 2 of eq 33.
    pub k_max: f64,
    /// Relative standard deviation of a stiffness below which it is valid, robust mode.
    pub valid_within: f64,
    /// Of the robust mode's CHANGED.
    pub false_alarms_per_hour: f64,
    /// Of the filter that the link's momentum passes in robust mode, rad/s.
    #[cfg_attr(feature = "python", pyo3(attribute("external_bandwidth_rad_s")))]
    pub external_bandwidth: f64,
    /// Time constant of the bias that follows the external torque, s; `None`: there is no bias.
    pub external_bias_s: Option<f64>,
    /// Least external torque that is called a contact, N·m; `None`: a share of the torque that is carried.
    #[cfg_attr(feature = "python", pyo3(attribute("contact_torque_nm")))]
    pub contact_torque: Option<f64>,
    /// Of the contact bit.
    pub contact_false_alarms_per_hour: f64,
}

impl Default for Settings {
    fn default() -> Settings {
        Settings {
            mode: Mode::Robust,
            method: Method::Auto,
            bandwidth: 60.0,
            k_tau: 300.0,
            k_sigma_1: 300.0,
            k_sigma_2: 1.0,
            k_r: 1900.0,
            k_max: 1.9,
            valid_within: 0.2,
            false_alarms_per_hour: 1.0,
            external_bandwidth: 200.0,
            external_bias_s: None,
            contact_torque: None,
            contact_false_alarms_per_hour: 1.0,
        }
    }
}

/// What is believed about a joint before any data: standard deviations, from `estimator.priors`.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Priors {
    /// Of B, relative to what is declared.
    pub motor_inertia: f64,
    /// Of D, relative to what is declared, beside the floor.
    pub viscous_damping: f64,
    /// Of D where nothing is declared, as a share of torque over speed.
    pub viscous_damping_floor: f64,
    /// Of undeclared dry friction, as a share of the torque.
    pub coulomb_friction: f64,
    /// Of a constant torque, likewise.
    pub torque_offset: f64,
    /// Of the zero between the encoders, as a share of the deflection.
    pub deflection_offset: f64,
    /// Of the link encoder's delay, periods.
    pub encoder_delay: f64,
    /// Of a motor torque's delay or lag, s.
    pub late: f64,
    /// Of the share of the torque that a gear loses.
    pub load_dependent_friction: f64,
    /// Of what the link encoder reads wrong once a revolution, rad.
    pub encoder_eccentricity: f64,
    /// Of any other effect that nobody declared, as a share of the torque.
    pub undeclared: f64,
    /// Of a law's parameter that is declared without its own, relative to it.
    pub law: f64,
    /// Of a spring's torque where nothing is declared, as a share of the motor's.
    pub spring: f64,
}

#[cfg(test)]
impl Priors {
    /// Of the unit tests: about those of `estimator/priors.py`.
    pub(crate) const USUAL: Priors = Priors {
        motor_inertia: 0.05,
        viscous_damping: 0.2,
        viscous_damping_floor: 0.05,
        coulomb_friction: 0.1,
        torque_offset: 0.3,
        deflection_offset: 0.003,
        encoder_delay: 1.0,
        late: 0.005,
        load_dependent_friction: 0.25,
        encoder_eccentricity: 0.01,
        undeclared: 0.05,
        law: 0.3,
        spring: 10.0,
    };
}
