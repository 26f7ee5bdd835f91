"""Effects of the transmission, acting on both sides.

Signs: x of a motor opposes it in eqs 5, 7, x of the link opposes it in eqs 4, 6, x of a transmission adds
to tau_e. Names and parameters are the estimator's, so that a model can be simulated; the laws are
independent.
"""

from __future__ import annotations

import math
from collections.abc import Callable

from sim.effects.assembly import Assembly, Definition, EffectParameter, Values
from sim.effects.common import SLIP, not_negative, slip, wave
from sim.errors import SimError
from sim.springs import Law


def _hysteresis(a: Assembly, m: int, p: Values) -> None:
    element = slip(p)
    a.motors[m].extras.append(lambda phi, rate, theta: element.torque(phi))
    a.motors[m].commits.append(lambda theta, phi: element.commit(phi))


def _backlash(a: Assembly, m: int, p: Values) -> None:
    gap, k = not_negative(p, "half_gap_rad"), p["stiffness_nm_rad"]

    def clipped(phi: float) -> float:
        return min(max(phi, -gap), gap)

    def dead_zone(law: Law) -> Law:
        return Law(
            lambda phi: law.torque(phi - clipped(phi)),
            lambda phi: law.stiffness(phi - clipped(phi)) if abs(phi) > gap else 0.0,
            lambda phi: law.potential(phi - clipped(phi)),
        )

    def softened(law: Law) -> Law:
        return Law(
            lambda phi: law.torque(phi) - k * clipped(phi),
            lambda phi: law.stiffness(phi) - (0.0 if abs(phi) > gap else k),
            lambda phi: law.potential(phi) - k * clipped(phi) * (phi - 0.5 * clipped(phi)),
        )

    a.motors[m].reshape.append(softened if k else dead_zone)


def _power(coefficient: float, power: float) -> Callable[[Law], Law]:
    n = round(power)
    if n != power or n < 2:
        raise SimError(f"power: expected a whole number >= 2, got {power!r}")
    return lambda law: Law(
        lambda phi: law.torque(phi) + coefficient * phi**n,
        lambda phi: law.stiffness(phi) + coefficient * n * phi ** (n - 1),
        lambda phi: law.potential(phi) + coefficient * phi ** (n + 1) / (n + 1),
    )


def _asymmetric_stiffness(a: Assembly, m: int, p: Values) -> None:
    a.motors[m].reshape.append(_power(p["coefficient_nm_rad2"], 2.0))


def _higher_order(a: Assembly, m: int, p: Values) -> None:
    a.motors[m].reshape.append(_power(p["coefficient"], p["power"]))


def _transmission_damping(a: Assembly, m: int, p: Values) -> None:
    d = p["damping_nm_s_rad"]
    a.motors[m].extras.append(lambda phi, rate, theta: d * rate)


def _kinematic_error(a: Assembly, m: int, p: Values) -> None:
    n, sin, cos = p["periods_per_rev"], math.sin, math.cos
    height, phase = wave(p["sin_rad"], p["cos_rad"], n)

    def error(theta: float) -> tuple[float, float]:
        angle = n * theta + phase
        return -height * sin(angle), -height * n * cos(angle)

    a.motors[m].kinematics.append(error)


DEFINITIONS = (
    Definition(
        name="hysteresis",
        location="transmission",
        meaning="torque that depends on the way the deflection has come",
        parameters=(*SLIP,),
        apply=_hysteresis,
    ),
    Definition(
        name="backlash",
        location="transmission",
        meaning="play: a range of deflection without torque",
        parameters=(
            EffectParameter("half_gap_rad", "half of the gap"),
            EffectParameter(
                "stiffness_nm_rad", "stiffness that is missing inside the gap; 0: the spring as a whole", 0.0
            ),
        ),
        apply=_backlash,
    ),
    Definition(
        name="asymmetric_stiffness",
        location="transmission",
        meaning="stiffness that differs between the directions",
        parameters=(EffectParameter("coefficient_nm_rad2", "torque per squared deflection"),),
        apply=_asymmetric_stiffness,
    ),
    Definition(
        name="higher_order_stiffness",
        location="transmission",
        meaning="stiffening beyond the declared law",
        parameters=(
            EffectParameter("coefficient", "torque per power of deflection, N·m/rad^power"),
            EffectParameter("power", "power of the deflection", 5.0),
        ),
        apply=_higher_order,
    ),
    Definition(
        name="transmission_damping",
        location="transmission",
        meaning="viscous damping of the transmission",
        parameters=(EffectParameter("damping_nm_s_rad", "torque per deflection rate"),),
        apply=_transmission_damping,
    ),
    Definition(
        name="kinematic_error",
        location="transmission",
        meaning="the gear turns unevenly: the spring sees more deflection than there is",
        parameters=(
            EffectParameter("sin_rad", "amplitude of the sine, as a deflection"),
            EffectParameter("cos_rad", "amplitude of the cosine", 0.0),
            EffectParameter("periods_per_rev", "periods in one joint revolution", 16.0),
        ),
        apply=_kinematic_error,
    ),
)
