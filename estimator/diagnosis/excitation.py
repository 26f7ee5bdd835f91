"""Judges whether the motion separates the effects, and advises a better one."""

from __future__ import annotations

import numpy as np
from scipy import fft

from estimator.choices import choice
from estimator.diagnosis.frame import Frame
from estimator.effects import in_words
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


_ANOTHER = "repeat with another motion: faster and slower, wider, a sum of several frequencies instead of one"
_HINTS = {
    frozenset(pair): hint
    for *pair, hint in (
        (
            "torque_offset", "deflection_offset",
            "only the link's dynamics ([link.dynamics]) or a known zero of the encoders separates them",
        ),
        ("cogging", "kinematic_error", "declare [link.dynamics]; a kinematic error shows on both sides"),
        ("cogging", "gravity", "take the load off, or turn the axis upright: cogging stays"),
        (
            "viscous_damping", "encoder_delay",
            "move faster, so that the deflection changes with acceleration, or declare [link.dynamics]",
        ),
        (
            "transmission_damping", "deflection_delay",
            "move faster, or declare [link.dynamics]; damping acts on the link, a late sensor does not",
        ),
        ("encoder_scale", "motor_inertia", "hold different positions under load at standstill"),
        ("coulomb_friction", "stribeck_friction", "move slowly, at constant velocities near zero"),
        ("coulomb_friction", "asymmetric_friction", "move at the same speeds in both directions"),
        ("coulomb_friction", "presliding_friction", "reverse often, over very small distances"),
        ("gravity", "deflection_offset", "cover a larger arc of the link, at least a quarter turn"),
        ("encoder_eccentricity", "encoder_scale", "cover a larger arc of the link, best a full turn"),
    )
}  # fmt: skip


def advice_for(name: str, alternatives: tuple[str, ...]) -> list[str]:
    """Return advice: the motion or knowledge that would separate an effect from its alternatives."""
    others: dict[str, list[str]] = {}
    for other in alternatives:
        others.setdefault(_HINTS.get(frozenset({name, other}), _ANOTHER), []).append(in_words(other))
    return [f"{in_words(name)} or {' or '.join(names)}: {hint}" for hint, names in others.items()]
