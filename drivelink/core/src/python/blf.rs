//! `BlfFrames`.

use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use pyo3::types::{PyBytes, PyString};

use crate::blf::{self, Next};

type Frame = (u64, u32, Py<PyBytes>, Py<PyString>);

/// The frames in the containers of a BLF file; `None` for an object that is no data frame with a short identifier.
#[pyclass(module = "drivelink._core")]
pub(super) struct BlfFrames {
    start_ns: u64,
    data: Vec<u8>,
    at: usize,
    channel: Option<(u16, Py<PyString>)>, // of the last frame, and its name
}

#[pymethods]
impl BlfFrames {
    #[new]
    fn new(start_ns: u64) -> BlfFrames {
        BlfFrames { start_ns, data: Vec::new(), at: 0, channel: None }
    }

    fn take<'py>(mut slf: PyRefMut<'py, Self>, container: &[u8]) -> PyRefMut<'py, Self> {
        let at = std::mem::take(&mut slf.at);
        slf.data.drain(..at);
        slf.data.extend_from_slice(container);
        slf
    }

    fn __iter__(slf: PyRefMut<'_, Self>) -> PyRefMut<'_, Self> {
        slf
    }

    fn __next__(&mut self, py: Python<'_>) -> PyResult<Option<Option<Frame>>> {
        match blf::next(&self.data[self.at..]) {
            Next::Part => Ok(None),
            Next::Damaged(why) => Err(PyValueError::new_err(why)),
            Next::Object(size, stamp_ns, found) => {
                self.at += size;
                let Some(frame) = found else { return Ok(Some(None)) };
                let stamp_ns = u64::try_from(u128::from(self.start_ns) + stamp_ns).unwrap_or(u64::MAX);
                let data = PyBytes::new_with(py, frame.length, |bytes| {
                    bytes[..frame.data.len()].copy_from_slice(frame.data);
                    Ok(())
                })?;
                let name = match &self.channel {
                    Some((channel, name)) if *channel == frame.channel => name.clone_ref(py),
                    _ => PyString::new(py, &(i32::from(frame.channel) - 1).to_string()).unbind(),
                };
                self.channel = Some((frame.channel, name.clone_ref(py)));
                Ok(Some(Some((stamp_ns, frame.can_id, data.unbind(), name))))
            }
        }
    }
}
