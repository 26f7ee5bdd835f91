"""Whether a recording is usable: long enough, complete, finite, moving. One line each."""

from __future__ import annotations

import numpy as np

from estimator.choices import choice, whole
from estimator.errors import EstimatorError
from estimator.model import JointModel
from estimator.reasons import percent
from estimator.sample import FloatArray, Record

__all__ = ["check"]

_ABSURD = 1.0 / np.finfo(float).eps  # where numbers are no longer told apart by one unit


def check(record: Record, model: JointModel) -> None:
    """Refuse a recording that no model can be fitted to.

    Raises:
        EstimatorError: too short, constant, not finite, channels missing.
    """
    n = len(record)
    seconds = n * record.period_s
    least, least_s = whole("samples"), choice("fit_periods") / choice("most_bandwidth")
    if n < least or seconds < least_s:
        raise EstimatorError(
            f"the recording is too short: expected at least {least_s:g} s and {least} rows, "
            f"got {seconds:.3g} s and {n} rows"
        )
    if record.motors != len(model.motors):
        raise EstimatorError(
            f"the recording has {record.motors} motor(s): expected {len(model.motors)} motor(s), "
            "as in the joint file"
        )
    if model.has_deflection and record.link_position_rad is None:
        raise EstimatorError(
            'the recording has no link_position_rad: expected it unless transmission.model is "none"'
        )
    span = int(record.sequence[-1] - record.sequence[0]) + 1
    gaps = choice("gaps")
    if span - n > gaps * span:
        raise EstimatorError(f"{span - n} of {span} samples are missing: expected at most {percent(gaps, 0)}")
    for i in range(record.motors):
        _channel(f"motor{i + 1}_position_rad", record.motor_position_rad[:, i])
        _channel(f"motor{i + 1}_torque_nm", record.motor_torque_nm[:, i])
    if record.link_position_rad is not None and model.has_deflection:
        _channel("link_position_rad", record.link_position_rad)
    if record.external_torque_nm is not None:
        _finite("external_torque_nm", record.external_torque_nm)


def _finite(name: str, x: FloatArray) -> None:
    bad = np.count_nonzero(~np.isfinite(x))
    if bad:
        raise EstimatorError(f"{name}: {bad} values are not finite")
    if np.max(np.abs(x)) > _ABSURD:
        raise EstimatorError(f"{name}: values up to {np.max(np.abs(x)):.3g} are not a measurement")


def _channel(name: str, x: FloatArray) -> None:
    _finite(name, x)
    if np.ptp(x) == 0.0:
        raise EstimatorError(
            f"{name} is constant ({x[0]:g}): the joint stands still, or its sensor is silent"
        )
    still = np.count_nonzero(np.diff(x) == 0.0) / (len(x) - 1)
    if still > 0.995 and len(np.unique(x)) < 4:
        raise EstimatorError(f"{name} hardly changes: only {len(np.unique(x))} different values")
