"""Discretised filters: exact for a held torque, with exact ratios between derivatives for a position.

A torque command is held over a period (zero-order hold); a position is interpolated linearly between samples
(first-order hold). Filters built on these assumptions give a signal and its derivatives without
differentiating samples.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from estimator.model import require, require_finite
from estimator.sample import FloatArray

__all__ = ["StateVariableFilter", "critically_damped", "linear_filter"]

_TERMS = 18  # of the exponential's series: at a norm of 1/2 the next one is below rounding


def linear_filter(
    b: Sequence[float] | FloatArray, a: Sequence[float] | FloatArray, signal: FloatArray
) -> FloatArray:
    """Return b(z) / A(z) over a whole recording, from rest, along axis 0: `scipy.signal.lfilter`.

    Imported here because scipy.signal would double the start-up time of a daemon, which does not need it.
    """
    from scipy.signal import lfilter

    return np.asarray(lfilter(b, a, signal, axis=0))


def critically_damped(order: int, bandwidth_rad_s: float) -> tuple[float, ...]:
    """Return the coefficients a_0 … a_(n-1) of (s + w)^n without its leading 1: all poles at w."""
    return tuple(math.comb(order, i) * bandwidth_rad_s ** (order - i) for i in range(order))


class _Discrete(NamedTuple):
    """x_k = advance x_(k-1) + old w_(k-1) + new w_k; outputs are rows of `derivatives` times x."""

    advance: FloatArray
    old: FloatArray
    new: FloatArray


class StateVariableFilter:
    """F(s) = w^n / (s + w)^n with the derivatives s^i F as its states, i = 0 … n-1.

    The states are x_i = s^i F(s) u, in the input's unit per s^i. As the derivatives come from one filter
    on one interpolated signal, their ratios are those of (j omega)^i exactly; only the interpolation
    itself acts on the amplitude, by 1 - (omega T)²/12, the same for every derivative.

    Args:
        order: n, at least 2.
        bandwidth_rad_s: w; kept below what the sampling can represent.
        period_s: T.
    """

    def __init__(self, order: int, bandwidth_rad_s: float, period_s: float) -> None:
        require(order >= 1, f"order: expected at least 1, got {order}")
        require_finite(0.0, strict=True, bandwidth_rad_s=bandwidth_rad_s, period_s=period_s)
        self.order = order
        self.period_s = period_s
        self.bandwidth_rad_s = min(bandwidth_rad_s, 1.0 / period_s)
        self.smooth = _discretise(order, self.bandwidth_rad_s, period_s, hold=False)
        self.held = _discretise(order, self.bandwidth_rad_s, period_s, hold=True)

    @property
    def settling_periods(self) -> int:
        """Periods after which less than 1e-6 of an initial state is left."""
        return math.ceil((14.0 + 3.0 * (self.order - 1)) / (self.bandwidth_rad_s * self.period_s))

    def rest(self, value: float) -> FloatArray:
        """Return the steady state (n,) for a constant input."""
        state = np.zeros(self.order)
        state[0] = value
        return state

    def impulse(self, periods: int, *, held: bool = False) -> FloatArray:
        """Return impulse responses of all states, (periods, n), newest first."""
        step = self.held if held else self.smooth
        out = np.empty((periods, self.order))
        state = step.new.copy()
        out[0] = state
        state = step.advance @ state + step.old
        for k in range(1, periods):
            out[k] = state
            state = step.advance @ state
        return out

    def apply(self, signal: FloatArray, derivatives: int = 0, *, held: bool = False) -> list[FloatArray]:
        """Filter a whole recording.

        Args:
            signal: (n,) or (n, m); starts at rest at its first sample.
            derivatives: highest derivative wanted.
            held: whether the signal is held between samples (a torque) rather than smooth (a position).

        Returns:
            F u, s F u, …, each shaped like the signal.
        """
        signal = np.asarray(signal, dtype=np.float64)
        origin = signal[:1]
        numerators, pole = _polynomials(self.order, self.bandwidth_rad_s, self.period_s, held)
        smoothed = signal - origin
        for _ in range(
            self.order
        ):  # one pole after the other: their product loses all digits at narrow bandwidths
            smoothed = linear_filter((1.0 - pole,), (1.0, -pole), smoothed)
        outputs = [linear_filter(numerators[i], (1.0,), smoothed) for i in range(derivatives + 1)]
        outputs[0] = outputs[0] + origin
        return outputs


def _exponential(matrix: FloatArray) -> FloatArray:
    """exp of a small matrix by its series, halved until that is short and squared back.

    `scipy.linalg.expm` gives the same to rounding (tested), but costs a daemon a third of a second at start.
    """
    halvings = max(0, math.ceil(math.log2(max(float(np.abs(matrix).sum(axis=1).max()), 1e-300))) + 1)
    scaled = matrix / 2.0**halvings
    term = total = np.eye(len(matrix))
    for k in range(1, _TERMS):
        term = term @ scaled / k
        total = total + term
    for _ in range(halvings):
        total = total @ total
    return total


@lru_cache(maxsize=64)
def _discretise(order: int, bandwidth: float, period: float, *, hold: bool) -> _Discrete:
    """The companion form of (s + w)^n over one period, its input held or straight."""
    scaled = critically_damped(order, bandwidth * period)  # time in periods keeps the numbers near one
    a = np.zeros((order + 2, order + 2))
    a[: order - 1, 1:order] = np.eye(order - 1)
    a[order - 1, :order] = -np.asarray(scaled)
    a[order - 1, order] = scaled[0]
    a[order, order + 1] = 1.0
    exponential = _exponential(a)
    units = period ** -np.arange(order, dtype=np.float64)
    advance = exponential[:order, :order] * units[:, None] / units[None, :]
    level, ramp = exponential[:order, order] * units, exponential[:order, order + 1] * units
    if hold:
        return _Discrete(advance, level, np.zeros(order))
    return _Discrete(advance, level - ramp, ramp)


@lru_cache(maxsize=64)
def _polynomials(order: int, bandwidth: float, period: float, hold: bool) -> tuple[FloatArray, float]:
    """Numerators (order, n+1) of every derivative, in z^-1, behind n times (1 - p) / (1 - p z^-1); and p."""
    advance, old, new = _discretise(order, bandwidth, period, hold=hold)
    pole = math.exp(-bandwidth * period)
    denominator = np.asarray(np.poly(np.full(order, pole)), dtype=np.float64)
    # x_k = A x_(k-1) + old u_(k-1) + new u_k: Markov parameters, then the product with the denominator.
    markov = np.zeros((order + 1, order))
    markov[0] = new
    state = advance @ new + old
    for k in range(1, order + 1):
        markov[k] = state
        state = advance @ state
    numerators = np.zeros((order, order + 1))
    for k in range(order + 1):
        for j in range(k + 1):
            numerators[:, k] += denominator[j] * markov[k - j]
    return numerators / (1.0 - pole) ** order, pole
