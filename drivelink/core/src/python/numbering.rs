//! `SyncNumbering`.

use std::collections::VecDeque;

use pyo3::prelude::*;
use pyo3::types::{PyList, PyTuple};

use crate::assembler::SYNC_COB_ID;
use crate::numbering::{AHEAD, Numbering};

type Numbered = (Py<PyList>, i64);

/// Numbers the SYNCs of a stream of frames once enough others have followed.
#[pyclass(module = "drivelink._core")]
pub(super) struct SyncNumbering {
    core: Numbering,
    cycles: VecDeque<Py<PyList>>, // each waiting SYNC and its frames
    measure: Option<Py<PyAny>>,
    #[pyo3(get)]
    period_s: f64,
}

#[pymethods]
impl SyncNumbering {
    #[new]
    #[pyo3(signature = (period_s, measure = None))]
    fn new(period_s: f64, measure: Option<Py<PyAny>>) -> SyncNumbering {
        SyncNumbering { core: Numbering::new(period_s * 1e9), cycles: VecDeque::new(), measure, period_s }
    }

    fn push<'py>(&mut self, frame: &Bound<'py, PyTuple>) -> PyResult<Option<Numbered>> {
        let py = frame.py();
        if frame.get_borrowed_item(1)?.extract::<u32>()? != SYNC_COB_ID {
            return match self.cycles.back() {
                Some(cycle) => cycle.bind(py).append(frame).map(|()| None),
                None => Ok(Some((PyList::new(py, [frame])?.unbind(), 1))),
            };
        }
        self.core.push(frame.get_borrowed_item(0)?.extract()?);
        self.cycles.push_back(PyList::new(py, [frame])?.unbind());
        if self.cycles.len() > AHEAD { self.pop(py) } else { Ok(None) }
    }

    /// The first of what waits, now that the stream has ended.
    fn pop(&mut self, py: Python<'_>) -> PyResult<Option<Numbered>> {
        if self.cycles.is_empty() {
            return Ok(None);
        }
        if let Some(measure) = self.measure.take() {
            let stamps: Vec<i64> = self.core.stamps().iter().copied().collect();
            self.period_s = measure.bind(py).call1((stamps, self.period_s))?.extract()?;
            self.core.retime(self.period_s * 1e9);
        }
        Ok(self.core.pop().and_then(|jump| Some((self.cycles.pop_front()?, jump))))
    }
}
