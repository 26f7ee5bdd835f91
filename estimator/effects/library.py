"""The library of physical effects: what each one is, where it sits, its parameters, its terms.

One definition serves arrays (regressors of a recording) and numbers (terms of the 1 kHz loop): a term is
written with functions that `math` and `numpy` both have, and is given the module to take them from.

Signs: with x in N·m, B theta" + D theta' + x_motor - tau_e(phi) - x_transmission = tau and
M q" + D_q q' + g(q) + tau_e + x_transmission + x_link = tau_k. x is the sum over an effect's terms, each
times its linear parameter. A measured torque has x too much: the torque that acts is tau - x. A reading
has its error too much: the true position is the reading less the error.
"""

from __future__ import annotations

from types import ModuleType
from typing import Any

from estimator.effects.memory import advance
from estimator.effects.types import Coordinates, EffectType, Parameter, Values

__all__ = ["LIBRARY"]

_SMOOTHING = Parameter("smoothing_rad_s", "velocity over which the sign changes", False, 0.01)
_WAVES = (Parameter("periods_per_rev", "periods in one joint revolution", False),)
_MEMORY = (
    Parameter("torque_nm", "torque at full sliding"),
    Parameter("displacement_rad", "displacement scale of the build-up", False),
    Parameter("exponent", "1: Dahl; 2: Bouc-Wen; 50 and more: elastic up to the limit", False, 1.0),
    Parameter("shape", "share of the law that depends on the direction (Dahl 1, Bouc-Wen 0.5)", False, 1.0),
)
_ERROR = Parameter("relative_error", "share by which the scale is off")

Out = tuple[Any, ...]


def _sign(velocity: Any, p: Values, m: ModuleType) -> Any:
    return m.tanh(velocity / p["smoothing_rad_s"])


def _coulomb(c: Coordinates, p: Values, m: ModuleType) -> Out:
    return (_sign(c.velocity, p, m),)


def _stribeck(c: Coordinates, p: Values, m: ModuleType) -> Out:
    ratio = c.velocity / p["stribeck_velocity_rad_s"]
    sign = _sign(c.velocity, p, m)
    return sign, sign * m.exp(-ratio * ratio)


def _asymmetric(c: Coordinates, p: Values, m: ModuleType) -> Out:
    sign = _sign(c.velocity, p, m)
    return 0.5 * (sign + m.fabs(sign)), 0.5 * (sign - m.fabs(sign))


def _load_dependent(c: Coordinates, p: Values, m: ModuleType) -> Out:
    return (m.fabs(c.flexibility_torque) * _sign(c.velocity, p, m),)


def _back_driving(c: Coordinates, p: Values, m: ModuleType) -> Out:
    sign = _sign(c.velocity, p, m)
    # tau_e acts on the motor as +tau_e: the link drives while it has the velocity's sign.
    return (0.5 * (m.fabs(c.flexibility_torque) * sign + c.flexibility_torque * m.fabs(sign)),)


def _waves(c: Coordinates, p: Values, m: ModuleType) -> Out:
    angle = p["periods_per_rev"] * c.position
    return m.sin(angle), m.cos(angle)


def _kinematic(c: Coordinates, p: Values, m: ModuleType) -> Out:
    sine, cosine = _waves(c, p, m)
    return c.stiffness * sine, c.stiffness * cosine


def _backlash(c: Coordinates, p: Values, m: ModuleType) -> Out:
    gap = p["half_gap_rad"]
    return (0.5 * (m.fabs(c.deflection - gap) - m.fabs(c.deflection + gap)),)


def _higher_order(c: Coordinates, p: Values, m: ModuleType) -> Out:
    power = c.deflection
    for _ in range(int(p["power"]) - 1):
        power = power * c.deflection
    return (power,)


def _drift(c: Coordinates, p: Values, m: ModuleType) -> Out:
    return (-c.torque * (1.0 - m.exp(-c.time / p["time_constant_s"])),)


def _contact(c: Coordinates, p: Values, m: ModuleType) -> Out:
    depth = p["side"] * (c.link_position - p["position_rad"])
    return (0.5 * p["side"] * (depth + m.fabs(depth)),)


def _motor_memory(z: Any, c: Coordinates, period_s: float, p: Values, m: ModuleType) -> Any:
    return advance(z, c.velocity * period_s / p["displacement_rad"], p["exponent"], p["shape"], m)


def _deflection_memory(z: Any, c: Coordinates, period_s: float, p: Values, m: ModuleType) -> Any:
    return advance(z, c.deflection_rate * period_s / p["displacement_rad"], p["exponent"], p["shape"], m)


_MOTOR = (
    EffectType(
        name="coulomb_friction",
        location="motor",
        coordinate="velocity",
        parameters=(Parameter("torque_nm", "friction torque"), _SMOOTHING),
        terms=_coulomb,
        description="dry friction of the motor",
    ),
    EffectType(
        name="stribeck_friction",
        location="motor",
        coordinate="velocity",
        parameters=(
            Parameter("torque_nm", "friction torque while sliding"),
            Parameter("stribeck_nm", "what is added near standstill"),
            Parameter("stribeck_velocity_rad_s", "velocity at which it has decayed", False),
            _SMOOTHING,
        ),
        terms=_stribeck,
        description="dry friction that falls with velocity",
    ),
    EffectType(
        name="asymmetric_friction",
        location="motor",
        coordinate="velocity",
        parameters=(
            Parameter("positive_nm", "friction torque in positive motion"),
            Parameter("negative_nm", "friction torque in negative motion"),
            _SMOOTHING,
        ),
        terms=_asymmetric,
        description="dry friction that differs between the directions",
    ),
    EffectType(
        name="presliding_friction",
        location="motor",
        coordinate="position",
        parameters=_MEMORY,
        law=_motor_memory,
        description="friction that builds up over a displacement",
    ),
    EffectType(
        name="load_dependent_friction",
        location="motor",
        coordinate="velocity",
        parameters=(Parameter("coefficient", "friction per flexibility torque"), _SMOOTHING),
        terms=_load_dependent,
        description="dry friction that grows with the transmitted torque",
    ),
    EffectType(
        name="viscous_damping",
        location="motor",
        coordinate="velocity",
        parameters=(Parameter("damping_nm_s_rad", "damping beyond what is declared"),),
        terms=lambda c, p, m: (c.velocity,),
        description="viscous damping of the motor",
    ),
    EffectType(
        name="quadratic_damping",
        location="motor",
        coordinate="velocity",
        parameters=(Parameter("damping_nm_s2_rad2", "torque per squared velocity"),),
        terms=lambda c, p, m: (c.velocity * m.fabs(c.velocity),),
        description="damping that grows with the square of velocity",
    ),
    EffectType(
        name="cogging",
        location="motor",
        coordinate="position",
        parameters=(
            Parameter("sin_nm", "amplitude of the sine"),
            Parameter("cos_nm", "amplitude of the cosine"),
            *_WAVES,
        ),
        terms=_waves,
        description="torque ripple over the motor position",
    ),
    EffectType(
        name="torque_offset",
        location="motor",
        coordinate="time",
        parameters=(Parameter("torque_nm", "torque that is always there"),),
        terms=lambda c, p, m: (1.0 + 0.0 * c.velocity,),
        description="offset of the motor torque or current",
    ),
    EffectType(
        name="torque_constant",
        location="motor",
        channel="motor_torque",
        coordinate="torque",
        parameters=(_ERROR,),
        terms=lambda c, p, m: (-c.torque,),
        description="the torque that acts is another multiple of what is reported",
    ),
    EffectType(
        name="torque_saturation",
        location="motor",
        channel="motor_torque",
        coordinate="torque",
        parameters=(Parameter("coefficient_per_nm2", "what is lost per cubed torque"),),
        terms=lambda c, p, m: (c.torque * c.torque * c.torque,),
        description="large torques fall short of what is reported",
    ),
    EffectType(
        name="torque_drift",
        location="motor",
        channel="motor_torque",
        coordinate="time",
        parameters=(
            Parameter("relative_change", "change of the torque scale in the long run"),
            Parameter("time_constant_s", "time constant of the change", False),
        ),
        terms=_drift,
        description="the torque scale changes as the motor warms up",
    ),
    EffectType(
        name="motor_inertia",
        location="motor",
        coordinate="acceleration",
        parameters=(Parameter("inertia_kg_m2", "inertia beyond what is declared"),),
        terms=lambda c, p, m: (c.acceleration,),
        description="another motor inertia than declared",
    ),
    EffectType(
        name="torque_delay",
        location="motor",
        channel="motor_torque",
        coordinate="torque_rate",
        parameters=(Parameter("delay_s", "the torque acts later than reported by"),),
        terms=lambda c, p, m: (c.torque_rate,),
        description="the torque acts later than it is reported",
    ),
    EffectType(
        name="torque_lag",
        location="motor",
        channel="motor_torque",
        coordinate="torque_rate",
        parameters=(
            Parameter("time_constant_s", "by which the acting torque lags; negative: the reported one does"),
        ),
        terms=lambda c, p, m: (c.torque_rate,),
        description="reported and acting torque are apart by a first-order lag",
    ),
    EffectType(
        name="back_driving_loss",
        location="motor",
        coordinate="velocity",
        parameters=(
            Parameter("coefficient", "loss per flexibility torque while the link drives"),
            _SMOOTHING,
        ),
        terms=_back_driving,
        description="the gear loses torque while the link drives the motor",
    ),
)

_TRANSMISSION = (
    EffectType(
        name="hysteresis",
        location="transmission",
        coordinate="deflection",
        parameters=_MEMORY,
        law=_deflection_memory,
        description="hysteresis of the transmission",
    ),
    EffectType(
        name="backlash",
        location="transmission",
        coordinate="deflection",
        parameters=(
            Parameter("stiffness_nm_rad", "stiffness that is missing inside the gap"),
            Parameter("half_gap_rad", "half of the gap", False),
        ),
        terms=_backlash,
        description="play: a range of deflection without torque",
    ),
    EffectType(
        name="asymmetric_stiffness",
        location="transmission",
        coordinate="deflection",
        parameters=(Parameter("coefficient_nm_rad2", "torque per squared deflection"),),
        terms=lambda c, p, m: (c.deflection * c.deflection,),
        description="stiffness that differs between the directions",
    ),
    EffectType(
        name="higher_order_stiffness",
        location="transmission",
        coordinate="deflection",
        parameters=(
            Parameter("coefficient", "torque per power of deflection, N·m/rad^power"),
            Parameter("power", "odd power of the deflection", False, 5.0),
        ),
        terms=_higher_order,
        description="stiffening beyond the declared model",
    ),
    EffectType(
        name="transmission_damping",
        location="transmission",
        coordinate="deflection_rate",
        parameters=(Parameter("damping_nm_s_rad", "torque per deflection rate"),),
        terms=lambda c, p, m: (c.deflection_rate,),
        description="viscous damping of the transmission",
    ),
    EffectType(
        name="kinematic_error",
        location="transmission",
        coordinate="position",
        parameters=(
            Parameter("sin_rad", "amplitude of the sine, as a deflection"),
            Parameter("cos_rad", "amplitude of the cosine, as a deflection"),
            *_WAVES,
        ),
        terms=_kinematic,
        description="transmission error over the motor position",
    ),
)

_MEASUREMENT = (
    EffectType(
        name="deflection_offset",
        location="measurement",
        channel="deflection",
        coordinate="time",
        parameters=(Parameter("offset_rad", "deflection that is read when there is none"),),
        terms=lambda c, p, m: (1.0 + 0.0 * c.deflection,),
        description="constant offset between the encoders",
    ),
    EffectType(
        name="encoder_eccentricity",
        location="measurement",
        channel="link_position",
        coordinate="link_position",
        parameters=(
            Parameter("sin_rad", "amplitude of the reading's error, sine of q"),
            Parameter("cos_rad", "amplitude of the reading's error, cosine of q"),
        ),
        terms=lambda c, p, m: (m.sin(c.link_position), m.cos(c.link_position)),
        description="once-per-revolution error of the link encoder",
    ),
    EffectType(
        name="encoder_delay",
        location="measurement",
        channel="link_position",
        coordinate="link_velocity",
        parameters=(Parameter("delay_s", "the link position is read later than the rest by"),),
        terms=lambda c, p, m: (-c.link_velocity,),
        description="the link encoder lags the other channels",
    ),
    EffectType(
        name="encoder_scale",
        location="measurement",
        channel="link_position",
        coordinate="link_position",
        parameters=(_ERROR,),
        terms=lambda c, p, m: (c.link_position,),
        description="scale error of the link encoder",
    ),
)

_LINK = (
    EffectType(
        name="gravity",
        location="link",
        coordinate="link_position",
        parameters=(
            Parameter("sin_nm", "torque times sin q beyond what is declared"),
            Parameter("cos_nm", "torque times cos q beyond what is declared"),
        ),
        terms=lambda c, p, m: (m.sin(c.link_position), m.cos(c.link_position)),
        description="gravity torque of the link",
    ),
    EffectType(
        name="link_coulomb_friction",
        location="link",
        coordinate="link_velocity",
        parameters=(Parameter("torque_nm", "friction torque"), _SMOOTHING),
        terms=lambda c, p, m: (_sign(c.link_velocity, p, m),),
        description="dry friction of the link",
    ),
    EffectType(
        name="link_viscous_damping",
        location="link",
        coordinate="link_velocity",
        parameters=(Parameter("damping_nm_s_rad", "damping beyond what is declared"),),
        terms=lambda c, p, m: (c.link_velocity,),
        description="viscous damping of the link",
    ),
    EffectType(
        name="link_inertia",
        location="link",
        coordinate="link_acceleration",
        parameters=(Parameter("inertia_kg_m2", "inertia beyond what is declared"),),
        terms=lambda c, p, m: (c.link_acceleration,),
        description="another link inertia than declared",
    ),
    EffectType(
        name="contact",
        location="link",
        coordinate="link_position",
        parameters=(
            Parameter("stiffness_nm_rad", "stiffness of what is touched"),
            Parameter("position_rad", "link position of the first touch", False),
            Parameter("side", "1: touched from below, -1: from above", False, 1.0),
        ),
        terms=_contact,
        description="the link touches something",
    ),
)

LIBRARY: dict[str, EffectType] = {
    effect.name: effect for effect in (*_MOTOR, *_TRANSMISSION, *_MEASUREMENT, *_LINK)
}
