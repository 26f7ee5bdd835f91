"""Priors of one joint, in its units."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from estimator.choices import choice
from estimator.diagnosis.candidates import Candidate, reverses
from estimator.diagnosis.declared import known_effects
from estimator.diagnosis.frame import Frame
from estimator.effects import LIBRARY
from estimator.model import JointModel
from estimator.priors import PRIORS
from estimator.sample import FloatArray

__all__ = ["OF_RUN", "effect_std", "everyday", "everyday_std", "least", "longest_delay_s"]

OF_RUN = ("coulomb_friction", "torque_offset", "deflection_offset")  # all else belongs to the machine
_AT_MOTOR = (
    "motor_inertia",
    "viscous_damping",
    "coulomb_friction",
    "torque_offset",
    "torque_delay",
    "deflection_offset",
)
_OF_LINK = ("link_inertia", "link_viscous_damping", "gravity")
_AT_LINK = ("encoder_delay", *_OF_LINK)


def everyday(frame: Frame) -> list[Candidate]:
    """Return errors of every rig: inexact declared numbers, and offsets and skews of readings."""
    made = []
    for i, flexible in enumerate(frame.flexible):
        names = [n for n in _AT_MOTOR if flexible or n not in ("deflection_offset", "torque_delay")]
        made += [Candidate(LIBRARY[name], i) for name in names]
    if frame.linked:
        made += [Candidate(LIBRARY["torque_constant"], i) for i in range(len(frame.motors))]
    for name in _AT_LINK:
        reading = name == "encoder_delay"
        if any(frame.flexible) if reading else frame.model.link is not None:
            made.append(Candidate(LIBRARY[name], None))
    return made + [one for one in known_effects(frame.model) if one not in made]


def everyday_std(
    frames: Sequence[Frame],
    candidate: Candidate,
    torque_rms: float,
    calibrating: bool,
    known: tuple[float, ...] | None = None,
) -> tuple[float, ...]:
    """Return the prior standard deviation of each linear parameter of an everyday error; 0:
    it does not apply.

    Args:
        frames: of all recordings.
        candidate: the error.
        torque_rms: of the motor torque without its mean, N·m.
        calibrating: the recordings are of a healthy joint and determine its declared numbers.
        known: the deviations of a declared effect (`known_effects`).
    """
    own, name = (0.0,) * len(candidate.kind.linear), candidate.kind.name
    if name in OF_RUN:
        own = (_of_run_std(frames, candidate, torque_rms, calibrating),)
    elif name in ("torque_delay", "encoder_delay"):
        own = (PRIORS[name].std * frames[0].signals.period_s,)
    elif name in _AT_LINK:
        own = _of_link_std(frames[0], candidate, torque_rms, calibrating)
    elif name in (*_AT_MOTOR, "torque_constant"):
        own = (_of_motor_std(frames, candidate, torque_rms, calibrating),)
    return own if calibrating or known is None else tuple(map(math.hypot, own, known))


def _of_run_std(frames: Sequence[Frame], candidate: Candidate, torque_rms: float, calibrating: bool) -> float:
    """Of friction, a constant torque, and a zero of the encoders."""
    name, motor, linked = candidate.kind.name, candidate.motor or 0, frames[0].linked
    std = PRIORS[name].std
    if name == "coulomb_friction":
        back = any(reverses(f.motors[motor].velocity) for f in frames)
        # Undeclared friction is a missing effect.
        return PRIORS["effect"].std * torque_rms if calibrating and back else 0.0
    if name == "torque_offset":
        # A healthy joint's constant torque is attributed to the encoders' zero: the two cannot be separated.
        if calibrating and frames[0].flexible[motor]:
            return 0.0
        return (choice("floor") if linked and not calibrating else std) * torque_rms
    phi = frames[0].motors[motor].deflection
    if calibrating:  # a healthy joint's encoders may start anywhere
        return std * _extent(frames[:1], motor)
    if not linked:
        return std * float(np.ptp(phi))
    # What is left of a zero that has been set is no effect, nor is what rounding leaves: half a count.
    rounded = 0.5 * max(f.signals.resolution_rad[motor] for f in frames)
    return max(choice("floor") * float(np.std(phi)), rounded)


def _extent(frames: Sequence[Frame], motor: int) -> float:
    """Largest deflection that may be read, rad."""
    each = [frame.motors[motor].deflection for frame in frames]
    return max(float(np.ptp(phi) + abs(np.mean(phi))) for phi in each)


def _of_motor_std(
    frames: Sequence[Frame], candidate: Candidate, torque_rms: float, calibrating: bool
) -> float:
    """Of torque scale, inertia and damping."""
    name, i, linked = candidate.kind.name, candidate.motor or 0, frames[0].linked
    motor, std = frames[0].model.motors[i], _declared_std(frames[0], name, calibrating)
    if name == "torque_constant":
        return 0.0 if calibrating else std  # the anchor
    if name == "motor_inertia":
        return (motor.inertia_std_relative or std) * motor.inertia_kg_m2
    fast = max(float(np.max(np.abs(f.motors[i].velocity))) for f in frames)
    undeclared = motor.viscous_damping_nm_s_rad == 0.0 and motor.viscous_damping_std_nm_s_rad is None
    if calibrating and undeclared:  # a damping that nobody declared is not known to be zero
        return PRIORS["effect"].std * torque_rms / max(fast, 1e-300)
    floor = 0.0 if linked else PRIORS["viscous_damping_floor"].std * torque_rms / max(fast, 1e-300)
    known = 0.0 if calibrating else motor.viscous_damping_std_nm_s_rad or 0.0
    return max(float(np.hypot(std * motor.viscous_damping_nm_s_rad, floor)), known)


def _of_link_std(
    frame: Frame, candidate: Candidate, torque_rms: float, calibrating: bool
) -> tuple[float, ...]:
    """Of inertia, damping and gravity of the link."""
    name, link = candidate.kind.name, frame.model.link
    if link is None:
        return (0.0,) * len(candidate.kind.linear)
    share, place = _declared_std(frame, name, calibrating), _OF_LINK.index(name)
    value = (link.inertia_kg_m2, link.viscous_damping_nm_s_rad, abs(link.gravity_nm))[place]
    known = (link.inertia_std_kg_m2, link.viscous_damping_std_nm_s_rad, link.gravity_std_nm)[place]
    std = max(share * value, link.std[place] if calibrating else known or 0.0)
    if name != "gravity":
        return (std,)
    unknown = PRIORS["effect"].std * torque_rms if calibrating and frame.carried else 0.0
    return (float(np.hypot(std, unknown)),) * 2


def _declared_std(frame: Frame, name: str, calibrating: bool) -> float:
    """Of a declared number; with both balances a wrong one is identifiable, an effect with a name."""
    if not frame.linked or calibrating:
        return PRIORS[name].std
    return PRIORS["calibrated_torque" if name == "torque_constant" else "declared"].std


def effect_std(frames: Sequence[Frame], candidate: Candidate, by_torque: FloatArray) -> FloatArray:
    """Return the prior standard deviations of an effect's linear parameters, by torque or by
    reading error.
    """
    name, model = candidate.kind.name, frames[0].model
    if name == "motor_inertia":
        return np.full_like(
            by_torque, PRIORS["anchor"].std * model.motors[candidate.motor or 0].inertia_kg_m2
        )
    if name == "link_inertia" and model.link is not None:
        return np.full_like(by_torque, PRIORS["anchor"].std * model.link.inertia_kg_m2)
    if name in ("torque_constant", "torque_drift"):
        return np.full_like(by_torque, PRIORS["torque_scale"].std)
    if name in ("load_dependent_friction", "back_driving_loss"):
        return np.full_like(by_torque, PRIORS[name].std)
    if name == "deflection_delay":
        return np.full_like(by_torque, PRIORS["late_deflection"].std)
    if name in ("torque_delay", "torque_lag", "encoder_delay"):
        return np.minimum(PRIORS["late"].std, by_torque)
    if name == "deflection_offset":  # of a spring without stiffness no torque tells it
        return np.minimum(_extent(frames, candidate.motor or 0), by_torque)
    if name in ("encoder_scale", "encoder_eccentricity"):
        return np.minimum(PRIORS[name].std, by_torque)
    return by_torque


def longest_delay_s(period_s: float) -> float:
    """Return the longest delay that is none of the time stamps: three deviations of its prior or samples."""
    return choice("sure") * max(PRIORS["late"].std, period_s)


def least(model: JointModel, candidate: Candidate) -> float:
    """Return the physical lower bound of an effect's linear parameters, beyond the declared value."""
    name = candidate.kind.name
    motor, link = model.motors[candidate.motor or 0], model.link
    if candidate.kind.parameters[0].positive:
        return 0.0
    if name == "motor_inertia":
        return -motor.inertia_kg_m2
    if name == "viscous_damping":
        return -motor.viscous_damping_nm_s_rad
    if name == "link_inertia" and link is not None:
        return -link.inertia_kg_m2
    if name == "link_viscous_damping" and link is not None:
        return -link.viscous_damping_nm_s_rad
    return -np.inf
