//! The extension module: `estimator._core`, with `drivelink._core`'s `Assembler`, `JointPipeline` and their results.

mod assembler;
mod blf;
mod latency;
mod mcap;
mod numbering;
mod pipeline;
mod sdo;
mod tick;
mod values;

use std::sync::{Mutex, MutexGuard, PoisonError};

use pyo3::exceptions::PyRuntimeError;
use pyo3::prelude::*;

use crate::pipeline::Failure;

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

fn to_python(failure: Failure) -> PyErr {
    match failure.downcast::<PyErr>() {
        Ok(error) => *error,
        Err(other) => PyRuntimeError::new_err(other.to_string()),
    }
}

/// What the one extension offers; `drivelink/_core.py` names the service's part of it.
#[pymodule(name = "_core")]
mod extension {
    use std::collections::HashMap;

    use pyo3::prelude::*;

    #[pymodule_export]
    use super::assembler::Assembler;
    #[pymodule_export]
    use super::blf::BlfFrames;
    #[pymodule_export]
    use super::latency::LatencyHistogram;
    #[pymodule_export]
    use super::mcap::{JsonNumbers, McapMessage, McapMessages, json_frame};
    #[pymodule_export]
    use super::numbering::SyncNumbering;
    #[pymodule_export]
    use super::pipeline::JointPipeline;
    #[pymodule_export]
    use super::sdo::SdoTransfers;
    #[pymodule_export]
    use super::tick::{History, Tick};
    #[pymodule_export]
    use super::values::{encode_estimate, encode_external, encode_sample};
    #[pymodule_export]
    use crate::node::Counters;
    #[pymodule_export]
    use estimator_core::python::{
        Estimator, ModelMonitor, TransmissionLaw, effect_kinds, effect_terms, state_variable_filter,
    };

    #[pymodule_init]
    fn init(module: &Bound<'_, PyModule>) -> PyResult<()> {
        let bits = estimator_core::sample::status::BITS.iter().chain(crate::assembler::status::BITS);
        module.add("STATUS_BITS", bits.copied().collect::<HashMap<_, _>>())?;
        let messages = crate::wire::MESSAGES.map(|(name, fields)| (name, fields.to_vec()));
        module.add("MESSAGES", HashMap::from(messages))?;
        module.add("LATE", crate::assembler::LATE)?;
        module.add("LATEST", estimator_core::choices::LATEST)?;
        let choices = estimator_core::choices::TABLE.iter();
        let rows = choices.map(|one| (one.name, one.value, one.unit, one.meaning, one.reason));
        module.add("CHOICES", rows.collect::<Vec<_>>())?;
        module.add("STOP_EXPONENT", estimator_core::memory::STOP_EXPONENT)?;
        module.add("SYNC_COB_ID", crate::assembler::SYNC_COB_ID)?;
        module.add("__version__", env!("CARGO_PKG_VERSION"))
    }
}
