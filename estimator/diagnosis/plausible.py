"""What an effect cannot be, or hardly: friction that drives, negative inertia, twice the declared inertia."""

from __future__ import annotations

import numpy as np

from estimator.diagnosis.frame import Frame
from estimator.model import JointModel
from estimator.sample import FloatArray

__all__ = ["doubt", "plausible"]

_POSITIVE = {
    "coulomb_friction",
    "presliding_friction",
    "load_dependent_friction",
    "quadratic_damping",
    "hysteresis",
    "backlash",
    "transmission_damping",
    "link_coulomb_friction",
    "contact",
}
_SATURATED = 0.4  # largest loss at the largest torque
_SCALE = 0.5  # largest relative error of a scale
_LATEST_S = 0.0125  # no drive and no encoder is later than this
_DRIFT = 0.8  # and by drift in the long run
_READ = 0.3  # largest relative error of an encoder
_INERTIA = 0.8  # largest share of an inertia that may be missing
_UNLIKELY = (
    0.4  # share of an inertia from which a correction is doubted: declared numbers are better than that
)
_OPPOSITE = -0.2  # of the larger friction in one direction: the smaller one in the other


def plausible(frame: Frame, name: str, motor: int | None, weights: FloatArray) -> bool:
    """Whether linear parameters of an effect can be true.

    Args:
        frame: the recording.
        name: of the effect.
        motor: where it is; None: at the link.
        weights: its linear parameters.
    """
    first = float(weights[0])
    link = frame.model.link
    own = frame.model.motors[motor or 0]
    if name in _POSITIVE:
        return first > 0.0
    if name in ("torque_constant", "torque_drift"):
        return abs(first) < (_SCALE if name == "torque_constant" else _DRIFT)
    if name == "torque_saturation":
        return 0.0 < first * float(np.max(frame.motors[motor or 0].torque ** 2)) < _SATURATED
    if name in ("encoder_delay", "torque_delay"):
        return abs(first) < max(_LATEST_S, 3.0 * frame.signals.period_s)
    if name == "encoder_scale":
        return abs(first) < _READ
    if name == "motor_inertia":
        return first > -_INERTIA * own.inertia_kg_m2
    if name == "link_inertia" and link is not None:
        return first > -_INERTIA * link.inertia_kg_m2
    if name == "viscous_damping":
        return first > -own.viscous_damping_nm_s_rad - 1e-12
    if name == "link_viscous_damping" and link is not None:
        return first > -link.viscous_damping_nm_s_rad - 1e-12
    if name == "stribeck_friction":
        return first > 0.0 and float(weights[1]) > 0.0
    if name == "asymmetric_friction":
        low, high = sorted((first, float(weights[1])))
        return high > 0.0 and low > _OPPOSITE * high
    return True


def doubt(model: JointModel, name: str, motor: int | None, first: float) -> str | None:
    """Why a finding is hardly to be believed, although it can be; None where nothing speaks against it.

    Args:
        model: the joint as declared.
        name: of the effect.
        motor: where it is; None: at the link.
        first: its first parameter.
    """
    if name == "motor_inertia":
        declared = model.motors[motor or 0].inertia_kg_m2
    elif name == "link_inertia" and model.link is not None:
        declared = model.link.inertia_kg_m2
    else:
        return None
    if abs(first) <= _UNLIKELY * declared:
        return None
    return (
        f"an inertia of {first:.3g} kg·m² beyond the declared {declared:.3g} kg·m² is hardly to be believed: "
        "if the declared number is known, this motion does not tell it from a stiffness, a torque scale or "
        "what is not in the library"
    )
