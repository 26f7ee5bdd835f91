"""Assembles a joint from its parts and the contributions of effects, some of which they share."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import TypeVar

from sim.effects.memory import Slip
from sim.errors import SimError
from sim.plant import Dry, JointPlant, LinkPlant, MotorPlant, Terms

Values = Mapping[str, float]
Body = TypeVar("Body", MotorPlant, LinkPlant)
Reading = Callable[[float], float]
"""True angle (rad) -> the angle that is read."""
TorquePath = Callable[[float, float, float], float]
"""(torque as the drive believes it, time, theta) -> torque that acts; N·m at the joint, s, rad."""


@dataclass(slots=True, kw_only=True)
class BodyParts(Terms):
    """Contributions of effects to one body, and to the encoder on it."""

    inertia_kg_m2: float = 0.0
    viscous_damping_nm_s_rad: float = 0.0
    readings: list[Reading] = field(default_factory=list)


@dataclass(slots=True, kw_only=True)
class MotorParts(BodyParts):
    """Contributions of effects to one motor, its drive and its transmission."""

    torque_path: list[TorquePath] = field(default_factory=list)
    torque_delay_s: float = 0.0
    torque_lag_s: float = 0.0
    """Of the acting torque behind the reported one; negative: of the reported one behind the acting one."""


@dataclass(slots=True, kw_only=True)
class LinkParts(BodyParts):
    """Contributions of effects to the link and its encoder."""

    reading_delay_s: float = 0.0
    deflection_delay_s: float = 0.0
    """Of a sensor of the deflection, whose reading with the first motor's position is that of the link."""


class Assembly:
    """A plant to which effects are added."""

    def __init__(self, plant: JointPlant, step_s: float) -> None:
        """Start with a plant.

        Args:
            step_s: the integration step, needed by effects with memory over time.
        """
        self.plant = plant
        self.step_s = step_s
        self.motors = [MotorParts() for _ in plant.motors]
        self.link = LinkParts()

    def joint(self) -> JointPlant:
        """Return the plant with all mechanical contributions."""
        motors = tuple(map(_with, self.plant.motors, self.motors))
        return replace(self.plant, motors=motors, link=_with(self.plant.link, self.link))


def _with(body: Body, parts: BodyParts) -> Body:
    return replace(
        body,
        inertia_kg_m2=body.inertia_kg_m2 + parts.inertia_kg_m2,
        viscous_damping_nm_s_rad=body.viscous_damping_nm_s_rad + parts.viscous_damping_nm_s_rad,
        terms=parts,
    )


Apply = Callable[[Assembly, int, Values], None]
"""(assembly, motor index, parameter values): puts one effect in."""


Default = float | Callable[[float], float]
Described = str | tuple[str, Default]
"""Meaning of a parameter, and its default if it has one."""


@dataclass(frozen=True, slots=True)
class EffectParameter:
    """A parameter of an effect."""

    name: str  # with its unit
    meaning: str
    # default value, or default as a function of the first parameter; None: required
    default: Default | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Definition:
    """Definition of an effect."""

    name: str  # of the effect
    location: str  # "motor", "transmission", "link" or "measurement"
    meaning: str  # the physics
    parameters: tuple[EffectParameter, ...]  # the first is the amplitude that `NAME=VALUE` sets
    apply: Apply  # puts it into a plant


LISTED: dict[str, Definition] = {}
"""Effects of the estimator's library, with the same names and parameters but independent laws."""
UNLISTED: dict[str, Definition] = {}
"""Others, which a diagnosis has to call "unexplained"."""


def define(
    library: dict[str, Definition], location: str, name: str, meaning: str, **parameters: Described
) -> Callable[[Apply], Apply]:
    """Register a function as an effect of a library; the arguments are those of `Definition`."""
    described = {key: (text,) if isinstance(text, str) else text for key, text in parameters.items()}

    def put(apply: Apply) -> Apply:
        library[name] = Definition(
            name=name,
            location=location,
            meaning=meaning,
            parameters=tuple(EffectParameter(key, *text) for key, text in described.items()),
            apply=apply,
        )
        return apply

    return put


SMOOTHING: dict[str, Described] = {
    "smoothing_rad_s": ("velocity below which an oil film carries the load; 0: dry, it sticks", 0.0)
}
SLIP: dict[str, Described] = {
    "torque_nm": "torque once everything slides",
    "displacement_rad": ("displacement over which it builds up", 0.01),
    "exponent": ("n of the law (1: Dahl, 2: Bouc-Wen, 50: a spring that slips)", 2.0),
    "shape": ("s of the law (1: Dahl, 0.5: Bouc-Wen)", 0.5),
    "elements": ("elements side by side, their scales a factor of two apart", 3.0),
}


def at_speed(level: Dry, smoothing: float) -> Dry:
    """Return the level of dry friction, smoothed to zero within `smoothing` (rad/s); 0: unchanged."""
    if smoothing <= 0.0:
        return level

    def lubricated(position: float, velocity: float, load: float, time: float) -> float:
        return level(position, velocity, load, time) * abs(velocity) / math.hypot(velocity, smoothing)

    return lubricated


def not_negative(values: Values, name: str) -> float:
    """Return that parameter.

    Raises:
        SimError: it is negative.
    """
    if values[name] < 0.0:
        raise SimError(f"{name}: expected a number >= 0, got {values[name]!r}")
    return values[name]


def slip(values: Values) -> Slip:
    """Return the element with memory that `SLIP` describes."""
    return Slip(*(values[name] for name in SLIP))


def wave(sine: float, cosine: float, periods: float) -> tuple[float, float]:
    """Return sine sin(n x) + cosine cos(n x) as amplitude and phase of one sine."""
    if periods <= 0.0:
        raise SimError(f"periods_per_rev: expected a number > 0, got {periods!r}")
    return math.hypot(sine, cosine), math.atan2(cosine, sine)
