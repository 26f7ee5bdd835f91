//! The Python binding: what `estimator.model`, `estimator.settings` and `estimator.sample` declare, to and from
//! the core's own.
//!
//! Its classes and functions are exported by the one extension module, see `drivelink/core`.

mod classes;
mod physics;

use pyo3::exceptions::{PyTypeError, PyValueError};
use pyo3::prelude::*;
use pyo3::sync::PyOnceLock;
use pyo3::types::{PyDict, PyTuple, PyType};

pub use self::classes::{Estimator, ModelMonitor};
pub use self::physics::{TransmissionLaw, effect_kinds, effect_terms, state_variable_filter};
use crate::effects::Element;
use crate::error::Error;
use crate::external::External;
use crate::model::{Arrangement, Link, Model, Motor, Transmission};
use crate::sample::{Estimate, MOTORS, Sample};
use crate::settings::{Method, Mode, Priors, Settings};

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

/// A choice that Python writes as a word; the last one stands for every other word.
macro_rules! words {
    ($choice:ident { $($word:literal => $value:ident,)* _ => $other:ident }) => {
        impl<'a, 'py> FromPyObject<'a, 'py> for $choice {
            type Error = PyErr;

            fn extract(word: Borrowed<'a, 'py, PyAny>) -> PyResult<$choice> {
                let word: String = word.extract()?;
                Ok(match word.as_str() {
                    $($word => $choice::$value,)*
                    _ => $choice::$other,
                })
            }
        }
    };
}

words!(Mode { "paper" => Paper, _ => Robust });
words!(Method { "mbe" => Mbe, "bbe" => Bbe, _ => Auto });
words!(Arrangement { "antagonistic" => Antagonistic, "serial" => Serial, _ => Single });

/// The elements of `estimator.model.Effect`s, as `estimator.effects` takes them apart.
fn elements(effects: &Bound<'_, PyAny>) -> PyResult<Vec<Element>> {
    let take_apart = effects.py().import("estimator.effects")?.getattr("elements")?;
    let mut all = Vec::new();
    for effect in effects.try_iter()? {
        let effect = effect?;
        let name: String = effect.getattr("name")?.extract()?;
        let sets: Vec<Bound<'_, PyDict>> = take_apart.call1((effect,))?.get_item(1)?.extract()?;
        for values in sets {
            let values: Vec<f64> = values.values().extract()?;
            all.push(Element::new(&name, &values)?);
        }
    }
    Ok(all)
}

/// Of an `estimator.model.Transmission`, whose law `estimator.transmissions` knows.
fn transmission(declared: &Bound<'_, PyAny>) -> PyResult<Transmission> {
    let transmissions = declared.py().import("estimator.transmissions")?;
    let known = transmissions.getattr("transmission_model")?.call1((declared,))?;
    if known.is_none() {
        let rigid = declared.getattr("model")?.eq(transmissions.getattr("RIGID")?)?;
        return Ok(if rigid { Transmission::Rigid } else { Transmission::Unknown });
    }
    let parameters = declared.getattr("parameters")?;
    let parameters = if parameters.is_truthy()? {
        known.call_method1("alpha", (parameters,))?.call_method0("tolist")?.extract()?
    } else {
        Vec::new()
    };
    let law = known.getattr("law")?.cast_into::<TransmissionLaw>()?.get().law.clone();
    let rows: Option<Vec<Vec<f64>>> = declared.getattr("covariance")?.extract()?;
    let covariance = rows.map(|rows| rows.concat());
    Ok(Transmission::Elastic { law, order: declared.getattr("order")?.extract()?, parameters, covariance })
}

/// An `estimator.model.Motor`.
#[derive(FromPyObject)]
struct MotorFields {
    #[pyo3(attribute("inertia_kg_m2"))]
    inertia: f64,
    #[pyo3(attribute("inertia_std_relative"))]
    inertia_std: Option<f64>,
    #[pyo3(attribute("viscous_damping_nm_s_rad"))]
    damping: f64,
    #[pyo3(attribute("viscous_damping_std_nm_s_rad"))]
    damping_std: Option<f64>,
    #[pyo3(attribute("zero_std_rad"))]
    zero_std: f64,
    #[pyo3(attribute("fit_rms_nm"))]
    fit_rms: Option<(f64, f64)>,
    #[pyo3(from_py_with = transmission)]
    transmission: Transmission,
    #[pyo3(from_py_with = elements)]
    effects: Vec<Element>,
}

/// An `estimator.model.LinkDynamics`.
#[derive(FromPyObject)]
struct LinkFields {
    #[pyo3(attribute("inertia_kg_m2"))]
    inertia: f64,
    #[pyo3(attribute("viscous_damping_nm_s_rad"))]
    damping: f64,
    #[pyo3(attribute("gravity_nm"))]
    gravity: f64,
    #[pyo3(attribute("gravity_phase_rad"))]
    gravity_phase: f64,
    std: (f64, f64, f64),
}

/// An `estimator.model.JointModel`.
#[derive(FromPyObject)]
struct JointFields {
    arrangement: Arrangement,
    motors: Vec<MotorFields>,
    link: Option<LinkFields>,
    #[pyo3(from_py_with = elements)]
    link_effects: Vec<Element>,
}

/// What a field's conversion raised, without the `TypeError`s that name the fields around it.
fn reason(py: Python<'_>, mut error: PyErr) -> PyErr {
    while let Some(cause) = error.cause(py).filter(|_| error.is_instance_of::<PyTypeError>(py)) {
        error = cause;
    }
    error
}

fn declared_model(joint: &Bound<'_, PyAny>) -> PyResult<Model> {
    let fields = joint.extract().map_err(|error| reason(joint.py(), error));
    let JointFields { arrangement, motors, link, link_effects } = fields?;
    let motor = |motor: MotorFields| {
        let MotorFields {
            inertia,
            inertia_std,
            damping,
            damping_std,
            zero_std,
            fit_rms,
            transmission,
            effects,
        } = motor;
        Motor { inertia, inertia_std, damping, damping_std, zero_std, fit_rms, transmission, effects }
    };
    let link = link.map(|LinkFields { inertia, damping, gravity, gravity_phase, std }| {
        let (inertia_std, damping_std, gravity_std) = std;
        Link { inertia, damping, gravity, gravity_phase, inertia_std, damping_std, gravity_std }
    });
    Ok(Model { arrangement, motors: motors.into_iter().map(motor).collect(), link, link_effects })
}

/// The priors of `estimator.priors`.
fn priors(py: Python<'_>) -> PyResult<Priors> {
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
        late: std("late")?,
        load_dependent_friction: std("load_dependent_friction")?,
        encoder_eccentricity: std("encoder_eccentricity")?,
        undeclared: std("undeclared_effect")?,
        law: std("declared_law")?,
        spring: std("transmission")?,
    })
}

fn declared_estimator(
    joint: &Bound<'_, PyAny>,
    settings: Settings,
    period_s: f64,
) -> PyResult<crate::estimator::Estimator> {
    let (priors, model) = (priors(joint.py())?, declared_model(joint)?);
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

/// An `estimator.sample.Sample`, and how many motors it is of; as many torques as positions are expected, so no
/// number where they differ.
///
/// # Errors
/// It is none.
pub fn sample(given: &Bound<'_, PyAny>) -> PyResult<(Sample, Option<usize>)> {
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
    Ok((sample, (motors == torques && motors <= MOTORS).then_some(motors)))
}

/// The named tuples of `estimator.sample`.
struct Tuples {
    make: Py<PyAny>,
    sample: Py<PyType>,
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
            sample: module.getattr("Sample")?.cast_into()?.unbind(),
            estimate: module.getattr("Estimate")?.cast_into()?.unbind(),
            transmission: module.getattr("TransmissionEstimate")?.cast_into()?.unbind(),
            external: module.getattr("External")?.cast_into()?.unbind(),
        })
    })
}

/// An `estimator.sample.Sample` of so many motors.
///
/// # Errors
/// Python's classes cannot be had.
pub fn sample_object<'py>(py: Python<'py>, s: &Sample, motors: usize) -> PyResult<Bound<'py, PyAny>> {
    let tuples = tuples(py)?;
    let values = (
        s.sequence,
        PyTuple::new(py, &s.motor_position[..motors])?,
        PyTuple::new(py, &s.motor_velocity[..motors])?,
        PyTuple::new(py, &s.motor_torque[..motors])?,
        s.link_position,
        s.link_velocity,
        s.external_torque,
    );
    tuples.make.bind(py).call1((&tuples.sample, values))
}

/// An `estimator.sample.Estimate`.
///
/// # Errors
/// Python's classes cannot be had.
pub fn estimate_object<'py>(py: Python<'py>, result: &Estimate) -> PyResult<Bound<'py, PyAny>> {
    let tuples = tuples(py)?;
    let make = tuples.make.bind(py);
    let parts = (result.transmissions[..result.motors].iter())
        .map(|t| {
            let values = (t.flexibility_torque, t.stiffness, t.stiffness_std, t.deflection);
            make.call1((&tuples.transmission, values))
        })
        .collect::<PyResult<Vec<_>>>()?;
    let parts = PyTuple::new(py, parts)?;
    let sequence = result.sequence as i64;
    let totals = (result.flexibility_torque, result.stiffness, result.stiffness_std);
    make.call1((&tuples.estimate, (sequence, result.status, totals.0, totals.1, totals.2, parts)))
}

/// An `estimator.sample.External`.
///
/// # Errors
/// Python's classes cannot be had.
pub fn external_object<'py>(py: Python<'py>, result: &External) -> PyResult<Bound<'py, PyAny>> {
    let tuples = tuples(py)?;
    let torques = (result.torque, result.torque_std, result.link_torque, result.difference);
    let values = (result.sequence as i64, result.status, torques.0, torques.1, torques.2, torques.3);
    tuples.make.bind(py).call1((&tuples.external, values))
}
