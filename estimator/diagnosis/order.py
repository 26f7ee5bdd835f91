"""Polynomials of open order: a higher order is part of the model, not a missing effect."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace

import numpy as np

from estimator.diagnosis.hypothesis import Fitted
from estimator.diagnosis.problem import Problem
from estimator.diagnosis.result import Finding
from estimator.model import HIGHEST_ORDER, JointModel, Transmission

__all__ = ["bends", "ordered"]


def _is_open(own: Transmission) -> bool:
    return own.model == "polynomial" and own.order is None and not own.parameters


def bends(model: JointModel, effects: Iterable[Finding]) -> bool:
    """Return whether a diagnosis has found a curve of the deflection, of which the order is open."""
    return any(
        (f.name == "higher_order_stiffness" or f.coordinates[:1] == ("deflection",))
        and _is_open(model.motors[f.motor or 0].transmission)
        for f in effects
    )


def ordered(
    model: JointModel, make: Callable[[JointModel, Problem | None], Problem]
) -> tuple[Problem, Fitted]:
    """Return the best fit; each open order is raised for as long as the evidence rises (eq 24).

    Args:
        model: the joint.
        make: the problem of a model, like another one.
    """
    problem = make(model, None)
    fitted = problem.null()
    for i, motor in enumerate(model.motors):
        if not _is_open(motor.transmission):
            continue
        for order in range(1, HIGHEST_ORDER + 1):
            own = replace(motor, transmission=replace(motor.transmission, order=order))
            motors = (*problem.model.motors[:i], own, *problem.model.motors[i + 1 :])
            one = make(replace(problem.model, motors=motors), problem)
            raised = one.null()
            closest = min((fitted, raised), key=lambda h: float(np.sum(np.log(h.posterior.sigma))))
            if order > 1 and raised.evidence(closest) <= fitted.evidence(closest):
                break
            problem, fitted = one, raised
    return problem, fitted
