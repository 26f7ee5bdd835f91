"""Parts of a joint: bodies, springs, and the terms that effects add."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

from sim.errors import SimError
from sim.springs import Law, Spring

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


@dataclass(frozen=True, slots=True, kw_only=True)
class Terms:
    """Terms that effects add to one body."""

    loads: tuple[Load, ...] = ()  # x(position, velocity), N·m
    dry: tuple[Dry, ...] = ()  # levels of dry friction, N·m
    extras: tuple[Extra, ...] = ()  # of a motor's transmission, added to tau_e on both sides
    kinematics: tuple[Kinematics, ...] = ()  # of a motor's gear
    commits: tuple[Commit, ...] = ()  # memories to update at each step


@dataclass(frozen=True, slots=True, kw_only=True)
class MotorPlant:
    """A motor and its transmission, reflected to the joint."""

    inertia_kg_m2: float  # B > 0
    viscous_damping_nm_s_rad: float = 0.0  # D_theta >= 0
    spring: Spring  # tau_e(phi); rigid: motor and link are one body
    reshape: tuple[Callable[[Law], Law], ...] = ()  # changes of the spring's law by effects, applied in order
    terms: Terms = Terms()  # further physics

    def __post_init__(self) -> None:
        _check("motor", self.inertia_kg_m2, self.viscous_damping_nm_s_rad)

    def law(self) -> Law:
        """Return the elastic law including effects."""
        law = self.spring.law()
        for reshape in self.reshape:
            law = reshape(law)
        return law


@dataclass(frozen=True, slots=True, kw_only=True)
class LinkPlant:
    """The link: g(q) = gravity_nm sin(q + gravity_phase_rad)."""

    inertia_kg_m2: float  # M > 0
    viscous_damping_nm_s_rad: float = 0.0  # D_q >= 0
    gravity_nm: float = 0.0  # amplitude of gravity
    gravity_phase_rad: float = 0.0  # angle added to q
    terms: Terms = Terms()  # further physics

    def __post_init__(self) -> None:
        _check("link", self.inertia_kg_m2, self.viscous_damping_nm_s_rad)


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


def _check(body: str, inertia: float, damping: float) -> None:
    if not (math.isfinite(inertia) and inertia > 0.0):
        raise SimError(f"{body}: inertia_kg_m2: expected a finite number > 0, got {inertia!r}")
    if not (math.isfinite(damping) and damping >= 0.0):
        raise SimError(f"{body}: viscous_damping_nm_s_rad: expected a finite number >= 0, got {damping!r}")
