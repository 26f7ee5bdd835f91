"""Plants with changed parameters, and a suitable excitation for them."""

import math
import re
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from sim.errors import SimError
from sim.plant import JointPlant, LinkPlant, MotorPlant

_SOFT_NM_RAD = 200.0  # springs up to this are soft
_SOFT_DEFLECTION_RAD = 0.15


def with_parameters(plant: JointPlant, parameters: Mapping[str, float]) -> JointPlant:
    """Replace values of a plant.

    Args:
        parameters: `link_inertia_kg_m2`, `link_gravity_nm`, `motor1_viscous_damping_nm_s_rad`,
            `motor2_k_nm_rad`, `motor1_coefficient2_nm_rad` (the second of `coefficients_nm_rad`), …;
            `lever_per_rad` of a serial joint.

    Raises:
        SimError: an unknown name or an impossible value.
    """
    for key, value in parameters.items():
        body, _, name = key.partition("_")
        index = {"motor1": 0, "motor2": 1}.get(body, -1)
        if key == "lever_per_rad" and plant.arrangement == "serial":
            plant = replace(plant, lever_per_rad=value)
        elif body == "link":
            plant = replace(plant, link=_link(plant.link, key, name, value))
        elif 0 <= index < len(plant.motors):
            motors = list(plant.motors)
            motors[index] = _motor(motors[index], key, name, value)
            plant = replace(plant, motors=tuple(motors))
        else:
            raise SimError(f"parameters.{key}: unknown, expected link_…, motor1_… or motor2_… of this joint")
    return plant


def _link(link: LinkPlant, key: str, name: str, value: float) -> LinkPlant:
    known = ("inertia_kg_m2", "viscous_damping_nm_s_rad", "gravity_nm", "gravity_phase_rad")
    if name not in known:
        raise SimError(f"parameters.{key}: unknown, the link has {', '.join(known)}")
    changes: dict[str, Any] = {name: value}
    return replace(link, **changes)


def _motor(motor: MotorPlant, key: str, name: str, value: float) -> MotorPlant:
    if name in ("inertia_kg_m2", "viscous_damping_nm_s_rad"):
        changes: dict[str, Any] = {name: value}
        return replace(motor, **changes)
    parameters = dict(motor.spring.parameters)
    coefficients = parameters.get("coefficients_nm_rad")
    match = re.fullmatch(r"coefficient(\d+)_nm_rad", name)
    if match and isinstance(coefficients, tuple) and 1 <= int(match[1]) <= len(coefficients):
        at = int(match[1]) - 1
        parameters["coefficients_nm_rad"] = (*coefficients[:at], value, *coefficients[at + 1 :])
    elif isinstance(parameters.get(name), float):
        parameters[name] = value
    else:
        known = ", ".join(parameters) or "no parameters"
        raise SimError(f"parameters.{key}: unknown, this transmission has {known}")
    return replace(motor, spring=replace(motor.spring, parameters=parameters))


def typical_torque_nm(plant: JointPlant) -> float:
    """Return a torque with a suitable motion: 0.15 rad in a soft spring, less in a stiff one.

    A rigid joint is one body, which it accelerates by 5 rad/s².
    """
    springs = [motor.spring for motor in plant.motors if not motor.spring.rigid]
    if not springs:
        whole = plant.link.inertia_kg_m2 + sum(motor.inertia_kg_m2 for motor in plant.motors)
        return max(abs(plant.link.gravity_nm), 5.0 * whole)
    stiffness = min(abs(spring.law().stiffness(0.0)) for spring in springs)
    softness = max(1.0, stiffness / _SOFT_NM_RAD)
    return float(_SOFT_DEFLECTION_RAD * stiffness / softness * softness**0.25)


def following(plant: JointPlant) -> dict[str, Any]:
    """Return the keys of an excitation with which a stiff position loop follows a motion."""
    laws = [motor.spring.law() for motor in plant.motors if not motor.spring.rigid]
    inertia = max(motor.inertia_kg_m2 for motor in plant.motors)
    hold = 4.0 * max((abs(law.stiffness(0.0)) for law in laws), default=typical_torque_nm(plant))
    return {"centring_nm_rad": hold, "centring_nm_s_rad": 2.0 * math.sqrt(hold * inertia)}


def suitable(plant: JointPlant) -> dict[str, Any]:
    """Return the excitation table for `sim.excitation.build`: rich, with soft centring against drift."""
    torque = typical_torque_nm(plant)
    inertia = plant.link.inertia_kg_m2 + sum(motor.inertia_kg_m2 for motor in plant.motors)
    hold = 3.0 * torque
    return {
        "kind": "rich",
        "amplitude_nm": torque,
        "centring_nm_rad": hold,
        "centring_nm_s_rad": 0.5 * math.sqrt(hold * inertia),
    }
