"""What an effect is: its name, place, parameters and terms, and the coordinates a term may depend on."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import ModuleType
from typing import Any, Literal, NamedTuple

__all__ = ["Channel", "Coordinates", "EffectType", "Law", "Location", "Parameter", "Terms", "Values"]

Location = Literal["motor", "transmission", "link", "measurement"]
Channel = Literal["torque", "motor_torque", "deflection", "link_position"]


class Coordinates(NamedTuple):
    """What a term may depend on: numbers of one tick, or arrays over a recording, all filtered alike.

    Attributes:
        position: theta, rad.
        velocity: theta', rad/s.
        acceleration: theta'', rad/s².
        deflection: phi = q - theta, rad.
        deflection_rate: phi', rad/s.
        flexibility_torque: tau_e(phi), N·m.
        stiffness: d tau_e / d phi, N·m/rad.
        torque: the motor's measured torque tau, N·m.
        torque_rate: its derivative, N·m/s.
        link_position: q, rad.
        link_velocity: q', rad/s.
        link_acceleration: q'', rad/s².
        time: since the start, s.
    """

    position: Any
    velocity: Any
    acceleration: Any
    deflection: Any
    deflection_rate: Any
    flexibility_torque: Any
    stiffness: Any
    torque: Any
    torque_rate: Any
    link_position: Any
    link_velocity: Any
    link_acceleration: Any
    time: Any


class Parameter(NamedTuple):
    """One parameter of an effect.

    Attributes:
        name: with its unit, as it stands in a joint file.
        meaning: in words.
        linear: whether the effect is proportional to it; the k-th linear parameter weighs the k-th term.
        default: its value where a joint file leaves it out; None: it must be given.
    """

    name: str
    meaning: str
    linear: bool = True
    default: float | None = None


Values = Mapping[str, float]
Terms = Callable[[Coordinates, Values, ModuleType], tuple[Any, ...]]
Law = Callable[[Any, Coordinates, float, Values, ModuleType], Any]


@dataclass(frozen=True, slots=True, kw_only=True)
class EffectType:
    """One kind of effect.

    Attributes:
        name: as in joint files and reports.
        location: the part of the joint it belongs to.
        channel: what it acts on: the torque balance of its location; the motor torque's measurement; the
            deflection (the zero between the encoders); the link encoder's reading.
        coordinate: the coordinate that reveals it, a field of `Coordinates`.
        parameters: its parameters.
        terms: the terms. Channel "torque": torques; "motor_torque": what the measured torque has too much;
            "deflection", "link_position": what the reading has too much, rad.
        law: for effects with memory: (z, coordinates, period_s, values, module) -> new z; z is the term.
        description: for reports, in a few words.
    """

    name: str
    location: Location
    channel: Channel = "torque"
    coordinate: str
    parameters: tuple[Parameter, ...]
    terms: Terms | None = None
    law: Law | None = None
    description: str

    @property
    def linear(self) -> tuple[str, ...]:
        """Names of the linear parameters, in the order of the terms."""
        return tuple(p.name for p in self.parameters if p.linear)

    @property
    def nonlinear(self) -> tuple[str, ...]:
        """Names of the parameters that enter nonlinearly."""
        return tuple(p.name for p in self.parameters if not p.linear)

    @property
    def on_link(self) -> bool:
        """Whether a joint file holds it under [[link.effect]] and not under [[motor.effect]]."""
        return self.location == "link" or self.channel == "link_position"
