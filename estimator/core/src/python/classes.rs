//! `Estimator` and `ModelMonitor`, as Python has them.

use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use pyo3::types::PyTuple;

use super::{declared_estimator, declared_model, estimate_object, external_object, sample};
use crate::laws::Law;
use crate::model_monitor::Baseline;
use crate::settings::Settings;
use crate::suspicion::{Reason, Signal};

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
    fn new(model: &Bound<'_, PyAny>, settings: Settings, period_s: f64) -> PyResult<Estimator> {
        let inner = declared_estimator(model, settings, period_s)?;
        Ok(Estimator { inner, motors: model.getattr("motors")?.len()? })
    }

    /// The estimate at this sample.
    fn step<'py>(&mut self, given: &Bound<'py, PyAny>) -> PyResult<Bound<'py, PyAny>> {
        let (mut taken, motors) = sample(given)?;
        if motors != Some(self.motors) {
            taken.motor_position[0] = f64::NAN; // no sample of this joint: rejected
        }
        let result = self.inner.step(&taken);
        estimate_object(given.py(), &result)
    }

    /// Forget everything that was learned.
    fn reset(&mut self) {
        self.inner.reset();
    }

    /// Positions may count from anywhere after this: what was learned is kept, but for where the zeros are.
    fn lose_zeros(&mut self) {
        self.inner.lose_zeros();
    }

    /// Standard deviation of the joint's flexibility torque at the last sample, N·m; NaN: unknown.
    #[getter]
    fn flexibility_torque_std_nm(&self) -> f64 {
        self.inner.flexibility_torque_std()
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
        self.inner.external().map(|result| external_object(py, &result)).transpose()
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

    /// (dry friction beyond what is declared, its standard deviation) of one motor, N·m.
    fn friction(&self, motor: usize) -> PyResult<Option<(f64, f64)>> {
        if motor >= self.motors {
            return Err(PyValueError::new_err(format!("motor: expected 0 to {}", self.motors - 1)));
        }
        Ok(self.inner.friction(motor))
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
        let model = declared_model(model)?;
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
    fn step(&mut self, given: &Bound<'_, PyAny>) -> PyResult<bool> {
        let (taken, motors) = sample(given)?;
        Ok(if motors == Some(self.motors) { self.inner.step(&taken) } else { self.inner.alarm() })
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
