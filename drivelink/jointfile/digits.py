"""Digits of a model's numbers in a joint file.

A number is rounded to three digits behind the first one of its standard deviation, so by less than a
thousandth of that; a deviation likewise. For a transmission's parameters it is the deviation that each has
where the other ones are known: no combination of them loses more. What was declared without a deviation
keeps all digits; what was found without one has ten, those of a reading of 32 bits.
"""

import math
from dataclasses import replace
from typing import Any

import numpy as np

from estimator.model import Effect, JointModel, LinkDynamics, Motor, ParameterValue, Transmission
from estimator.transmissions import transmission_model

_MORE = 3  # digits behind the first of the standard deviation
_READING = 10  # digits of a number of 32 bits


def kept(value: ParameterValue, std: ParameterValue | None) -> Any:
    """Return a number, or several, with the digits that the standard deviations ask for."""
    if isinstance(value, tuple):
        return tuple(map(kept, value, std if isinstance(std, tuple) else (std,) * len(value)))
    if isinstance(std, tuple) or std is None or not 0.0 < std < math.inf:
        return value
    return round(value, _MORE - math.floor(math.log10(std)))


def ten_digits(value: float) -> float:
    """Return a number that was found without a standard deviation, with the digits of a reading."""
    return float(f"{value:.{_READING}g}")


def kept_model(model: JointModel) -> JointModel:
    """Return a model as it is written."""
    effects = tuple(map(_effect, model.link_effects))
    link = model.link and _link(model.link)
    return replace(model, motors=tuple(map(_motor, model.motors)), link=link, link_effects=effects)


def _motor(motor: Motor) -> Motor:
    share, damping = motor.inertia_std_relative, motor.viscous_damping_std_nm_s_rad
    return replace(
        motor,
        inertia_kg_m2=kept(motor.inertia_kg_m2, share and share * motor.inertia_kg_m2),
        inertia_std_relative=kept(share, share) if share else share,
        viscous_damping_nm_s_rad=kept(motor.viscous_damping_nm_s_rad, damping),
        viscous_damping_std_nm_s_rad=kept(damping, damping) if damping else damping,
        transmission=_transmission(motor.transmission),
        effects=tuple(map(_effect, motor.effects)),
    )


def _link(link: LinkDynamics) -> LinkDynamics:
    inertia, damping, gravity = link.inertia_std_kg_m2, link.viscous_damping_std_nm_s_rad, link.gravity_std_nm
    std = {"inertia_kg_m2": inertia, "viscous_damping_nm_s_rad": damping, "gravity_nm": gravity}
    std["gravity_phase_rad"] = gravity / abs(link.gravity_nm) if gravity and link.gravity_nm else None
    std |= {"inertia_std_kg_m2": inertia, "viscous_damping_std_nm_s_rad": damping, "gravity_std_nm": gravity}
    return replace(link, **{name: kept(getattr(link, name), s) for name, s in std.items()})


def _effect(effect: Effect) -> Effect:
    parameters = {name: kept(value, effect.std.get(name)) for name, value in effect.parameters.items()}
    return replace(effect, parameters=parameters, std={name: kept(s, s) for name, s in effect.std.items()})


def _transmission(own: Transmission) -> Transmission:
    law = transmission_model(own)
    if own.covariance is None or law is None:
        return own
    covariance = np.asarray(own.covariance)
    std = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    if not np.all(std > 0.0):
        return own
    alone = std / np.sqrt(np.maximum(np.diag(np.linalg.pinv(covariance / np.outer(std, std))), 1.0))
    alpha = kept(tuple(law.alpha(own.parameters).tolist()), tuple(alone.tolist()))
    return replace(own, parameters=law.parameters(alpha))
