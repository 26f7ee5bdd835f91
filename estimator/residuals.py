"""The residuals of the paper: the flexibility torque from momenta, without differentiating or sensing it.

`momentum` integrates the known part of a balance exactly for a held torque; `FirstOrder` and
`SecondOrder` turn it into eqs 14-16 and 28-30 tick by tick, `first_order` and `second_order` over arrays.
"""

from __future__ import annotations

import numpy as np

from estimator.filters import first_order_pole, held_integral, linear_filter, tustin_biquad
from estimator.model import LinkDynamics
from estimator.sample import FloatArray

__all__ = [
    "FirstOrder",
    "SecondOrder",
    "external_balance",
    "first_order",
    "match_first_order",
    "match_second_order",
    "motor_balance",
    "second_order",
]


def motor_balance(
    inertia_kg_m2: float,
    damping_nm_s_rad: float,
    position: FloatArray,
    velocity: FloatArray,
    torque: FloatArray,
    period_s: float,
) -> FloatArray:
    """y = B theta' + D theta - integral(tau), whose derivative is tau_e (from eq 5).

    Args:
        inertia_kg_m2: B.
        damping_nm_s_rad: D_theta.
        position: theta, (n,).
        velocity: theta', (n,).
        torque: tau, (n,); row k acts from t_k to t_(k+1).
        period_s: T.

    Returns:
        (n,) in N·m·s, zero at the first sample.
    """
    balance = inertia_kg_m2 * velocity + damping_nm_s_rad * position - held_integral(torque, period_s)
    return np.asarray(balance - balance[0])


def external_balance(
    link: LinkDynamics,
    position: FloatArray,
    velocity: FloatArray,
    external_torque: FloatArray,
    period_s: float,
) -> FloatArray:
    """y = M q' + D_q q - integral(tau_k - g(q)), whose derivative is -tau_e,t (from eqs 4, 6).

    tau_k and g are smooth, so the integral is the trapezoidal one.
    """
    load = external_torque - link.gravity_nm * np.sin(position + link.gravity_phase_rad)
    integral = np.zeros_like(load)
    np.cumsum(0.5 * period_s * (load[1:] + load[:-1]), out=integral[1:])
    balance = link.inertia_kg_m2 * velocity + link.viscous_damping_nm_s_rad * position - integral
    return np.asarray(balance - balance[0])


def first_order(balance: FloatArray, k_tau_rad_s: float, period_s: float) -> FloatArray:
    """r of eq 14 (or 12): K s/(s + K) y, which is tau_e (or -tau_e,t) through K/(s + K) (eqs 13, 15, 16).

    r_k = a r_(k-1) + (1 - a) (y_k - y_(k-1)) / T with a = exp(-K T): exact for a straight y.
    """
    a = first_order_pole(k_tau_rad_s, period_s)
    gain = (1.0 - a) / period_s
    return linear_filter([gain, -gain], [1.0, -a], balance)


def match_first_order(signal: FloatArray, k_tau_rad_s: float, period_s: float) -> FloatArray:
    """A regressor through the residual's own filter K/(s + K), so that their lags cancel.

    The residual sees the mean of tau_e over each period; the regressor's is that of its two ends.
    """
    a = first_order_pole(k_tau_rad_s, period_s)
    mean = 0.5 * (signal[1:] + signal[:-1])
    out = np.zeros_like(signal)
    out[1:] = linear_filter([1.0 - a], [1.0, -a], mean)
    return out


def second_order(balance: FloatArray, k1: float, k2: float, period_s: float) -> FloatArray:
    """r_sigma of eq 28: K1 s²/(s² + K2 s + K1) y, which is sigma phi' through eq 30 (bilinear transform)."""
    b, a = tustin_biquad((k1, 0.0, 0.0), (1.0, k2, k1), period_s)
    return linear_filter(b, a, balance)


def match_second_order(signal: FloatArray, k1: float, k2: float, period_s: float) -> FloatArray:
    """s K1/(s² + K2 s + K1) of a deflection: phi' through the filter of eq 30 (bilinear transform)."""
    b, a = tustin_biquad((0.0, k1, 0.0), (1.0, k2, k1), period_s)
    return linear_filter(b, a, signal - signal[0])


class _Balance:
    """y of `motor_balance` tick by tick, bridging gaps with the torque that was held."""

    def __init__(self, inertia_kg_m2: float, damping_nm_s_rad: float, period_s: float) -> None:
        self._B, self._D, self._T = inertia_kg_m2, damping_nm_s_rad, period_s
        self.reset()

    def reset(self) -> None:
        self._origin: float | None = None
        self._integral = 0.0
        self._torque = 0.0

    def update(self, position: float, velocity: float, torque: float, periods: int) -> float:
        self._integral += self._torque * self._T * periods
        self._torque = torque
        value = self._B * velocity + self._D * position - self._integral
        if self._origin is None:
            self._origin = value
        return value - self._origin


class FirstOrder:
    """The residual r_tau_e of eq 14, one tick at a time."""

    def __init__(
        self, inertia_kg_m2: float, damping_nm_s_rad: float, k_tau_rad_s: float, period_s: float
    ) -> None:
        self._balance = _Balance(inertia_kg_m2, damping_nm_s_rad, period_s)
        self._K, self._T = k_tau_rad_s, period_s
        self.reset()

    def reset(self) -> None:
        """Start anew from r = 0."""
        self._balance.reset()
        self.value = 0.0
        self._last = 0.0

    def update(self, position: float, velocity: float, torque: float, periods: int = 1) -> float:
        """r_tau_e at this sample, N·m; `periods` since the last one (more than one after a gap)."""
        y = self._balance.update(position, velocity, torque, periods)
        a = first_order_pole(self._K, self._T * periods)
        self.value = a * self.value + (1.0 - a) * (y - self._last) / (self._T * periods)
        self._last = y
        return self.value


class SecondOrder:
    """The residual r_sigma of eq 28, one tick at a time (bilinear transform, transposed direct form)."""

    def __init__(
        self, inertia_kg_m2: float, damping_nm_s_rad: float, k1: float, k2: float, period_s: float
    ) -> None:
        self._balance = _Balance(inertia_kg_m2, damping_nm_s_rad, period_s)
        b, a = tustin_biquad((k1, 0.0, 0.0), (1.0, k2, k1), period_s)
        self._b, self._a = tuple(b.tolist()), tuple(a.tolist())
        self.reset()

    def reset(self) -> None:
        """Start anew from r = 0."""
        self._balance.reset()
        self.value = 0.0
        self._last = self._w1 = self._w2 = 0.0

    def update(self, position: float, velocity: float, torque: float, periods: int = 1) -> float:
        """r_sigma at this sample, N·m/s; a gap is bridged along a straight line of y."""
        y = self._balance.update(position, velocity, torque, periods)
        slope = (y - self._last) / periods
        (b0, b1, b2), (_, a1, a2) = self._b, self._a
        for k in range(1, periods + 1):
            u = self._last + k * slope
            self.value = b0 * u + self._w1
            self._w1 = b1 * u - a1 * self.value + self._w2
            self._w2 = b2 * u - a2 * self.value
        self._last = y
        return self.value
