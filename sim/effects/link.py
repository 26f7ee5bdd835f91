"""Effects at the link.

Signs: x of a motor opposes it in eqs 5, 7, x of the link opposes it in eqs 4, 6, x of a transmission adds
to tau_e. Names and parameters are the estimator's, so that a model can be simulated; the laws are
independent.
"""

from __future__ import annotations

import math

from sim.effects.assembly import Assembly, Definition, EffectParameter, Values
from sim.effects.common import SMOOTHING, at_speed, not_negative, wave


def _gravity(a: Assembly, m: int, p: Values) -> None:
    height, phase = wave(p["sin_nm"], p["cos_nm"], 1.0)
    a.link.loads.append(lambda q, v: height * math.sin(q + phase))


def _link_coulomb(a: Assembly, m: int, p: Values) -> None:
    level = not_negative(p, "torque_nm")
    a.link.dry.append(at_speed(lambda q, v, te, t: level, p["smoothing_rad_s"]))


def _link_viscous(a: Assembly, m: int, p: Values) -> None:
    a.link.viscous_damping_nm_s_rad += p["damping_nm_s_rad"]


def _link_inertia(a: Assembly, m: int, p: Values) -> None:
    a.link.inertia_kg_m2 += p["inertia_kg_m2"]


def _contact(a: Assembly, m: int, p: Values) -> None:
    k, at, side = p["stiffness_nm_rad"], p["position_rad"], math.copysign(1.0, p["side"])
    a.link.loads.append(lambda q, v: side * k * max(0.0, side * (q - at)))


DEFINITIONS = (
    Definition(
        name="gravity",
        location="link",
        meaning="gravity beyond what is declared",
        parameters=(
            EffectParameter("sin_nm", "torque times sin q"),
            EffectParameter("cos_nm", "torque times cos q", 0.0),
        ),
        apply=_gravity,
    ),
    Definition(
        name="link_coulomb_friction",
        location="link",
        meaning="dry friction of the link, which sticks",
        parameters=(EffectParameter("torque_nm", "friction torque"), SMOOTHING),
        apply=_link_coulomb,
    ),
    Definition(
        name="link_viscous_damping",
        location="link",
        meaning="viscous damping beyond what is declared",
        parameters=(EffectParameter("damping_nm_s_rad", "torque per velocity"),),
        apply=_link_viscous,
    ),
    Definition(
        name="link_inertia",
        location="link",
        meaning="inertia beyond what is declared",
        parameters=(EffectParameter("inertia_kg_m2", "that inertia"),),
        apply=_link_inertia,
    ),
    Definition(
        name="contact",
        location="link",
        meaning="the link touches something elastic",
        parameters=(
            EffectParameter("stiffness_nm_rad", "stiffness of what is touched"),
            EffectParameter("position_rad", "link position of the first touch", 0.3),
            EffectParameter("side", "1: touched from below, -1: from above", 1.0),
        ),
        apply=_contact,
    ),
)
