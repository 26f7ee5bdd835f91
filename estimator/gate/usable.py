"""Whether a recording is usable: long enough, complete, finite, moving. One line each."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from estimator.choices import choice, whole
from estimator.errors import EstimatorError
from estimator.model import JointModel
from estimator.reasons import counted, percent
from estimator.sample import FloatArray, Record

__all__ = ["at_limit", "check", "is_held", "without_hold"]

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
            f"the recording has {counted(record.motors, 'motor')}: expected {len(model.motors)}, "
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
        _finite("link_position_rad", record.link_position_rad)
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
    if _stands(x):
        raise EstimatorError(f"{name} hardly changes: only {len(np.unique(x))} different values")


def _stands(x: FloatArray) -> bool:
    """Whether a reading stays within a few counts, and on one of them nearly always."""
    changes = np.count_nonzero(np.diff(x))
    return bool(changes < 0.005 * (len(x) - 1) and len(np.unique(x)) < 4)


def at_limit(record: Record) -> NDArray[np.int64]:
    """Return (k, 2) first and last row of stretches where a torque rests on its largest or smallest value.

    They are longer than what a line bridges. A drive or a recorder clips there: more may have acted. A torque
    that is often there, as that of a motor that is switched, is as it is. So is a peak that rounding makes
    flat: a parabola is within its next value for sqrt(2) times as long at least.
    """
    made: list[NDArray[np.int64]] = []
    for torque in record.motor_torque_nm.T:
        often, found = 0.0, []
        for side in (torque, -torque):
            first, at = np.unique(side)[-2:][0], side == np.max(side)
            often += float(np.mean(at))
            runs, wide = _runs(at), _runs(side >= first)
            around = wide[np.searchsorted(wide[:, 0], runs[:, 0], side="right") - 1]
            sharp = np.ptp(around, axis=1) + 1 < np.sqrt(2.0) * (np.ptp(runs, axis=1) + 1)
            found.append(runs[sharp & (np.ptp(runs, axis=1) >= whole("bridged"))])
        if often <= choice("gaps"):
            made += found
    return np.concatenate([np.zeros((0, 2), dtype=np.int64), *made])


def _runs(true: NDArray[np.bool_]) -> NDArray[np.int64]:
    """(k, 2) first and last row of each stretch."""
    return np.asarray(np.flatnonzero(np.diff(true, prepend=False, append=False)).reshape(-1, 2) - [0, 1])


def is_held(record: Record, model: JointModel) -> bool:
    """Whether the link stands still: then the motor's spring ends at a fixed point."""
    link = record.link_position_rad
    return model.has_deflection and link is not None and _stands(link)


def without_hold(records: Sequence[Record], model: JointModel) -> JointModel:
    """The model without the link's balance, where a torque that is not measured holds the link."""
    held = any(is_held(one, model) and one.external_torque_nm is None for one in records)
    return replace(model, link=None) if held else model
