//! Laws of transmissions and terms of effects over arrays, for `fit` and `diagnose`.

use std::fmt;
use std::sync::Arc;

use pyo3::buffer::PyBuffer;
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use pyo3::types::PyTuple;

use crate::effects::along;
use crate::error::Error;
use crate::filters::StateVariableFilter;
use crate::laws::{Foreign, Law, PARAMETERS, Shape, Table};
use crate::library::{self, Coordinates, Element, LIBRARY, Parameter, Role};

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

impl Callables {
    fn try_evaluate(
        &self,
        py: Python<'_>,
        phi: &[f64],
        shape: &[f64],
        torque: &mut [f64],
        stiffness: &mut [f64],
    ) -> PyResult<()> {
        call(py, &self.torque, phi, shape, torque)?;
        call(py, &self.stiffness, phi, shape, stiffness)
    }
}

impl Foreign for Callables {
    fn evaluate(&self, phi: &[f64], shape: &[f64], torque: &mut [f64], stiffness: &mut [f64]) {
        Python::attach(|py| {
            if let Err(error) = self.try_evaluate(py, phi, shape, torque, stiffness) {
                torque.fill(f64::NAN);
                stiffness.fill(f64::NAN);
                error.write_unraisable(py, Some(self.torque.bind(py)));
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
    let mut values = numpy.call_method1("asarray", (result, "float64"))?;
    if !values.getattr("shape")?.eq((phi.len(),))? {
        values = numpy.call_method1("broadcast_to", (values, (phi.len(),)))?; // a constant
    }
    let values: Vec<f64> = values.call_method0("tolist")?.extract()?;
    out.copy_from_slice(&values);
    Ok(())
}

type EffectParameter = (&'static str, &'static str, bool, bool, Option<f64>);
type EffectKind =
    (&'static str, &'static str, &'static str, Vec<&'static str>, Vec<EffectParameter>, bool, &'static str);

/// A transmission's law over arrays of float64; α as `estimator.flexibility` has it.
#[pyclass(frozen)]
pub struct TransmissionLaw {
    pub(super) law: Law,
    functions: Option<Arc<Callables>>, // those of a law of Python's
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
        Ok(TransmissionLaw { law: Law::named(name).ok_or_else(unknown)?, functions: None })
    }

    /// An odd curve through points, see `estimator.flexibility.Table`.
    #[staticmethod]
    fn table(deflection: Vec<f64>, torque: Vec<f64>) -> PyResult<TransmissionLaw> {
        let expected =
            "expected as many deflections as torques, all finite, the deflections growing from above 0";
        let table = Table::new(&deflection, &torque).ok_or_else(|| Error(format!("table: {expected}")))?;
        Ok(TransmissionLaw { law: Law::Tabulated(Arc::new(table)), functions: None })
    }

    /// f = k g(φ, *shape) of Python's functions g and ∂g/∂φ on arrays; (least, largest, usual) of each shape.
    #[staticmethod]
    fn of(torque: Py<PyAny>, stiffness: Py<PyAny>, shapes: Vec<(f64, f64, f64)>) -> TransmissionLaw {
        let functions = Arc::new(Callables { torque, stiffness });
        let shapes = shapes.into_iter().map(|(low, high, start)| Shape { low, high, start }).collect();
        TransmissionLaw { law: Law::Foreign(functions.clone(), shapes), functions: Some(functions) }
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
        if let Some(functions) = &self.functions {
            functions.try_evaluate(py, &phi, &alpha[1..], &mut values, &mut slopes)?;
            values.iter_mut().chain(&mut slopes).for_each(|value| *value *= alpha[0]);
        } else {
            self.law.along(&phi, &alpha, &mut values, &mut slopes);
        }
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
        self.law.stiffness_jacobian_along(&phi, &alpha, &mut rows);
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
    let parameter = |p: &Parameter| (p.name, p.meaning, p.role.linear(), p.role == Role::Loss, p.default);
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
    along(&element, moments, &mut result.chunks_exact_mut(n).collect::<Vec<_>>());
    out.copy_from_slice(py, &result)
}

/// Filter a recording from rest by wⁿ/(s + w)ⁿ, n from 1 to 8: state i into row i of `out`.
#[pyfunction]
pub fn state_variable_filter(
    py: Python<'_>,
    order: usize,
    bandwidth_rad_s: f64,
    period_s: f64,
    signal: PyBuffer<f64>,
    held: bool,
    out: PyBuffer<f64>,
) -> PyResult<()> {
    fn run<const N: usize>(w: f64, period_s: f64, signal: &[f64], held: bool, rows: &mut [&mut [f64]]) {
        StateVariableFilter::<N>::new(w, period_s).along(signal, held, rows);
    }
    let signal = slice(py, &signal)?;
    let mut states = vec![0.0; order * signal.len()];
    let mut rows: Vec<&mut [f64]> = states.chunks_exact_mut(signal.len().max(1)).collect();
    let run = match order {
        1 => run::<1>,
        2 => run::<2>,
        3 => run::<3>,
        4 => run::<4>,
        5 => run::<5>,
        6 => run::<6>,
        7 => run::<7>,
        8 => run::<8>,
        _ => return Err(PyValueError::new_err(format!("order: expected 1 to 8, got {order}"))),
    };
    run(bandwidth_rad_s, period_s, &signal, held, &mut rows);
    out.copy_from_slice(py, &states)
}
