"""Declared effects: corrects the readings and subtracts their torques from the balances."""

from __future__ import annotations

import numpy as np

from estimator.diagnosis.candidates import Candidate, columns
from estimator.diagnosis.corrections import READINGS
from estimator.diagnosis.frame import Corrections, Frame
from estimator.effects import elements
from estimator.model import Effect, JointModel
from estimator.sample import FloatArray

__all__ = ["declared_corrections", "declared_torque"]


def declared_corrections(model: JointModel) -> Corrections:
    """Return the corrections of the readings by the declared effects."""
    delays, lags, offsets = [], [], []
    for motor in model.motors:
        delays.append(_sum(motor.effects, "torque_delay", "delay_s"))
        lags.append(_sum(motor.effects, "torque_lag", "time_constant_s"))
        offsets.append(_sum(motor.effects, "deflection_offset", "offset_rad"))
    link = model.link_effects
    return Corrections(
        torque_delay_s=tuple(delays),
        torque_lag_s=tuple(lags),
        offset_rad=tuple(offsets),
        encoder_delay_s=_sum(link, "encoder_delay", "delay_s"),
        deflection_delay_s=_sum(link, "deflection_delay", "delay_s"),
        encoder_sin_rad=_sum(link, "encoder_eccentricity", "sin_rad"),
        encoder_cos_rad=_sum(link, "encoder_eccentricity", "cos_rad"),
        encoder_scale=_sum(link, "encoder_scale", "relative_error"),
    )


def _sum(effects: tuple[Effect, ...], name: str, parameter: str) -> float:
    return sum(v[parameter] for e in effects if e.name == name for v in elements(e)[1])


def declared_torque(frame: Frame) -> FloatArray:
    """Return the contribution of the declared effects to the stacked balances."""
    total = np.zeros(frame.rows * frame.equations)
    owners = [(i, effect) for i, motor in enumerate(frame.model.motors) for effect in motor.effects]
    for motor, effect in [*owners, *((None, effect) for effect in frame.model.link_effects)]:
        if effect.name in READINGS:
            continue
        kind, each = elements(effect)
        for values in each:
            weights = tuple(values[name] for name in kind.linear)
            total = total + columns(frame, Candidate(kind, motor), values, weights) @ np.array(weights)
    return total
