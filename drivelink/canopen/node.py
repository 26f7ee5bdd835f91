"""Configures one node: identity, units, mapping, SYNC, heartbeat."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

from drivelink._core import SYNC_COB_ID
from drivelink.canopen import Address
from drivelink.canopen.layout import MappedObject, NodeLayout, Offer, Role, Signal
from drivelink.canopen.mapping import NMT_PRE_OPERATIONAL, NMT_START, SETTLE_S, Mapper, disable
from drivelink.canopen.pdo import (
    ABSENT,
    CHECKS,
    OPTIONAL,
    Tpdo,
    decode,
    read_identity,
    read_optional,
    read_tpdos,
    unused,
)
from drivelink.canopen.sdo import (
    Nmt,
    Pause,
    Program,
    Read,
    SdoAbort,
    SdoTimeout,
    Unsized,
    Write,
    abort_text,
    read_number,
)
from drivelink.canopen.units import offer, unit_objects
from drivelink.canopen.vendors import Vendor, vendor_of
from drivelink.errors import DriveError
from drivelink.jointfile import BusSection
from drivelink.notice import Findings

_SYNC_PRODUCER = 1 << 30
_ENCODER_HEARTBEAT_MS = 100
_VALUE_BYTES = 8  # of the longest object that can be mapped
_ATTEMPTS = 2  # to configure a node whose units change meanwhile
BOOT_S = 3.0  # until a node answers after power-on; the slowest take two seconds


@dataclass(frozen=True, slots=True, kw_only=True)
class NodeSurvey:
    """Data read from a node."""

    role: Role  # what it is there for
    device_type: int  # 0x1000; 0 if it has no value
    identity: tuple[int, int, int, int]  # 0x1018
    reported: Mapping[Address, int]  # unsigned values of the requested objects that exist
    offer: Offer  # signals it can send
    refused: SdoAbort | None  # the last aborted read of an object that may exist, or None
    # for each signal, the objects that exist, best first, at their real length
    available: Mapping[Signal, tuple[MappedObject, ...]]
    tpdos: tuple[Tpdo, ...]  # present TPDOs


def survey_node(role: Role, patience: int = 1, *, wake: bool = False) -> Program[NodeSurvey]:
    """Read identity, possible signals and present TPDOs of a node; write nothing.

    Args:
        patience: attempts, each with SDO timeout and retries, before the node counts as absent.
        wake: send a silent node to pre-operational: a stopped node has no SDO (CiA 301, 7.3.2.2.4).
    """
    node = role.node_id
    device_type = yield from _first_contact(node, patience, wake)
    identity = yield from read_identity(node)
    vendor = vendor_of(identity[0])
    reported, refused = yield from _units(role, vendor)
    offered = offer(role, reported, vendor)
    available: dict[Signal, tuple[MappedObject, ...]] = {}
    for signal, candidates in offered.candidates.items():
        available[signal] = yield from _existing(node, candidates)
    return NodeSurvey(
        role=role,
        device_type=device_type,
        identity=identity,
        reported=reported,
        offer=offered,
        refused=refused,
        available=available,
        tpdos=(yield from read_tpdos(node)),
    )


def _units(role: Role, vendor: Vendor) -> Program[tuple[dict[Address, int], SdoAbort | None]]:
    """Unit objects that the node has, and the last read that it aborted although the object may exist."""
    reported: dict[Address, int] = {}
    refused = None
    for address in unit_objects(role, vendor):
        try:
            reported[address] = yield from read_number(role.node_id, *address)
        except SdoAbort as abort:
            refused = refused if abort.code in ABSENT else abort
    return reported, refused


def _changed(survey: NodeSurvey) -> Program[str]:
    """Return what the node says otherwise than before it was configured; empty: nothing.

    The answer of somebody else comes once, and a unit that is wrong scales everything that follows.
    """
    node, before = survey.role.node_id, {(0x1018, k + 1): x for k, x in enumerate(survey.identity)}
    before |= survey.reported
    identity = yield from read_identity(node)
    units, _ = yield from _units(survey.role, vendor_of(survey.identity[0]))
    now = {(0x1018, k + 1): x for k, x in enumerate(identity)} | units
    for index, subindex in sorted(before.keys() | now.keys()):
        first, second = before.get((index, subindex)), now.get((index, subindex))
        if first != second:
            first_text, second_text = ("nothing" if x is None else x for x in (first, second))
            return f"0x{index:04X}:{subindex:02X} was {first_text} and is {second_text}"
    return ""


def _first_contact(node: int, patience: int, wake: bool) -> Program[int]:
    """Read the device type, with retries for a node that is booting."""
    for _ in range(patience - 1):
        try:
            return (yield from read_optional(node, 0x1000, 0)) or 0
        except SdoTimeout:
            if wake:
                yield Nmt(node, NMT_PRE_OPERATIONAL)
    return (yield from read_optional(node, 0x1000, 0)) or 0


def _existing(node: int, candidates: tuple[MappedObject, ...]) -> Program[tuple[MappedObject, ...]]:
    """Return the objects that exist, with their actual length; some have no value before the drive runs."""
    found = []
    for candidate in candidates:
        try:
            data = yield Read(node, *candidate.address, most=_VALUE_BYTES)
        except SdoAbort as abort:
            if abort.code not in ABSENT:
                found.append(candidate)
            continue
        sized = len(data) in (1, 2, 3, 4, 8) and not isinstance(data, Unsized)
        found.append(replace(candidate, bits=8 * len(data)) if sized else candidate)
    return tuple(found)


def configure_node(
    role: Role,
    bus: BusSection,
    taken: set[int],
    *,
    drop_others: bool = False,
    start: bool = True,
    stopped: bool = False,
) -> Program[NodeLayout]:
    """Make a node send what the joint needs at every SYNC.

    Its identity and units are read before and after: where they differ, it is configured once more.

    Args:
        stopped: the node is stopped and does not answer SDO until it is woken.

    Raises:
        DriveError: the node is absent, refuses, cannot give what is needed, or says different things.
    """
    if stopped:
        yield Nmt(role.node_id, NMT_PRE_OPERATIONAL)
        yield Pause(SETTLE_S)
    for _ in range(_ATTEMPTS):
        survey, layout = yield from _configured(role, bus, taken, drop_others)
        changed = yield from _changed(survey)
        if not changed:
            break
    else:
        raise DriveError(
            f"{role.subject} ({role.key}): {changed} when asked again: does another device answer for it?"
        )
    if start:
        yield Nmt(role.node_id, NMT_START)
    return layout


def _configured(
    role: Role, bus: BusSection, taken: set[int], drop_others: bool
) -> Program[tuple[NodeSurvey, NodeLayout]]:
    attempt_s = bus.sdo_timeout_s * (1 + bus.sdo_retries)
    survey = yield from survey_node(role, max(2, math.ceil(BOOT_S / attempt_s)), wake=True)
    findings = Findings(notices=list(survey.offer.notices))
    available = _wanted(survey, findings)
    mapper = Mapper(
        role=role,
        available=available,
        tpdos={tpdo.number: tpdo for tpdo in survey.tpdos},
        taken=taken,
        prefer_unused=bus.sync == "follow",
        findings=findings,
        period_s=bus.period_s,
        readable=survey.offer.checks,
    )
    layouts = yield from mapper.program()
    used = {layout.number for layout in layouts}
    others = tuple(tpdo for tpdo in mapper.tpdos.values() if tpdo.enabled and tpdo.number not in used)
    others = yield from _others(role, others, {layout.cob_id for layout in layouts}, drop_others, findings)
    yield from _sync(role, bus, findings)
    heartbeat_ms = yield from _heartbeat(role, findings)
    return survey, NodeLayout(
        node_id=role.node_id,
        motor=role.motor,
        tpdos=layouts,
        other_tpdos=decode(others, {}),
        heartbeat_ms=heartbeat_ms,
        identity=survey.identity,
        reported=tuple(survey.reported.items()),
        notices=tuple(findings.notices),
    )


def _wanted(survey: NodeSurvey, findings: Findings) -> dict[Signal, tuple[MappedObject, ...]]:
    """Signals to map, each with the objects that carry it.

    Raises:
        DriveError: a needed signal is not available.
    """
    subject = survey.role.subject
    for signal, reason in survey.offer.missing.items():
        if signal not in OPTIONAL:
            why = f"; {survey.refused}" if survey.refused is not None else ""
            raise DriveError(f"{subject} ({survey.role.key}): {reason}{why}")
        findings.warn(subject, f"no {signal}: {reason}")
    wanted: dict[Signal, tuple[MappedObject, ...]] = {}
    for signal, objects in survey.available.items():
        candidates = unused(wanted, objects) if signal in CHECKS else objects
        if candidates:
            wanted[signal] = candidates
            continue
        tried = ", ".join(f"0x{c.address[0]:04X}:{c.address[1]:02X}" for c in survey.offer.candidates[signal])
        if signal not in OPTIONAL:
            raise DriveError(f"{subject} ({survey.role.key}) gives no {signal}: it has no {tried}")
        findings.warn(subject, f"gives no {signal}: it has no {tried}")
    return wanted


def _others(
    role: Role, others: tuple[Tpdo, ...], used: set[int], drop: bool, findings: Findings
) -> Program[tuple[Tpdo, ...]]:
    """Disable TPDOs that share an identifier with ours and, on request, unused ones."""
    left = []
    for tpdo in others:
        if not drop and tpdo.cob_id not in used:
            left.append(tpdo)
            continue
        why = "shares its identifier with ours" if tpdo.cob_id in used else "the bus load would be too high"
        yield Nmt(role.node_id, NMT_PRE_OPERATIONAL)
        yield Pause(SETTLE_S)
        try:
            yield from disable(role.node_id, tpdo)
        except SdoAbort as abort:
            left.append(tpdo)
            why += f", but it stays on: SDO abort {abort_text(abort.code)}"
        text = f"TPDO{tpdo.number} (0x{tpdo.cob_id:03X}), which nobody here needs, is switched off: {why}"
        findings.info(role.subject, text)
    return tuple(left)


def _sync(role: Role, bus: BusSection, findings: Findings) -> Program[None]:
    """Configure SYNC: identifier, one producer, the same counter on both sides."""
    node = role.node_id
    cob = yield from read_optional(node, 0x1005, 0)
    if cob is not None and (cob & 0x7FF != SYNC_COB_ID or cob & _SYNC_PRODUCER):
        try:
            yield Write(node, 0x1005, 0, SYNC_COB_ID, 4)
        except SdoAbort as abort:
            what = "makes SYNC itself" if cob & _SYNC_PRODUCER else f"waits for SYNC 0x{cob & 0x7FF:03X}"
            raise DriveError(
                f"{role.subject} {what} (0x1005) and refuses 0x080: SDO abort {abort_text(abort.code)}; "
                'bus.sync = "follow" may be what you want'
            ) from abort
    overflow = yield from read_optional(node, 0x1019, 0)
    wanted = bus.sync_counter_overflow
    if overflow == wanted or (overflow is None and not wanted):
        return
    if overflow is None:
        text = "has no SYNC counter (0x1019) and may reject a SYNC with one"
        findings.warn(role.subject, text, "bus.sync_counter_overflow = 0")
        return
    period = yield from read_optional(node, 0x1006, 0)
    if period:  # only while it is zero 0x1019 may be written (CiA 301, 7.5.2.22)
        yield Write(node, 0x1006, 0, 0, 4)
    yield Write(node, 0x1019, 0, wanted, 1)
    if period:
        yield Write(node, 0x1006, 0, period, 4)


def _heartbeat(role: Role, findings: Findings) -> Program[int]:
    """Request a heartbeat; the value read back is monitored."""
    node = role.node_id
    wanted = role.drive.heartbeat_ms if role.drive is not None else _ENCODER_HEARTBEAT_MS
    has = yield from read_optional(node, 0x1017, 0)
    if has is None or not wanted or has == wanted:
        return has or 0
    try:
        yield Write(node, 0x1017, 0, wanted, 2)
    except SdoAbort as abort:
        text = f"keeps its heartbeat of {has} ms instead of {wanted} ms: SDO abort {abort_text(abort.code)}"
        findings.warn(role.subject, text)
        return has
    return (yield from read_optional(node, 0x1017, 0)) or 0
