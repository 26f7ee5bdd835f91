"""Inertias and gravity that are declared wrong by any factor: competitors of those that are declared."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from estimator.choices import choice, whole
from estimator.diagnosis.hypothesis import Fitted
from estimator.diagnosis.law_parameters import start, with_flexibility
from estimator.diagnosis.order import Make
from estimator.diagnosis.problem import Problem
from estimator.gate import judge
from estimator.model import JointModel, LinkDynamics
from estimator.priors import PRIORS
from estimator.ranges import range_of
from estimator.sample import Record

__all__ = ["asked_for", "asks", "believed", "moved_link"]


def asked_for(records: Sequence[Record], model: JointModel) -> JointModel:
    """Return the joint with the motors' inertias that the gate says all recordings ask for, as widely known
    as one that was declared wrong; the torque is the anchor then.
    """
    each = asks(records, model)
    if not all(each):
        return model
    factors = np.exp(np.mean(np.log(each), axis=0)).tolist()
    motors = tuple(
        motor
        if factor == 1.0
        else replace(
            motor,
            inertia_kg_m2=factor * motor.inertia_kg_m2,
            inertia_std_relative=PRIORS["anchor"].std,
        )
        for motor, factor in zip(model.motors, factors, strict=True)
    )
    return replace(model, motors=motors)


def asks(records: Sequence[Record], model: JointModel) -> list[tuple[float, ...]]:
    """Return which share of the motors' declared inertias each recording asks for (`Judgement.inertia`)."""
    return [judge(one, model).inertia for one in records]


def believed(model: JointModel, make: Make) -> JointModel:
    """Return the joint as declared, or with the link's numbers as the recordings have them and as wide as
    they may be, where the declared ones are less probable: one link in some hundreds is declared wrong by any
    factor (`choices`: the gate's fault, and free inertia).

    The motor's inertia stays the anchor.
    """
    problem = make(model, None)
    if model.link is None or not problem.frames[0].linked:
        return model
    declared, link = problem.null(), _as_motors_say(model.link, problem)
    for _ in range(whole("newton_steps")):
        wide = replace(model, link=_widened(link, problem))
        free = make(wide, problem).null()
        moved = moved_link(link, *_numbers(free))
        if moved is None:
            break
        if abs(math.log(moved.inertia_kg_m2 / link.inertia_kg_m2)) < choice("converged"):
            return wide if _confirmed(free, declared, problem) else model
        link = moved
    return model


def _as_motors_say(declared: LinkDynamics, problem: Problem) -> LinkDynamics:
    """The link by least squares of what its springs carry by the motors' balances; as it is declared where
    that leaves no inertia.
    """
    frame = max(problem.frames, key=lambda one: one.rows)
    base = start(frame)
    here = with_flexibility(frame, base)
    carried = sum(c.flexibility_torque for c, pulls in zip(here.motors, here.pulls, strict=True) if pulls)
    c = here.motors[0]
    paths = (c.link_acceleration, c.link_velocity, np.sin(c.link_position), np.cos(c.link_position))
    columns = frame.project(np.stack([*paths, np.ones_like(c.time)]))
    target = frame.project(frame.external - carried)
    inertia, damping, a, b, _ = np.linalg.lstsq(columns.T, target, rcond=1e-9)[0].tolist()
    nothing = replace(declared, inertia_kg_m2=range_of("inertia_kg_m2").least, viscous_damping_nm_s_rad=0.0)
    return moved_link(replace(nothing, gravity_nm=0.0), inertia, damping, (a, b)) or declared


def _confirmed(free: Fitted, declared: Fitted, problem: Problem) -> bool:
    """Whether other numbers than declared explain decisively more, and more than filters leave anyway."""
    gone = float(np.sum(declared.posterior.sigma**2 - free.posterior.sigma**2))
    if gone < (choice("floor") * problem.torque_rms) ** 2:
        return False
    closest = min((declared, free), key=lambda h: float(np.sum(np.log(h.posterior.sigma))))
    odds = free.evidence(closest) - declared.evidence(closest)
    return odds > choice("fault") + choice("free_inertia")


def moved_link(
    link: LinkDynamics, inertia: float, damping: float, gravity: tuple[float, ...]
) -> LinkDynamics | None:
    """Return link dynamics with so much more of each (kg·m², N·m·s/rad, N·m times sin q and cos q); None: no
    inertia is left.
    """
    if link.inertia_kg_m2 + inertia < range_of("inertia_kg_m2").least:
        return None
    link = replace(
        link,
        inertia_kg_m2=link.inertia_kg_m2 + inertia,
        viscous_damping_nm_s_rad=max(link.viscous_damping_nm_s_rad + damping, 0.0),
    )
    if not gravity:
        return link
    a = link.gravity_nm * math.cos(link.gravity_phase_rad) + gravity[0]
    b = link.gravity_nm * math.sin(link.gravity_phase_rad) + gravity[1]
    sign = -1.0 if link.gravity_nm < 0.0 else 1.0
    return replace(link, gravity_nm=sign * math.hypot(a, b), gravity_phase_rad=math.atan2(sign * b, sign * a))


def _numbers(fitted: Fitted) -> tuple[float, float, tuple[float, ...]]:
    """What a hypothesis adds to the link's declared numbers."""
    each = [
        fitted.total("everyday", name, None) for name in ("link_inertia", "link_viscous_damping", "gravity")
    ]
    inertia, damping = (sum(parts) for parts in each[:2])
    return inertia, damping, tuple(each[2])


def _widened(link: LinkDynamics, problem: Problem) -> LinkDynamics:
    """The link with deviations of its numbers by which each may take as much torque as a transmission."""
    torque = PRIORS["transmission"].std * problem.torque_rms
    paths = [frame.motors[0] for frame in problem.frames]
    sizes = [
        max(float(np.std(getattr(path, name))) for path in paths)
        for name in ("link_acceleration", "link_velocity")
    ]
    inertia, damping = (torque / max(size, 1e-300) for size in sizes)
    return replace(
        link, inertia_std_kg_m2=inertia, viscous_damping_std_nm_s_rad=damping, gravity_std_nm=torque
    )
