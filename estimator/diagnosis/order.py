"""What a joint file leaves open of its laws, which is no missing effect: a polynomial's order, and over which
velocity dry friction changes its sign.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace

import numpy as np

from estimator.choices import choice
from estimator.diagnosis.heldout import Held
from estimator.diagnosis.hypothesis import Fitted
from estimator.diagnosis.problem import Problem
from estimator.diagnosis.result import Finding
from estimator.effects import open_smoothing, sharpened
from estimator.model import HIGHEST_ORDER, JointModel, Transmission
from estimator.ranges import range_of
from estimator.transmissions import UNKNOWN

__all__ = ["bare", "bends", "ordered", "ordered_beside", "sharp"]

Make = Callable[[JointModel, Problem | None], Problem]
_CURVES = ("higher_order_stiffness", "backlash")  # odd, as a polynomial is


def _is_open(own: Transmission) -> bool:
    return own.model == "polynomial" and own.order is None and not own.parameters


def bends(model: JointModel, effects: Iterable[Finding]) -> bool:
    """Return whether a diagnosis has found a curve of the deflection, of which the order is open."""
    return any(
        (f.name in _CURVES or f.coordinates[:1] == ("deflection",))
        and _is_open(model.motors[f.motor or 0].transmission)
        for f in effects
    )


def bare(model: JointModel) -> JointModel:
    """Return the joint without transmission parameters."""

    def without(own: Transmission) -> Transmission:
        name = "polynomial" if own.model == UNKNOWN else own.model
        return replace(own, model=name, parameters={}, covariance=None)

    return replace(
        model, motors=tuple(replace(m, transmission=without(m.transmission)) for m in model.motors)
    )


def sharp(model: JointModel, make: Make) -> float | None:
    """Return over which velocity declared dry friction changes its sign, rad/s: the default, or what noise
    resolves and softer steps, whichever explains most; None: nothing is left out.

    A motor at rest is held by any torque up to its friction, which a smoother law does not have.
    """
    if not open_smoothing(model):
        return None
    problem = make(model, None)
    steps = problem.smoothing_rad_s * choice("softer") ** np.linspace(0.0, 2.0, 5)
    fits = {None: problem.null()} | {
        float(one): make(sharpened(model, float(one)), problem).null() for one in steps if one > 0.0
    }
    closest = min(fits.values(), key=lambda h: float(np.sum(np.log(h.posterior.sigma))))
    return max(fits, key=lambda one: fits[one].evidence(closest))


def ordered(model: JointModel, make: Make) -> tuple[Problem, Fitted]:
    """Return the best fit; each open order is raised for as long as the evidence rises (eq 24).

    Args:
        model: the joint.
        make: the problem of a model, like another one.
    """
    problem = make(model, None)
    found = problem, problem.null()
    for i in _open(model):
        orders = _orders(found[0], i, make, None)
        found = next(orders)
        for problem, raised in orders:
            closest = min((found[1], raised), key=lambda h: float(np.sum(np.log(h.posterior.sigma))))
            if raised.evidence(closest) <= found[1].evidence(closest):
                break
            found = problem, raised
    return found


def ordered_beside(model: JointModel, make: Make, hold: Callable[[Problem], Held], beside: Fitted) -> Problem:
    """Return the problem with each open order the lowest that held-out data do not surely raise.

    Args:
        model: the joint.
        make: the problem of a model, like another one.
        hold: the data held out of a problem.
        beside: a hypothesis, of which all effects but curves of the deflection are there too.
    """
    problem = make(model, None)
    for i in _open(model):
        orders = [(hold(one), fitted) for one, fitted in _orders(problem, i, make, beside)]
        best, most = max(orders, key=lambda pair: float(np.mean(pair[0].scores(pair[1]))))
        problem = next(held.problem for held, fitted in orders if not best.confirms(most, fitted, held))
    return problem


def _open(model: JointModel) -> list[int]:
    return [i for i, motor in enumerate(model.motors) if _is_open(motor.transmission)]


def _orders(problem: Problem, i: int, make: Make, beside: Fitted | None) -> Iterator[tuple[Problem, Fitted]]:
    """The fit of each order of a motor's polynomial whose coefficients a joint file holds."""
    model, most = problem.model, range_of("coefficients_nm_rad").most
    for order in range(1, HIGHEST_ORDER + 1):
        own = replace(model.motors[i], transmission=replace(model.motors[i].transmission, order=order))
        one = make(replace(model, motors=(*model.motors[:i], own, *model.motors[i + 1 :])), problem)
        fitted = one.null()
        terms = () if beside is None else tuple(t for t in beside.terms if not t.candidate.bends)
        if beside is not None and terms:
            fitted = one.fit(terms, fitted.base, beside.corrections)
        if order > 1 and float(np.max(np.abs(fitted.moved_base(one.frames[0]).alpha[i]))) > most:
            return
        yield one, fitted
