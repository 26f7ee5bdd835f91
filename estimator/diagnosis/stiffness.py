"""Stiffness over deflection before and after a diagnosis, with the uncertainty of both."""

from __future__ import annotations

import numpy as np

from estimator.diagnosis.covariance import hac_covariance
from estimator.diagnosis.hypothesis import Fitted, Problem
from estimator.diagnosis.result import StiffnessCurve
from estimator.sample import FloatArray

__all__ = ["stiffness_curves"]

_POINTS = 121
_OUTERMOST = 0.99  # quantile of the deflections: what is beyond is a few samples


def stiffness_curves(problem: Problem, before: Fitted, after: Fitted) -> tuple[StiffnessCurve, ...]:
    """One curve for each flexible transmission, over the deflections of the first recording."""
    frame, made = problem.frames[0], []
    for i, motor in enumerate(problem.model.motors):
        if not motor.flexible:
            continue
        reach = float(np.quantile(np.abs(frame.motors[i].deflection), _OUTERMOST))
        phi = np.linspace(-reach, reach, _POINTS)
        made.append(
            StiffnessCurve(i, phi, *_stiffness(problem, before, i, phi), *_stiffness(problem, after, i, phi))
        )
    return tuple(made)


def _stiffness(
    problem: Problem, fitted: Fitted, motor: int, phi: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """(stiffness, standard deviation) of one motor's transmission."""
    model = fitted.base.models(problem.frames[0])[motor]
    nothing = np.full_like(phi, np.nan)
    if model is None:
        return nothing, nothing
    mine = [j for j, slot in enumerate(fitted.slots) if slot.kind == "base" and slot.motor == motor]
    alpha = np.array([fitted.slots[j].taken + fitted.posterior.x[j] for j in mine])
    own = hac_covariance(problem, fitted)[np.ix_(mine, mine)]
    slopes = model.stiffness_jacobian(phi, alpha)
    variance = np.einsum("ij,jk,ik->i", slopes, own, slopes)
    return np.asarray(model.stiffness(phi, alpha)), np.sqrt(np.maximum(variance, 0.0))
