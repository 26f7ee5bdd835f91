"""A joint's model from a healthy recording: what `drivelink fit` shows, and what it writes.

`fit` gives each transmission and its motor. `calibrate` adds what that leaves open: the link's dynamics, and
the errors of the readings. With the readings put right, `fit` has the last word on its own numbers, so that
there is one set of them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

from estimator.batch import TransmissionFit, fit
from estimator.diagnosis import calibrate
from estimator.effects import elements
from estimator.errors import EstimatorError
from estimator.model import Effect, JointModel, Motor, Transmission
from estimator.sample import Record
from estimator.transmissions import RIGID

__all__ = ["Identified", "identify"]

_SURE = 4.0  # standard deviations from zero at which a delay is kept: chance makes one of 16 000
_LEAST_DELAY_S = 2e-5  # and how much of it: less shifts no estimate that anybody could see
# Readings put right lower the error of the motor's balance; by less than this it rises where they hardly
# change and are interpolated anew.
_WORSE = 1.01
_READINGS = ("torque_delay", "deflection_offset", "encoder_delay")


@dataclass(frozen=True, slots=True, kw_only=True)
class Identified:
    """A joint, fitted to a recording.

    Attributes:
        fits: of each motor, in order; every number that `model` has, too, is the same there.
        model: the joint with what was found: transmissions, inertias, dampings, link, readings.
        doubt: why link dynamics and readings stay as declared; empty: they do not.
    """

    fits: list[TransmissionFit]
    model: JointModel
    doubt: str = ""


def identify(record: Record, model: JointModel, bandwidth_rad_s: float | None = None) -> Identified:
    """Fit all numbers of a joint to a healthy recording.

    Args:
        record: measured data.
        model: declared joint; its effects are honoured, those of the readings are refined.
        bandwidth_rad_s: of the filter that all channels of `fit` share; left out: chosen for the sampling.

    Raises:
        EstimatorError: the recording lacks what is needed, is too short, or nothing moves in it.
        GateError: its units, signs, gear ratio or time do not fit the joint.
    """
    fits = fit(record, model, bandwidth_rad_s)
    aligned = _aligned(model, fits)
    try:
        calibrated = calibrate(record, _fitted(aligned, fits, usable_only=True))
    except EstimatorError as error:
        return Identified(fits=fits, model=_fitted(aligned, fits), doubt=str(error))
    motors = (
        replace(mine, effects=found.effects) if mine.flexible else found
        for mine, found in zip(model.motors, calibrated.motors, strict=True)
    )
    found = replace(model, motors=tuple(motors), link=calibrated.link, link_effects=calibrated.link_effects)
    if _readings(found) != _readings(model):
        again = fit(record, found, bandwidth_rad_s)
        if any(b.error_rms_nm > _WORSE * a.error_rms_nm for a, b in zip(fits, again, strict=True)):
            doubt = "the zeros and delays that suit them best spoil the motor's balance" if model.link else ""
            return Identified(fits=fits, model=_fitted(aligned, fits), doubt=doubt)
        fits = again
    return Identified(fits=fits, model=_fitted(_aligned(found, fits), fits))


def _aligned(model: JointModel, fits: Sequence[TransmissionFit]) -> JointModel:
    """The model with the delays that `fit` is sure of as effects of the readings."""
    motors = []
    for motor, one in zip(model.motors, fits, strict=True):
        std = one.nuisance_std.get("torque_skew", math.inf)
        if _sure(one.torque_skew_s, std):  # late readings are of a torque that acted earlier
            motor = replace(motor, effects=_later(motor.effects, "torque_delay", -one.torque_skew_s))
        motors.append(motor)
    told = [(one.link_delay_s, one.nuisance_std["link_delay"]) for one in fits if one.model != RIGID]
    weights = [1.0 / max(std, 1e-12) ** 2 for _, std in told]
    link_effects = model.link_effects
    if told:
        delay = sum(w * d for w, (d, _) in zip(weights, told, strict=True)) / sum(weights)
        if _sure(delay, 1.0 / math.sqrt(sum(weights))):
            link_effects = _later(link_effects, "encoder_delay", delay)
    return replace(model, motors=tuple(motors), link_effects=link_effects)


def _sure(delay_s: float, std_s: float) -> bool:
    return abs(delay_s) > max(_SURE * std_s, _LEAST_DELAY_S)


def _later(effects: tuple[Effect, ...], name: str, delay_s: float) -> tuple[Effect, ...]:
    """The effects with so much more of a delay."""
    declared = sum(v["delay_s"] for e in effects if e.name == name for v in elements(e)[1])
    others = tuple(e for e in effects if e.name != name)
    return (*others, Effect(name=name, parameters={"delay_s": declared + delay_s}))


def _readings(model: JointModel) -> list[list[Effect]]:
    owners = [motor.effects for motor in model.motors]
    return [[e for e in effects if e.name in _READINGS] for effects in (*owners, model.link_effects)]


def _fitted(model: JointModel, fits: Sequence[TransmissionFit], *, usable_only: bool = False) -> JointModel:
    """The model with the numbers of the fits; of the usable ones only, where others stand in the way."""
    motors = (
        motor if one.model == RIGID or (usable_only and not one.stiffens) else _told(motor, one)
        for motor, one in zip(model.motors, fits, strict=True)
    )
    return replace(model, motors=tuple(motors))


def _told(motor: Motor, one: TransmissionFit) -> Motor:
    order = int(one.alpha.size) if one.model == "polynomial" else motor.transmission.order
    return replace(
        motor,
        inertia_kg_m2=one.inertia_kg_m2,
        viscous_damping_nm_s_rad=max(one.viscous_damping_nm_s_rad, 0.0),
        transmission=Transmission(model=one.model, order=order, parameters=one.parameters),
    )
