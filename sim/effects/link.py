"""Effects at the link, and in the measurement of positions: a reading is the true angle plus its error."""

import math
from functools import partial

from sim.effects.assembly import LISTED, SMOOTHING, Assembly, Values, at_speed, define, not_negative, wave

_effect = partial(define, LISTED, "link")


@_effect(
    "gravity",
    "gravity beyond what is declared",
    sin_nm="torque times sin q",
    cos_nm=("torque times cos q", 0.0),
)
def _gravity(a: Assembly, m: int, p: Values) -> None:
    height, phase = wave(p["sin_nm"], p["cos_nm"], 1.0)
    a.link.loads.append(lambda q, v: height * math.sin(q + phase))


@_effect(
    "link_coulomb_friction",
    "dry friction of the link, which sticks",
    torque_nm="friction torque",
    **SMOOTHING,
)
def _link_coulomb(a: Assembly, m: int, p: Values) -> None:
    level = not_negative(p, "torque_nm")
    a.link.dry.append(at_speed(lambda q, v, te, t: level, p["smoothing_rad_s"]))


@_effect(
    "link_viscous_damping", "viscous damping beyond what is declared", damping_nm_s_rad="torque per velocity"
)
def _link_viscous(a: Assembly, m: int, p: Values) -> None:
    a.link.viscous_damping_nm_s_rad += p["damping_nm_s_rad"]


@_effect("link_inertia", "inertia beyond what is declared", inertia_kg_m2="that inertia")
def _link_inertia(a: Assembly, m: int, p: Values) -> None:
    a.link.inertia_kg_m2 += p["inertia_kg_m2"]


@_effect(
    "contact",
    "the link touches something elastic",
    stiffness_nm_rad="stiffness of what is touched",
    position_rad=("link position of the first touch", 0.3),
    side=("1: touched from below, -1: from above", 1.0),
)
def _contact(a: Assembly, m: int, p: Values) -> None:
    k, at, side = p["stiffness_nm_rad"], p["position_rad"], math.copysign(1.0, p["side"])
    a.link.loads.append(lambda q, v: side * k * max(0.0, side * (q - at)))


_of_measurement = partial(define, LISTED, "measurement")


@_of_measurement(
    "deflection_offset",
    "constant offset of the link encoder, or with two motors of that motor's encoder",
    offset_rad="deflection that is read where there is none",
)
def _deflection_offset(a: Assembly, m: int, p: Values) -> None:
    offset = p["offset_rad"]
    if len(a.motors) == 1:
        a.link.readings.append(lambda q: q + offset)
    else:
        a.motors[m].readings.append(lambda theta: theta - offset)


@_of_measurement(
    "encoder_eccentricity",
    "the link encoder's disc is off centre",
    sin_rad="error of the reading, sine of q",
    cos_rad=("error of the reading, cosine of q", 0.0),
)
def _eccentricity(a: Assembly, m: int, p: Values) -> None:
    height, phase = wave(p["sin_rad"], p["cos_rad"], 1.0)
    a.link.readings.append(lambda q: q + height * math.sin(q + phase))


@_of_measurement("encoder_delay", "the link position is older than the rest", delay_s="by this time")
def _encoder_delay(a: Assembly, m: int, p: Values) -> None:
    a.link.reading_delay_s += not_negative(p, "delay_s")


@_of_measurement(
    "deflection_delay",
    "the deflection's sensor (strain gauges) is older than the rest",
    delay_s="by this time",
)
def _deflection_delay(a: Assembly, m: int, p: Values) -> None:
    a.link.deflection_delay_s += not_negative(p, "delay_s")


@_of_measurement(
    "encoder_scale", "the link encoder's scale is wrong", relative_error="share by which it reads too much"
)
def _encoder_scale(a: Assembly, m: int, p: Values) -> None:
    scale = 1.0 + p["relative_error"]
    a.link.readings.append(lambda q: q * scale)
