//! `SdoTransfers`.

use std::borrow::Cow;

use pyo3::prelude::*;
use pyo3::types::{PyBytes, PyDict, PySet};

use crate::sdo::{Address, Ended, Transfers};

type Read = (Address, Py<PyBytes>);

/// Follows the SDO channel of one node, and keeps the values of the objects that are of interest.
#[pyclass(subclass, module = "drivelink._core")]
pub(super) struct SdoTransfers {
    core: Transfers,
    interesting: Py<PyAny>,
    asked: Option<(Address, bool)>, // the last answer of it: most masters read one object all the time
    #[pyo3(get)]
    values: Py<PyDict>,
    #[pyo3(get)]
    written: Py<PySet>,
    #[pyo3(get)]
    disputed: Py<PySet>,
    #[pyo3(get, set)]
    changes: u64,
}

#[pymethods]
impl SdoTransfers {
    #[new]
    fn new(py: Python<'_>, interesting: Py<PyAny>, timeout_s: f64) -> PyResult<SdoTransfers> {
        let (written, disputed) = (PySet::empty(py)?.unbind(), PySet::empty(py)?.unbind());
        let (core, values) = (Transfers::new(timeout_s), PyDict::new(py).unbind());
        Ok(SdoTransfers { core, interesting, asked: None, values, written, disputed, changes: 0 })
    }

    #[getter]
    fn unasked(&self) -> u64 {
        self.core.unasked
    }

    #[getter]
    fn pending(&self) -> Option<Address> {
        self.core.pending()
    }

    /// Whether the transfer under way is of a parameter of a TPDO (CiA 301, 7.5.2.37 and 38).
    #[getter]
    fn is_mapping(&self) -> bool {
        self.core.pending().is_some_and(|(index, _)| (0x1800..=0x1BFF).contains(&index))
    }

    fn drop_transfer(&mut self) {
        self.core.forget();
    }

    fn request(&mut self, py: Python<'_>, data: Cow<'_, [u8]>, now_s: f64) -> PyResult<()> {
        let lost = self.core.request(&data, now_s);
        lost.into_iter().flatten().try_for_each(|address| self.dispute(py, address))
    }

    fn response(&mut self, py: Python<'_>, data: Cow<'_, [u8]>, now_s: f64) -> PyResult<Option<Read>> {
        match self.core.response(&data, now_s) {
            None => Ok(None),
            Some(Ended::Disputed(address)) => self.dispute(py, address).map(|()| None),
            Some(Ended::Complete(address, value, writing)) => match value.whole() {
                Some(bytes) if self.is_of_interest(py, address)? => self.keep(py, address, bytes, writing),
                _ => Ok(None),
            },
        }
    }
}

impl SdoTransfers {
    fn is_of_interest(&mut self, py: Python<'_>, address: Address) -> PyResult<bool> {
        match self.asked {
            Some((asked, answer)) if asked == address => Ok(answer),
            _ => {
                let answer = self.interesting.bind(py).call1(address)?.extract()?;
                self.asked = Some((address, answer));
                Ok(answer)
            }
        }
    }

    fn dispute(&mut self, py: Python<'_>, address: Address) -> PyResult<()> {
        if self.is_of_interest(py, address)? && !self.disputed.bind(py).contains(address)? {
            self.disputed.bind(py).add(address)?;
            self.changes += 1;
        }
        Ok(())
    }

    fn keep(
        &mut self,
        py: Python<'_>,
        address: Address,
        bytes: &[u8],
        writing: bool,
    ) -> PyResult<Option<Read>> {
        let (values, disputed) = (self.values.bind(py), self.disputed.bind(py));
        if writing {
            self.written.bind(py).add(address)?;
        }
        let value = bytes.iter().rev().fold(0u64, |value, byte| value << 8 | u64::from(*byte));
        let before = values.get_item(address)?.map(|before| before.extract::<u64>()).transpose()?;
        if disputed.discard(address)? || before != Some(value) {
            values.set_item(address, value)?;
            self.changes += 1;
        }
        Ok((!writing).then(|| (address, PyBytes::new(py, bytes).unbind())))
    }
}
