"""The library of physical effects: what each one is, and its terms over arrays.

Names, places, parameters and laws are those of `estimator/core/src/library.rs`, which a tick uses as well.

Signs: with x in N·m, B theta" + D theta' + x_motor - tau_e(phi) - x_transmission = tau and
M q" + D_q q' + g(q) + tau_e + x_transmission + x_link = tau_k. x is the sum over an effect's terms, each
times its linear parameter. A measured torque is the acting torque plus x; a reading is the true position plus
its error.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal, NamedTuple, cast

import numpy as np

from estimator import _core
from estimator._core import STOP_EXPONENT as STOP_EXPONENT
from estimator.errors import EstimatorError, expected
from estimator.model import Effect, JointModel
from estimator.sample import FloatArray

_SMOOTHING = "smoothing_rad_s"

Location = Literal["motor", "transmission", "link", "measurement"]
Channel = Literal["torque", "motor_torque", "deflection", "link_position"]


class Coordinates(NamedTuple):
    """What a term may depend on: numbers of one tick, or equally filtered arrays of a recording."""

    position: Any  # theta, rad
    velocity: Any  # theta', rad/s
    acceleration: Any  # theta'', rad/s²
    deflection: Any  # phi = q - theta, rad
    deflection_rate: Any  # phi', rad/s
    flexibility_torque: Any  # tau_e(phi), N·m
    stiffness: Any  # d tau_e / d phi, N·m/rad
    torque: Any  # the motor's measured torque tau, N·m
    torque_rate: Any  # its derivative, N·m/s
    link_position: Any  # q, rad
    link_velocity: Any  # q', rad/s
    link_acceleration: Any  # q'', rad/s²
    time: Any  # since the start, s


class Parameter(NamedTuple):
    """One parameter of an effect."""

    name: str  # with its unit, as it stands in a joint file
    meaning: str  # in words
    linear: bool  # whether the effect is proportional to it; the k-th linear parameter weighs the k-th term
    positive: bool  # whether it is not negative, as of what only dissipates
    default: float | None  # value used if the joint file omits it; None: required


@dataclass(frozen=True, slots=True)
class EffectType:
    """One kind of effect."""

    name: str  # as in joint files and reports
    location: Location  # the part of the joint it belongs to
    # what it acts on: the torque balance of its location; the motor torque's measurement; the deflection
    # (the zero between the encoders); the link encoder's reading
    channel: Channel
    # the fields of `Coordinates` that it depends on; first the one that reveals it
    coordinates: tuple[str, ...]
    parameters: tuple[Parameter, ...]  # its parameters
    remembers: bool  # whether it has memory (hysteresis)
    description: str  # for reports, in a few words

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
        """Whether it belongs into [[link.effect]] of a joint file rather than [[motor.effect]]."""
        return self.location == "link" or self.channel == "link_position"

    def terms(self, c: Coordinates, values: Mapping[str, float]) -> FloatArray:
        """Return the effect's terms over consecutive moments, unweighted.

        Channel "torque": torques; "motor_torque": error of the measured torque, N·m; "deflection" and
        "link_position": error of the reading, rad. Effects with memory start unloaded.

        Args:
            c: arrays (n,), or numbers where they do not change.
            values: of the nonlinear parameters.

        Returns:
            (k, n), one row per linear parameter.
        """
        return self._evaluated(self.name, self.coordinates, c, values)

    def reaction(self, c: Coordinates, values: Mapping[str, float]) -> FloatArray | None:
        """Return the terms that act on the motor beside them, with the same parameters; None: none."""
        if self.name != "kinematic_error":
            return None
        return self._evaluated("kinematic_reaction", ("position", "flexibility_torque"), c, values)

    def _evaluated(
        self, name: str, coordinates: tuple[str, ...], c: Coordinates, values: Mapping[str, float]
    ) -> FloatArray:
        named = (getattr(c, each) for each in coordinates)
        fields = [np.ascontiguousarray(field, dtype=np.float64).reshape(-1) for field in named]
        listed = [1.0 if p.linear else values[p.name] for p in self.parameters]
        out = np.empty((len(self.linear), max(map(len, fields))))
        _core.effect_terms(name, listed, fields, out.reshape(-1))
        return out


LIBRARY: dict[str, EffectType] = {
    name: EffectType(
        name,
        cast(Location, location),
        cast(Channel, channel),
        tuple(coordinates),
        tuple(Parameter(*p) for p in parameters),
        remembers,
        description,
    )
    for name, location, channel, coordinates, parameters, remembers, description in _core.effect_kinds()
}


def elements(effect: Effect) -> tuple[EffectType, list[dict[str, float]]]:
    """Return an effect as its type and one set of plain numbers per element.

    A parameter given as an array makes a sum of elements, e.g. cogging with two harmonics; plain numbers
    beside it belong to every element. What is left out takes its default.

    Raises:
        EstimatorError: no such effect or parameter, a parameter missing, arrays of unequal length.
    """
    kind = LIBRARY.get(effect.name)
    if kind is None:
        raise EstimatorError(f'effect "{effect.name}": {expected(effect.name, sorted(LIBRARY))}')
    values: dict[str, float | tuple[float, ...]] = {}
    for parameter in kind.parameters:
        value = effect.parameters.get(parameter.name, parameter.default)
        if value is None:
            raise EstimatorError(
                f'effect "{effect.name}": expected parameter {parameter.name}, it is missing'
            )
        values[parameter.name] = value
    unknown = sorted(set(effect.parameters) - set(values))
    if unknown:
        raise EstimatorError(
            f'effect "{effect.name}": unknown parameter {unknown[0]}, expected {", ".join(values)}'
        )
    lengths = {len(value) for value in values.values() if isinstance(value, tuple)}
    if len(lengths) > 1:
        raise EstimatorError(
            f'effect "{effect.name}": expected arrays of equal length, got {sorted(lengths)}'
        )
    count = lengths.pop() if lengths else 1
    return kind, [
        {name: v[i] if isinstance(v, tuple) else v for name, v in values.items()} for i in range(count)
    ]


def open_smoothing(model: JointModel) -> bool:
    """Return whether a joint file leaves out over which velocity some dry friction changes its sign."""
    effects = (*model.link_effects, *(effect for motor in model.motors for effect in motor.effects))
    return any(map(_is_open, effects))


def sharpened(model: JointModel, smoothing_rad_s: float | None) -> JointModel:
    """Return the joint with that velocity where it is left out; None: as it is."""
    if smoothing_rad_s is None:
        return model

    def sharp(effects: tuple[Effect, ...]) -> tuple[Effect, ...]:
        more = {_SMOOTHING: smoothing_rad_s}
        return tuple(
            replace(one, parameters={**one.parameters, **more}) if _is_open(one) else one for one in effects
        )

    motors = tuple(replace(motor, effects=sharp(motor.effects)) for motor in model.motors)
    return replace(model, motors=motors, link_effects=sharp(model.link_effects))


def _is_open(effect: Effect) -> bool:
    return _SMOOTHING in LIBRARY[effect.name].nonlinear and _SMOOTHING not in effect.parameters


def in_words(name: str) -> str:
    """Return the name of an effect as it stands in a sentence."""
    return name.replace("_", " ").replace("coulomb", "Coulomb").replace("stribeck", "Stribeck")
