"""Declared effects: corrects the readings and subtracts their torques from the balances."""

from __future__ import annotations

import numpy as np

from estimator.choices import choice
from estimator.diagnosis.candidates import Candidate, columns, rubbing, slips
from estimator.diagnosis.corrections import READINGS
from estimator.diagnosis.frame import Corrections, Frame
from estimator.effects import LIBRARY, elements
from estimator.model import Effect, JointModel
from estimator.sample import FloatArray

__all__ = ["declared_corrections", "declared_laws", "declared_torque", "held_at_rest", "known_effects"]


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


def declared_torque(frame: Frame, *, laws: bool = False) -> FloatArray:
    """Return the contribution of the declared effects to the balances; `laws`: of those with a shape."""
    total = np.zeros(frame.rows * frame.equations)
    for candidate, effect in _declared(frame.model):
        if effect.name in READINGS or (laws and not candidate.kind.nonlinear):
            continue
        for values in elements(effect)[1]:
            weights = tuple(values[name] for name in candidate.kind.linear)
            total = total + columns(frame, candidate, values, weights) @ np.array(weights)
    return total


def held_at_rest(frame: Frame, left: FloatArray) -> FloatArray:
    """Return what declared dry friction may hold of the balances' residual (rows,).

    A motor at rest has any friction up to its level, of which a law of the velocity names one.
    """
    if ("held",) not in frame.memo:
        band = np.zeros((2, frame.rows * frame.equations))
        for candidate, effect in _declared(frame.model):
            motor, kind = candidate.motor or 0, candidate.kind
            if not slips(kind):
                continue
            c, here = frame.motors[motor], rubbing(frame, motor)
            still = np.abs(c.velocity) <= choice("sure") * frame.signals.velocity_noise(motor)
            for values in elements(effect)[1]:
                weights = np.array([values[name] for name in kind.linear])
                fast = choice("sure") * values["smoothing_rad_s"]
                ends = (c._replace(velocity=np.full_like(c.velocity, v)) for v in (fast, -fast))
                now = weights @ kind.terms(here, values)
                more = np.array([now - weights @ kind.terms(end, values) for end in ends])
                band += frame.column(motor, np.where(still, more, 0.0), None)
        frame.memo["held",] = band
    least, most = frame.memo["held",]
    return np.clip(left, least, most)


def known_effects(model: JointModel) -> dict[Candidate, tuple[dict[str, float], tuple[float, ...]]]:
    """Return parameters of torques that the joint file says were fitted, and the linear ones' deviations."""
    made = {}
    for candidate, effect in _declared(model):
        values, linear = elements(effect)[1], candidate.kind.linear
        if candidate.kind.channel == "torque" and len(values) == 1 and effect.std:
            std = [float(np.max(effect.std.get(name, 0.0))) for name in linear]
            made[candidate] = values[0], tuple(max(one, choice("exact") * max(std)) for one in std)
    return made


def declared_laws(model: JointModel) -> dict[object, int]:
    """Return the number of parameters of each declared effect that has a shape, by its family."""
    kinds = [candidate for candidate, _ in _declared(model) if candidate.kind.nonlinear]
    return {one.family: len(one.kind.parameters) for one in kinds}


def _declared(model: JointModel) -> list[tuple[Candidate, Effect]]:
    owners = [(i, effect) for i, motor in enumerate(model.motors) for effect in motor.effects]
    every = [*owners, *((None, effect) for effect in model.link_effects)]
    return [(Candidate(LIBRARY[effect.name], motor), effect) for motor, effect in every]
