"""Examines an EDS or DCF: signals that the drive can send, the mapping that would be used, cross-checks."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from drivelink.canopen.eds import DataSheet, load_eds
from drivelink.canopen.layout import MappedObject, Role, Signal
from drivelink.canopen.pdo import Assignment, Available, Entry, Tpdo, assign, describe, entry_text, unused
from drivelink.canopen.units import offer
from drivelink.canopen.vendors import vendor_of
from drivelink.doctor.report import Section
from drivelink.errors import DriveError
from drivelink.jointfile import BusSection, DriveSection, EncoderSection
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
        section.info("cross-check", text, line)


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
            section.info("cross-check", f"{text}: {_frames(frames)}", f"[motor.drive] {line}")

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


# Objects for each signal, best first; the vendor's current object is last.
_OBJECTS: dict[Signal, tuple[tuple[int, int], ...]] = {
    Signal.MOTOR_POSITION: ((0x6064, 0),),
    Signal.MOTOR_TORQUE: ((0x6077, 0), (0x6078, 0)),
    Signal.STATUSWORD: ((0x6041, 0),),
    Signal.MOTOR_VELOCITY: ((0x606C, 0),),
    Signal.LINK_POSITION: ((0x60E4, 1), (0x60E4, 0)),
}
_CIA406: dict[Signal, tuple[tuple[int, int], ...]] = {Signal.LINK_POSITION: ((0x6004, 0),)}
_NEEDED = {Signal.MOTOR_POSITION, Signal.MOTOR_TORQUE}  # of a drive
_NEEDED_OF_ENCODER = {Signal.LINK_POSITION}
_UNDECLARED = {
    Signal.MOTOR_POSITION: "the file gives no counts per motor revolution (0x608F)",
    Signal.MOTOR_TORQUE: "the file gives no value for rated torque (0x6076) or rated current (0x6075)",
}
_STATE = {
    Signal.MOTOR_POSITION: "motor.drive: counts_per_rev, if the drive does not report it",
    Signal.MOTOR_TORQUE: "motor.drive: rated_torque_nm, or torque_constant_nm_a and rated_current_a or "
    "current_object, if the drive does not report it",
}
_ASSUMED_COUNTS = 4096.0  # a stand-in for units that need it


def examine_sheet(section: Section, path: Path) -> None:
    """Add the findings about one file.

    Raises:
        DriveError: it cannot be read.
    """
    sheet = load_eds(path)
    section.ok(path.name, _title(sheet))
    for problem in sheet.problems:
        section.info(path.name, problem)
    available = _signals(section, sheet)
    tpdos = sheet.tpdos()
    section.info("by default", describe(tpdo for tpdo in tpdos if tpdo.enabled))
    role = _role(sheet)
    mappable = {signal: objects for signal, objects in available.items() if objects}
    mappable.pop(Signal.MOTOR_VELOCITY, None)  # not mapped by default
    if any(not available[signal] for signal in _needed(sheet) & available.keys()):
        return
    _units(section, sheet)
    try:
        plan = assign(role, mappable, tpdos, prefer_unused=False) if mappable else ()
    except DriveError as error:
        section.error("mapping", str(error).removeprefix(f"{role.subject} "), "another drive, or firmware")
        return
    for assignment in plan:
        number, entries = planned_entries(assignment)
        kept = "" if assignment.objects is not None else "its map as it is, "
        text = " + ".join(entry_text(entry) for entry in entries)
        section.ok("configured", f"TPDO{number} = {text}, {kept}at every SYNC")
    checks = _checks(sheet, available)
    say_checks(section, role, mappable, checks, tpdos)
    section.facts["mapping"] = [
        {"tpdo": number, "objects": [f"0x{i:04X}:{s:02X}:{b}" for i, s, b in entries]}
        for number, entries in map(planned_entries, plan)
    ]


def _title(sheet: DataSheet) -> str:
    """Maker, product and numbers, as far as the file has them."""
    maker, product = sheet.vendor_name, sheet.product_name
    names = [product] if product.lower().startswith(maker.lower()) else [maker, product]
    parts = [" ".join(name for name in names if name)]
    parts += [f"vendor 0x{sheet.vendor_id:X}"] if sheet.vendor_id else []
    parts += [f"product 0x{sheet.product_code:X}"] if sheet.product_code else []
    return ", ".join([part for part in parts if part] + [f"{len(sheet.objects)} objects"])


def planned_entries(assignment: Assignment) -> tuple[int, tuple[Entry, ...]]:
    """Return the number and entries of a TPDO as it would be configured."""
    if assignment.objects is None:
        return assignment.tpdo.number, assignment.tpdo.entries
    return assignment.tpdo.number, tuple((*c.address, c.bits) for c in assignment.objects)


def _is_encoder(sheet: DataSheet) -> bool:
    return (sheet.value(0x1000) or 0) & 0xFFFF == 406 or (
        (0x6004, 0) in sheet.objects and (0x6064, 0) not in sheet.objects
    )


def _needed(sheet: DataSheet) -> set[Signal]:
    return _NEEDED_OF_ENCODER if _is_encoder(sheet) else _NEEDED


def _role(sheet: DataSheet) -> Role:
    encoder = _is_encoder(sheet)
    return Role(
        node_id=1,
        motor=None if encoder else 0,
        drive=None if encoder else DriveSection(node_id=1, counts_per_rev=_ASSUMED_COUNTS),
        encoder=EncoderSection(source="cia406", node_id=1) if encoder else None,
        key="drive",
        eds=sheet.path,
        tpdo=(),
    )


def _signals(section: Section, sheet: DataSheet) -> dict[Signal, tuple[MappedObject, ...]]:
    """Which signals the drive can put into a TPDO, with a finding for each."""
    vendor = vendor_of(sheet.vendor_id)
    carried = {(i, s) for tpdo in sheet.tpdos() for i, s, _ in tpdo.entries}
    found: dict[Signal, tuple[MappedObject, ...]] = {}
    for signal, addresses in (_CIA406 if _is_encoder(sheet) else _OBJECTS).items():
        if signal is Signal.MOTOR_TORQUE and vendor.current is not None:
            addresses += (vendor.current.address,)
        there = [address for address in addresses if address in sheet.objects]
        if (0x60E4, 1) in there:
            there = [(0x60E4, 1)]  # subindex 0 is then only the count
        usable = [a for a in there if sheet.objects[a].pdo_mappable or a in carried]
        found[signal] = tuple(
            MappedObject(signal=signal, index=a[0], subindex=a[1], bits=len(sheet.objects[a]), signed=True)
            for a in usable
        )
        _say_signal(section, signal, sheet, there, usable)
    return found


def _checks(
    sheet: DataSheet, available: Mapping[Signal, tuple[MappedObject, ...]]
) -> dict[Signal, tuple[MappedObject, ...]]:
    """Objects for cross-checks: a second torque or current, velocity, following error."""

    def mappable(signal: Signal, index: int, subindex: int = 0) -> tuple[MappedObject, ...]:
        entry = sheet.objects.get((index, subindex))
        if entry is None or not entry.pdo_mappable:
            return ()
        return (MappedObject(signal=signal, index=index, subindex=subindex, bits=len(entry), signed=True),)

    as_check = {
        Signal.VELOCITY_CHECK: available.get(Signal.MOTOR_VELOCITY, ()),
        Signal.TORQUE_CHECK: available.get(Signal.MOTOR_TORQUE, ()),
    }
    return {
        **{signal: tuple(replace(o, signal=signal) for o in objects) for signal, objects in as_check.items()},
        Signal.FOLLOWING_ERROR: mappable(Signal.FOLLOWING_ERROR, 0x60F4),
        Signal.POSITION_DEMAND: mappable(Signal.POSITION_DEMAND, 0x6062),
        Signal.SECOND_POSITION: mappable(Signal.SECOND_POSITION, 0x60E4, 2),
    }


def _say_signal(
    section: Section,
    signal: Signal,
    sheet: DataSheet,
    there: list[tuple[int, int]],
    usable: list[tuple[int, int]],
) -> None:
    name = signal.replace("_", " ")
    section.facts[str(signal)] = [f"0x{index:04X}:{subindex:02X}" for index, subindex in usable]
    if usable:
        parts = [f"0x{i:04X}:{s:02X} {sheet.objects[i, s].name}".rstrip() for i, s in usable]
        text = " or ".join(parts) + _more(signal, sheet, usable)
        section.ok(name, text)
    elif there:
        parts = [f"0x{i:04X}:{s:02X}" for i, s in there]
        severity = Severity.ERROR if signal in _needed(sheet) else Severity.INFO
        section.add(severity, name, f"{', '.join(parts)} is there, but cannot be mapped into a TPDO")
    else:
        severity = Severity.ERROR if signal in _needed(sheet) else Severity.INFO
        section.add(severity, name, "no object provides it")


def _more(signal: Signal, sheet: DataSheet, usable: list[tuple[int, int]]) -> str:
    """Remarks on the object of a signal."""
    if signal is Signal.MOTOR_VELOCITY:
        return ", mapped with velocity = true"
    index, subindex = usable[0]
    if signal is not Signal.LINK_POSITION or index != 0x60E4 or not subindex:
        return ""
    others = [
        s for i, s in sorted(sheet.objects) if i == index and s > 1 and sheet.objects[i, s].pdo_mappable
    ]
    names = [f"0x{index:04X}:{s:02X} {sheet.objects[index, s].name}".rstrip() for s in others]
    sensorless = vendor_of(sheet.vendor_id).sensorless == (index, subindex)
    return (", the sensorless one" if sensorless else "") + (
        f"; or, by link.encoder.object, {', '.join(names)}" if names else ""
    )


def _units(section: Section, sheet: DataSheet) -> None:
    """Units in the file, and those that the joint file has to declare."""
    if _is_encoder(sheet):
        counts = sheet.value(0x6501)
        text = (
            f"0x6501 says {counts} counts per revolution" if counts else "state link.encoder.counts_per_rev"
        )
        section.info("units", text)
        return
    drive = DriveSection(node_id=1)
    bare = Role(node_id=1, motor=0, drive=drive, encoder=None, key="motor.drive", eds=sheet.path, tpdo=())
    offered = offer(bare, sheet.values(), vendor_of(sheet.vendor_id))
    for signal, missing in _UNDECLARED.items():
        if signal in offered.missing:
            section.info("units", missing, _STATE[signal])
