//! How an estimator is to work.

/// Which estimator.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Mode {
    /// The default: one filter for every channel, joint recursive estimation, uncertainty, alarms.
    Robust,
    /// Eqs 14, 28, 32, 33 as printed, correctly discretised.
    Paper,
}

/// Where the stiffness comes from.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Method {
    /// Robust: the transmission's model wherever it has one. Paper: black box.
    Auto,
    /// The transmission's model.
    Mbe,
    /// Black box.
    Bbe,
}

/// Settings of both modes; each mode reads its own. Units as in the names of the Python class.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Settings {
    /// See [`Mode`].
    pub mode: Mode,
    /// See [`Method`].
    pub method: Method,
    /// Of the filter that all channels share in robust mode, rad/s.
    pub bandwidth: f64,
    /// K_τe of eq 14, rad/s.
    pub k_tau: f64,
    /// K_σ,1 of eq 28, rad²/s².
    pub k_sigma_1: f64,
    /// K_σ,2 of eq 28, rad/s.
    pub k_sigma_2: f64,
    /// K_R of eq 32, s²/rad².
    pub k_r: f64,
    /// K_max < 2 of eq 33.
    pub k_max: f64,
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
        }
    }
}
