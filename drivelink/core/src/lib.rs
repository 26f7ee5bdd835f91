//! One joint's pipeline: CAN frames to a sample per SYNC, its estimate, and the exact bytes for zenoh.
//!
//! No socket and no clock: live, lockstep and replay feed the same pipeline.

#![cfg_attr(not(feature = "python"), forbid(unsafe_code))]

pub mod assembler;
pub mod blf;
pub mod cross_check;
pub mod frames;
pub mod json;
pub mod latency;
pub mod layout;
pub mod mcap;
pub mod node;
pub mod numbering;
pub mod pipeline;
#[cfg(feature = "python")]
pub mod python;
pub mod sdo;
pub mod wire;
