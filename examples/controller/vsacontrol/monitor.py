"""Does a motor still do what the daemon's model says? A fast answer, beside the daemon's thorough one.

The paper's residual (eq 14) is a first-order image of the flexibility torque. What the daemon's model says of
the same torque, sent through the same filter, must agree with it; where it does not, some torque acts at the
motor that is undeclared. The daemon reports what touches the link.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from vsacontrol.plant import Joint

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
    """The filtered difference between measured and modelled flexibility torque, per motor.

    With y = B theta' + D theta - int tau, the residual's exact discretisation is r_k = a r_(k-1) + (1 - a)
    (y_k - y_(k-1)) / T, a = exp(-K T); the difference quotient is taken symmetrically about a SYNC, where
    the torques held before and after it act by halves.

    Args:
        joint: the declared inertias and dampings.
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
        self._differences = [0.0, 0.0]

    def step(self, moment: Moment) -> float:
        """Take one cycle.

        Returns:
            The size of the difference, the larger one of two motors, N·m; 0 until known.
        """
        past = self._past
        known = math.isfinite(moment.q + sum(moment.theta) + sum(moment.tau) + sum(moment.modelled))
        if not known or (past and moment.sequence != past[-1].sequence + 1):
            self.restart()
            past = self._past
        elif len(past) == 2:
            self._compare(past[0], past[1], moment)
        self._past = [*past, moment][-2:] if known else []
        return max(map(abs, self._differences))

    def _compare(self, before: Moment, at: Moment, after: Moment) -> None:
        """B theta'' + D theta' - tau at the middle one of three cycles against tau_e as modelled."""
        joint, T = self._joint, self._T
        motors = zip(joint.motor_inertia_kg_m2, joint.motor_damping_nm_s_rad, strict=True)
        for i, (B, D) in enumerate(motors):
            a, b, c = before.theta[i], at.theta[i], after.theta[i]
            moved = B * (c - 2.0 * b + a) / (T * T) + D * (c - a) / (2.0 * T)
            difference = moved - 0.5 * (before.tau[i] + at.tau[i]) - at.modelled[i]
            self._differences[i] += (1.0 - self._keep) * (difference - self._differences[i])
