"""What the controller knows of the joint besides its springs, and the state it steers by."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

from drivelink.jointfile import JointFile
from vsacontrol.springs import Law

__all__ = ["Joint", "State", "deflections", "joint_of"]

_NEWTON_STEPS = 30
_CONVERGED = 1e-9
_LARGEST_STEP_RAD = 0.2
_LARGEST_RAD = 1.1


class State(NamedTuple):
    """The joint at one instant.

    Attributes:
        q: link position, rad.
        dq: link velocity, rad/s.
        theta: motor positions, rad, joint side.
        dtheta: motor velocities, rad/s.
    """

    q: float
    dq: float
    theta: tuple[float, float]
    dtheta: tuple[float, float]


@dataclass(frozen=True, slots=True, kw_only=True)
class Joint:
    """The declared constants of eqs 6, 7 for two motors in antagonistic arrangement.

    Attributes:
        motor_inertia_kg_m2: B_1, B_2.
        motor_damping_nm_s_rad: D_1, D_2.
        link_inertia_kg_m2: M.
        link_damping_nm_s_rad: D_q.
        gravity_nm: g(q) = gravity_nm sin(q).
    """

    motor_inertia_kg_m2: tuple[float, float]
    motor_damping_nm_s_rad: tuple[float, float]
    link_inertia_kg_m2: float
    link_damping_nm_s_rad: float
    gravity_nm: float

    def gravity(self, q: float) -> float:
        """The torque g(q), N·m."""
        return self.gravity_nm * math.sin(q)


def joint_of(file: JointFile) -> Joint:
    """The constants that a joint file declares.

    Raises:
        ValueError: not an antagonistic joint with known link dynamics.
    """
    link = file.link.dynamics
    if file.arrangement != "antagonistic" or link is None:
        raise ValueError(f'{file.name}: expected arrangement = "antagonistic" and [link.dynamics]')
    one, two = file.motor
    return Joint(
        motor_inertia_kg_m2=(one.inertia_kg_m2, two.inertia_kg_m2),
        motor_damping_nm_s_rad=(one.viscous_damping_nm_s_rad, two.viscous_damping_nm_s_rad),
        link_inertia_kg_m2=link.inertia_kg_m2,
        link_damping_nm_s_rad=link.viscous_damping_nm_s_rad,
        gravity_nm=link.gravity_nm,
    )


def deflections(
    springs: tuple[Law, ...], torque_nm: float, stiffness_nm_rad: float, start: tuple[float, float]
) -> tuple[float, float]:
    """phi_1 > phi_2 with tau_e,1 + tau_e,2 = torque and sigma_1 + sigma_2 = stiffness, by Newton's method.

    Where there is no such pair (less stiffness than the springs have at rest), the nearest found is returned.

    Args:
        springs: the two laws.
        torque_nm: total flexibility torque (eq 9).
        stiffness_nm_rad: total stiffness (eq 11).
        start: where the search begins; the last solution saves iterations.
    """
    first, second = springs
    x, y = start
    for _ in range(_NEWTON_STEPS):
        a, b = first(x), second(y)
        e, f = torque_nm - a.torque - b.torque, stiffness_nm_rad - a.stiffness - b.stiffness
        determinant = a.stiffness * b.slope - b.stiffness * a.slope
        if abs(e) + abs(f) < _CONVERGED or abs(determinant) < 1e-12:
            break
        dx = (e * b.slope - b.stiffness * f) / determinant
        dy = (a.stiffness * f - a.slope * e) / determinant
        shrink = min(1.0, _LARGEST_STEP_RAD / max(abs(dx), abs(dy), 1e-12))
        x = max(-_LARGEST_RAD, min(_LARGEST_RAD, x + shrink * dx))
        y = max(-_LARGEST_RAD, min(_LARGEST_RAD, y + shrink * dy))
    return x, y
