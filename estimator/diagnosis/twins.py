"""What recordings leave open: effects of which every balance that there is says the same."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from estimator.choices import choice
from estimator.diagnosis.candidates import AGAIN
from estimator.diagnosis.hypothesis import Fitted, Keys
from estimator.diagnosis.problem import Problem
from estimator.effects import LIBRARY

__all__ = ["Twin", "twins"]


class Twin(NamedTuple):
    """Effects that a hypothesis holds, and those that may be there instead.

    Attributes:
        held, instead: they.
        measured: whether data may tell, where a fit of either leaves more than laws differ by.
    """

    held: Keys
    instead: Keys
    measured: bool


# One, the other, what tells them, whether the other may be the one too.
_TABLE = (
    # A loss c of the torque while the link drives leaves k and k (1 - c), the motor driving and driven; c/2
    # both ways with a stiffness of k (1 - c/2) leaves the same.
    (("back_driving_loss",), ("load_dependent_friction",), "link", True),
    (("motor_inertia",), ("torque_constant",), "link", False),  # one scale
    (("encoder_eccentricity",), ("kinematic_error",), "reaction", False),  # once a turn
    (("encoder_scale",), ("kinematic_error",), "turn", False),  # over a part of its period: a slope
    (("asymmetric_friction",), ("coulomb_friction", "torque_offset"), "", True),  # the sum
    (("backlash",), ("higher_order_stiffness",), "law", False),  # what bends otherwise looks like play
    (("gravity",), ("cogging",), "gear", False),  # once a turn, of a rigid joint's motor without a gear
)
_CONSTANTS = ("torque_offset", "deflection_offset")


def twins(fitted: Fitted, problem: Problem) -> Iterator[Twin]:
    """Yield what a hypothesis holds and what may be instead."""
    own = fitted.keys | _constants(fitted, problem)
    linked = problem.frames[0].linked and not problem.calibrating
    turned = max(float(np.ptp(frame.motors[0].link_position)) for frame in problem.frames) >= 2.0 * np.pi
    for one, other, told, both in _TABLE:
        for i, motor in enumerate(problem.model.motors):
            spring = motor.transmission
            law = spring.model != "polynomial" or bool(spring.parameters)
            geared = motor.flexible or (motor.gear_ratio or 1.0) != 1.0 or not turned
            known = {"link": linked, "law": law, "turn": turned, "gear": geared}
            if known.get(told, False):
                continue
            for here, there in ((one, other), (other, one))[: 1 + both]:
                held, instead = ({_key(name, i) for name in names} for names in (here, there))
                if held <= own:
                    again = {(name + AGAIN * ((name, i) in own - held), i) for name, i in instead}
                    yield Twin(frozenset(held), frozenset(again), told in ("reaction", "turn") and linked)


def _key(name: str, motor: int) -> tuple[str, int | None]:
    return name, None if LIBRARY[name].on_link else motor


def _constants(fitted: Fitted, problem: Problem) -> Keys:
    """Constant torques beside dry friction that may be part of it, where nothing ties the zeros: friction
    dissipates both ways, so they are smaller than it.
    """
    made = set()
    for place, term in enumerate(fitted.terms):
        name, motor = term.candidate.key
        if name != "coulomb_friction" or problem.frames[0].linked:
            continue
        free = [
            j for j, s in enumerate(fitted.slots)
            if s.kind == "everyday" and s.motor == motor and s.name in _CONSTANTS
        ]  # fmt: skip
        rows = problem.group % problem.equations == motor
        x = fitted.posterior.x[free] + np.array([fitted.slots[j].taken for j in free])
        size = abs(float(np.mean(fitted.regression.design[rows][:, free] @ x)))
        friction = fitted.terms[place].weights[0]
        if choice("law") * friction < size < friction:
            made.add(("torque_offset", motor))
    return frozenset(made)
