//! `LatencyHistogram`.

use std::sync::Mutex;

use pyo3::prelude::*;
use pyo3::types::PyDict;

use super::lock;
use crate::latency::{self, Percentiles};

/// A distribution of durations.
#[pyclass(frozen, module = "drivelink._core")]
pub(super) struct LatencyHistogram {
    core: Mutex<latency::LatencyHistogram>,
}

pub(super) fn percentiles<'py>(py: Python<'py>, found: Option<Percentiles>) -> PyResult<Bound<'py, PyDict>> {
    let shown = PyDict::new(py);
    if let Some(found) = found {
        for (name, us) in ["p50_us", "p90_us", "p99_us", "p999_us"].into_iter().zip(found.at) {
            shown.set_item(name, us)?;
        }
        shown.set_item("max_us", found.maximum)?;
    }
    Ok(shown)
}

#[pymethods]
impl LatencyHistogram {
    #[new]
    fn new() -> LatencyHistogram {
        LatencyHistogram { core: Mutex::default() }
    }

    #[getter]
    fn count(&self) -> u64 {
        lock(&self.core).count
    }

    fn add(&self, duration_ns: i64) {
        lock(&self.core).add(duration_ns);
    }

    fn total<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        let found = lock(&self.core).total();
        percentiles(py, found)
    }

    fn recent<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        let found = lock(&self.core).recent();
        percentiles(py, found)
    }
}
