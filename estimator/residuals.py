"""The paper's residuals: the flexibility torque from momenta, without differentiation or torque sensor.

`motor_balance` integrates the known part of a balance exactly for a held torque; `first_order` and
`second_order` turn it into eqs 14-16 and 28-30 over arrays. The paper mode computes them tick by tick, with
eqs 12 and 13.
"""

from __future__ import annotations

import numpy as np

from estimator.filters import first_order_pole, held_integral, linear_filter, tustin_biquad
from estimator.sample import FloatArray

__all__ = [
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


def first_order(balance: FloatArray, k_tau_rad_s: float, period_s: float) -> FloatArray:
    """r of eq 14: K s/(s + K) y, which is tau_e through K/(s + K) (eqs 15, 16).

    r_k = a r_(k-1) + (1 - a) (y_k - y_(k-1)) / T with a = exp(-K T): exact for a straight y.
    """
    a = first_order_pole(k_tau_rad_s, period_s)
    gain = (1.0 - a) / period_s
    return linear_filter([gain, -gain], [1.0, -a], balance)


def match_first_order(signal: FloatArray, k_tau_rad_s: float, period_s: float) -> FloatArray:
    """Filter a regressor by the residual's filter K/(s + K), so that their lags cancel.

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
