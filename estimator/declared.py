"""Declared effects over whole recordings.

Readings are corrected sample by sample as on line, and x_motor - x_transmission comes as one array.
"""

from __future__ import annotations

import math

import numpy as np

from estimator.effects import LIBRARY, Coordinates, OnlineEffects, elements
from estimator.filters import linear_filter
from estimator.model import JointModel, Motor
from estimator.sample import FloatArray, Record

__all__ = ["corrected", "effect_torque"]

_LIGHT_RATIO = 5.0  # bandwidth of velocities that effects are formed from, over that of the regression


def corrected(record: Record, model: JointModel) -> Record:
    """The recording as perfect sensors would have given it."""
    effects = OnlineEffects(model, record.period_s)
    if not effects.active:
        return record
    samples = [effects.correct(sample) for sample in record.samples()]
    link = record.link_position_rad
    return Record(
        period_s=record.period_s,
        sequence=record.sequence,
        motor_position_rad=np.array([s.motor_position_rad for s in samples]),
        motor_torque_nm=np.array([s.motor_torque_nm for s in samples]),
        link_position_rad=None if link is None else np.array([s.link_position_rad for s in samples]),
        start_s=record.start_s,
    )


def effect_torque(
    motor: Motor, theta: FloatArray, q: FloatArray, tau: FloatArray, period_s: float, bandwidth_rad_s: float
) -> FloatArray:
    """x_motor - x_transmission of a motor's declared effects on a grid of whole periods, (n,) N·m.

    Args:
        motor: its model.
        theta: (n,) motor position. q: (n,) link position. tau: (n,) motor torque.
        period_s: T.
        bandwidth_rad_s: of the regression's filter; velocities keep five times as much.
    """
    total = np.zeros(len(theta))
    active = [e for e in motor.effects if LIBRARY[e.name].channel == "torque"]
    if not active:
        return total
    c = _coordinates(motor, theta, q, tau, period_s, _LIGHT_RATIO * bandwidth_rad_s)
    for effect in active:
        kind, each = elements(effect)
        sign = 1.0 if kind.location == "motor" else -1.0
        for values in each:
            weights = [values[name] for name in kind.linear]
            total += sign * np.dot(weights, kind.terms(c, values))
    return total


def _coordinates(
    motor: Motor, theta: FloatArray, q: FloatArray, tau: FloatArray, period_s: float, bandwidth: float
) -> Coordinates:
    pole = math.exp(-bandwidth * period_s)
    velocity = _smooth(np.gradient(theta, period_s), pole)
    acceleration = np.gradient(velocity, period_s)
    phi = q - theta
    balance = motor.inertia_kg_m2 * acceleration + motor.viscous_damping_nm_s_rad * velocity - tau
    flexibility = _smooth(balance, pole)
    stiffness = float(phi @ flexibility) / max(float(phi @ phi), 1e-300)
    return Coordinates(
        position=theta,
        velocity=velocity,
        acceleration=acceleration,
        deflection=phi,
        deflection_rate=_smooth(np.gradient(phi, period_s), pole),
        flexibility_torque=flexibility,
        stiffness=stiffness,
        torque=tau,
        torque_rate=np.gradient(tau, period_s),
        link_position=q,
        link_velocity=velocity,
        link_acceleration=acceleration,
        time=np.arange(len(theta)) * period_s,
    )


def _smooth(signal: FloatArray, pole: float) -> FloatArray:
    """Two poles forwards and two backwards: no delay."""
    for _ in range(2):
        for _ in range(2):
            start = signal[0]
            signal = linear_filter([1.0 - pole], [1.0, -pole], signal - start) + start
        signal = signal[::-1]
    return signal
