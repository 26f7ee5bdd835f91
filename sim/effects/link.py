"""Effects at the link."""

from __future__ import annotations

import math
from functools import partial

from sim.effects.assembly import LISTED, Assembly, Values, define
from sim.effects.common import SMOOTHING, at_speed, not_negative, wave

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
