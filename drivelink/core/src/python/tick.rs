//! What is published of a cycle, and the last samples.

use std::collections::VecDeque;
use std::sync::Mutex;

use estimator_core::python::{estimate_object, external_object, sample_object};
use estimator_core::sample::Sample;
use pyo3::prelude::*;
use pyo3::types::PyBytes;

use super::lock;
use crate::pipeline;

/// What is published of one cycle.
#[pyclass(frozen, module = "drivelink._core")]
pub(super) struct Tick {
    pub(super) core: pipeline::Tick,
}

#[pymethods]
impl Tick {
    #[getter]
    fn sequence(&self) -> u64 {
        self.core.estimate.sequence
    }

    #[getter]
    fn status(&self) -> u32 {
        self.core.estimate.status
    }

    #[getter]
    fn stamp_ns(&self) -> i64 {
        self.core.stamp_ns
    }

    #[getter]
    fn current(&self) -> bool {
        self.core.current
    }

    #[getter]
    fn fresh(&self) -> bool {
        self.core.sample.is_some()
    }

    #[getter]
    fn estimate<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        estimate_object(py, &self.core.estimate)
    }

    #[getter]
    fn external<'py>(&self, py: Python<'py>) -> PyResult<Option<Bound<'py, PyAny>>> {
        self.core.external.map(|external| external_object(py, &external)).transpose()
    }

    #[getter]
    fn sample<'py>(&self, py: Python<'py>) -> PyResult<Option<Bound<'py, PyAny>>> {
        self.core.sample.map(|sample| sample_object(py, &sample, self.core.motors)).transpose()
    }

    fn flagged(&self, status: u32) -> Tick {
        let mut core = self.core;
        core.estimate.status |= status;
        Tick { core }
    }

    fn stamped(&self, stamp_ns: i64) -> Tick {
        Tick { core: pipeline::Tick { stamp_ns, ..self.core } }
    }

    #[getter]
    fn estimate_payload<'py>(&self, py: Python<'py>) -> Bound<'py, PyBytes> {
        PyBytes::new(py, self.core.estimate_payload().bytes())
    }

    #[getter]
    fn external_payload<'py>(&self, py: Python<'py>) -> Option<Bound<'py, PyBytes>> {
        self.core.external_payload().map(|payload| PyBytes::new(py, payload.bytes()))
    }

    #[getter]
    fn sample_payload<'py>(&self, py: Python<'py>) -> Option<Bound<'py, PyBytes>> {
        self.core.sample_payload().map(|payload| PyBytes::new(py, payload.bytes()))
    }
}

/// The last samples of a joint, for a new estimator to start from; read by another thread than the cycle's.
#[pyclass(frozen, module = "drivelink._core")]
pub(super) struct History {
    keep: usize,
    kept: Mutex<VecDeque<(Sample, usize)>>,
}

impl History {
    pub(super) fn new(keep: usize) -> History {
        History { keep, kept: Mutex::new(VecDeque::with_capacity(keep)) }
    }

    pub(super) fn push(&self, sample: Sample, motors: usize) {
        if self.keep > 0 {
            let mut kept = lock(&self.kept);
            if kept.len() == self.keep {
                kept.pop_front();
            }
            kept.push_back((sample, motors));
        }
    }

    /// The kept samples after one of that number, the oldest `most` of them.
    pub(super) fn copied(&self, sequence: i64, most: Option<usize>) -> Vec<(Sample, usize)> {
        let kept = lock(&self.kept);
        let first = kept.partition_point(|(sample, _)| sample.sequence as i64 <= sequence);
        kept.range(first..).take(most.unwrap_or(usize::MAX)).copied().collect()
    }
}

#[pymethods]
impl History {
    fn __len__(&self) -> usize {
        lock(&self.kept).len()
    }

    #[pyo3(signature = (sequence, most = None))]
    fn after<'py>(
        &self,
        py: Python<'py>,
        sequence: i64,
        most: Option<usize>,
    ) -> PyResult<Vec<Bound<'py, PyAny>>> {
        let found = self.copied(sequence, most);
        found.iter().map(|(sample, motors)| sample_object(py, sample, *motors)).collect()
    }

    fn behind(&self, sequence: i64) -> usize {
        let kept = lock(&self.kept);
        kept.len() - kept.partition_point(|(sample, _)| sample.sequence as i64 <= sequence)
    }
}
