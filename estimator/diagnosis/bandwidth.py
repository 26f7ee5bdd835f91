"""Chooses the bandwidth of all channels, and computes the noise it passes into each equation."""

from __future__ import annotations

import numpy as np
from scipy import fft

from estimator.diagnosis.choices import choice
from estimator.diagnosis.frame import Signals
from estimator.diagnosis.spectral import lowpass
from estimator.model import JointModel
from estimator.sample import FloatArray, Record

__all__ = ["choose_bandwidth", "equation_noise", "torque_rms"]


def torque_rms(record: Record) -> float:
    """rms of the motor torque without its mean, N·m; the larger one of two motors."""
    return float(np.max(np.std(record.motor_torque_nm, axis=0)))


def choose_bandwidth(record: Record, model: JointModel) -> float:
    """A bandwidth from the data, Hz: wide enough for the motion, narrow enough for the encoders' noise."""
    rate = 1.0 / record.period_s
    torque = record.motor_torque_nm - record.motor_torque_nm.mean(axis=0)
    power = np.sum(np.abs(fft.rfft(torque, axis=0)) ** 2, axis=1)
    share = np.cumsum(power) / max(float(power.sum()), 1e-300)
    content = float(np.searchsorted(share, choice("content"))) * rate / len(torque)
    wanted = min(
        max(choice("wider") * content, choice("least_bandwidth")),
        choice("most_bandwidth"),
        choice("sampled") * rate,
    )
    limit = 2.0 * choice("floor") * torque_rms(record)
    stiffness = rough_stiffness(record, model)
    bandwidth = wanted
    while bandwidth > choice("narrowest"):
        signals = Signals(record, bandwidth)
        if float(np.max(equation_noise(signals, model, stiffness, linked=False))) <= limit:
            break
        bandwidth *= choice("narrowing")
    return float(min(max(bandwidth, choice("narrowest")), wanted))


def rough_stiffness(record: Record, model: JointModel) -> list[float]:
    """K of each transmission from the slow part of torque and deflection, N·m/rad."""
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


def equation_noise(signals: Signals, model: JointModel, stiffness: list[float], linked: bool) -> FloatArray:
    """Standard deviation that the channels' noise has in each equation's balance, N·m."""
    f = signals.light.frequency_hz
    s = 2j * np.pi * f
    narrow = lowpass(f, signals.bandwidth_hz)

    variances = []
    for i, motor in enumerate(model.motors):
        k = stiffness[i]
        own = motor.inertia_kg_m2 * s**2 + motor.viscous_damping_nm_s_rad * s + k
        variance = signals.noise(signals.theta[i], own * narrow) + signals.noise(signals.tau[i], narrow)
        if k and signals.q is not None:
            variance += signals.noise(signals.q, k * narrow)
        variances.append(variance)
    if linked and model.link is not None and signals.q is not None:
        k = sum(stiffness)
        own = model.link.inertia_kg_m2 * s**2 + model.link.viscous_damping_nm_s_rad * s + k
        variance = signals.noise(signals.q, own * narrow)
        for spectrum, each in zip(signals.theta, stiffness, strict=True):
            variance += signals.noise(spectrum, each * narrow)
        variances.append(variance)
    return np.asarray(np.sqrt(np.array(variances)))
