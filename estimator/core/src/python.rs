//! The Python binding: converts objects of `estimator.model` and `estimator.settings`.
//!
//! Its classes and functions are exported by the one extension module, see `drivelink/core`.

use std::fmt;
use std::sync::Arc;

use pyo3::buffer::PyBuffer;
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use pyo3::sync::PyOnceLock;
use pyo3::types::{PyDict, PyTuple, PyType};

use crate::effects::{Coordinates, Element, JointEffects};
use crate::error::Error;
use crate::external::External;
use crate::laws::{Foreign, Law, PARAMETERS, Shape, Table};
use crate::library::{self, LIBRARY, Parameter, Role};
use crate::model::{Arrangement, Link, Model, Motor, Transmission};
use crate::model_monitor::Baseline;
use crate::sample::{Estimate, MOTORS, Sample, TransmissionEstimate};
use crate::settings::{Method, Mode, Priors, Settings};
use crate::suspicion::{Reason, Signal};

impl From<Error> for PyErr {
    fn from(error: Error) -> PyErr {
        let message = error.to_string();
        Python::attach(|py| {
            let class = py.import("estimator.errors").and_then(|module| module.getattr("EstimatorError"));
            match class.and_then(|class| class.call1((&message,))) {
                Ok(error) => PyErr::from_value(error),
                Err(_) => PyValueError::new_err(message),
            }
        })
    }
}

/// A law of Python's: two callables g(φ, *shape) and ∂g/∂φ on arrays.
struct Callables {
    torque: Py<PyAny>,
    stiffness: Py<PyAny>,
}

impl fmt::Debug for Callables {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.write_str("Callables")
    }
}

impl Foreign for Callables {
    fn evaluate(&self, phi: &[f64], shape: &[f64], torque: &mut [f64], stiffness: &mut [f64]) {
        Python::attach(|py| {
            for (function, out) in [(&self.torque, torque), (&self.stiffness, stiffness)] {
                if let Err(error) = call(py, function, phi, shape, out) {
                    out.fill(f64::NAN);
                    error.write_unraisable(py, Some(function.bind(py)));
                }
            }
        });
    }
}

fn call(py: Python<'_>, function: &Py<PyAny>, phi: &[f64], shape: &[f64], out: &mut [f64]) -> PyResult<()> {
    let numpy = py.import("numpy")?;
    let mut arguments = vec![numpy.call_method1("array", (phi.to_vec(),))?];
    for value in shape {
        arguments.push(value.into_pyobject(py)?.into_any());
    }
    let result = function.bind(py).call1(PyTuple::new(py, arguments)?)?;
    let wide = numpy.call_method1("broadcast_to", (result, (phi.len(),)))?;
    let values: Vec<f64> = wide.call_method1("astype", ("float64",))?.call_method0("tolist")?.extract()?;
    out.copy_from_slice(&values);
    Ok(())
}

fn tabulated(deflection: &[f64], torque: &[f64]) -> Result<Law, Error> {
    let expected =
        "expected as many deflections as torques, all finite, the deflections growing from above 0";
    let table = Table::new(deflection, torque).ok_or_else(|| Error(format!("table: {expected}")))?;
    Ok(Law::Tabulated(Arc::new(table)))
}

/// The law of a model of `estimator.transmissions.MODELS`.
///
/// # Errors
/// It is of no kind that is known here.
pub fn law(model: &Bound<'_, PyAny>) -> PyResult<Law> {
    let name: String = model.getattr("name")?.extract()?;
    Ok(match Law::named(&name) {
        Some(law) => law,
        None if model.hasattr("points")? => {
            let (deflection, torque): (Vec<f64>, Vec<f64>) = model.getattr("points")?.extract()?;
            tabulated(&deflection, &torque)?
        }
        None => {
            let bounds: Vec<(f64, f64)> = model.getattr("shape_bounds")?.extract()?;
            let starts: Vec<f64> = model.getattr("shape_start")?.extract()?;
            let shapes: Vec<Shape> = (bounds.iter().zip(starts))
                .map(|((low, high), start)| Shape { low: *low, high: *high, start })
                .collect();
            let torque = model.getattr("_torque")?.unbind();
            let stiffness = model.getattr("_stiffness")?.unbind();
            Law::Foreign(Arc::new(Callables { torque, stiffness }), shapes.into())
        }
    })
}

fn elements(effects: &Bound<'_, PyAny>) -> PyResult<Vec<Element>> {
    let take_apart = effects.py().import("estimator.effects")?.getattr("elements")?;
    let mut all = Vec::new();
    for effect in effects.try_iter()? {
        let effect = effect?;
        let name: String = effect.getattr("name")?.extract()?;
        for values in take_apart.call1((&effect,))?.get_item(1)?.try_iter()? {
            let values: Vec<f64> = values?
                .cast_into::<PyDict>()?
                .values()
                .iter()
                .map(|v| v.extract())
                .collect::<PyResult<_>>()?;
            all.push(Element::new(&name, &values)?);
        }
    }
    Ok(all)
}

fn transmission(declared: &Bound<'_, PyAny>) -> PyResult<Transmission> {
    let py = declared.py();
    let name: String = declared.getattr("model")?.extract()?;
    let known = py.import("estimator.transmissions")?.getattr("transmission_model")?.call1((declared,))?;
    if known.is_none() {
        return Ok(if name == "none" { Transmission::Rigid } else { Transmission::Unknown });
    }
    let parameters = declared.getattr("parameters")?;
    let parameters = if parameters.is_truthy()? {
        known.call_method1("alpha", (parameters,))?.call_method0("tolist")?.extract()?
    } else {
        Vec::new()
    };
    let order = declared.getattr("order")?.extract()?;
    let rows: Option<Vec<Vec<f64>>> = declared.getattr("covariance")?.extract()?;
    Ok(Transmission::Elastic { law: law(&known)?, order, parameters, covariance: rows.map(|r| r.concat()) })
}

/// A model from an `estimator.model.JointModel`.
///
/// # Errors
/// A transmission or an effect is not known, or contradicts itself: an `EstimatorError`.
pub fn model(joint: &Bound<'_, PyAny>) -> PyResult<Model> {
    let arrangement: String = joint.getattr("arrangement")?.extract()?;
    let mut motors = Vec::new();
    for motor in joint.getattr("motors")?.try_iter()? {
        let motor = motor?;
        motors.push(Motor {
            inertia: motor.getattr("inertia_kg_m2")?.extract()?,
            inertia_std: motor.getattr("inertia_std_relative")?.extract()?,
            damping: motor.getattr("viscous_damping_nm_s_rad")?.extract()?,
            damping_std: motor.getattr("viscous_damping_std_nm_s_rad")?.extract()?,
            transmission: transmission(&motor.getattr("transmission")?)?,
            effects: elements(&motor.getattr("effects")?)?,
        });
    }
    let link = joint.getattr("link")?;
    let link = if link.is_none() {
        None
    } else {
        let (inertia_std, damping_std, gravity_std) = link.call_method0("uncertainty")?.extract()?;
        Some(Link {
            inertia: link.getattr("inertia_kg_m2")?.extract()?,
            damping: link.getattr("viscous_damping_nm_s_rad")?.extract()?,
            gravity: link.getattr("gravity_nm")?.extract()?,
            gravity_phase: link.getattr("gravity_phase_rad")?.extract()?,
            inertia_std,
            damping_std,
            gravity_std,
        })
    };
    let arrangement = match arrangement.as_str() {
        "antagonistic" => Arrangement::Antagonistic,
        "serial" => Arrangement::Serial,
        _ => Arrangement::Single,
    };
    Ok(Model { arrangement, motors, link, link_effects: elements(&joint.getattr("link_effects")?)? })
}

/// Settings from an `estimator.settings.EstimatorSettings`.
///
/// # Errors
/// It is none.
pub fn settings(given: &Bound<'_, PyAny>) -> PyResult<Settings> {
    let mode: String = given.getattr("mode")?.extract()?;
    let method: String = given.getattr("method")?.extract()?;
    let number = |name: &str| -> PyResult<f64> { given.getattr(name)?.extract() };
    Ok(Settings {
        mode: match mode.as_str() {
            "paper" => Mode::Paper,
            _ => Mode::Robust,
        },
        method: match method.as_str() {
            "mbe" => Method::Mbe,
            "bbe" => Method::Bbe,
            _ => Method::Auto,
        },
        bandwidth: number("bandwidth_rad_s")?,
        k_tau: number("k_tau_rad_s")?,
        k_sigma_1: number("k_sigma_1_rad2_s2")?,
        k_sigma_2: number("k_sigma_2_rad_s")?,
        k_r: number("k_r_s2_rad2")?,
        k_max: number("k_max")?,
        valid_within: number("valid_within")?,
        false_alarms_per_hour: number("false_alarms_per_hour")?,
        external_bandwidth: number("external_bandwidth_rad_s")?,
        external_bias_s: given.getattr("external_bias_s")?.extract()?,
        contact_torque: given.getattr("contact_torque_nm")?.extract()?,
        contact_false_alarms_per_hour: number("contact_false_alarms_per_hour")?,
    })
}

/// The priors of `estimator.priors`.
///
/// # Errors
/// One is missing.
pub fn priors(py: Python<'_>) -> PyResult<Priors> {
    let table = py.import("estimator.priors")?.getattr("PRIORS")?;
    let std = |name: &str| -> PyResult<f64> { table.get_item(name)?.getattr("std")?.extract() };
    Ok(Priors {
        motor_inertia: std("motor_inertia")?,
        viscous_damping: std("viscous_damping")?,
        viscous_damping_floor: std("viscous_damping_floor")?,
        coulomb_friction: std("coulomb_friction")?,
        torque_offset: std("torque_offset")?,
        deflection_offset: std("declared_zero")?,
        encoder_delay: std("encoder_delay")?,
    })
}

/// An estimator from Python's model and settings.
///
/// # Errors
/// See [`model`]; a period that is no positive number.
pub fn estimator(
    joint: &Bound<'_, PyAny>,
    given: &Bound<'_, PyAny>,
    period_s: f64,
) -> PyResult<crate::estimator::Estimator> {
    let (priors, model, settings) = (priors(joint.py())?, model(joint)?, settings(given)?);
    // Without the interpreter's lock: a daemon builds beside its cycle.
    Ok(joint.py().detach(|| crate::estimator::Estimator::new(&model, &settings, &priors, period_s))?)
}

fn several(tuple: &Bound<'_, PyTuple>, place: usize) -> PyResult<([f64; MOTORS], usize)> {
    let values = tuple.get_borrowed_item(place)?;
    let values = values.cast::<PyTuple>()?;
    let mut out = [f64::NAN; MOTORS];
    for (i, out) in out.iter_mut().enumerate().take(values.len()) {
        *out = values.get_borrowed_item(i)?.extract()?;
    }
    Ok((out, values.len()))
}

/// A sample from an `estimator.sample.Sample`, and how many motors it is of.
///
/// # Errors
/// It is none.
pub fn sample(given: &Bound<'_, PyAny>) -> PyResult<(Sample, usize)> {
    let tuple = given.cast::<PyTuple>()?;
    let number = |place: usize| -> PyResult<f64> { tuple.get_borrowed_item(place)?.extract() };
    let (motor_position, motors) = several(tuple, 1)?;
    let (motor_torque, torques) = several(tuple, 3)?;
    let sequence: i64 = tuple.get_borrowed_item(0)?.extract()?;
    let sample = Sample {
        sequence: sequence as u64,
        motor_position,
        motor_velocity: several(tuple, 2)?.0,
        motor_torque,
        link_position: number(4)?,
        link_velocity: number(5)?,
        external_torque: number(6)?,
    };
    Ok((sample, motors.min(torques)))
}

/// The named tuples that an estimate becomes.
struct Tuples {
    make: Py<PyAny>,
    estimate: Py<PyType>,
    transmission: Py<PyType>,
    external: Py<PyType>,
}

static TUPLES: PyOnceLock<Tuples> = PyOnceLock::new();

fn tuples(py: Python<'_>) -> PyResult<&'static Tuples> {
    TUPLES.get_or_try_init(py, || -> PyResult<Tuples> {
        let module = py.import("estimator.sample")?;
        Ok(Tuples {
            make: py.get_type::<PyTuple>().getattr("__new__")?.unbind(),
            estimate: module.getattr("Estimate")?.cast_into()?.unbind(),
            transmission: module.getattr("TransmissionEstimate")?.cast_into()?.unbind(),
            external: module.getattr("External")?.cast_into()?.unbind(),
        })
    })
}

/// An `estimator.sample.Estimate`.
///
/// # Errors
/// Python's classes cannot be had.
pub fn estimate<'py>(py: Python<'py>, result: &Estimate) -> PyResult<Bound<'py, PyAny>> {
    let tuples = tuples(py)?;
    let make = tuples.make.bind(py);
    let part = |i: usize| -> PyResult<Bound<'py, PyAny>> {
        let t = &result.transmissions[i];
        let values = (t.flexibility_torque, t.stiffness, t.stiffness_std, t.deflection);
        make.call1((&tuples.transmission, values))
    };
    let parts = if result.motors == 1 {
        PyTuple::new(py, [part(0)?])?
    } else {
        PyTuple::new(py, [part(0)?, part(1)?])?
    };
    let sequence = result.sequence as i64;
    let totals = (result.flexibility_torque, result.stiffness, result.stiffness_std);
    make.call1((&tuples.estimate, (sequence, result.status, totals.0, totals.1, totals.2, parts)))
}

/// An `estimator.sample.External`.
///
/// # Errors
/// Python's classes cannot be had.
pub fn external<'py>(py: Python<'py>, result: &External) -> PyResult<Bound<'py, PyAny>> {
    let tuples = tuples(py)?;
    let torques = (result.torque, result.torque_std, result.link_torque, result.difference);
    let values = (result.sequence as i64, result.status, torques.0, torques.1, torques.2, torques.3);
    tuples.make.bind(py).call1((&tuples.external, values))
}

/// Signal, motor from 1 on or 0, reason, amount, its standard deviation, whether it explains all.
type Suspected = (&'static str, usize, &'static str, f64, f64, bool);

/// The on-line estimator of a joint, in either mode; see `estimator.online.Estimator`.
#[pyclass]
pub struct Estimator {
    /// The mathematics.
    pub inner: crate::estimator::Estimator,
    motors: usize,
}

#[pymethods]
impl Estimator {
    #[new]
    fn new(model: &Bound<'_, PyAny>, settings: &Bound<'_, PyAny>, period_s: f64) -> PyResult<Estimator> {
        let inner = estimator(model, settings, period_s)?;
        Ok(Estimator { inner, motors: model.getattr("motors")?.len()? })
    }

    /// The estimate at this sample.
    fn step<'py>(&mut self, sample: &Bound<'py, PyAny>) -> PyResult<Bound<'py, PyAny>> {
        let (mut taken, motors) = self::sample(sample)?;
        if motors != self.motors {
            taken.motor_position[0] = f64::NAN; // no sample of this joint: rejected
        }
        let result = self.inner.step(&taken);
        estimate(sample.py(), &result)
    }

    /// Forget everything that was learned.
    fn reset(&mut self) {
        self.inner.reset();
    }

    /// The next sample may not be of its moment: use it, but learn nothing from it.
    fn distrust(&mut self) {
        self.inner.distrust();
    }

    /// Effects of one motor, counted from 0, that nobody declared and evidence chose.
    fn undeclared(&self, motor: usize) -> PyResult<Vec<&'static str>> {
        if motor >= self.motors {
            return Err(PyValueError::new_err(format!("motor: expected 0 to {}", self.motors - 1)));
        }
        Ok(self.inner.undeclared(motor).map_or_else(Vec::new, Iterator::collect))
    }

    /// What the model left unexplained of the torque balance at the last sample; nan: unknown.
    #[getter]
    fn residual_nm(&self) -> f64 {
        self.inner.residual()
    }

    /// What the world does to the link, by the last sample.
    #[getter]
    fn external<'py>(&self, py: Python<'py>) -> PyResult<Option<Bound<'py, PyAny>>> {
        self.inner.external().map(|result| external(py, &result)).transpose()
    }

    /// (rms of what the two sides' flexibility torques differ by, of the link's) over some seconds.
    #[getter]
    fn consistency(&self) -> Option<(f64, f64)> {
        self.inner.consistency().map(|[difference, torque]| (difference, torque))
    }

    /// (whether they are of a law, whether that is a polynomial, α, its standard deviations) of one motor.
    fn alpha(&self, motor: usize) -> PyResult<(bool, bool, Vec<f64>, Vec<f64>)> {
        if motor >= self.motors {
            return Err(PyValueError::new_err(format!("motor: expected 0 to {}", self.motors - 1)));
        }
        let (mut values, mut std) = (Vec::new(), Vec::new());
        let law = self.inner.parameters(motor, &mut values, &mut std);
        let polynomial = matches!(law, Some(Law::Polynomial));
        Ok((law.is_some(), polynomial, values, std))
    }

    /// The reading that is suspected.
    fn suspicion(&self) -> Option<Suspected> {
        let result = self.inner.suspicion()?;
        let (signal, motor) = match result.signal {
            Signal::MotorPosition(motor) => ("motor_position", motor + 1),
            Signal::MotorTorque(motor) => ("motor_torque", motor + 1),
            Signal::LinkPosition => ("link_position", 0),
            Signal::Positions(motor) => ("motor_or_link_position", motor + 1),
        };
        let reason = match result.reason {
            Reason::Scale => "scale",
            Reason::Delay => "delay",
            Reason::Zero => "zero",
            Reason::Impossible => "impossible",
            Reason::Jumped => "jumped",
            Reason::Frozen => "frozen",
        };
        Some((signal, motor, reason, result.amount, result.std, result.explains))
    }

    /// Why the last estimate is not valid: (name, motor from 1 or 0, share, names of what may have changed).
    fn why(&self) -> Option<(&'static str, usize, f64, Vec<&'static str>)> {
        let why = self.inner.why()?;
        let motor = why.motor.map_or(0, |motor| motor + 1);
        Some((why.reason.name(), motor, why.reason.share(), why.changed().collect()))
    }

    /// Seconds that each of so many ticks takes, the samples being taken again and again in turn.
    fn time_ticks(&mut self, samples: Vec<Bound<'_, PyAny>>, ticks: usize) -> PyResult<Vec<f64>> {
        let taken: Vec<Sample> =
            samples.iter().map(|one| Ok(self::sample(one)?.0)).collect::<PyResult<_>>()?;
        let nothing = TransmissionEstimate::NOTHING;
        let mut last: Option<Estimate> = None;
        let mut seconds = Vec::with_capacity(ticks);
        for k in 0..ticks {
            let mut sample = taken[k % taken.len()];
            sample.sequence = k as u64;
            let start = std::time::Instant::now();
            last = Some(self.inner.step(&sample));
            seconds.push(start.elapsed().as_secs_f64());
        }
        debug_assert!(last.is_none_or(|last| last.transmissions[0] != nothing));
        Ok(seconds)
    }
}

/// The effects of a joint's model tick by tick; see `estimator.effects`.
#[pyclass]
pub struct OnlineEffects {
    inner: JointEffects,
    active: bool,
    motors: usize,
}

#[pymethods]
impl OnlineEffects {
    #[new]
    fn new(model: &Bound<'_, PyAny>, period_s: f64) -> PyResult<OnlineEffects> {
        let model = self::model(model)?;
        let active = !model.link_effects.is_empty() || model.motors.iter().any(|m| !m.effects.is_empty());
        Ok(OnlineEffects { inner: JointEffects::new(&model, period_s)?, active, motors: model.motors.len() })
    }

    /// Whether the model has any effect.
    #[getter]
    fn active(&self) -> bool {
        self.active
    }

    /// Forget memories, delayed samples, the time since the start.
    fn reset(&mut self) {
        self.inner.reset();
    }

    /// The sample as perfect sensors would have given it, all channels as of one moment, with the same
    /// sequence number; None until every channel has the past that it waits for.
    fn correct<'py>(&mut self, sample: &Bound<'py, PyAny>) -> PyResult<Option<Bound<'py, PyAny>>> {
        let py = sample.py();
        let Some(corrected) = self.inner.corrections.correct(&self::sample(sample)?.0, false) else {
            return Ok(None);
        };
        let corrected = corrected.aligned;
        let each = |values: &[f64; MOTORS]| PyTuple::new(py, &values[..self.motors]);
        let class = py.import("estimator.sample")?.getattr("Sample")?;
        class
            .call1((
                corrected.sequence as i64,
                each(&corrected.motor_position)?,
                each(&corrected.motor_velocity)?,
                each(&corrected.motor_torque)?,
                corrected.link_position,
                corrected.link_velocity,
                corrected.external_torque,
            ))
            .map(Some)
    }

    /// (x_motor and x_transmission of each motor, x_link) at one tick's `Coordinates`.
    fn torques(
        &mut self,
        motors: Vec<[f64; Coordinates::NAMES.len()]>,
        link: [f64; Coordinates::NAMES.len()],
    ) -> PyResult<(Vec<f64>, Vec<f64>, f64)> {
        if motors.len() != self.motors {
            return Err(PyValueError::new_err(format!("motors: expected {} Coordinates", self.motors)));
        }
        let coordinates = |numbers: &[f64; Coordinates::NAMES.len()]| Coordinates::from_fn(|k| numbers[k]);
        let each: Vec<Coordinates> = motors.iter().map(coordinates).collect();
        let x = self.inner.torques(&each, &coordinates(&link));
        Ok((x.motor[..self.motors].to_vec(), x.transmission[..self.motors].to_vec(), x.link))
    }
}

/// Residuals, torques, standard deviations of logarithms, seconds.
type BaselineNumbers = (Vec<f64>, Vec<f64>, Vec<f64>, usize);

/// The monitor of a joint's model; see `estimator.model_monitor.ModelMonitor`.
#[pyclass]
pub struct ModelMonitor {
    /// The mathematics.
    pub inner: crate::model_monitor::ModelMonitor,
    #[pyo3(get)]
    monitoring: bool,
    motors: usize,
}

#[pymethods]
impl ModelMonitor {
    /// A baseline that is of another joint is not used.
    #[new]
    fn new(
        model: &Bound<'_, PyAny>,
        period_s: f64,
        baseline: Option<BaselineNumbers>,
        false_alarms_per_hour: f64,
    ) -> PyResult<ModelMonitor> {
        let model = self::model(model)?;
        let balances = crate::model_monitor::balances(&model);
        let baseline =
            baseline.filter(|known| known.0.len() == balances).map(|(residual, torque, log_std, seconds)| {
                let padded =
                    |values: Vec<f64>| std::array::from_fn(|b| values.get(b).copied().unwrap_or(1.0));
                Baseline {
                    residual: padded(residual),
                    torque: padded(torque),
                    log_std: padded(log_std),
                    seconds,
                }
            });
        let inner =
            crate::model_monitor::ModelMonitor::new(&model, baseline, false_alarms_per_hour, period_s)?;
        Ok(ModelMonitor { inner, monitoring: baseline.is_some(), motors: model.motors.len() })
    }

    /// Take one sample; whether the alarm is on.
    fn step(&mut self, sample: &Bound<'_, PyAny>) -> PyResult<bool> {
        let (taken, motors) = self::sample(sample)?;
        Ok(if motors == self.motors { self.inner.step(&taken) } else { self.inner.alarm() })
    }

    /// Forget everything but the model and its baseline.
    fn reset(&mut self) {
        self.inner.reset();
    }

    /// Whether the alarm is on.
    #[getter]
    fn alarm(&self) -> bool {
        self.inner.alarm()
    }

    /// Whole seconds that have been judged.
    #[getter]
    fn seconds(&self) -> u64 {
        self.inner.seconds()
    }

    /// Rms of each balance over the last whole second, N·m.
    #[getter]
    fn residual_nm<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyTuple>> {
        PyTuple::new(py, &self.inner.found().residual[..self.inner.balances()])
    }

    /// Rms of the torque that it is to be compared with, N·m.
    #[getter]
    fn torque_nm<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyTuple>> {
        PyTuple::new(py, &self.inner.found().torque[..self.inner.balances()])
    }

    /// (residual over what is foreseen, that which raises the alarm) of the balance that is nearest to it.
    #[getter]
    fn ratio(&self) -> (f64, f64) {
        (self.inner.found().ratio, self.inner.found().limit)
    }

    /// Where the effect that the model lacks is likely to sit.
    fn location(&self) -> &'static str {
        self.inner.location()
    }
}

type EffectParameter = (&'static str, &'static str, bool, Option<f64>);
type EffectKind =
    (&'static str, &'static str, &'static str, Vec<&'static str>, Vec<EffectParameter>, bool, &'static str);

/// A transmission's law over arrays of float64; α as `estimator.flexibility` has it.
#[pyclass(frozen)]
pub struct TransmissionLaw {
    law: Law,
}

fn slice(py: Python<'_>, buffer: &PyBuffer<f64>) -> PyResult<Vec<f64>> {
    buffer.to_vec(py)
}

fn check(law: &Law, alpha: &[f64]) -> PyResult<()> {
    let (got, expected) = (alpha.len(), 1 + law.shapes().len());
    let fits = if law.is_polynomial() { (1..=PARAMETERS).contains(&got) } else { got == expected };
    if fits { Ok(()) } else { Err(PyValueError::new_err(format!("alpha: got {got} numbers"))) }
}

#[pymethods]
impl TransmissionLaw {
    /// By its name: linear, polynomial, vsa-ii, exponential.
    #[new]
    fn new(name: &str) -> PyResult<TransmissionLaw> {
        let unknown = || PyValueError::new_err(format!("law: expected a known name, got {name}"));
        Ok(TransmissionLaw { law: Law::named(name).ok_or_else(unknown)? })
    }

    /// An odd curve through points, see `estimator.flexibility.Table`.
    #[staticmethod]
    fn table(deflection: Vec<f64>, torque: Vec<f64>) -> PyResult<TransmissionLaw> {
        Ok(TransmissionLaw { law: tabulated(&deflection, &torque)? })
    }

    /// (least, largest, usual value) of each of its shape parameters.
    #[getter]
    fn shapes(&self) -> Vec<(f64, f64, f64)> {
        self.law.shapes().iter().map(|shape| (shape.low, shape.high, shape.start)).collect()
    }

    /// Torque and stiffness at each φ into arrays of its size.
    fn evaluate(
        &self,
        py: Python<'_>,
        phi: PyBuffer<f64>,
        alpha: Vec<f64>,
        torque: PyBuffer<f64>,
        stiffness: PyBuffer<f64>,
    ) -> PyResult<()> {
        check(&self.law, &alpha)?;
        let phi = slice(py, &phi)?;
        let (mut values, mut slopes) = (vec![0.0; phi.len()], vec![0.0; phi.len()]);
        self.law.along(&phi, &alpha, &mut values, &mut slopes);
        torque.copy_from_slice(py, &values)?;
        stiffness.copy_from_slice(py, &slopes)
    }

    /// ∂f/∂α at each φ into an array (size of φ, size of α).
    fn jacobian(
        &self,
        py: Python<'_>,
        phi: PyBuffer<f64>,
        alpha: Vec<f64>,
        out: PyBuffer<f64>,
    ) -> PyResult<()> {
        check(&self.law, &alpha)?;
        let phi = slice(py, &phi)?;
        let mut rows = vec![0.0; phi.len() * alpha.len()];
        self.law.jacobian_along(&phi, &alpha, &mut rows);
        out.copy_from_slice(py, &rows)
    }

    /// ∂σ/∂α at each φ into an array (size of φ, size of α).
    fn stiffness_jacobian(
        &self,
        py: Python<'_>,
        phi: PyBuffer<f64>,
        alpha: Vec<f64>,
        out: PyBuffer<f64>,
    ) -> PyResult<()> {
        check(&self.law, &alpha)?;
        let phi = slice(py, &phi)?;
        let mut rows = vec![0.0; phi.len() * alpha.len()];
        for (phi, row) in phi.iter().zip(rows.chunks_exact_mut(alpha.len().max(1))) {
            self.law.stiffness_slopes(*phi, &alpha, row);
        }
        out.copy_from_slice(py, &rows)
    }

    /// (torque, stiffness) at one φ.
    fn at(&self, phi: f64, alpha: Vec<f64>) -> PyResult<(f64, f64)> {
        check(&self.law, &alpha)?;
        Ok(self.law.at(phi, &alpha))
    }

    /// Largest |φ| for which it is defined, rad.
    fn reach(&self, shape: Vec<f64>) -> f64 {
        if shape.len() == self.law.shapes().len() { self.law.reach(&shape) } else { f64::INFINITY }
    }
}

/// (name, location, channel, coordinates, parameters, whether it remembers, description) of every effect.
#[pyfunction]
pub fn effect_kinds() -> Vec<EffectKind> {
    let parameter = |p: &Parameter| (p.name, p.meaning, p.role == Role::Linear, p.default);
    (LIBRARY.iter())
        .map(|kind| {
            let (location, channel) = kind.place.names();
            let parameters = kind.parameters.iter().map(parameter).collect();
            let remembers = matches!(kind.law, library::Law::Memory { .. });
            (kind.name, location, channel, kind.coordinates.to_vec(), parameters, remembers, kind.description)
        })
        .collect()
}

/// The terms of one element of an effect, unweighted, over consecutive moments.
///
/// `coordinates`: those that the effect names, each of n numbers or of one; `out`: n numbers a term.
#[pyfunction]
pub fn effect_terms(
    py: Python<'_>,
    name: &str,
    values: Vec<f64>,
    coordinates: Vec<PyBuffer<f64>>,
    out: PyBuffer<f64>,
) -> PyResult<()> {
    let element = Element::new(name, &values)?;
    let names = element.kind.coordinates;
    let fields: Vec<_> = coordinates.iter().map(|field| slice(py, field)).collect::<PyResult<_>>()?;
    let n = fields.iter().map(Vec::len).max().unwrap_or(0);
    let terms = element.kind.terms();
    let alike = fields.iter().all(|field| field.len() == n || field.len() == 1);
    if !alike || fields.len() != names.len() || n == 0 || out.item_count() != n * terms {
        return Err(PyValueError::new_err(format!("coordinates: expected arrays of one size: {names:?}")));
    }
    let places: Vec<usize> =
        names.iter().filter_map(|name| Coordinates::NAMES.iter().position(|one| one == name)).collect();
    let mut c = Coordinates::default();
    let moments = (0..n).map(|k| {
        for (place, field) in places.iter().zip(&fields) {
            c.set(*place, if field.len() == 1 { field[0] } else { field[k] });
        }
        c
    });
    let mut result = vec![0.0; n * terms];
    element.along(moments, &mut result.chunks_exact_mut(n).collect::<Vec<_>>());
    out.copy_from_slice(py, &result)
}
