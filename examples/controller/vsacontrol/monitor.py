"""Does the joint still do what the daemon's model says? A fast answer, beside the daemon's thorough one.

The paper's residual (eq 14) is a first-order image of the flexibility torque. What the daemon's model says of
the same torque, sent through the same filter, must agree with it; where it does not, some torque acts that
nobody declared. The link's balance (eq 6) is looked at in the same way: an obstacle, somebody
who pushes it.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from vsacontrol.plant import Joint

_STRIDE = 2  # periods of a difference at the link: its counts are coarse against its inertia

__all__ = ["MismatchMonitor", "Moment"]


class Moment(NamedTuple):
    """One cycle, as far as it is needed here.

    Attributes:
        sequence: of the SYNC.
        q: link position, rad.
        theta: motor positions, rad.
        tau: motor torques that act from this SYNC to the next, N·m.
        modelled: tau_e of each transmission by the daemon's model, N·m.
    """

    sequence: int
    q: float
    theta: tuple[float, ...]
    tau: tuple[float, ...]
    modelled: tuple[float, ...]


class MismatchMonitor:
    """The filtered difference between measured and modelled flexibility torque, per motor and of the link.

    With y = B theta' + D theta - int tau, the residual's exact discretisation is r_k = a r_(k-1) + (1 - a)
    (y_k - y_(k-1)) / T, a = exp(-K T); the difference quotient is taken symmetrically about a SYNC, where
    the torques held before and after it act by halves.

    Args:
        joint: the declared inertias, dampings and gravity.
        period_s: T.
        gain_rad_s: K of eq 14.
    """

    def __init__(self, joint: Joint, period_s: float, gain_rad_s: float = 200.0) -> None:
        self._joint = joint
        self._T = period_s
        self._keep = math.exp(-gain_rad_s * period_s)
        self.restart()

    def restart(self) -> None:
        """Forget the past: positions start anew, or there is a gap."""
        self._past: list[Moment] = []
        self._differences = [0.0, 0.0, 0.0]

    def step(self, moment: Moment) -> tuple[float, float]:
        """Take one cycle.

        Returns:
            The size of the difference at the motors (the larger one) and at the link, N·m; 0 until known.
        """
        past = self._past
        known = math.isfinite(moment.q + sum(moment.theta) + sum(moment.tau) + sum(moment.modelled))
        if not known or (past and moment.sequence != past[-1].sequence + 1):
            self.restart()
            past = self._past
        elif len(past) == _STRIDE * 2:
            self._motors(past[-2], past[-1], moment)
            self._link(past[0], past[_STRIDE], moment)
        self._past = [*past, moment][-_STRIDE * 2 :] if known else []
        one, two, link = map(abs, self._differences)
        return max(one, two), link

    def _motors(self, before: Moment, at: Moment, after: Moment) -> None:
        joint = self._joint
        motors = zip(joint.motor_inertia_kg_m2, joint.motor_damping_nm_s_rad, strict=True)
        for i, (B, D) in enumerate(motors):
            moved = self._inertial(B, D, self._T, (before.theta[i], at.theta[i], after.theta[i]))
            found = moved - 0.5 * (before.tau[i] + at.tau[i])
            self._note(i, found - at.modelled[i])

    def _link(self, before: Moment, at: Moment, after: Moment) -> None:
        joint = self._joint
        M, Dq = joint.link_inertia_kg_m2, joint.link_damping_nm_s_rad
        moved = self._inertial(M, Dq, _STRIDE * self._T, (before.q, at.q, after.q))
        self._note(2, -moved - joint.gravity(at.q) - sum(at.modelled))

    @staticmethod
    def _inertial(J: float, D: float, step_s: float, x: tuple[float, float, float]) -> float:
        """J x'' + D x' at the middle one of three positions."""
        return J * (x[2] - 2.0 * x[1] + x[0]) / (step_s * step_s) + D * (x[2] - x[0]) / (2.0 * step_s)

    def _note(self, which: int, difference: float) -> None:
        self._differences[which] += (1.0 - self._keep) * (difference - self._differences[which])
