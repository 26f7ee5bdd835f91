"""Judges whether the motion separates the effects, and advises a better one."""

from __future__ import annotations

import numpy as np
from scipy import fft

from estimator.choices import choice
from estimator.diagnosis.frame import Frame
from estimator.sample import FloatArray

__all__ = ["advice_for", "lines", "poor"]


def lines(x: FloatArray) -> float:
    """Return the effective number of spectral lines of a signal: (sum S)² / sum S², one for a sine."""
    window = np.hanning(len(x))
    power = np.abs(fft.rfft((x - x.mean()) * window)) ** 2
    # A line is three bins wide behind this window, with powers 1/4, 1, 1/4 of its peak.
    return float(power.sum() ** 2 / np.sum(power**2) / 2.0)


def poor(frame: Frame) -> bool:
    """Return whether the motion is little more than one sine."""
    return all(
        lines(frame.project(c.velocity)) < choice("one_sine")
        and lines(frame.project(c.torque)) < choice("one_sine")
        for c in frame.motors
    )


_HINTS = {
    frozenset({"torque_offset", "deflection_offset"}): (
        "torque_offset or deflection_offset: only the link's dynamics ([link.dynamics]) or a known zero of "
        "the encoders separates them"
    ),
    frozenset({"cogging", "kinematic_error"}): (
        "cogging or kinematic_error: declare [link.dynamics]; a kinematic error shows on both sides"
    ),
    frozenset({"viscous_damping", "encoder_delay"}): (
        "viscous_damping or encoder_delay: move faster, so that the deflection changes with acceleration, or "
        "declare [link.dynamics]"
    ),
    frozenset({"transmission_damping", "deflection_delay"}): (
        "transmission_damping or deflection_delay: move faster, or declare [link.dynamics]; damping acts on "
        "the link, a late sensor does not"
    ),
    frozenset({"encoder_scale", "motor_inertia"}): (
        "encoder_scale or motor_inertia: hold different positions under load at standstill"
    ),
    frozenset({"coulomb_friction", "stribeck_friction"}): (
        "coulomb_friction or stribeck_friction: move slowly, at constant velocities near zero"
    ),
    frozenset({"coulomb_friction", "asymmetric_friction"}): (
        "coulomb_friction or asymmetric_friction: move at the same speeds in both directions"
    ),
    frozenset({"coulomb_friction", "presliding_friction"}): (
        "coulomb_friction or presliding_friction: reverse often, over very small distances"
    ),
    frozenset({"gravity", "deflection_offset"}): (
        "gravity or deflection_offset: cover a larger arc of the link, at least a quarter turn"
    ),
    frozenset({"encoder_eccentricity", "encoder_scale"}): (
        "encoder_eccentricity or encoder_scale: cover a larger arc of the link, best a full turn"
    ),
}


def advice_for(name: str, alternatives: tuple[str, ...]) -> list[str]:
    """Return advice: the motion or knowledge that would separate an effect from its alternatives."""
    said = []
    for other in alternatives:
        hint = _HINTS.get(frozenset({name, other}))
        said.append(
            hint
            or f"{name} or {other}: repeat with another motion: faster and slower, wider, a sum of several "
            "frequencies instead of one"
        )
    return said
