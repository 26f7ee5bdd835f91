//! The Python module `drivelink._core`: `Assembler`, `JointPipeline` and their results.
//!
//! No lock is held while Python code runs.

use std::collections::VecDeque;
use std::sync::{Mutex, MutexGuard, PoisonError};

use estimator_core::external::External;
use estimator_core::python::{Estimator, ModelMonitor, external as external_object};
use estimator_core::sample::{Estimate, MOTORS, Sample, TransmissionEstimate};
use pyo3::PyClass;
use pyo3::exceptions::{PyRuntimeError, PyValueError};
use pyo3::prelude::*;
use pyo3::sync::PyOnceLock;
use pyo3::types::{PyBytes, PyDict, PyTuple};

use crate::assembler::{self, SYNC_COB_ID};
use crate::cross_check::{CrossCheck, Verdict};
use crate::latency::{self, Percentiles};
use crate::layout::{MappedObject, Node, Signal, Tpdo};
use crate::node::Counters;
use crate::pipeline::{self, Due, Failure, Pipeline, Step};
use crate::wire;

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

fn to_python(failure: Failure) -> PyErr {
    match failure.downcast::<PyErr>() {
        Ok(error) => *error,
        Err(other) => PyRuntimeError::new_err(other.to_string()),
    }
}

// --- values ---------------------------------------------------------------------------------------------------------

struct Types {
    sample: Py<PyAny>,
    estimate: Py<PyAny>,
    transmission: Py<PyAny>,
    drive_error: Py<PyAny>,
}

fn types(py: Python<'_>) -> PyResult<&'static Types> {
    static TYPES: PyOnceLock<Types> = PyOnceLock::new();
    TYPES.get_or_try_init(py, || {
        let module = py.import("estimator.sample")?;
        Ok(Types {
            sample: module.getattr("Sample")?.unbind(),
            estimate: module.getattr("Estimate")?.unbind(),
            transmission: module.getattr("TransmissionEstimate")?.unbind(),
            drive_error: py.import("drivelink.errors")?.getattr("DriveError")?.unbind(),
        })
    })
}

fn drive_error(py: Python<'_>, message: String) -> PyErr {
    match types(py).and_then(|types| types.drive_error.bind(py).call1((message,))) {
        Ok(error) => PyErr::from_value(error),
        Err(error) => error,
    }
}

fn sample_object<'py>(py: Python<'py>, s: &Sample, motors: usize) -> PyResult<Bound<'py, PyAny>> {
    types(py)?.sample.bind(py).call1((
        s.sequence,
        PyTuple::new(py, &s.motor_position[..motors])?,
        PyTuple::new(py, &s.motor_velocity[..motors])?,
        PyTuple::new(py, &s.motor_torque[..motors])?,
        s.link_position,
        s.link_velocity,
        s.external_torque,
    ))
}

/// A `Sample` and how many motors it has.
fn sample_from(object: &Bound<'_, PyAny>) -> PyResult<(Sample, usize)> {
    type Motors = Vec<f64>;
    let (sequence, position, velocity, torque, link_position, link_velocity, external_torque): (
        u64,
        Motors,
        Motors,
        Motors,
        f64,
        f64,
        f64,
    ) = object.extract()?;
    let motors = position.len();
    if motors > MOTORS || torque.len() != motors {
        return Err(PyValueError::new_err(format!("sample: expected at most {MOTORS} motors, got {motors}")));
    }
    let of_motors = |values: &Motors| std::array::from_fn(|i| values.get(i).copied().unwrap_or(f64::NAN));
    let sample = Sample {
        sequence,
        motor_position: of_motors(&position),
        motor_velocity: of_motors(&velocity),
        motor_torque: of_motors(&torque),
        link_position,
        link_velocity,
        external_torque,
    };
    Ok((sample, motors))
}

fn estimate_object<'py>(py: Python<'py>, e: &Estimate) -> PyResult<Bound<'py, PyAny>> {
    let types = types(py)?;
    let transmissions = e.transmissions[..e.motors]
        .iter()
        .map(|t| {
            let numbers = (t.flexibility_torque, t.stiffness, t.stiffness_std, t.deflection);
            types.transmission.bind(py).call1(numbers)
        })
        .collect::<PyResult<Vec<_>>>()?;
    types.estimate.bind(py).call1((
        e.sequence,
        e.status,
        e.flexibility_torque,
        e.stiffness,
        e.stiffness_std,
        PyTuple::new(py, transmissions)?,
    ))
}

/// The fields of an `Estimate`, with any number of transmissions.
type EstimateFields = (u64, i64, f64, f64, f64, Vec<(f64, f64, f64, f64)>);

fn transmission_of(numbers: (f64, f64, f64, f64)) -> TransmissionEstimate {
    let (flexibility_torque, stiffness, stiffness_std, deflection) = numbers;
    TransmissionEstimate { flexibility_torque, stiffness, stiffness_std, deflection }
}

fn estimate_from(object: &Bound<'_, PyAny>) -> PyResult<Estimate> {
    let (sequence, status, flexibility_torque, stiffness, stiffness_std, each): EstimateFields =
        object.extract()?;
    if each.len() > MOTORS {
        let message = format!("estimate: expected at most {MOTORS} transmissions, got {}", each.len());
        return Err(PyValueError::new_err(message));
    }
    let mut transmissions = [TransmissionEstimate::NOTHING; MOTORS];
    for (to, from) in transmissions.iter_mut().zip(&each) {
        *to = transmission_of(*from);
    }
    Ok(Estimate {
        sequence,
        status: status as u32,
        flexibility_torque,
        stiffness,
        stiffness_std,
        transmissions,
        motors: each.len(),
    })
}

/// The bytes of `<prefix>/<joint>/estimate`.
#[pyfunction]
fn encode_estimate<'py>(
    py: Python<'py>,
    estimate: &Bound<'py, PyAny>,
    stamp_ns: u64,
) -> PyResult<Bound<'py, PyBytes>> {
    let (sequence, status, torque, stiffness, std, each): EstimateFields = estimate.extract()?;
    if each.len() > wire::MOST_ELEMENTS {
        let message =
            format!("estimate: expected at most {} transmissions, got {}", wire::MOST_ELEMENTS, each.len());
        return Err(PyValueError::new_err(message));
    }
    let transmissions: Vec<_> = each.into_iter().map(transmission_of).collect();
    let joint = [torque, stiffness, std];
    let payload = wire::encode_estimate(sequence, stamp_ns, status as u32, joint, &transmissions);
    Ok(PyBytes::new(py, payload.bytes()))
}

/// The bytes of `<prefix>/<joint>/sample`.
#[pyfunction]
fn encode_sample<'py>(
    py: Python<'py>,
    sample: &Bound<'py, PyAny>,
    stamp_ns: u64,
) -> PyResult<Bound<'py, PyBytes>> {
    let (sample, motors) = sample_from(sample)?;
    Ok(PyBytes::new(py, wire::encode_sample(&sample, motors, stamp_ns).bytes()))
}

/// The fields of an `External`.
type ExternalFields = (u64, u32, f64, f64, f64, f64);

fn external_of(fields: ExternalFields) -> External {
    let (sequence, status, torque, torque_std, link_torque, difference) = fields;
    External { sequence, status, torque, torque_std, link_torque, difference }
}

/// The bytes of `<prefix>/<joint>/external`.
#[pyfunction]
fn encode_external<'py>(
    py: Python<'py>,
    external: &Bound<'py, PyAny>,
    stamp_ns: u64,
) -> PyResult<Bound<'py, PyBytes>> {
    let external = external_of(external.extract()?);
    Ok(PyBytes::new(py, wire::encode_external(&external, stamp_ns).bytes()))
}

// --- layouts --------------------------------------------------------------------------------------------------------

fn mapped_from(py: Python<'_>, object: &Bound<'_, PyAny>) -> PyResult<MappedObject> {
    let signal = match object.getattr("signal")?.extract::<String>()?.as_str() {
        "motor_position" => Signal::MotorPosition,
        "motor_velocity" => Signal::MotorVelocity,
        "motor_torque" => Signal::MotorTorque,
        "statusword" => Signal::Statusword,
        "link_position" => Signal::LinkPosition,
        "link_velocity" => Signal::LinkVelocity,
        "velocity_check" => Signal::VelocityCheck,
        "torque_check" => Signal::TorqueCheck,
        "second_position" => Signal::SecondPosition,
        "following_error" => Signal::FollowingError,
        "position_demand" => Signal::PositionDemand,
        _ => Signal::Other,
    };
    let bits: u32 = object.getattr("bits")?.extract()?;
    if bits > 64 && signal != Signal::Other {
        let (index, subindex): (u32, u32) =
            (object.getattr("index")?.extract()?, object.getattr("subindex")?.extract()?);
        let message = format!("0x{index:04X}:{subindex:02X}: expected at most 64 bits, got {bits}");
        return Err(drive_error(py, message));
    }
    let modulus: i128 = object.getattr("modulus")?.extract()?;
    let range = match (object.getattr("wraps")?.extract::<bool>()?, modulus) {
        (false, _) => 0,
        (true, 0) => 1 << bits,
        (true, modulus) => modulus,
    };
    Ok(MappedObject {
        signal,
        bits,
        signed: object.getattr("signed")?.extract()?,
        scale: object.getattr("scale")?.extract()?,
        offset: object.getattr("offset")?.extract()?,
        range,
    })
}

fn layout_from(py: Python<'_>, layout: &Bound<'_, PyAny>) -> PyResult<Node> {
    let tpdos = layout.getattr("tpdos")?.try_iter()?.map(|tpdo| {
        let tpdo = tpdo?;
        let objects = tpdo.getattr("objects")?.try_iter()?.map(|each| mapped_from(py, &each?));
        Ok(Tpdo {
            cob_id: tpdo.getattr("cob_id")?.extract::<u32>()? & 0x7FF,
            objects: objects.collect::<PyResult<_>>()?,
            transmission_type: tpdo.getattr("transmission_type")?.extract()?,
        })
    });
    Ok(Node {
        node_id: layout.getattr("node_id")?.extract()?,
        motor: layout.getattr("motor")?.extract()?,
        tpdos: tpdos.collect::<PyResult<_>>()?,
    })
}

// --- assembler ------------------------------------------------------------------------------------------------------

/// What became of one node's frames since the start.
#[pyclass(frozen, get_all, module = "drivelink._core")]
struct NodeCounters {
    received: u64,
    missing: u64,
    late: u64,
    duplicate: u64,
    conflicting: u64,
    wrong_length: u64,
    ignored: u64,
    reboots: u64,
    emergencies: u64,
}

#[pymethods]
impl NodeCounters {
    #[new]
    fn new() -> NodeCounters {
        Counters::default().into()
    }

    fn as_dict<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        let found = PyDict::new(py);
        for (name, count) in [
            ("received", self.received),
            ("missing", self.missing),
            ("late", self.late),
            ("duplicate", self.duplicate),
            ("conflicting", self.conflicting),
            ("wrong_length", self.wrong_length),
            ("ignored", self.ignored),
            ("reboots", self.reboots),
            ("emergencies", self.emergencies),
        ] {
            found.set_item(name, count)?;
        }
        Ok(found)
    }
}

impl From<Counters> for NodeCounters {
    fn from(c: Counters) -> NodeCounters {
        NodeCounters {
            received: c.received,
            missing: c.missing,
            late: c.late,
            duplicate: c.duplicate,
            conflicting: c.conflicting,
            wrong_length: c.wrong_length,
            ignored: c.ignored,
            reboots: c.reboots,
            emergencies: c.emergencies,
        }
    }
}

/// Makes the samples of one joint from the frames of its nodes.
#[pyclass(frozen, module = "drivelink._core")]
struct Assembler {
    core: Mutex<assembler::Assembler>,
}

#[pymethods]
impl Assembler {
    #[new]
    #[pyo3(signature = (layouts, motors, *, active = true, hold_periods = 250, period_s = 0.001))]
    fn new(
        py: Python<'_>,
        layouts: &Bound<'_, PyAny>,
        motors: usize,
        active: bool,
        hold_periods: i64,
        period_s: f64,
    ) -> PyResult<Assembler> {
        let layouts =
            layouts.try_iter()?.map(|layout| layout_from(py, &layout?)).collect::<PyResult<Vec<_>>>()?;
        let core = assembler::Assembler::new(&layouts, motors, active, hold_periods, period_s)
            .map_err(|message| drive_error(py, message))?;
        Ok(Assembler { core: Mutex::new(core) })
    }

    #[getter]
    fn sequence(&self) -> i64 {
        lock(&self.core).sequence
    }

    #[getter]
    fn missed(&self) -> i64 {
        lock(&self.core).missed.unwrap_or(-1)
    }

    #[getter]
    fn flags(&self) -> u32 {
        lock(&self.core).flags
    }

    #[getter]
    fn extra_syncs(&self) -> u64 {
        lock(&self.core).extra_syncs
    }

    #[getter]
    fn cob_ids<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyTuple>> {
        let cob_ids: Vec<u32> = lock(&self.core).cob_ids().collect();
        PyTuple::new(py, cob_ids)
    }

    #[getter]
    fn counters<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        let counters: Vec<_> = lock(&self.core).nodes().iter().map(|n| (n.node_id, n.counters)).collect();
        let found = PyDict::new(py);
        for (node_id, counted) in counters {
            found.set_item(node_id, NodeCounters::from(counted).into_pyobject(py)?)?;
        }
        Ok(found)
    }

    #[getter]
    fn faults<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        let found = PyDict::new(py);
        for node in lock(&self.core).nodes().iter().filter(|node| node.faulted || node.emergency != 0) {
            found.set_item(node.node_id, node.emergency)?;
        }
        Ok(found)
    }

    #[getter]
    fn statuswords<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        let found = PyDict::new(py);
        for node in lock(&self.core).nodes() {
            if let Some(statusword) = node.statusword {
                found.set_item(node.node_id, statusword)?;
            }
        }
        Ok(found)
    }

    #[getter]
    fn untrusted<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyTuple>> {
        let core = lock(&self.core);
        let nodes: Vec<u32> = core.nodes().iter().filter(|n| !n.trusted).map(|n| n.node_id).collect();
        PyTuple::new(py, nodes)
    }

    #[getter]
    fn checks(&self) -> Vec<(usize, &'static str, &'static str, f64, f64)> {
        let fields = |check: &CrossCheck| {
            let verdict = match check.verdict() {
                Verdict::Untested => "untested",
                Verdict::Agrees => "agrees",
                Verdict::Contradicts => "contradicts",
            };
            let (scale, std) = check.scale();
            (check.motor + 1, check.kind.name(), verdict, scale, std)
        };
        lock(&self.core).checks().iter().map(fields).collect()
    }

    #[getter]
    fn has_link(&self) -> bool {
        lock(&self.core).has_link()
    }

    #[getter]
    fn complete(&self) -> bool {
        lock(&self.core).complete()
    }

    fn missing_nodes<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyTuple>> {
        let mut nodes: Vec<u32> = lock(&self.core).missing_nodes().collect();
        nodes.dedup();
        PyTuple::new(py, nodes)
    }

    #[pyo3(signature = (cob_id, data, jump = 1))]
    fn feed<'py>(
        &self,
        py: Python<'py>,
        cob_id: u32,
        data: &[u8],
        jump: i64,
    ) -> PyResult<Option<Bound<'py, PyAny>>> {
        let (sample, motors) = {
            let mut core = lock(&self.core);
            (core.feed(cob_id, data, jump), core.motors())
        };
        sample.map(|sample| sample_object(py, &sample, motors)).transpose()
    }

    fn supervise(&self) {
        lock(&self.core).supervise();
    }

    fn distrust(&self, node_id: u32) {
        lock(&self.core).distrust(node_id);
    }

    fn trust(&self, node_id: u32) {
        lock(&self.core).trust(node_id);
    }

    fn contradict(&self, node_id: u32, contradicted: bool) {
        lock(&self.core).contradict(node_id, contradicted);
    }

    fn relayout(&self, py: Python<'_>, layout: &Bound<'_, PyAny>) -> PyResult<()> {
        let layout = layout_from(py, layout)?;
        let changed = lock(&self.core).relayout(&layout);
        changed.map_err(|message| drive_error(py, message))
    }
}

// --- durations ------------------------------------------------------------------------------------------------------

/// A distribution of durations.
#[pyclass(frozen, module = "drivelink._core")]
struct LatencyHistogram {
    core: Mutex<latency::LatencyHistogram>,
}

fn percentiles<'py>(py: Python<'py>, found: Option<Percentiles>) -> PyResult<Bound<'py, PyDict>> {
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

    #[getter]
    fn maximum_us(&self) -> u64 {
        lock(&self.core).maximum_us
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

// --- pipeline -------------------------------------------------------------------------------------------------------

/// What is published of one cycle.
#[pyclass(frozen, module = "drivelink._core")]
struct Tick {
    core: pipeline::Tick,
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
struct History {
    keep: usize,
    kept: Mutex<VecDeque<(Sample, usize)>>,
}

impl History {
    fn push(&self, sample: Sample, motors: usize) {
        if self.keep > 0 {
            let mut kept = lock(&self.kept);
            if kept.len() == self.keep {
                kept.pop_front();
            }
            kept.push_back((sample, motors));
        }
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
        let found: Vec<_> = {
            let kept = lock(&self.kept);
            let first = kept.partition_point(|(sample, _)| sample.sequence as i64 <= sequence);
            kept.range(first..).take(most.unwrap_or(usize::MAX)).copied().collect()
        };
        found.iter().map(|(sample, motors)| sample_object(py, sample, *motors)).collect()
    }

    fn behind(&self, sequence: i64) -> usize {
        let kept = lock(&self.kept);
        kept.len() - kept.partition_point(|(sample, _)| sample.sequence as i64 <= sequence)
    }
}

/// The estimator of a pipeline, and the monitor of its model: compiled ones are called without Python in between.
struct Driver {
    estimator: Py<PyAny>,
    compiled: Option<Py<Estimator>>,
    model_monitor: Option<Py<PyAny>>,
    compiled_monitor: Option<Py<ModelMonitor>>,
    motors: usize,
}

/// What a Python object is made of, where that is a class of this module.
fn core_of<T: PyClass>(py: Python<'_>, object: &Py<PyAny>) -> Option<Py<T>> {
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

    fn reset(&mut self) -> Result<(), Failure> {
        Python::attach(|py| self.estimator.call_method0(py, "reset").map(drop)).map_err(Failure::from)
    }

    fn distrust(&mut self) -> Result<(), Failure> {
        Python::attach(|py| self.estimator.call_method0(py, "distrust").map(drop)).map_err(Failure::from)
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

/// Frames of one joint in, estimates and their bytes out.
#[pyclass(frozen, module = "drivelink._core")]
struct JointPipeline {
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
    ) -> PyResult<pipeline::Tick> {
        let results = {
            let Ok(mut driver) = self.driver.try_lock() else {
                return Err(PyRuntimeError::new_err("two threads feed one joint"));
            };
            driver.motors = motors;
            pipeline::estimate(&mut *driver, sample, flags).map_err(to_python)?
        };
        self.history.get().push(*sample, motors);
        Ok(lock(&self.state).take(sample, motors, results, stamp_ns))
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
            history: Py::new(py, History { keep, kept: Mutex::new(VecDeque::with_capacity(keep)) })?,
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

    #[pyo3(signature = (cob_id, data, jump = 1, stamp_ns = 0))]
    fn feed(&self, cob_id: u32, data: &[u8], jump: i64, stamp_ns: i64) -> PyResult<Option<Tick>> {
        let (due, motors) = {
            let mut assembler = lock(&self.assembler.get().core);
            let due = lock(&self.state).feed(&mut assembler, cob_id, data, jump, stamp_ns);
            (due, assembler.motors())
        };
        match due {
            None => Ok(None),
            Some(Due::Sample(sample, flags)) => {
                self.run(&sample, motors, flags, None).map(|core| Some(Tick { core }))
            }
            Some(Due::Missed(sequence, flags)) => Ok(self.carry_on(sequence, flags, None)),
        }
    }

    #[pyo3(signature = (sample, flags = 0, stamp_ns = 0))]
    fn take(&self, sample: &Bound<'_, PyAny>, flags: u32, stamp_ns: i64) -> PyResult<Tick> {
        let (sample, motors) = sample_from(sample)?;
        Ok(Tick { core: self.run(&sample, motors, flags, Some(stamp_ns))? })
    }

    #[pyo3(signature = (sequence, flags = 0, stamp_ns = None))]
    fn carry_on(&self, sequence: i64, flags: u32, stamp_ns: Option<i64>) -> Option<Tick> {
        lock(&self.state).carry_on(sequence, flags, stamp_ns).map(|core| Tick { core })
    }

    #[pyo3(signature = (estimator, model_monitor, unseen = None))]
    fn exchange(
        &self,
        py: Python<'_>,
        estimator: Py<PyAny>,
        model_monitor: Option<Py<PyAny>>,
        unseen: Option<&Bound<'_, PyAny>>,
    ) -> PyResult<()> {
        if let Some(unseen) = unseen {
            for sample in unseen.try_iter()? {
                estimator.bind(py).call_method1("step", (sample?,))?;
            }
        }
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

/// What `drivelink._core` offers.
#[cfg(feature = "extension-module")]
#[pymodule(name = "_core")]
mod extension {
    use super::*;

    #[pymodule_export]
    use super::{
        Assembler, Estimator, History, JointPipeline, LatencyHistogram, ModelMonitor, NodeCounters, Tick,
        encode_estimate, encode_external, encode_sample,
    };

    #[pymodule_init]
    fn init(module: &Bound<'_, PyModule>) -> PyResult<()> {
        module.add("LATE", assembler::LATE)?;
        module.add("SYNC_COB_ID", SYNC_COB_ID)?;
        module.add("__version__", env!("CARGO_PKG_VERSION"))
    }
}
