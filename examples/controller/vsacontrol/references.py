"""What the joint is to do: smooth ways from one pair of position and stiffness to the next."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from vsacontrol.laws import Target

__all__ = ["WAYPOINTS", "Reference", "Waypoint"]

# Rest to rest in one unit of time with four derivatives that vanish at both ends.
_NINTH = (126.0, -420.0, 540.0, -315.0, 70.0)  # of x^5 … x^9


class Waypoint(NamedTuple):
    """Reach this position and stiffness in so many seconds, and rest there for some more."""

    way_s: float
    rest_s: float
    q_rad: float
    sigma_nm_rad: float


# The link moves up to 0.45 rad out of the vertical while the stiffness changes independently.
_TRACKING = (
    Waypoint(0.0, 0.0, 0.0, 0.6),
    Waypoint(1.0, 0.0, 0.4, 0.75),
    Waypoint(1.0, 0.0, -0.3, 0.55),
    Waypoint(0.8, 0.0, 0.3, 0.85),
    Waypoint(1.2, 0.0, 0.3, 0.6),  # stiffness alone
    Waypoint(1.0, 0.0, -0.45, 0.6),  # motion alone
    Waypoint(0.8, 0.0, 0.0, 0.5),
    Waypoint(0.7, 0.0, 0.4, 0.7),
    Waypoint(1.0, 0.5, -0.2, 0.8),
)

_REGULATION = (
    Waypoint(0.0, 1.0, 0.0, 0.6),
    Waypoint(0.4, 2.0, 0.4, 0.75),
    Waypoint(0.4, 2.0, -0.3, 0.55),
    Waypoint(0.4, 2.0, 0.3, 0.85),
    Waypoint(0.4, 2.0, 0.3, 0.6),
    Waypoint(0.4, 2.0, -0.4, 0.65),
)

# By control law.
WAYPOINTS = {"regulation": _REGULATION, "decoupling": _TRACKING}


def _blend(x: float) -> tuple[float, ...]:
    """The ninth-degree polynomial from 0 to 1, and its first four derivatives."""
    if not 0.0 < x < 1.0:
        return (float(x >= 1.0), 0.0, 0.0, 0.0, 0.0)
    values, factors = [], list(_NINTH)
    for order in range(5):
        values.append(sum(f * x ** (5 + k - order) for k, f in enumerate(factors)))
        factors = [f * (5 + k - order) for k, f in enumerate(factors)]
    return tuple(values)


class Reference:
    """Goes through waypoints; position and stiffness move together.

    Args:
        waypoints: in order; the first one is where it starts.
    """

    def __init__(self, waypoints: Sequence[Waypoint]) -> None:
        self.waypoints = tuple(waypoints)
        self.begins_s = [0.0]
        for waypoint in self.waypoints:
            self.begins_s.append(self.begins_s[-1] + waypoint.way_s + waypoint.rest_s)

    @property
    def length_s(self) -> float:
        """When it ends."""
        return self.begins_s[-1]

    def index(self, time_s: float) -> int:
        """The waypoint that is headed for, or rested at."""
        last = len(self.waypoints) - 1
        return next((k for k in range(last) if time_s < self.begins_s[k + 1]), last)

    def settled(self, time_s: float, after_s: float) -> bool:
        """Whether it has been resting at a waypoint for so long."""
        index = self.index(time_s)
        return time_s - self.begins_s[index] >= self.waypoints[index].way_s + after_s

    def at(self, time_s: float) -> Target:
        """The target at one time."""
        index = self.index(time_s)
        way_s, _, q1, sigma1 = self.waypoints[index]
        _, _, q0, sigma0 = self.waypoints[max(0, index - 1)]
        elapsed_s = time_s - self.begins_s[index]
        shares = _blend(elapsed_s / way_s if way_s > 0.0 else 1.0)
        scaled = [share / max(way_s, 1e-6) ** n for n, share in enumerate(shares)]
        q = [(q1 - q0) * share for share in scaled]
        sigma = [(sigma1 - sigma0) * share for share in scaled]
        return Target((q0 + q[0], q[1], q[2], q[3], q[4]), (sigma0 + sigma[0], sigma[1], sigma[2]))
