"""Faults of a first installation: units, signs, gear ratio. Recognised by trying what would be right."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from estimator.diagnosis.frame import Frame, Signals
from estimator.diagnosis.known import declared_corrections
from estimator.diagnosis.outcome import errors
from estimator.diagnosis.regression import Blocks, Rows
from estimator.diagnosis.select import Tracer
from estimator.errors import EstimatorError
from estimator.model import JointModel
from estimator.sample import Record

__all__ = ["refuse_faults"]

_SUSPECT = 0.15  # relative error of the declared model from which faults are looked for
_CURED = 0.25  # what a cure must bring the error down to, as a share of it
_FAR_APART = 4.0  # beyond this ratio it is one of the two positions
_DEGREE = np.pi / 180.0
_GEAR = (0.6, 1.6)  # motions of link and motor that belong together have a ratio in between

Cure = Callable[[Record], Record | None]


def refuse_faults(record: Record, model: JointModel, tracer: Tracer, bandwidth_hz: float) -> None:
    """Raise what is wrong with units, signs or gear ratio, if one such cure explains the data.

    Raises:
        EstimatorError: a fault in one line, with what tells so.
    """
    before = _error(tracer)
    stiff = all(alpha.size == 0 or alpha[0] > 0.0 for alpha in tracer.base.alpha)
    if before < _SUSPECT and stiff:
        return
    apart = _geared(record) is not None and abs(np.log(_ratio(record))) > np.log(_FAR_APART)
    found: tuple[float, str] = (np.inf, "")
    for what, cure in _CURES.items():
        cured = cure(record)
        if cured is None or (apart and what not in _OF_ONE):
            continue
        signals = Signals(cured, bandwidth_hz)
        frame = Frame.make(model, signals, declared_corrections(model))
        blocks = Blocks.make(frame.rows, tracer.rows.blocks.count, 0)
        other = Tracer(frame, Rows(blocks, frame.equations, np.ones(frame.equations)), 1.0)
        if any(alpha.size and alpha[0] <= 0.0 for alpha in other.base.alpha):
            continue
        error = _error(other)
        if error < found[0]:
            found = (error, what)
    if found[0] < _CURED * before or (not stiff and found[0] < before):
        raise EstimatorError(
            f"{found[1]}: the torque balance is off by {before:.0%} of the torque, "
            f"and by {found[0]:.1%} with that put right"
        )


def _error(tracer: Tracer) -> float:
    frame = tracer.frame
    left = tracer.left(tracer.evaluate(()))
    scale = np.sqrt(np.mean([np.mean(frame.project(c.torque) ** 2) for c in frame.motors]))
    one = errors(frame, left, left, np.ones(frame.rows, dtype=bool), False).before_rms_nm
    both = float(np.sqrt(np.mean(left**2))) if frame.linked else one
    return max(one, both) / max(float(scale), 1e-300)


def _torque(factor: float) -> Cure:
    return lambda r: replace(r, motor_torque_nm=r.motor_torque_nm * factor)


def _positions(motor: float, link: float) -> Cure:
    def cure(r: Record) -> Record | None:
        if r.link_position_rad is None and motor == 1.0:
            return None
        moved = None if r.link_position_rad is None else r.link_position_rad * link
        return replace(r, motor_position_rad=r.motor_position_rad * motor, link_position_rad=moved)

    return cure


def _geared(r: Record) -> Record | None:
    """The motor's positions brought to the link's scale, where the two do not belong together."""
    if r.link_position_rad is None:
        return None
    ratio = _ratio(r)
    if ratio <= 0.0 or _GEAR[0] < ratio < _GEAR[1]:
        return None
    return replace(r, motor_position_rad=r.motor_position_rad * ratio)


def _ratio(r: Record) -> float:
    """Motion of the link over that of the motors."""
    if r.link_position_rad is None:
        return 1.0
    x = r.motor_position_rad.mean(axis=1)
    x, y = x - x.mean(), r.link_position_rad - r.link_position_rad.mean()
    size = float(np.sqrt(np.sum(y * y) / max(float(np.sum(x * x)), 1e-300)))
    return size if float(np.sum(x * y)) >= 0.0 else -size


_CURES: dict[str, Cure] = {
    "the motor torque has the wrong sign": _torque(-1.0),
    "the motor torque looks like N·mm, expected N·m": _torque(1e-3),
    "the motor torque looks like kN·m, expected N·m": _torque(1e3),
    "the positions look like degrees, expected rad": _positions(_DEGREE, _DEGREE),
    "the link position looks like degrees, expected rad": _positions(1.0, _DEGREE),
    "the motor position looks like degrees, expected rad": _positions(_DEGREE, 1.0),
    "the link position has the wrong sign": _positions(1.0, -1.0),
    "the motor position has the wrong sign": _positions(-1.0, 1.0),
    "positions and torque have opposite signs": _positions(-1.0, -1.0),
    "the motor position does not belong to the link's (wrong gear ratio?)": _geared,
}
_OF_ONE = [name for name in _CURES if "position" in name and "degrees" in name and "positions" not in name]
_OF_ONE.append("the motor position does not belong to the link's (wrong gear ratio?)")
