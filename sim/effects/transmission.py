"""Effects of the transmission, acting on both sides."""

import math
from collections.abc import Callable
from functools import partial

from sim.effects.assembly import LISTED, SLIP, Assembly, Values, define, not_negative, slip, wave
from sim.errors import SimError
from sim.plant import Law

_effect = partial(define, LISTED, "transmission")


def _power(coefficient: float, power: float) -> Callable[[Law], Law]:
    n = round(power)
    if n != power or n < 2:
        raise SimError(f"power: expected a whole number >= 2, got {power!r}")
    return lambda law: Law(
        lambda phi: law.torque(phi) + coefficient * phi**n,
        lambda phi: law.stiffness(phi) + coefficient * n * phi ** (n - 1),
        lambda phi: law.potential(phi) + coefficient * phi ** (n + 1) / (n + 1),
    )


@_effect("hysteresis", "torque that depends on the way the deflection has come", **SLIP)
def _hysteresis(a: Assembly, m: int, p: Values) -> None:
    element = slip(p)
    a.motors[m].extras.append(lambda phi, rate, theta: element.torque(phi))
    a.motors[m].commits.append(lambda theta, phi: element.commit(phi))


@_effect(
    "backlash",
    "play: a range of deflection without torque",
    half_gap_rad="half of the gap",
    stiffness_nm_rad=("stiffness that is missing inside the gap; 0: the spring as a whole", 0.0),
)
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


@_effect(
    "asymmetric_stiffness",
    "stiffness that differs between the directions",
    coefficient_nm_rad2="torque per squared deflection",
)
def _asymmetric_stiffness(a: Assembly, m: int, p: Values) -> None:
    a.motors[m].reshape.append(_power(p["coefficient_nm_rad2"], 2.0))


@_effect(
    "higher_order_stiffness",
    "stiffening beyond the declared law",
    coefficient="torque per power of deflection, N·m/rad^power",
    power=("power of the deflection", 5.0),
)
def _higher_order(a: Assembly, m: int, p: Values) -> None:
    a.motors[m].reshape.append(_power(p["coefficient"], p["power"]))


@_effect(
    "transmission_damping",
    "viscous damping of the transmission",
    damping_nm_s_rad="torque per deflection rate",
)
def _transmission_damping(a: Assembly, m: int, p: Values) -> None:
    d = p["damping_nm_s_rad"]
    a.motors[m].extras.append(lambda phi, rate, theta: d * rate)


@_effect(
    "kinematic_error",
    "the gear turns unevenly: the spring sees more deflection than there is",
    sin_rad="amplitude of the sine, as a deflection",
    cos_rad=("amplitude of the cosine", 0.0),
    periods_per_rev=("periods in one joint revolution", 16.0),
)
def _kinematic_error(a: Assembly, m: int, p: Values) -> None:
    n, sin, cos = p["periods_per_rev"], math.sin, math.cos
    height, phase = wave(p["sin_rad"], p["cos_rad"], n)

    def error(theta: float) -> tuple[float, float]:
        angle = n * theta + phase
        return -height * sin(angle), -height * n * cos(angle)

    a.motors[m].kinematics.append(error)
