"""Chooses the bandwidth of all channels, from the motion and the noise that it passes into each balance."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy import fft
from scipy.optimize import brentq

from estimator.choices import choice, rate
from estimator.diagnosis.frame import Signals
from estimator.diagnosis.spectral import lowpass
from estimator.errors import EstimatorError
from estimator.model import JointModel
from estimator.sample import FloatArray, Record

__all__ = ["choose_bandwidth", "require_bandwidth", "torque_rms", "widest"]


def torque_rms(record: Record) -> float:
    """Return the rms of the motor torque without its mean, N·m; the larger one of two motors."""
    return float(np.max(np.std(record.motor_torque_nm, axis=0)))


def choose_bandwidth(records: Sequence[Record], model: JointModel) -> float:
    """Return a bandwidth from the data, Hz: that of the recording that needs the narrowest.

    It is wide enough for `fit_periods` of it in the shortest recording.
    """
    shortest_s = min(len(one) * one.period_s for one in records)
    least = min(choice("fit_periods") / shortest_s, widest(max(one.period_s for one in records)))
    return max(min(_suits(one, model) for one in records), least)


def _suits(record: Record, model: JointModel) -> float:
    """Wide enough for the motion, narrow enough for the noise; Hz."""
    torque = record.motor_torque_nm - record.motor_torque_nm.mean(axis=0)
    power = np.sum(np.abs(fft.rfft(torque, axis=0)) ** 2, axis=1)
    share = np.cumsum(power) / max(float(power.sum()), 1e-300)
    content = float(np.searchsorted(share, choice("content"))) / (record.period_s * len(torque))
    wanted = min(
        max(choice("harmonics") * content, choice("least_bandwidth")),
        choice("most_bandwidth"),
        widest(record.period_s),
    )
    signals, stiffness = Signals(record, wanted), rough_stiffness(record, model)

    def beyond(bandwidth_hz: float) -> float:
        """Return the noise beyond what is allowed; rises with the bandwidth."""
        noise = equation_noise(signals, model, stiffness, bandwidth_hz)
        return float(np.max(noise)) - 2.0 * choice("floor") * torque_rms(record)

    narrowest = min(choice("narrowest"), wanted)
    if beyond(wanted) <= 0.0:
        return wanted
    return float(brentq(beyond, narrowest, wanted)) if beyond(narrowest) < 0.0 else narrowest


def widest(period_s: float) -> float:
    """Return the largest bandwidth, Hz: every sample is a row."""
    return 1.0 / (rate() * period_s)


def require_bandwidth(bandwidth_hz: float, records: Sequence[Record]) -> None:
    """Refuse a bandwidth of which no period fits into the longest recording, or beyond `widest`.

    Raises:
        EstimatorError: it is out of this range.
    """
    least = 1.0 / max(len(one) * one.period_s for one in records)
    most = widest(max(one.period_s for one in records))
    if not least <= bandwidth_hz <= most:
        raise EstimatorError(f"bandwidth: expected {least:.3g} to {most:g} Hz, got {bandwidth_hz:g}")


def rough_stiffness(record: Record, model: JointModel) -> list[float]:
    """Return K of each transmission from the slow part of torque and deflection, N·m/rad."""
    found = []
    for i, motor in enumerate(model.motors):
        if motor.transmission.model == "none" or record.link_position_rad is None:
            found.append(0.0)
            continue
        phi = record.link_position_rad - record.motor_position_rad[:, i]
        tau = record.motor_torque_nm[:, i]
        phi, tau = phi - phi.mean(), tau - tau.mean()
        found.append(float(np.sqrt(np.sum(tau * tau) / max(float(np.sum(phi * phi)), 1e-300))))
    return found


def equation_noise(
    signals: Signals, model: JointModel, stiffness: list[float], bandwidth_hz: float
) -> FloatArray:
    """Return the standard deviation of the channels' noise in each motor's balance at a bandwidth, N·m."""
    f = signals.light.frequency_hz
    s = 2j * np.pi * f
    narrow = lowpass(f, bandwidth_hz)
    variances = []
    for i, motor in enumerate(model.motors):
        k = stiffness[i]
        own = motor.inertia_kg_m2 * s**2 + motor.viscous_damping_nm_s_rad * s + k
        variance = signals.noise(signals.theta[i], own * narrow) + signals.noise(signals.tau[i], narrow)
        if k and signals.q is not None:
            variance += signals.noise(signals.q, k * narrow)
        variances.append(variance)
    return np.asarray(np.sqrt(np.array(variances)))
