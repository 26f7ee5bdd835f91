"""Common errors of a first installation, and their effect on each channel."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from estimator.choices import choice
from estimator.gate.balance import Scales
from estimator.model import JointModel

__all__ = ["Cause", "Change", "Kind", "causes", "scales"]

Kind = Literal["unit", "sign", "gear", "period", "inertia"]

_DEGREE = math.pi / 180.0
_MILLI = 1e-3
_LINK, _DEFLECTION, _TIME = "link_position", "deflection", "time"


@dataclass(frozen=True, slots=True)
class Change:
    """Correction of one channel.

    Attributes:
        channel: "motor1_position", "motor1_torque", "motor1_inertia", …, "link_position", "deflection" (of
            the link against its motor) or "time".
        factor: true value over recorded (or declared) value; infinite: any.
    """

    channel: str
    factor: float


@dataclass(frozen=True, slots=True)
class Cause:
    """One possible error.

    Attributes:
        kind: of it.
        what: in words, e.g. "looks like degrees".
        changes: of the channels that it touches.
        extra: prior cost beyond that of any fault, nats.
    """

    kind: Kind
    what: str
    changes: tuple[Change, ...]
    extra: float = 0.0

    @property
    def cost(self) -> float:
        """Prior cost, nats."""
        return choice("fault") + self.extra

    @property
    def channels(self) -> frozenset[str]:
        """What it touches."""
        return frozenset(change.channel for change in self.changes)


def scales(found: Sequence[Cause], motor: int) -> Scales:
    """Return the combined scales of some causes in the balance of one motor."""
    factors = {change.channel: change.factor for cause in found for change in cause.changes}
    own = f"motor{motor + 1}_"
    return Scales(
        position=factors.get(f"{own}position", 1.0),
        torque=factors.get(f"{own}torque", 1.0),
        link=factors.get(_LINK, 1.0),
        time=factors.get(_TIME, 1.0),
        inertia=factors.get(f"{own}inertia", 1.0),
        deflection=factors.get(_DEFLECTION, 1.0),
    )


def causes(model: JointModel, linked: bool, ratios: Sequence[float | None]) -> list[Cause]:
    """Return all causes that are tested.

    Args:
        model: the joint as declared.
        linked: whether there is a link position.
        ratios: link over motor position as each balance has it; None: it is undetermined.
    """
    names = [f"motor{i + 1}" for i in range(len(model.motors))]
    positions = [f"{name}_position" for name in names]
    torques = [f"{name}_torque" for name in names]
    found = [Cause("period", "looks like milliseconds, expected s", (Change(_TIME, _MILLI),))]
    found += _units(positions, torques, linked)
    found += _signs(positions, torques, linked)
    for name, motor, ratio in zip(names, model.motors, ratios, strict=True):
        found += _gears(name, motor.gear_ratio, ratio, linked)
        any_inertia = (Change(f"{name}_inertia", math.inf),)
        found.append(Cause("inertia", "is not the declared one", any_inertia, choice("free_inertia")))
    return [cause for cause in found if not any(_parts(cause, i, x) for i, x in enumerate(ratios))]


def _parts(cause: Cause, motor: int, ratio: float | None) -> bool:
    """Whether a correction makes positions of different sizes that are alike as they are read."""
    own, alike = scales([cause], motor), math.log(choice("declared_factor"))
    if not ratio or abs(math.log(abs(ratio))) > alike:
        return False
    return abs(math.log(abs(own.position / own.link))) > alike


def _all(channels: Sequence[str], factor: float) -> tuple[Change, ...]:
    return tuple(Change(channel, factor) for channel in channels)


def _units(positions: list[str], torques: list[str], linked: bool) -> list[Cause]:
    degrees, radians = "looks like degrees, expected rad", "looks like radians that were taken for degrees"
    small, large = "N·mm", "kN·m"
    everywhere = [*positions, _LINK] if linked else positions
    groups = [everywhere, *([[_LINK]] if linked else [])]
    groups += [[position] for position in positions] if len(everywhere) > 1 else []
    if linked and len(positions) > 1:
        groups.append(positions)
    found = [Cause("unit", degrees, _all(group, _DEGREE)) for group in groups]
    found += [Cause("unit", radians, _all(group, 1.0 / _DEGREE)) for group in groups]
    for group in (torques, *([[t] for t in torques] if len(torques) > 1 else [])):
        found.append(Cause("unit", f"looks like {small}, expected N·m", _all(group, _MILLI)))
        found.append(Cause("unit", f"looks like {large}, expected N·m", _all(group, 1e3)))
    return found


def _signs(positions: list[str], torques: list[str], linked: bool) -> list[Cause]:
    wrong = "has the wrong sign"
    found = [Cause("sign", wrong, _all([channel], -1.0)) for channel in (*positions, *torques)]
    if linked:
        found += [Cause("sign", wrong, _all([channel], -1.0)) for channel in (_LINK, _DEFLECTION)]
    if len(positions) > 1:  # of a single joint it is the link's sign
        found += [Cause("sign", wrong, _all(pair, -1.0)) for pair in zip(positions, torques, strict=True)]
    return found


def _gears(name: str, gear: float | None, ratio: float | None, linked: bool) -> list[Cause]:
    position, torque = f"{name}_position", f"{name}_torque"
    found = []
    if gear is not None and abs(math.log(gear)) > math.log(choice("declared_factor")):
        shaft, twice = "is of the motor shaft, expected the joint's side", "has the gear ratio in it twice"
        for what, n in ((shaft, gear), (twice, 1.0 / gear)):
            found.append(Cause("gear", what, (Change(position, 1.0 / n), Change(torque, n))))
            found.append(Cause("gear", what, (Change(position, 1.0 / n),)))
            found.append(Cause("gear", what, (Change(torque, n),)))
            if linked:
                found.append(Cause("gear", what, (Change(_LINK, 1.0 / n),)))
        rotor = "is the rotor's own, expected the joint's side"
        found.append(Cause("inertia", rotor, (Change(f"{name}_inertia", gear * gear),)))
    elif ratio is not None and ratio != 0.0 and _is_gear(abs(ratio)):
        what = "does not belong to the link's (wrong gear ratio?)"
        found.append(Cause("gear", what, (Change(position, abs(ratio)),), choice("free_ratio")))
    return found


def _is_gear(ratio: float) -> bool:
    """Whether two positions differ by more than the deflection, and not by the factor of degrees."""
    units = (1.0, _DEGREE, 1.0 / _DEGREE)
    return all(
        abs(math.log(ratio / unit)) > math.log(choice("declared_factor") if unit == 1.0 else 1.3)
        for unit in units
    )
