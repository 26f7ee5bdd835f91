"""Shared parts of the effects."""

from __future__ import annotations

import math

from sim.effects.assembly import Described, Values
from sim.effects.memory import Slip
from sim.errors import SimError
from sim.plant import Dry

SMOOTHING: dict[str, Described] = {
    "smoothing_rad_s": ("velocity below which an oil film carries the load; 0: dry, it sticks", 0.0)
}
SLIP: dict[str, Described] = {
    "torque_nm": "torque once everything slides",
    "displacement_rad": ("displacement over which it builds up", 0.01),
    "exponent": ("n of the law (1: Dahl, 2: Bouc-Wen, 50: a spring that slips)", 2.0),
    "shape": ("s of the law (1: Dahl, 0.5: Bouc-Wen)", 0.5),
    "elements": ("elements side by side, their scales a factor of two apart", 3.0),
}


def at_speed(level: Dry, smoothing: float) -> Dry:
    """Return the level of dry friction, smoothed to zero at standstill over `smoothing`
    (rad/s); 0: unchanged.
    """
    if smoothing <= 0.0:
        return level

    def lubricated(position: float, velocity: float, load: float, time: float) -> float:
        return level(position, velocity, load, time) * abs(velocity) / math.hypot(velocity, smoothing)

    return lubricated


def not_negative(values: Values, name: str) -> float:
    """Return that parameter.

    Raises:
        SimError: it is negative.
    """
    if values[name] < 0.0:
        raise SimError(f"{name}: expected a number >= 0, got {values[name]!r}")
    return values[name]


def slip(values: Values) -> Slip:
    """Return the element with memory that `SLIP` describes."""
    return Slip(*(values[name] for name in SLIP))


def wave(sine: float, cosine: float, periods: float) -> tuple[float, float]:
    """Return sine sin(n x) + cosine cos(n x) as amplitude and phase of one sine."""
    if periods <= 0.0:
        raise SimError(f"periods_per_rev: expected a number > 0, got {periods!r}")
    return math.hypot(sine, cosine), math.atan2(cosine, sine)
