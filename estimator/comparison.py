"""What tells two models apart: correlations of a free run's residual, curves with intervals."""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from estimator.effects import Coordinates, elements
from estimator.freerun import FreeRun
from estimator.model import Motor
from estimator.sample import SIGMA_95, FloatArray, Record
from estimator.transmissions import transmission_model


class Correlation(NamedTuple):
    """Normalised correlation over lags, and half the 95 % band of none."""

    lag_s: FloatArray  # (n,); the residual is later than the torque by it
    value: FloatArray  # (n,) from -1 to 1
    band: float  # 1.96 standard deviations of what chance makes (Bartlett)


class Curve(NamedTuple):
    """y over x with its standard deviation, each (n,)."""

    x: FloatArray
    y: FloatArray
    std: FloatArray


def correlations(
    run: FreeRun, record: Record, channel: int, motor: int, longest_s: float
) -> tuple[Correlation, Correlation]:
    """Correlate a free run's residual with itself and with the motor torque, within its windows.

    Args:
        channel: of `run.channels`.

    Returns:
        Autocorrelation (band: of white noise) and cross-correlation (band: of independent signals as coloured
        as these).
    """
    size = max(round(run.horizon_s / record.period_s), 2)
    rows = np.searchsorted(record.time_s, run.time_s)
    residual = _windows(run.residual_rad[:, channel], size)
    torque = _windows(record.motor_torque_nm[rows, motor], size)
    most = min(max(round(longest_s / record.period_s), 1), size - 1)
    lags = np.arange(-most, most + 1, dtype=np.int64)
    own = _correlation(residual, residual, lags)
    driven = _correlation(torque, torque, lags)
    cross = _correlation(torque, residual, lags)
    chance = SIGMA_95 / np.sqrt(residual.size)
    coloured = chance * np.sqrt(max(float(own @ driven), 1.0))
    after = lags > 0
    return (
        Correlation(record.period_s * lags[after].astype(float), own[after], chance),
        Correlation(record.period_s * lags.astype(float), cross, min(coloured, 1.0)),
    )


def _windows(values: FloatArray, size: int) -> FloatArray:
    """(windows, size) of consecutive values, without their mean."""
    return (values - np.mean(values)).reshape(-1, size)


def _correlation(first: FloatArray, second: FloatArray, lags: NDArray[np.int64]) -> FloatArray:
    """Normalised correlation within windows of the same shape, second later than first by each lag."""
    size = first.shape[1]
    length = 2 * size
    spectra = [np.fft.rfft(one, length, axis=1) for one in (first, second)]
    sums = np.fft.irfft(np.sum(np.conj(spectra[0]) * spectra[1], axis=0), length)
    scale = float(np.linalg.norm(first) * np.linalg.norm(second))
    return np.asarray(sums[lags % length] / scale) if scale else np.zeros(len(lags))


def stiffness_curve(motor: Motor, deflection_rad: FloatArray) -> Curve | None:
    """Return the stiffness of a transmission (N·m/rad) with its covariance's interval; None:
    it has no parameters.
    """
    transmission = motor.transmission
    law = transmission_model(transmission)
    if law is None or not transmission.parameters:
        return None
    alpha = law.alpha(transmission.parameters)
    slopes = law.stiffness_jacobian(deflection_rad, alpha)
    covariance = np.zeros((alpha.size, alpha.size))
    if transmission.covariance is not None:
        covariance = np.asarray(transmission.covariance)
    variance = np.einsum("ij,jk,ik->i", slopes, covariance, slopes)
    return Curve(deflection_rad, law.stiffness(deflection_rad, alpha), np.sqrt(np.maximum(variance, 0.0)))


def friction_curve(motor: Motor, velocity_rad_s: FloatArray) -> Curve:
    """Return the torque of damping and of the effects of the motor's velocity alone (N·m), in steady motion.

    Its standard deviation is that of the parameters, each moved by its own.
    """

    def torque(changed: Motor) -> FloatArray:
        total = changed.viscous_damping_nm_s_rad * velocity_rad_s
        zero = np.zeros_like(velocity_rad_s)
        at = Coordinates(**{**dict.fromkeys(Coordinates._fields, zero), "velocity": velocity_rad_s})
        for effect in changed.effects:
            kind, sets = elements(effect)
            if kind.coordinates[0] == "velocity" and kind.location == "motor" and not kind.remembers:
                for values in sets:
                    total = total + np.array([values[name] for name in kind.linear]) @ kind.terms(at, values)
        return np.asarray(total)

    y = torque(motor)
    moved = [torque(one) - y for one in _moved(motor)]
    return Curve(velocity_rad_s, y, np.sqrt(np.sum(np.square([np.zeros_like(y), *moved]), axis=0)))


def _moved(motor: Motor) -> Sequence[Motor]:
    """The motor with each of its friction's plain parameters a standard deviation away."""
    made = []
    if motor.viscous_damping_std_nm_s_rad is not None:
        damping = motor.viscous_damping_nm_s_rad + motor.viscous_damping_std_nm_s_rad
        made.append(replace(motor, viscous_damping_nm_s_rad=damping))
    for k, effect in enumerate(motor.effects):
        for name, std in effect.std.items():
            value = effect.parameters[name]
            if isinstance(value, float | int) and isinstance(std, float | int):
                changed = replace(effect, parameters={**effect.parameters, name: value + std})
                made.append(replace(motor, effects=(*motor.effects[:k], changed, *motor.effects[k + 1 :])))
    return made
