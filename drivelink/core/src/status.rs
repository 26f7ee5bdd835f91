//! Bits of an estimate's status that the service adds; bits 0 to 7 are the estimator's.

/// A drive reports a fault or is not operational.
pub const DRIVE_FAULT: u32 = 1 << 8;
/// Frames of this cycle were late or missing.
pub const BUS_FAULT: u32 = 1 << 9;
/// The estimate is carried on without fresh measurements.
pub const STALE: u32 = 1 << 10;
/// SYNCs of another master: the values may be of another moment; nothing is learned from them.
pub const UNTIMED: u32 = 1 << 11;
/// Positions may have started anew: with this sample the estimator begins anew.
pub const NODE_RESTARTED: u32 = 1 << 12;
/// Two readings of one quantity that the estimate is made of contradict each other.
pub const CONTRADICTED: u32 = 1 << 14;
