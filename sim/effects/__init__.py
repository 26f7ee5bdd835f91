"""Physical effects that can be switched on in the world, by name.

Each module defines the effects of one place, and fills `LISTED` or `UNLISTED` with them.

Signs: x of a motor opposes it in eqs 5, 7, x of the link opposes it in eqs 4, 6, x of a transmission adds
to tau_e. Names and parameters are the estimator's, so that a model can be simulated; the laws are
independent.
"""

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from importlib import import_module

from sim.effects.assembly import LISTED, UNLISTED, Assembly, Definition, Values
from sim.errors import SimError, expected
from sim.plant import JointPlant

__all__ = ["LISTED", "UNLISTED", "Assembly", "Definition", "PlantEffect", "assemble", "make", "parse"]

for _place in ("motor", "transmission", "link", "unlisted"):
    import_module(f"sim.effects.{_place}")


@dataclass(frozen=True, slots=True, kw_only=True)
class PlantEffect:
    """One effect with its parameters."""

    definition: Definition
    values: Values = field(default_factory=dict)  # all its parameters
    motor: int = 0  # index of the motor it acts on, if any

    @property
    def name(self) -> str:
        """Its name."""
        return self.definition.name


def make(name: str, parameters: Mapping[str, object], motor: int | None = None) -> PlantEffect:
    """Return an effect by name.

    Args:
        name: of `LISTED` or `UNLISTED`.
        parameters: by name; those with a default are optional. "motor" (1 or 2) says which motor.
        motor: index of the motor, unless `parameters` has it.

    Raises:
        SimError: unknown effect, unknown, missing or impossible parameter.
    """
    definition = LISTED.get(name) or UNLISTED.get(name)
    if definition is None:
        known = (*LISTED, *UNLISTED)
        raise SimError(f'effect "{name}": {expected(name, known)}')
    given = {key: _number(f"{name}.{key}", value) for key, value in parameters.items()}
    which = given.pop("motor", 1.0 + (motor or 0))
    if which not in (1.0, 2.0):
        raise SimError(f"{name}.motor: expected 1 or 2, got {which:g}")
    names = [parameter.name for parameter in definition.parameters]
    for key in given:
        if key not in names:
            raise SimError(f"{name}.{key}: unknown parameter, expected {', '.join(names)}")
    return PlantEffect(definition=definition, values=_complete(definition, given), motor=int(which) - 1)


def _complete(definition: Definition, given: dict[str, float]) -> dict[str, float]:
    values = {}
    main = given.get(definition.parameters[0].name)
    for parameter in definition.parameters:
        value: object = given.get(parameter.name, parameter.default)
        if callable(value) and main is not None:
            value = value(main)
        if not isinstance(value, int | float):
            raise SimError(f"{definition.name}.{parameter.name}: expected this parameter, it is missing")
        values[parameter.name] = float(value)
    return values


def _number(where: str, value: object) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise SimError(f"{where}: expected a finite number, got {value!r}")
    return float(value)


def parse(text: str) -> PlantEffect:
    """Return an effect from the command line: "coulomb_friction=0.3" or
    "cogging=0.1,periods_per_rev=12,motor=2".

    The first value is the effect's main amplitude, in its unit; further ones go by name.

    Raises:
        SimError: anything else.
    """
    name, equals, rest = text.partition("=")
    definition = LISTED.get(name.strip()) or UNLISTED.get(name.strip())
    if not equals or not rest:
        raise SimError(f'effect: expected NAME=VALUE[,PARAMETER=VALUE…], got "{text}"')
    if definition is None:
        return make(name.strip(), {})
    first, *further = rest.split(",")
    parameters = {definition.parameters[0].name: _parsed(text, first)}
    for item in further:
        key, _, value = item.partition("=")
        parameters[key.strip()] = _parsed(text, value)
    return make(definition.name, parameters)


def _parsed(text: str, value: str) -> float:
    try:
        return float(value)
    except ValueError:
        raise SimError(f'effect "{text}": expected a number, got "{value}"') from None


def assemble(plant: JointPlant, effects: Iterable[PlantEffect], step_s: float) -> Assembly:
    """Add effects to a plant.

    Raises:
        SimError: a motor that the joint does not have, or impossible values.
    """
    assembly = Assembly(plant, step_s)
    for effect in effects:
        if effect.motor >= len(plant.motors):
            raise SimError(f"{effect.name}: the joint has no motor {effect.motor + 1}")
        if effect.definition.location == "transmission" and plant.motors[effect.motor].spring.rigid:
            raise SimError(f"{effect.name}: expected a flexible transmission at motor {effect.motor + 1}")
        try:
            effect.definition.apply(assembly, effect.motor, effect.values)
        except SimError as error:
            raise SimError(f"{effect.name}: {error}") from None
        except ZeroDivisionError:
            raise SimError(f"{effect.name}: expected scales and time constants other than 0") from None
    return assembly
