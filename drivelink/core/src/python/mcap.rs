//! `McapMessages`, what they yield, and what is in it.

use std::collections::{HashMap, HashSet};

use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use pyo3::types::{PyBytes, PyString, PyTuple};

use crate::json::{self, Value};
use crate::mcap::{self, Record};

const TOPIC: usize = 256; // bytes; a longer one is nobody's: ours have a joint's name, and the file 65 536 channels

/// One message: topic, time, data.
#[pyclass(frozen, get_all, module = "drivelink._core")]
pub(super) struct McapMessage {
    topic: Py<PyString>,
    log_time_ns: u64,
    data: Py<PyBytes>,
}

/// The messages among the records of a file, on topics of interest.
#[pyclass(module = "drivelink._core")]
pub(super) struct McapMessages {
    topics: Option<HashSet<String>>,
    channels: HashMap<u16, (Py<PyString>, u64)>, // topic, and for how many records a message counts
    records: Py<PyBytes>,
    at: usize,
    most: u64,
    #[pyo3(get)]
    count: u64,
    #[pyo3(get)]
    stamp_ns: u64,
    #[pyo3(get)]
    broken: bool,
}

#[pymethods]
impl McapMessages {
    #[new]
    fn new(py: Python<'_>, topics: Option<HashSet<String>>) -> McapMessages {
        let (channels, records) = (HashMap::new(), PyBytes::new(py, b"").unbind());
        McapMessages { topics, channels, records, at: 0, most: 0, count: 0, stamp_ns: 0, broken: false }
    }

    fn take(mut slf: PyRefMut<'_, Self>, records: Py<PyBytes>, most: u64) -> PyRefMut<'_, Self> {
        slf.records = records;
        (slf.at, slf.most) = (0, most);
        slf
    }

    fn __iter__(slf: PyRefMut<'_, Self>) -> PyRefMut<'_, Self> {
        slf
    }

    fn __next__(&mut self, py: Python<'_>) -> Option<McapMessage> {
        let data = self.records.as_bytes(py);
        while self.at < data.len() && self.count <= self.most && !self.broken {
            let Some((record, rest)) = mcap::split(&data[self.at..]) else {
                self.broken = true;
                break;
            };
            self.at = data.len() - rest.len();
            self.count += 1;
            match record {
                Record::Channel(number, topic) => {
                    let wanted = topic.len() <= TOPIC;
                    let topic = String::from_utf8_lossy(if wanted { topic } else { b"" });
                    let last = topic.rsplit('/').next().unwrap_or_default();
                    if wanted && self.topics.as_ref().is_none_or(|topics| topics.contains(last)) {
                        // Of a joint at rest, samples and estimates have twice the bytes of a frame.
                        let counts = 1 + u64::from(matches!(last, "sample" | "estimate"));
                        self.channels.insert(number, (PyString::new(py, &topic).unbind(), counts));
                    } else {
                        self.channels.remove(&number);
                    }
                }
                Record::Message(channel, stamp_ns, data) => {
                    let Some((topic, counts)) = self.channels.get(&channel) else { continue };
                    self.count += counts - 1;
                    self.stamp_ns = stamp_ns;
                    if stamp_ns > i64::MAX as u64 {
                        break;
                    }
                    let (topic, data) = (topic.clone_ref(py), PyBytes::new(py, data).unbind());
                    return Some(McapMessage { topic, log_time_ns: stamp_ns, data });
                }
                Record::Other => {}
            }
        }
        None
    }
}

/// Reads some numbers of messages.
#[pyclass(frozen, module = "drivelink._core")]
pub(super) struct JsonNumbers {
    names: Vec<String>,
}

#[pymethods]
impl JsonNumbers {
    #[new]
    fn new(names: Vec<String>) -> JsonNumbers {
        JsonNumbers { names }
    }

    fn __call__<'py>(&self, py: Python<'py>, data: &[u8]) -> PyResult<Bound<'py, PyTuple>> {
        let mut found = vec![None; self.names.len()];
        let mut wrong = None;
        json::each(data, |name, value| {
            if let Some(at) = self.names.iter().position(|wanted| wanted.as_bytes() == name) {
                match value {
                    Value::Number(number) => found[at] = Some(number),
                    _ => wrong = Some(at),
                }
            }
        })
        .map_err(PyValueError::new_err)?;
        match wrong {
            Some(at) => Err(PyValueError::new_err(format!("{}: expected a number", self.names[at]))),
            None => PyTuple::new(py, found),
        }
    }
}

/// Identifier and bytes of a frame's message.
#[pyfunction]
pub(super) fn json_frame<'py>(py: Python<'py>, data: &[u8]) -> PyResult<(u32, Bound<'py, PyBytes>)> {
    let (can_id, data) = json::frame(data).map_err(PyValueError::new_err)?;
    Ok((can_id, PyBytes::new(py, &data)))
}
