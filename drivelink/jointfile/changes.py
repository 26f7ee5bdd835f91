"""A fitted model as the changes that it makes to a joint file."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

from estimator.model import Effect, JointModel, Motor, ParameterValue

_DIGITS = 9  # of a covariance


def changes_to(model: JointModel) -> dict[str, Any]:
    """Return the changes of `write_model` that put a model's numbers and their uncertainty
    into a joint file.
    """
    changes: dict[str, Any] = {"motor": [_motor(motor) for motor in model.motors]}
    link = link_entry(model)
    return changes | ({"link": link} if link else {})


def link_entry(model: JointModel) -> dict[str, Any]:
    """Return table [link]: dynamics, effects of link and encoder."""
    link: dict[str, Any] = {}
    if model.link is not None:
        link["dynamics"] = {name: x for name, x in asdict(model.link).items() if x is not None}
    if model.link_effects:
        link["effect"] = [effect_entry(effect) for effect in model.link_effects]
    return link


def effect_entry(effect: Effect) -> dict[str, Any]:
    """Return one effect: name, parameters, and the standard deviations of those that were fitted."""
    entry = {"name": effect.name, "parameters": plain_parameters(effect.parameters)}
    return entry | ({"std": plain_parameters(effect.std)} if effect.std else {})


def plain_parameters(parameters: Mapping[str, ParameterValue]) -> dict[str, float | list[float]]:
    """Return the parameters as a file has them: numbers and lists of numbers."""
    return {name: list(v) if isinstance(v, tuple) else float(v) for name, v in parameters.items()}


def _motor(motor: Motor) -> dict[str, Any]:
    names = (
        "inertia_kg_m2", "inertia_std_relative", "viscous_damping_nm_s_rad", "viscous_damping_std_nm_s_rad"
    )  # fmt: skip
    entry: dict[str, Any] = {name: x for name in names if (x := getattr(motor, name)) is not None}
    own = motor.transmission
    if own.parameters:
        entry["transmission"] = {"model": own.model, "parameters": plain_parameters(own.parameters)}
        if own.order is not None:
            entry["transmission"]["order"] = own.order
        if own.covariance is not None:
            rows = [[float(f"{x:.{_DIGITS}g}") for x in row] for row in own.covariance]
            entry["transmission"]["covariance"] = rows
    if motor.effects:
        entry["effect"] = [effect_entry(effect) for effect in motor.effects]
    return entry
