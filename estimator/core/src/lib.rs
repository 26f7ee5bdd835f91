//! Flexibility torque and stiffness from motor signals: the mathematics that runs every cycle.
//!
//! Numbers in, numbers out: no clock, no file, no socket, no allocation after construction. Equation numbers are
//! those of "Residual-based Stiffness Estimation in Robots with Flexible Transmissions".

#![cfg_attr(not(feature = "python"), forbid(unsafe_code))]

pub mod error;
pub mod estimator;
pub mod model;
#[cfg(feature = "python")]
pub mod python;
pub mod sample;
pub mod settings;
