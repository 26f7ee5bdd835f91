"""Suggests cross-checks that a drive could send, with the line for the joint file."""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence

from drivelink.canopen.layout import Signal
from drivelink.canopen.pdo import Tpdo
from drivelink.canopen.roles import Role
from drivelink.canopen.tpdo_assignment import Available, assign, unused
from drivelink.doctor.report import Section
from drivelink.errors import DriveError
from drivelink.jointfile import BusSection
from drivelink.notice import Severity

_SIGNALS = {  # as `checks` of [motor.drive] names them
    "velocity": (Signal.VELOCITY_CHECK,),
    "current": (Signal.TORQUE_CHECK,),
    "following_error": (Signal.FOLLOWING_ERROR, Signal.POSITION_DEMAND),
}
_AGAINST = {"velocity": "position", "current": "torque", "following_error": "position and its demand"}
_ENCODERS = ("0x60E4:01", "0x60E4:02")  # beside the one of the position
_COUNTER = 240  # CiA 301, 7.5.2.22: the longest


def asked_signals(role: Role) -> set[Signal]:
    """Return signals that the joint file requests for cross-checks."""
    if role.drive is None:
        return set()
    asked = {signal for name in role.drive.checks for signal in _SIGNALS[name]}
    return asked | ({Signal.SECOND_POSITION} if role.drive.second_encoder else set())


def second_encoder(role: Role) -> str:
    """Return the object where a second encoder of the motor would be: the first that is not the link's."""
    link = "" if role.encoder is None else role.encoder.object or _ENCODERS[0]
    return next(each for each in _ENCODERS if each.lower() != link.lower())


def say_sync_counter(section: Section, subject: str, bus: BusSection) -> None:
    """Report a SYNC counter (0x1019) that is off: it shows each lost SYNC."""
    if bus.sync == "produce" and not bus.sync_counter_overflow:
        line = f"[bus] sync_counter_overflow = {_COUNTER}"
        text = f"{subject} has a SYNC counter (0x1019), which numbers each SYNC in logs: no further frame"
        section.say(Severity.INFO, "cross-check", text, line)


def say_checks(
    section: Section, role: Role, wanted: Available, available: Available, tpdos: Sequence[Tpdo]
) -> None:
    """Report which checks the drive can send, their cost in frames, and the line for the joint file."""
    drive = role.drive
    if drive is None:
        return
    mapped = {*drive.checks, *(["velocity"] if drive.velocity else [])}
    offered = {
        name: {signal: unused(wanted, available.get(signal, ())) for signal in signals}
        for name, signals in (_SIGNALS | {"second_encoder": (Signal.SECOND_POSITION,)}).items()
    }
    found = {
        name: objects for name, objects in offered.items() if name not in mapped and all(objects.values())
    }
    encoder = found.pop("second_encoder", None)

    def say(text: str, objects: Available, line: str) -> None:
        frames = _cost(role, wanted, objects, tpdos)
        if frames is not None:
            section.say(Severity.INFO, "cross-check", f"{text}: {_frames(frames)}", f"[motor.drive] {line}")

    def checks(names: Iterable[str]) -> str:
        return f"checks = {json.dumps([*drive.checks, *names])}"

    for name, objects in found.items():
        say(f"{name} ({_names(objects)}) can be compared with {_AGAINST[name]}", objects, checks([name]))
    if len(found) > 1:
        say(
            "all of them", {signal: o for each in found.values() for signal, o in each.items()}, checks(found)
        )
    if encoder is not None and drive.second_encoder is None:
        name = _names(encoder)
        text = f"second encoder ({name}), if on the motor, can be compared with position"
        say(text, encoder, f'second_encoder = "{name}"')
    section.facts["cross_checks"] = list(found)


def _names(objects: Available) -> str:
    return " + ".join(f"0x{o[0].address[0]:04X}:{o[0].address[1]:02X}" for o in objects.values())


def _frames(more: int) -> str:
    return f"{more} more frame{'s' if more > 1 else ''} a cycle" if more else "no further frame"


def _cost(role: Role, wanted: Available, objects: Available, tpdos: Sequence[Tpdo]) -> int | None:
    """Additional frames per cycle; None: there is no room."""
    try:
        now = assign(role, wanted, tpdos, prefer_unused=False)
        return len(assign(role, {**wanted, **objects}, tpdos, prefer_unused=False)) - len(now)
    except DriveError:
        return None
