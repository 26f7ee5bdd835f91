//! Flexibility torque and stiffness from motor signals: the mathematics that runs every cycle.
//!
//! Numbers in, numbers out: no clock, no file, no socket, no allocation after construction, no panic on a
//! tick. Equation numbers are those of "Residual-based Stiffness Estimation in Robots with Flexible
//! Transmissions". SI units, joint side, the paper's signs: φ = q − θ, and τ_e = f(φ) acts on the motor as
//! +τ_e.

#![cfg_attr(not(feature = "python"), forbid(unsafe_code))]
#![allow(clippy::needless_range_loop)] // matrices read better by their indices

pub mod align;
pub mod balance;
pub mod blocks;
pub mod causes;
pub mod choices;
pub mod corrections;
pub mod deflection;
pub mod effects;
pub mod error;
pub mod estimator;
pub mod external;
pub mod filters;
pub mod gram;
pub mod joint_effects;
pub mod laws;
pub mod library;
pub mod memory;
pub mod model;
pub mod model_monitor;
pub mod noise;
pub mod paper;
pub mod reasons;
pub mod rigid;
pub mod robust;
pub mod sample;
pub mod sample_validator;
pub mod settings;
pub mod side;
pub mod signals;
pub mod snapshot;
pub mod spring;
pub mod student;
pub mod suspicion;
pub mod unknowns;

#[cfg(feature = "python")]
pub mod python;
