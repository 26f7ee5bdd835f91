"""The declared model brought into line with a healthy run, so that a suspect run is judged against that.

All declared numbers are fitted together: both balances share the transmission, the motor torque's scale is
the anchor. So are the small errors that every rig's readings have: channels that are not taken at the same
instant, encoders with different zeros. What the recording does not reveal stays near its declared value.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from estimator.diagnosis.bandwidth import choose_bandwidth
from estimator.diagnosis.choices import choice
from estimator.diagnosis.covariance import hac_covariance
from estimator.diagnosis.hypothesis import Fitted, Problem
from estimator.gate import check
from estimator.model import Effect, JointModel
from estimator.sample import Record

__all__ = ["calibrate"]


def calibrate(
    record: Record | Sequence[Record], model: JointModel, bandwidth_hz: float | None = None
) -> JointModel:
    """The model that fits healthy recordings best.

    Args:
        record: a run without a fault, or several.
        model: as declared; its effects stay as they are.
        bandwidth_hz: of the filter that all channels share; None: chosen from the data.

    Returns:
        The model with inertias, dampings, gravity and transmission parameters refitted, and with the skews
        and the zeros between its readings as effects, where there are any.

    Raises:
        EstimatorError: a recording does not allow it.
    """
    records = [record] if isinstance(record, Record) else list(record)
    for one in records:
        check(one, model)
    bandwidth = bandwidth_hz or choose_bandwidth(records[0], model)
    problem = Problem(records, model, bandwidth, calibrating=True)
    fitted = problem.null()
    return _with_readings(_applied(problem, fitted), problem, fitted)


def _applied(problem: Problem, fitted: Fitted) -> JointModel:
    """The model with the fitted corrections added to what it declares."""
    model = problem.model

    def more(name: str, motor: int | None, part: int = 0) -> float:
        found = fitted.total("everyday", name, motor)
        return found[part] if len(found) > part else 0.0

    motors = []
    parameters = fitted.moved_base(problem).parameters(problem.frames[0])
    for i, motor in enumerate(model.motors):
        transmission = motor.transmission
        if parameters[i]:
            transmission = replace(transmission, parameters=parameters[i])
        motors.append(
            replace(
                motor,
                inertia_kg_m2=motor.inertia_kg_m2 + more("motor_inertia", i),
                viscous_damping_nm_s_rad=max(
                    motor.viscous_damping_nm_s_rad + more("viscous_damping", i), 0.0
                ),
                transmission=transmission,
            )
        )
    link = model.link
    if link is not None and fitted.total("everyday", "link_inertia", None):
        a = link.gravity_nm * np.cos(link.gravity_phase_rad) + more("gravity", None, 0)
        b = link.gravity_nm * np.sin(link.gravity_phase_rad) + more("gravity", None, 1)
        sign = -1.0 if link.gravity_nm < 0.0 else 1.0
        link = replace(
            link,
            inertia_kg_m2=link.inertia_kg_m2 + more("link_inertia", None),
            viscous_damping_nm_s_rad=max(
                link.viscous_damping_nm_s_rad + more("link_viscous_damping", None), 0.0
            ),
            gravity_nm=sign * float(np.hypot(a, b)),
            gravity_phase_rad=float(np.arctan2(sign * b, sign * a)),
        )
    return replace(model, motors=tuple(motors), link=link)


def _with_readings(model: JointModel, problem: Problem, fitted: Fitted) -> JointModel:
    """The model with the errors of its readings as effects; what is not sure stays as declared."""
    std = np.sqrt(np.maximum(np.diag(hac_covariance(problem, fitted)), 0.0))

    def sure(name: str, motor: int | None, least: float) -> float | None:
        for slot, x, sigma in zip(fitted.slots, fitted.posterior.x, std, strict=True):
            if (slot.kind, slot.name, slot.motor) == ("everyday", name, motor):
                value = slot.taken + float(x)
                return value if abs(value) > max(choice("sure") * float(sigma), least) else None
        return None

    motors = []
    for i, motor in enumerate(model.motors):
        effects = motor.effects
        if (delay := sure("torque_delay", i, choice("least_skew"))) is not None:
            effects = _with_effect(
                effects, "torque_delay", "delay_s", problem.declared.torque_delay_s[i] + delay
            )
        if (offset := sure("deflection_offset", i, 0.0)) is not None:
            effects = _with_effect(
                effects, "deflection_offset", "offset_rad", problem.declared.offset_rad[i] + offset
            )
        motors.append(replace(motor, effects=effects))
    at_link = model.link_effects
    if (delay := sure("encoder_delay", None, choice("least_skew"))) is not None:
        at_link = _with_effect(at_link, "encoder_delay", "delay_s", problem.declared.encoder_delay_s + delay)
    return replace(model, motors=tuple(motors), link_effects=at_link)


def _with_effect(effects: tuple[Effect, ...], name: str, parameter: str, value: float) -> tuple[Effect, ...]:
    """The effects with one of them as given now, whether or not it was there."""
    return (*(e for e in effects if e.name != name), Effect(name=name, parameters={parameter: value}))
