"""The two control laws. Both get the springs as a model: the true one, a wrong one, or the estimated one.

Signs are the paper's: phi_i = q - theta_i, tau_e,i acts on motor i as +tau_e,i and on the link as -tau_e,i.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple, Protocol

from vsacontrol.plant import Joint, State, deflections
from vsacontrol.springs import Law

__all__ = ["ControlLaw", "Decoupler", "Regulator", "Target"]


class Target(NamedTuple):
    """What is wanted now.

    Attributes:
        q: link position and its first four derivatives by time, rad/s^n.
        sigma: total stiffness and its first two derivatives, N·m/rad/s^n.
    """

    q: tuple[float, float, float, float, float]
    sigma: tuple[float, float, float]


class ControlLaw(Protocol):
    """State and target in, motor torques out."""

    def torques(self, state: State, target: Target, springs: tuple[Law, ...]) -> tuple[float, float]:
        """Torque of each motor, N·m, joint side."""


@dataclass(slots=True, kw_only=True)
class Regulator:
    """Position and stiffness regulation: PD on the motors with on-line gravity compensation.

        theta_d,i = q_d - phi*_i(q, sigma_d)
        tau_i = Kp (theta_d,i - theta_i) - Kd theta_i' - tau_e,i(phi*_i)

    where phi*_1, phi*_2 hold gravity at the *present* link position with the wanted total stiffness,
    tau_e,1 + tau_e,2 = -g(q) and sigma_1 + sigma_2 = sigma_d, solved on line with the spring model. In the
    steady state q = q_d and sigma_t = sigma_d, if the model is right.

    Source: De Luca, Siciliano, Zollo, "PD control with on-line gravity compensation for robots with elastic
    joints: Theory and experiments", Automatica 41 (2005); there K^-1 g(q) shifts the motor's reference of a
    joint with one constant stiffness. Two nonlinear transmissions put phi* in its place, which is what the
    paper asks for in PD regulation of the VSA-II's two motors (its introduction, [3]).

    Attributes:
        joint: constants.
        kp_nm_rad: Kp.
        kd_nm_s_rad: Kd.
    """

    joint: Joint
    kp_nm_rad: float = 0.2
    kd_nm_s_rad: float = 0.02
    _phi: tuple[float, float] = (0.5, -0.5)

    def torques(self, state: State, target: Target, springs: tuple[Law, ...]) -> tuple[float, float]:
        """See the class."""
        self._phi = deflections(springs, -self.joint.gravity(state.q), target.sigma[0], self._phi)
        result = []
        for law, phi, theta, rate in zip(springs, self._phi, state.theta, state.dtheta, strict=True):
            push = self.kp_nm_rad * (target.q[0] - phi - theta) - self.kd_nm_s_rad * rate
            result.append(push - law(phi).torque)
        return result[0], result[1]


@dataclass(slots=True, kw_only=True)
class Decoupler:
    """Simultaneous motion and stiffness decoupling by static state feedback linearization.

    The outputs q and sigma_t have relative degrees 4 and 2, six in all: the whole state. Differentiating
    eq 6 twice and eq 11 twice until the torques appear, with phi_i'' = q'' - theta_i'' and eq 7:

        [q''''; sigma_t''] = b(x) + A(x) [tau_1; tau_2]
        A = [sigma_1 / (M B_1), sigma_2 / (M B_2); -sigma_1' / B_1, -sigma_2' / B_2]

    so tau = A^-1 (v - b) makes two chains of integrators, and v places their poles:

        v_1 = q_d'''' + k3 (q_d''' - q''') + k2 (q_d'' - q'') + k1 (q_d' - q') + k0 (q_d - q)
        v_2 = sigma_d'' + h1 (sigma_d' - sigma_t') + h0 (sigma_d - sigma_t)

    all poles of the first chain at -`position_rad_s`, of the second at -`stiffness_rad_s`; q'', q''' and
    sigma_t are computed from the state with the spring model and its derivatives sigma', sigma''. A is
    singular where sigma_1'/sigma_1 = sigma_2'/sigma_2: without pretension; `smallest` keeps clear of it.

    Source: De Luca, Flacco, Bicchi, Schiavi, "Nonlinear decoupled motion-stiffness control and collision
    detection/reaction for the VSA-II variable stiffness device", IROS 2009, the law that the paper's
    introduction names as the one which needs the stiffnesses "as well as their first and second
    derivatives"; see also Palli, Melchiorri, De Luca, "On the feedback linearization of robots with variable
    joint stiffness", ICRA 2008.

    Attributes:
        joint: constants.
        position_rad_s: fourfold pole of the motion.
        stiffness_rad_s: double pole of the stiffness.
        smallest: |det A| B_1 B_2 M below which the torques are not a number, (N·m)²/rad³.
    """

    joint: Joint
    position_rad_s: float = 18.0
    stiffness_rad_s: float = 25.0
    smallest: float = 1e-3

    def torques(self, state: State, target: Target, springs: tuple[Law, ...]) -> tuple[float, float]:
        """See the class; NaN where the decoupling is singular."""
        joint = self.joint
        M, Dq = joint.link_inertia_kg_m2, joint.link_damping_nm_s_rad
        B, D = joint.motor_inertia_kg_m2, joint.motor_damping_nm_s_rad
        q, dq = state.q, state.dq
        sine, cosine = joint.gravity_nm * math.sin(q), joint.gravity_nm * math.cos(q)
        points = [law(q - theta) for law, theta in zip(springs, state.theta, strict=True)]
        rates = [dq - rate for rate in state.dtheta]

        q2 = -(Dq * dq + sine + points[0].torque + points[1].torque) / M
        spread = sum(p.stiffness * r for p, r in zip(points, rates, strict=True))
        q3 = -(Dq * q2 + cosine * dq + spread) / M
        # phi_i'' without the motor's torque, which enters through A
        free = [q2 - (p.torque - d * w) / b for p, w, b, d in zip(points, state.dtheta, B, D, strict=True)]
        pulled = sum(p.slope * r * r + p.stiffness * f for p, r, f in zip(points, rates, free, strict=True))
        b1 = -(Dq * q3 + cosine * q2 - sine * dq * dq + pulled) / M
        b2 = sum(p.bend * r * r + p.slope * f for p, r, f in zip(points, rates, free, strict=True))

        sigma = points[0].stiffness + points[1].stiffness
        dsigma = sum(p.slope * r for p, r in zip(points, rates, strict=True))
        v1 = self._motion(target, (q, dq, q2, q3)) - b1
        h = self.stiffness_rad_s
        v2 = target.sigma[2] + 2.0 * h * (target.sigma[1] - dsigma) + h * h * (target.sigma[0] - sigma) - b2
        # A^-1 by hand, with the rows scaled by M and -1 and the columns by B
        s1, s2, c1, c2 = points[0].stiffness, points[1].stiffness, points[0].slope, points[1].slope
        determinant = s1 * c2 - s2 * c1
        if abs(determinant) < self.smallest:
            return math.nan, math.nan
        u1, u2 = M * v1, -v2
        return B[0] * (u1 * c2 - s2 * u2) / determinant, B[1] * (s1 * u2 - c1 * u1) / determinant

    def _motion(self, target: Target, link: tuple[float, float, float, float]) -> float:
        p = self.position_rad_s
        gains = (p**4, 4.0 * p**3, 6.0 * p * p, 4.0 * p)
        errors = (wanted - found for wanted, found in zip(target.q, link, strict=False))
        return target.q[4] + sum(gain * error for gain, error in zip(gains, errors, strict=True))
