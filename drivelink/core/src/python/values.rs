//! Python's values and layouts to and from the core's; the bytes of messages.

use estimator_core::external::External;
use estimator_core::python::sample;
use estimator_core::sample::{Estimate, MOTORS, Sample, TransmissionEstimate};
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use pyo3::types::PyBytes;

use crate::wire;

pub(super) fn drive_error(py: Python<'_>, message: String) -> PyErr {
    let class = py.import("drivelink.errors").and_then(|module| module.getattr("DriveError"));
    class.and_then(|class| class.call1((message,))).map_or_else(|error| error, PyErr::from_value)
}

/// A `Sample` and how many motors it has.
pub(super) fn sample_from(object: &Bound<'_, PyAny>) -> PyResult<(Sample, usize)> {
    let (sample, motors) = sample(object)?;
    let expected = || format!("sample: expected at most {MOTORS} motors, with one torque each");
    Ok((sample, motors.ok_or_else(|| PyValueError::new_err(expected()))?))
}

/// The fields of an `Estimate`, with any number of transmissions.
pub(super) type EstimateFields = (u64, i64, f64, f64, f64, Vec<(f64, f64, f64, f64)>);

pub(super) fn transmission_of(numbers: (f64, f64, f64, f64)) -> TransmissionEstimate {
    let (flexibility_torque, stiffness, stiffness_std, deflection) = numbers;
    let flexibility_torque_std = f64::NAN;
    TransmissionEstimate { flexibility_torque, flexibility_torque_std, stiffness, stiffness_std, deflection }
}

pub(super) fn estimate_from(object: &Bound<'_, PyAny>) -> PyResult<Estimate> {
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
        flexibility_torque_std: f64::NAN,
        stiffness,
        stiffness_std,
        transmissions,
        motors: each.len(),
    })
}

/// The bytes of `<prefix>/<joint>/estimate`.
#[pyfunction]
pub(super) fn encode_estimate<'py>(
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
pub(super) fn encode_sample<'py>(
    py: Python<'py>,
    sample: &Bound<'py, PyAny>,
    stamp_ns: u64,
) -> PyResult<Bound<'py, PyBytes>> {
    let (sample, motors) = sample_from(sample)?;
    Ok(PyBytes::new(py, wire::encode_sample(&sample, motors, stamp_ns).bytes()))
}

/// The fields of an `External`.
pub(super) type ExternalFields = (u64, u32, f64, f64, f64, f64);

pub(super) fn external_of(fields: ExternalFields) -> External {
    let (sequence, status, torque, torque_std, link_torque, difference) = fields;
    External { sequence, status, torque, torque_std, link_torque, difference }
}

/// The bytes of `<prefix>/<joint>/external`.
#[pyfunction]
pub(super) fn encode_external<'py>(
    py: Python<'py>,
    external: &Bound<'py, PyAny>,
    stamp_ns: u64,
) -> PyResult<Bound<'py, PyBytes>> {
    let external = external_of(external.extract()?);
    Ok(PyBytes::new(py, wire::encode_external(&external, stamp_ns).bytes()))
}
