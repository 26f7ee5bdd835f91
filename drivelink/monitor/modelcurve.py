"""Stiffness over deflection by the model document: the fitted curve beside the live one."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from typing import Any

import numpy as np

from estimator.errors import EstimatorError
from estimator.transmissions import MODELS

_POINTS = 60


def model_curves(
    model: Mapping[str, Any], curves: list[list[tuple[float, float, float]]]
) -> list[list[tuple[float, float]]]:
    """Return the stiffness of each transmission by the model in use, over the deflections seen so far.

    Args:
        curves: (deflection, stiffness, standard deviation) of each transmission, by deflection.

    Returns:
        (deflection, stiffness) of each, rad, N·m/rad; empty where its parameters are not known.
    """
    motors = model.get("motors")
    known = motors if isinstance(motors, list) else ()
    return [_curve(motor, points) for motor, points in zip(known, curves, strict=False)]


def _curve(motor: Any, points: list[tuple[float, float, float]]) -> list[tuple[float, float]]:
    # The document comes from the network: whatever cannot be evaluated is not drawn.
    with suppress(EstimatorError, KeyError, TypeError, ValueError, AttributeError, OverflowError):
        transmission = motor["transmission"]
        parameters = {
            k: tuple(v) if isinstance(v, list) else v for k, v in transmission["parameters"].items()
        }
        if points and parameters:
            law = MODELS[transmission["model"]]
            phi = np.linspace(points[0][0], points[-1][0], _POINTS)
            values = law.stiffness(phi, law.alpha(parameters))
            if np.all(np.isfinite(values)):
                return list(zip(phi.tolist(), values.tolist(), strict=True))
    return []
