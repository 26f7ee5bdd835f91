"""Velocities from positions without a model of the joint: a tracking filter of third order."""

from __future__ import annotations

import math

from vsacontrol.plant import State

__all__ = ["StateTracker", "Tracker"]


class Tracker:
    """Follows one position with velocity and acceleration, without lag while the acceleration is constant.

    The critically damped alpha-beta-gamma filter: all its poles are at exp(-bandwidth T).

    Args:
        bandwidth_rad_s: its pole.
        period_s: T.
    """

    def __init__(self, bandwidth_rad_s: float, period_s: float) -> None:
        pole = math.exp(-bandwidth_rad_s * period_s)
        self._T = period_s
        self._alpha = 1.0 - pole**3
        self._beta = 1.5 * (1.0 - pole) ** 2 * (1.0 + pole)
        self._gamma = (1.0 - pole) ** 3
        self.rest(0.0)

    def rest(self, position: float) -> None:
        """Start anew at a standstill."""
        self._x, self._v, self._a = position, 0.0, 0.0

    def step(self, position: float, periods: int) -> None:
        """Take the next measurement, so many periods after the last one."""
        T = periods * self._T
        self._x += self._v * T + 0.5 * self._a * T * T
        self._v += self._a * T
        error = position - self._x
        self._x += self._alpha * error
        self._v += self._beta / self._T * error
        self._a += self._gamma / (self._T * self._T) * error

    def ahead(self, seconds: float) -> tuple[float, float]:
        """Position and velocity so much later than the last measurement."""
        x = self._x + self._v * seconds + 0.5 * self._a * seconds * seconds
        return x, self._v + self._a * seconds


class StateTracker:
    """The joint's state at the time when the next torque will act.

    Args:
        period_s: T.
        bandwidth_rad_s: of the filters.
        ahead_periods: from a sample to the middle of the period in which the torque that follows from it
            acts: the set-point is latched by the next SYNC and holds for one period.
    """

    def __init__(self, period_s: float, bandwidth_rad_s: float = 150.0, ahead_periods: float = 1.5) -> None:
        self._trackers = [Tracker(bandwidth_rad_s, period_s) for _ in range(3)]
        self._ahead_s = ahead_periods * period_s
        self._sequence: int | None = None
        self._longest = max(3, round(0.02 / period_s))

    def step(self, sequence: int, q: float, theta: tuple[float, ...]) -> State:
        """Take a sample; after a gap too long to carry on over, begin at a standstill."""
        periods = self._longest + 1 if self._sequence is None else sequence - self._sequence
        self._sequence = sequence
        for tracker, position in zip(self._trackers, (q, *theta), strict=True):
            if 0 < periods <= self._longest:
                tracker.step(position, periods)
            elif periods:
                tracker.rest(position)
        link, one, two = (tracker.ahead(self._ahead_s) for tracker in self._trackers)
        return State(link[0], link[1], (one[0], two[0]), (one[1], two[1]))
