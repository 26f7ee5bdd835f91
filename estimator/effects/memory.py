"""Friction and hysteresis with memory: one element of the Dahl, Bouc-Wen and elastic-slip family."""

from __future__ import annotations

import math
from bisect import bisect_right
from functools import lru_cache
from types import ModuleType
from typing import Any

import numpy as np

from estimator.sample import FloatArray

__all__ = ["STOP_EXPONENT", "advance", "trace"]

# From this exponent on the element is elastic up to its limit and then slips (Jenkins element, "stop").
STOP_EXPONENT = 50.0
_FULL = 1e-9  # distance from full sliding at which a law's curve ends
_POINTS = 8000


def advance(state: Any, increment: Any, exponent: float, shape: float, m: ModuleType = math) -> Any:
    """Carry the state z of one element over a displacement increment.

    dz/dx = 1 - |z|^n (beta sgn(u z) + 1 - beta), |z| <= 1, with u = dx/d. n = 1, beta = 1 is Dahl's law,
    n >= 1, beta = 0.5 is Bouc-Wen's, n >= STOP_EXPONENT an elastic-slip element. With y = z sgn(u) the law is
    dy/d|u| = (1 - y) k(y); k is taken at the middle of the step, so Dahl's law is exact for any increment.

    Args:
        state: z, number or array.
        increment: u = dx/d, the displacement increment over the element's displacement scale d.
        exponent: n.
        shape: beta.
        m: `math` for numbers, `numpy` for arrays.

    Returns:
        The new z.
    """
    sign = m.copysign(1.0, increment)
    u = m.fabs(increment)
    y = state * sign
    if exponent >= STOP_EXPONENT:
        y = y + u
        return 0.5 * sign * (1.0 + y - m.fabs(1.0 - y))
    gap = 1.0 - y
    middle = 1.0 - gap * m.exp(-0.5 * u * _rate(y, gap, exponent, shape, m))
    rate = _rate(middle, 1.0 - middle, exponent, shape, m)
    return sign * (1.0 - gap * m.exp(-u * rate))


def _rate(y: Any, gap: Any, exponent: float, shape: float, m: ModuleType) -> Any:
    size = m.fabs(y)
    power = size ** (exponent - 1.0)
    slope = 1.0 - power * (shape * y + (1.0 - shape) * size)
    return slope / (gap + 1e-12)


def trace(displacement: FloatArray, exponent: float, shape: float) -> FloatArray:
    """The state z over a whole path, started at z = 0: `advance` with exact steps, for arrays.

    Between two reversals y = z sgn(u) moves along one curve y(s) with dy/ds = 1 - |y|^n (...), so a
    stretch is a look-up on that curve from where it starts.

    Args:
        displacement: (n,) x/d.
        exponent: n.
        shape: beta.

    Returns:
        (n,) z at each point.
    """
    steps = np.diff(displacement)
    direction = np.sign(steps)
    moving = np.flatnonzero(direction)
    z = np.zeros(len(displacement))
    if not len(moving):
        return z
    turns = moving[np.flatnonzero(np.diff(direction[moving]))] + 1
    starts = np.concatenate(([0], turns))
    ends = np.concatenate((turns, [len(displacement) - 1]))
    arc, curve = _curve(exponent, shape)
    origin = np.empty(len(starts))
    lengths = np.abs(displacement[ends] - displacement[starts]).tolist()
    signs = np.where(direction[ends - 1] != 0.0, direction[ends - 1], direction[starts])
    along, values, begin = arc.tolist(), curve.tolist(), 0.0
    for k, (length, sign) in enumerate(zip(lengths, signs.tolist(), strict=True)):
        origin[k] = _between(values, along, begin * sign)
        begin = _between(along, values, origin[k] + length) * sign
    segment = np.searchsorted(starts, np.arange(len(displacement)), side="right") - 1
    length = np.abs(displacement - displacement[starts[segment]])
    z = np.interp(origin[segment] + length, arc, curve) * signs[segment]
    return np.asarray(z)


def _between(x: list[float], y: list[float], at: float) -> float:
    """Linear interpolation of one value, the ends held."""
    k = bisect_right(x, at)
    if k == 0:
        return y[0]
    if k == len(x):
        return y[-1]
    return y[k - 1] + (y[k] - y[k - 1]) * (at - x[k - 1]) / (x[k] - x[k - 1])


@lru_cache(maxsize=64)
def _curve(exponent: float, shape: float) -> tuple[FloatArray, FloatArray]:
    """Arc length and y along the law's curve from y = -1 to full sliding."""
    if exponent >= STOP_EXPONENT:
        return np.array([0.0, 2.0]), np.array([-1.0, 1.0])
    gap = np.geomspace(2.0, _FULL, _POINTS)
    y = 1.0 - gap
    size = np.abs(y)
    slope = 1.0 - size ** (exponent - 1.0) * (shape * y + (1.0 - shape) * size)
    # ds = dy / slope = -gap / slope d(ln gap), and gap / slope stays finite up to full sliding.
    share = gap / np.maximum(slope, 1e-300)
    steps = 0.5 * (share[1:] + share[:-1]) * -np.diff(np.log(gap))
    return np.concatenate(([0.0], np.cumsum(steps))), y
