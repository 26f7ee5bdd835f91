//! Bits of an estimate's status that the service adds; bits 0 to 7 are the estimator's.

estimator_core::status_bits! {
    DRIVE_FAULT = 8, BUS_FAULT = 9, STALE = 10, UNTIMED = 11, NODE_RESTARTED = 12, CONTRADICTED = 14,
}
