"""Polynomials of open order: a higher order is part of the model, not a missing effect."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

from estimator.diagnosis.result import Finding
from estimator.model import JointModel, Motor

__all__ = ["raised"]


def raised(model: JointModel, effects: Iterable[Finding]) -> JointModel | None:
    """Return the model with open orders raised to those found by a diagnosis (eq 24).

    Args:
        model: as it was diagnosed.
        effects: what the diagnosis has found missing.

    Returns:
        The model with raised orders; None if there is nothing to raise.
    """
    powers = {
        finding.motor: finding.parameters["power"]
        for finding in effects
        if finding.name == "higher_order_stiffness"
    }
    motors = [_raised(motor, powers.get(index)) for index, motor in enumerate(model.motors)]
    return replace(model, motors=tuple(motors)) if tuple(motors) != model.motors else None


def _raised(motor: Motor, power: object) -> Motor:
    transmission = motor.transmission
    is_open = (
        transmission.model == "polynomial" and transmission.order is None and not transmission.parameters
    )
    if not is_open or not isinstance(power, float):
        return motor
    return replace(motor, transmission=replace(transmission, order=round((power + 1) / 2)))
