"""Suggests cross-checks that a drive could send, with the line for the joint file."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence

from drivelink.canopen.layout import Signal
from drivelink.canopen.mappable import MappableObject
from drivelink.canopen.pdo import Tpdo
from drivelink.canopen.roles import Role
from drivelink.canopen.tpdo_assignment import assign, unused
from drivelink.doctor.report import Section
from drivelink.errors import DriveError
from drivelink.notice import Severity

__all__ = ["asked_signals", "say_free_checks"]

_SIGNALS = {  # as `checks` of [motor.drive] names them
    "velocity": (Signal.VELOCITY_CHECK,),
    "current": (Signal.TORQUE_CHECK,),
    "following_error": (Signal.FOLLOWING_ERROR, Signal.POSITION_DEMAND),
}
_AGAINST = {"velocity": "position", "current": "torque", "following_error": "position and its demand"}

Available = Mapping[Signal, Sequence[MappableObject]]


def asked_signals(role: Role) -> set[Signal]:
    """Signals that the joint file requests for cross-checks."""
    if role.drive is None:
        return set()
    asked = {signal for name in role.drive.checks for signal in _SIGNALS[name]}
    return asked | ({Signal.SECOND_POSITION} if role.drive.second_encoder else set())


def say_free_checks(
    section: Section, role: Role, wanted: Available, available: Available, tpdos: Sequence[Tpdo]
) -> None:
    """Report which checks the drive can send, their cost in frames, and the line for the joint file.

    Args:
        section: of the drive.
        role: the drive.
        wanted: signals that are mapped anyway.
        available: its objects for cross-checks.
        tpdos: present TPDOs.
    """
    if role.drive is None:
        return
    found = {}
    for name, signals in _SIGNALS.items():
        objects = {signal: unused(wanted, available.get(signal, ())) for signal in signals}
        asked = name in role.drive.checks or (name == "velocity" and role.drive.velocity)
        if not asked and all(objects.values()):
            found[name] = objects
    for name, objects in found.items():
        what = " + ".join(f"0x{o[0].address[0]:04X}:{o[0].address[1]:02X}" for o in objects.values())
        text = f"{name} ({what}) can be compared with {_AGAINST[name]}"
        _say(section, role, [name], text, _cost(role, wanted, objects, tpdos))
    if len(found) > 1:
        everything = {signal: each for objects in found.values() for signal, each in objects.items()}
        _say(section, role, list(found), "all of them", _cost(role, wanted, everything, tpdos))
    section.facts["cross_checks"] = list(found)


def _say(section: Section, role: Role, names: list[str], text: str, frames: int | None) -> None:
    if role.drive is None or frames is None:
        return
    cost = f"{frames} more frame{'s' if frames > 1 else ''} a cycle" if frames else "no further frame"
    line = f"[motor.drive] checks = {json.dumps([*role.drive.checks, *names])}"
    section.say(Severity.INFO, "cross-check", f"{text}: {cost}", line)


def _cost(role: Role, wanted: Available, objects: Available, tpdos: Sequence[Tpdo]) -> int | None:
    """Additional frames per cycle; None: there is no room."""
    try:
        now = assign(role, wanted, tpdos, prefer_unused=False)
        return len(assign(role, {**wanted, **objects}, tpdos, prefer_unused=False)) - len(now)
    except DriveError:
        return None
