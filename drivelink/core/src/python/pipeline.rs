//! `JointPipeline`, and the estimator in it.
//!
//! No lock is held while Python code runs.

use std::sync::Mutex;

use estimator_core::external::External;
use estimator_core::python::{Estimator, ModelMonitor, estimate_object, external_object, sample_object};
use estimator_core::sample::{Estimate, Sample};
use estimator_core::{estimator, model_monitor, snapshot};
use pyo3::PyClass;
use pyo3::exceptions::{PyRuntimeError, PyValueError};
use pyo3::prelude::*;
use pyo3::types::PyBytes;

use super::assembler::Assembler;
use super::tick::{History, Tick};
use super::values::{ExternalFields, estimate_from, external_of, sample_from};
use super::{lock, to_python};
use crate::pipeline::{self, Due, Failure, Pipeline, Step};

/// The estimator of a pipeline, and the monitor of its model: compiled ones are called without Python in between.
pub(super) struct Driver {
    estimator: Py<PyAny>,
    compiled: Option<Py<Estimator>>,
    model_monitor: Option<Py<PyAny>>,
    compiled_monitor: Option<Py<ModelMonitor>>,
    motors: usize,
}

/// What a Python object is made of, where that is a class of this module.
pub(super) fn core_of<T: PyClass>(py: Python<'_>, object: &Py<PyAny>) -> Option<Py<T>> {
    object.bind(py).getattr("core").ok()?.cast_into().ok().map(Bound::unbind)
}

impl Driver {
    fn new(py: Python<'_>, estimator: Py<PyAny>, model_monitor: Option<Py<PyAny>>) -> Driver {
        let compiled = core_of(py, &estimator);
        let compiled_monitor = model_monitor.as_ref().and_then(|monitor| core_of(py, monitor));
        Driver { estimator, compiled, model_monitor, compiled_monitor, motors: 0 }
    }
}

impl Step for Driver {
    fn step(&mut self, sample: &Sample) -> Result<Estimate, Failure> {
        Python::attach(|py| {
            if let Some(compiled) = &self.compiled {
                return Ok(compiled.try_borrow_mut(py).map_err(PyErr::from)?.inner.step(sample));
            }
            let sample = sample_object(py, sample, self.motors)?;
            estimate_from(&self.estimator.bind(py).call_method1("step", (sample,))?)
        })
        .map_err(Failure::from)
    }

    fn lose_zeros(&mut self) -> Result<(), Failure> {
        Python::attach(|py| self.estimator.call_method0(py, "lose_zeros").map(drop)).map_err(Failure::from)
    }

    fn distrust(&mut self) -> Result<(), Failure> {
        Python::attach(|py| self.estimator.call_method0(py, "distrust").map(drop)).map_err(Failure::from)
    }

    fn delay_next(&mut self, late_s: f64) {
        let Some(compiled) = &self.compiled else { return };
        Python::attach(|py| {
            if let Ok(mut compiled) = compiled.try_borrow_mut(py) {
                compiled.inner.delay_next(late_s);
            }
        });
    }

    fn alarm(&mut self, sample: &Sample, estimate: &Estimate) -> Result<bool, Failure> {
        let Some(model_monitor) = &self.model_monitor else { return Ok(false) };
        Python::attach(|py| {
            if let Some(monitor) = &self.compiled_monitor {
                return Ok(monitor.try_borrow_mut(py).map_err(PyErr::from)?.inner.step(sample));
            }
            let residual = self.estimator.getattr(py, "residual_nm")?;
            let sample = sample_object(py, sample, self.motors)?;
            let estimate = estimate_object(py, estimate)?;
            model_monitor.bind(py).call_method1("step", (sample, estimate, residual))?.extract()
        })
        .map_err(Failure::from)
    }

    fn external(&mut self) -> Result<Option<External>, Failure> {
        Python::attach(|py| -> PyResult<Option<External>> {
            if let Some(compiled) = &self.compiled {
                return Ok(compiled.try_borrow(py).map_err(PyErr::from)?.inner.external());
            }
            // An estimator that somebody registered may have none.
            let Ok(external) = self.estimator.getattr(py, "external") else { return Ok(None) };
            Ok(external.extract::<Option<ExternalFields>>(py)?.map(external_of))
        })
        .map_err(Failure::from)
    }
}

/// Number of the last sample, and what goes on from there.
type State = (i64, estimator::Estimator, Option<model_monitor::ModelMonitor>);

/// Frames of one joint in, estimates and their bytes out.
#[pyclass(frozen, module = "drivelink._core")]
pub(super) struct JointPipeline {
    assembler: Py<Assembler>,
    history: Py<History>,
    state: Mutex<Pipeline>,
    driver: Mutex<Driver>, // held while Python runs: by the cycle's thread only
    objects: Mutex<(Py<PyAny>, Option<Py<PyAny>>)>, // estimator and model monitor, for whoever asks
}

impl JointPipeline {
    /// Estimate a sample for which these service bits hold.
    fn run(
        &self,
        sample: &Sample,
        motors: usize,
        flags: u32,
        stamp_ns: Option<i64>,
        late_s: f64,
    ) -> PyResult<pipeline::Tick> {
        let results = {
            let Ok(mut driver) = self.driver.try_lock() else {
                return Err(PyRuntimeError::new_err("two threads feed one joint"));
            };
            driver.motors = motors;
            pipeline::estimate(&mut *driver, sample, flags, late_s).map_err(to_python)?
        };
        self.history.get().push(*sample, motors);
        Ok(lock(&self.state).conclude(sample, motors, results, stamp_ns))
    }
}

#[pymethods]
impl JointPipeline {
    #[new]
    #[pyo3(signature = (assembler, estimator, model_monitor = None, *, keep = 0))]
    fn new(
        py: Python<'_>,
        assembler: Py<Assembler>,
        estimator: Py<PyAny>,
        model_monitor: Option<Py<PyAny>>,
        keep: usize,
    ) -> PyResult<JointPipeline> {
        let objects = (estimator.clone_ref(py), model_monitor.as_ref().map(|monitor| monitor.clone_ref(py)));
        Ok(JointPipeline {
            assembler,
            history: Py::new(py, History::new(keep))?,
            state: Mutex::default(),
            driver: Mutex::new(Driver::new(py, estimator, model_monitor)),
            objects: Mutex::new(objects),
        })
    }

    #[getter]
    fn assembler(&self, py: Python<'_>) -> Py<Assembler> {
        self.assembler.clone_ref(py)
    }

    #[getter]
    fn history(&self, py: Python<'_>) -> Py<History> {
        self.history.clone_ref(py)
    }

    #[getter]
    fn estimator(&self, py: Python<'_>) -> Py<PyAny> {
        lock(&self.objects).0.clone_ref(py)
    }

    #[getter]
    fn model_monitor(&self, py: Python<'_>) -> Option<Py<PyAny>> {
        lock(&self.objects).1.as_ref().map(|monitor| monitor.clone_ref(py))
    }

    #[getter]
    fn missed(&self) -> u64 {
        lock(&self.state).missed
    }

    #[getter]
    fn complete(&self) -> bool {
        lock(&self.assembler.get().core).complete()
    }

    #[getter]
    fn estimate<'py>(&self, py: Python<'py>) -> PyResult<Option<Bound<'py, PyAny>>> {
        let last = lock(&self.state).last().copied();
        last.map(|tick| estimate_object(py, &tick.estimate)).transpose()
    }

    #[getter]
    fn status(&self) -> Option<u32> {
        lock(&self.state).last().map(|tick| tick.estimate.status)
    }

    #[getter]
    fn external<'py>(&self, py: Python<'py>) -> PyResult<Option<Bound<'py, PyAny>>> {
        let last = lock(&self.state).last().copied();
        last.and_then(|tick| tick.external).map(|external| external_object(py, &external)).transpose()
    }

    #[getter]
    fn sample<'py>(&self, py: Python<'py>) -> PyResult<Option<Bound<'py, PyAny>>> {
        let last = lock(&self.state).last().copied();
        let Some((sample, motors)) = last.and_then(|tick| Some((tick.sample?, tick.motors))) else {
            return Ok(None);
        };
        sample_object(py, &sample, motors).map(Some)
    }

    #[pyo3(signature = (cob_id, data, jump = 1, stamp_ns = 0, late_ns = 0))]
    fn feed(
        &self,
        cob_id: u32,
        data: &[u8],
        jump: i64,
        stamp_ns: i64,
        late_ns: i64,
    ) -> PyResult<Option<Tick>> {
        let (due, motors) = {
            let mut assembler = lock(&self.assembler.get().core);
            let due = lock(&self.state).feed(&mut assembler, cob_id, data, jump, (stamp_ns, late_ns));
            (due, assembler.motors())
        };
        match due {
            None => Ok(None),
            Some(Due::Sample(sample, flags, late_s)) => {
                self.run(&sample, motors, flags, None, late_s).map(|core| Some(Tick { core }))
            }
            Some(Due::Missed(sequence, flags)) => Ok(self.carry_on(sequence, flags, None)),
        }
    }

    fn snapshot<'py>(&self, py: Python<'py>) -> PyResult<Option<(i64, Bound<'py, PyBytes>)>> {
        let state: State = {
            let Some(tick) = lock(&self.state).last().copied() else { return Ok(None) };
            let Ok(driver) = self.driver.try_lock() else { return Ok(None) }; // it is in Python's code
            let (Some(compiled), Some(sample)) = (&driver.compiled, tick.sample) else { return Ok(None) };
            if driver.model_monitor.is_some() && driver.compiled_monitor.is_none() {
                return Ok(None);
            }
            let monitor = driver.compiled_monitor.as_ref();
            let monitor = monitor.map(|monitor| Ok::<_, PyErr>(monitor.try_borrow(py)?.inner.clone()));
            (sample.sequence as i64, compiled.try_borrow(py)?.inner.clone(), monitor.transpose()?)
        };
        // None: of a law that is no data.
        let Ok(bytes) = py.detach(|| snapshot::keep(&state)) else { return Ok(None) };
        Ok(Some((state.0, PyBytes::new(py, &bytes))))
    }

    fn restore(&self, py: Python<'_>, bytes: &[u8]) -> PyResult<i64> {
        let (sequence, estimator, monitor): State =
            snapshot::restore(bytes).map_err(|error| PyValueError::new_err(error.to_string()))?;
        let Ok(driver) = self.driver.try_lock() else {
            return Err(PyRuntimeError::new_err("two threads feed one joint"));
        };
        match (&driver.compiled, &driver.compiled_monitor, monitor) {
            (Some(own), None, None) => own.try_borrow_mut(py)?.inner = estimator,
            (Some(own), Some(own_monitor), Some(monitor)) => {
                own.try_borrow_mut(py)?.inner = estimator;
                own_monitor.try_borrow_mut(py)?.inner = monitor;
            }
            _ => return Err(PyValueError::new_err("snapshot: expected one of a joint like this")),
        }
        Ok(sequence)
    }

    #[pyo3(signature = (sample, flags = 0, stamp_ns = 0, late_ns = 0))]
    fn step(&self, sample: &Bound<'_, PyAny>, flags: u32, stamp_ns: i64, late_ns: i64) -> PyResult<Tick> {
        let (sample, motors) = sample_from(sample)?;
        Ok(Tick { core: self.run(&sample, motors, flags, Some(stamp_ns), late_ns as f64 * 1e-9)? })
    }

    #[pyo3(signature = (sequence, flags = 0, stamp_ns = None))]
    fn carry_on(&self, sequence: i64, flags: u32, stamp_ns: Option<i64>) -> Option<Tick> {
        lock(&self.state).carry_on(sequence, flags, stamp_ns).map(|core| Tick { core })
    }

    /// Step a new estimator through the kept samples after one of that number, without the interpreter's lock.
    #[pyo3(signature = (estimator, sequence, most = None))]
    fn warm(
        &self,
        py: Python<'_>,
        estimator: Py<PyAny>,
        sequence: i64,
        most: Option<usize>,
    ) -> PyResult<i64> {
        let samples = self.history.get().copied(sequence, most);
        if let Some(compiled) = core_of::<Estimator>(py, &estimator) {
            let mut estimator = compiled.try_borrow_mut(py)?;
            let inner = &mut estimator.inner;
            py.detach(|| {
                samples.iter().for_each(|(sample, _)| {
                    inner.step(sample);
                })
            });
        } else {
            for (sample, motors) in &samples {
                estimator.call_method1(py, "step", (sample_object(py, sample, *motors)?,))?;
            }
        }
        Ok(samples.last().map_or(sequence, |(sample, _)| sample.sequence as i64))
    }

    #[pyo3(signature = (estimator, model_monitor))]
    fn exchange(
        &self,
        py: Python<'_>,
        estimator: Py<PyAny>,
        model_monitor: Option<Py<PyAny>>,
    ) -> PyResult<()> {
        let objects = (estimator.clone_ref(py), model_monitor.as_ref().map(|monitor| monitor.clone_ref(py)));
        let next = Driver::new(py, estimator, model_monitor);
        let Ok(mut driver) = self.driver.try_lock() else {
            return Err(PyRuntimeError::new_err("two threads feed one joint"));
        };
        let before = std::mem::replace(&mut *driver, next);
        drop(driver);
        let shown = std::mem::replace(&mut *lock(&self.objects), objects);
        drop((before, shown)); // their destructors may run Python code
        Ok(())
    }
}
