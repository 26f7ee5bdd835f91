"""Examines an EDS or DCF: signals that the drive can send, the mapping that would be used, cross-checks."""

import json
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from drivelink.canopen.eds import DataSheet, load_eds
from drivelink.canopen.layout import MappedObject, Role, Signal
from drivelink.canopen.pdo import CHECKS, Available, Tpdo, assign, describe, entry_text, unused
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


def curious(role: Role) -> Role:
    """Return a role that is interested in all signals, those for cross-checks included."""
    if role.drive is None:
        return role
    link = "" if role.encoder is None else role.encoder.object or _ENCODERS[0]
    other = next(each for each in _ENCODERS if each.lower() != link.lower())
    update = {
        "velocity": True,
        "checks": ("current", "following_error"),
        "second_encoder": role.drive.second_encoder or other,
    }
    return replace(role, drive=role.drive.model_copy(update=update))


def velocity_as_check(available: Available) -> dict[Signal, tuple[MappedObject, ...]]:
    """Return what a curious role finds, with the velocity as a cross-check."""
    found = {signal: tuple(objects) for signal, objects in available.items()}
    velocity = found.pop(Signal.MOTOR_VELOCITY, ())
    return found | {Signal.VELOCITY_CHECK: tuple(replace(o, signal=Signal.VELOCITY_CHECK) for o in velocity)}


def report_sync_counter(section: Section, bus: BusSection) -> None:
    """Report a SYNC counter (0x1019) that is off: it shows each lost SYNC."""
    if bus.sync == "produce" and not bus.sync_counter_overflow:
        line = f"[bus] sync_counter_overflow = {_COUNTER}"
        text = "a SYNC counter (0x1019) can number each SYNC in logs: no further frame"
        section.info("cross-check", text, line)


def report_checks(
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
    found = {name: each for name, each in offered.items() if name not in mapped and all(each.values())}
    encoder = found.pop("second_encoder", None)

    def report(text: str, objects: Available, line: str) -> None:
        if (frames := _cost(role, wanted, objects, tpdos)) is not None:
            section.info("cross-check", f"{text}: {_frames(frames)}", f"[motor.drive] {line}")

    def checks(names: Iterable[str]) -> str:
        return f"checks = {json.dumps([*drive.checks, *names])}"

    for name, objects in found.items():
        report(f"{name} ({_names(objects)}) can be compared with {_AGAINST[name]}", objects, checks([name]))
    if len(found) > 1:
        every = {signal: objects for each in found.values() for signal, objects in each.items()}
        report("all of them", every, checks(found))
    if encoder is not None and drive.second_encoder is None:
        name = _names(encoder)
        text = f"second encoder ({name}), if on the motor, can be compared with position"
        report(text, encoder, f'second_encoder = "{name}"')
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


_NEEDED = {Signal.MOTOR_POSITION, Signal.MOTOR_TORQUE}  # of a drive
_NEEDED_OF_ENCODER = {Signal.LINK_POSITION}
# Stand-ins for the units of a drive that is not there: only which objects it has is of interest.
_ASSUMED: dict[str, Any] = {
    "counts_per_rev": 4096.0,
    "rated_torque_nm": 1.0,
    "rated_current_a": 1.0,
    "torque_constant_nm_a": 1.0,
    "velocity_rad_s_per_count": 1.0,
}


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
    optional = (Signal.MOTOR_VELOCITY, *CHECKS)  # not mapped by default
    mappable = {signal: found for signal, found in available.items() if found and signal not in optional}
    if any(not available[signal] for signal in _needed(sheet) & available.keys()):
        return
    _units(section, sheet)
    try:
        plan = assign(role, mappable, tpdos, prefer_unused=False) if mappable else ()
    except DriveError as error:
        section.error("mapping", str(error).removeprefix(f"{role.subject} "), "another drive, or firmware")
        return
    for assignment in plan:
        kept = "" if assignment.objects is not None else "its map as it is, "
        text = " + ".join(map(entry_text, assignment.entries))
        section.ok("configured", f"TPDO{assignment.tpdo.number} = {text}, {kept}at every SYNC")
    report_checks(section, role, mappable, velocity_as_check(available), tpdos)
    section.facts["mapping"] = [
        {"tpdo": one.tpdo.number, "objects": [f"0x{i:04X}:{s:02X}:{b}" for i, s, b in one.entries]}
        for one in plan
    ]


def _title(sheet: DataSheet) -> str:
    """Maker, product and numbers, as far as the file has them."""
    maker, product = sheet.vendor_name, sheet.product_name
    names = [product] if product.lower().startswith(maker.lower()) else [maker, product]
    parts = [" ".join(name for name in names if name)]
    parts += [f"vendor 0x{sheet.vendor_id:X}"] if sheet.vendor_id else []
    parts += [f"product 0x{sheet.product_code:X}"] if sheet.product_code else []
    return ", ".join([part for part in parts if part] + [f"{len(sheet.objects)} objects"])


def _is_encoder(sheet: DataSheet) -> bool:
    counts = (0x6004, 0) in sheet.objects and (0x6064, 0) not in sheet.objects
    return counts or (sheet.value(0x1000) or 0) & 0xFFFF == 406


def _needed(sheet: DataSheet) -> set[Signal]:
    return _NEEDED_OF_ENCODER if _is_encoder(sheet) else _NEEDED


def _role(sheet: DataSheet) -> Role:
    encoder = _is_encoder(sheet)
    return Role(
        node_id=1,
        motor=None if encoder else 0,
        drive=None if encoder else DriveSection(node_id=1, **_ASSUMED),
        encoder=EncoderSection(source="cia406" if encoder else "drive", node_id=1, counts_per_rev=1.0),
        key="drive",
        eds=sheet.path,
        tpdo=(),
    )


def _signals(section: Section, sheet: DataSheet) -> dict[Signal, tuple[MappedObject, ...]]:
    """Objects of each signal that the drive can put into a TPDO, with a finding for what a joint reads."""
    offered = offer(curious(_role(sheet)), {}, vendor_of(sheet.vendor_id)).candidates
    carried = {(i, s) for tpdo in sheet.tpdos() for i, s, _ in tpdo.entries}
    found: dict[Signal, tuple[MappedObject, ...]] = {}
    for signal, objects in offered.items():
        if signal is Signal.LINK_POSITION and objects[0].address not in sheet.objects:
            objects += (replace(objects[0], subindex=0),)  # where 0x60E4 is no array
        there = [one for one in objects if one.address in sheet.objects]
        usable = [one for one in there if sheet.objects[one.address].pdo_mappable or one.address in carried]
        found[signal] = tuple(replace(one, bits=len(sheet.objects[one.address])) for one in usable)
        if signal not in CHECKS:
            _report_signal(section, signal, sheet, [o.address for o in there], [o.address for o in usable])
    return found


def _report_signal(
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
    else:
        names = ", ".join(f"0x{i:04X}:{s:02X}" for i, s in there)
        text = f"{names} is there, but cannot be mapped into a TPDO" if there else "no object provides it"
        section.add(Severity.ERROR if signal in _needed(sheet) else Severity.INFO, name, text)


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
        said = f"0x6501 says {counts} counts per revolution"
        section.info("units", said if counts else "state link.encoder.counts_per_rev")
        return
    drive = DriveSection(node_id=1)
    bare = Role(node_id=1, motor=0, drive=drive, encoder=None, key="motor.drive", eds=sheet.path, tpdo=())
    offered = offer(bare, sheet.values(), vendor_of(sheet.vendor_id))
    for signal in sorted(_NEEDED & offered.missing.keys()):
        section.info("units", offered.missing[signal])
