"""Parts of a joint: transmission laws, bodies, springs, and the terms that effects add.

A law gives torque, stiffness and potential of a deflection in closed form, on purpose independently of the
estimator's. Every law is odd, has a potential (eq 1) and is made of scalar closures, because the plant calls
it four times per step.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Literal

from sim.errors import SimError, expected, require

Scalar = Callable[[float], float]
Parameters = Mapping[str, float | tuple[float, ...]]

RIGID = "none"


@dataclass(frozen=True, slots=True)
class Law:
    """A transmission's elastic law over its deflection phi (rad)."""

    torque: Scalar  # tau_e(phi), N·m (eq 1)
    stiffness: Scalar  # sigma(phi) = d tau_e / d phi, N·m/rad (eq 3)
    potential: Scalar  # U_e(phi), J


@dataclass(frozen=True, slots=True, kw_only=True)
class Spring:
    """A transmission law by name and parameters."""

    model: str  # "linear", "polynomial", "vsa-ii", "exponential", or "none" for a rigid coupling
    parameters: Parameters = field(default_factory=dict)  # by names that carry their unit (see `MODELS`)

    def __post_init__(self) -> None:
        if self.model != RIGID:
            self.law()

    @property
    def rigid(self) -> bool:
        """Whether motor and link are one body."""
        return self.model == RIGID

    def law(self) -> Law:
        """Return the law as closures.

        Raises:
            SimError: unknown model, missing, unknown or impossible parameter, or a rigid coupling.
        """
        if self.model not in MODELS:
            raise SimError(
                f'transmission model "{self.model}": {expected(self.model, [*sorted(MODELS), RIGID])}'
            )
        build, names = MODELS[self.model]
        missing = [name for name in names if name not in self.parameters]
        unknown = [name for name in self.parameters if name not in names]
        if missing or unknown:
            got = ", ".join(self.parameters) or "nothing"
            raise SimError(f'transmission "{self.model}": expected {", ".join(names)}, got {got}')
        return build(self.parameters)


def _linear(parameters: Parameters) -> Law:
    """tau_e = k phi."""
    k = require("k_nm_rad", parameters["k_nm_rad"], positive=True)
    return Law(lambda phi: k * phi, lambda phi: k, lambda phi: 0.5 * k * phi * phi)


def _polynomial(parameters: Parameters) -> Law:
    """tau_e = sum_h a_h phi^(2h-1): odd powers only, evaluated by Horner's rule in phi²."""
    given = parameters["coefficients_nm_rad"]
    if not isinstance(given, tuple | list) or not given or not all(math.isfinite(a) for a in given):
        raise SimError(f"coefficients_nm_rad: expected a list of finite numbers, got {given!r}")
    torque = tuple(float(a) for a in reversed(given))
    powers = range(2 * len(given) - 1, 0, -2)
    slope = tuple(a * n for a, n in zip(torque, powers, strict=True))
    energy = tuple(a / (n + 1) for a, n in zip(torque, powers, strict=True))
    if len(torque) == 2:
        k3, k1 = torque
        return Law(
            lambda phi: (k1 + k3 * phi * phi) * phi,
            lambda phi: k1 + 3.0 * k3 * phi * phi,
            lambda phi: (0.5 * k1 + 0.25 * k3 * phi * phi) * phi * phi,
        )

    def horner(coefficients: tuple[float, ...], square: float) -> float:
        total = 0.0
        for a in coefficients:
            total = total * square + a
        return total

    return Law(
        lambda phi: phi * horner(torque, phi * phi),
        lambda phi: horner(slope, phi * phi),
        lambda phi: phi * phi * horner(energy, phi * phi),
    )


def _vsa_ii(parameters: Parameters) -> Law:
    """tau_e = 2 k beta beta', beta = asin(C sin(phi/2)) - phi/2 (eqs 19, 20), so U_e = k beta².

    The four-bar linkage is fully stretched at C sin(phi/2) = 1. From 99.5 % of that angle on the law
    continues as a straight line, so that torques stay finite.
    """
    k = require("k_nm_rad", parameters["k_nm_rad"], positive=True)
    c = require("c", parameters["c"], positive=True)
    if c <= 1.0:
        raise SimError(f"c: expected a number > 1 (eq 20), got {c!r}")
    sin, cos, asin, sqrt = math.sin, math.cos, math.asin, math.sqrt
    two_k, half_c = 2.0 * k, 0.5 * c
    stop = 0.995 * 2.0 * asin(1.0 / c)

    def inside(phi: float) -> float:
        half = 0.5 * phi
        u = c * sin(half)
        return two_k * (asin(u) - half) * (half_c * cos(half) / sqrt(1.0 - u * u) - 0.5)

    def slope_inside(phi: float) -> float:
        half = 0.5 * phi
        u, du = c * sin(half), half_c * cos(half)
        root = sqrt(1.0 - u * u)
        bend = du / root - 0.5
        return two_k * (bend * bend + (asin(u) - half) * (u * du * du / root**3 - 0.25 * u / root))

    edge, edge_slope = inside(stop), slope_inside(stop)
    edge_energy = k * (asin(c * sin(0.5 * stop)) - 0.5 * stop) ** 2

    def torque(phi: float) -> float:
        if -stop < phi < stop:
            return inside(phi)
        return math.copysign(edge + edge_slope * (abs(phi) - stop), phi)

    def potential(phi: float) -> float:
        over = abs(phi) - stop
        if over < 0.0:
            return k * (asin(c * sin(0.5 * phi)) - 0.5 * phi) ** 2
        return edge_energy + (edge + 0.5 * edge_slope * over) * over

    return Law(torque, lambda phi: slope_inside(phi) if -stop < phi < stop else edge_slope, potential)


def _exponential(parameters: Parameters) -> Law:
    """tau_e = sign(phi) (k/b) (exp(b |phi|) - 1): a stiffness that grows with the torque, k + b |tau_e|."""
    k = require("k_nm_rad", parameters["k_nm_rad"], positive=True)
    b = require("b_per_rad", parameters["b_per_rad"], positive=True)
    gain, expm1, exp, copysign = k / b, math.expm1, math.exp, math.copysign
    return Law(
        lambda phi: copysign(gain * expm1(b * abs(phi)), phi),
        lambda phi: k * exp(b * abs(phi)),
        lambda phi: gain * (expm1(b * abs(phi)) / b - abs(phi)),
    )


MODELS: dict[str, tuple[Callable[[Parameters], Law], tuple[str, ...]]] = {
    "linear": (_linear, ("k_nm_rad",)),
    "polynomial": (_polynomial, ("coefficients_nm_rad",)),
    "vsa-ii": (_vsa_ii, ("k_nm_rad", "c")),
    "exponential": (_exponential, ("k_nm_rad", "b_per_rad")),
}
"""Law by name, with the parameters that it needs."""


Arrangement = Literal["single", "antagonistic", "serial"]
Load = Callable[[float, float], float]
"""Torque (N·m) that opposes the motion, of position and velocity."""
Dry = Callable[[float, float, float, float], float]
"""Level (N·m, >= 0) of dry friction, of position, velocity, transmission torque and time."""
Extra = Callable[[float, float, float], float]
"""Torque (N·m) added to tau_e on both sides, of deflection, its rate and theta."""
Kinematics = Callable[[float], tuple[float, float]]
"""Error e(theta) of the gear (rad) and its slope de/dtheta: the spring sees phi - e."""
Commit = Callable[[float, float], None]
"""Called with theta and the deflection of the spring at the end of each step."""


@dataclass(slots=True, kw_only=True)
class Terms:
    """Terms that effects add to one body."""

    loads: list[Load] = field(default_factory=list)  # x(position, velocity), N·m
    dry: list[Dry] = field(default_factory=list)  # levels of dry friction, N·m
    # Of a motor's transmission, added to tau_e on both sides.
    extras: list[Extra] = field(default_factory=list)
    kinematics: list[Kinematics] = field(default_factory=list)  # of a motor's gear
    commits: list[Commit] = field(default_factory=list)  # memories to update at each step
    reshape: list[Callable[[Law], Law]] = field(default_factory=list)  # of a motor's spring, applied in order


@dataclass(frozen=True, slots=True, kw_only=True)
class MotorPlant:
    """A motor and its transmission, reflected to the joint."""

    inertia_kg_m2: float  # B > 0
    viscous_damping_nm_s_rad: float = 0.0  # D_theta >= 0
    spring: Spring  # tau_e(phi); rigid: motor and link are one body
    terms: Terms = field(default_factory=Terms)  # further physics

    def __post_init__(self) -> None:
        require("motor: inertia_kg_m2", self.inertia_kg_m2, positive=True)
        require("motor: viscous_damping_nm_s_rad", self.viscous_damping_nm_s_rad, positive=False)

    def law(self) -> Law:
        """Return the elastic law including effects."""
        law = self.spring.law()
        for reshape in self.terms.reshape:
            law = reshape(law)
        return law


@dataclass(frozen=True, slots=True, kw_only=True)
class LinkPlant:
    """The link: g(q) = gravity_nm sin(q + gravity_phase_rad)."""

    inertia_kg_m2: float  # M > 0
    viscous_damping_nm_s_rad: float = 0.0  # D_q >= 0
    gravity_nm: float = 0.0  # amplitude of gravity
    gravity_phase_rad: float = 0.0  # angle added to q
    terms: Terms = field(default_factory=Terms)  # further physics

    def __post_init__(self) -> None:
        require("link: inertia_kg_m2", self.inertia_kg_m2, positive=True)
        require("link: viscous_damping_nm_s_rad", self.viscous_damping_nm_s_rad, positive=False)


@dataclass(frozen=True, slots=True, kw_only=True)
class JointPlant:
    """A joint: motors, transmissions and link."""

    # "single", "antagonistic" (eq 9) or "serial" (motor 2 sets the lever of motor 1's spring)
    arrangement: Arrangement
    motors: tuple[MotorPlant, ...]  # one, or two
    link: LinkPlant  # the link
    lever_per_rad: float = 0.0  # l of the serial arrangement, 1/rad; unused otherwise

    def __post_init__(self) -> None:
        expected = 1 if self.arrangement == "single" else 2
        if len(self.motors) != expected:
            raise SimError(f'"{self.arrangement}": expected {expected} motor(s), got {len(self.motors)}')
        springs = self.motors if self.arrangement == "antagonistic" else self.motors[:1]
        if expected == 2 and any(motor.spring.rigid for motor in springs):
            raise SimError(f'"{self.arrangement}": expected a flexible transmission, got "none"')

    @property
    def rigid(self) -> bool:
        """Whether motor and link are one body."""
        return self.arrangement == "single" and self.motors[0].spring.rigid
