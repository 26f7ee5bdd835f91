"""Reads the TPDOs of a node (CiA 301, 7.5.2), and assigns signals to them without sending anything.

Preferred is one frame with position, torque and statusword, so that a sample is atomic; other signals go into
a second one. Fixed mappings that carry the needed signals are used as they are. They are read by programs of
`drivelink.canopen.sdo`, because canopen's PDO code blocks until each answer.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

from drivelink.canopen import Address
from drivelink.canopen.layout import MappedObject, Role, Signal, TpdoLayout
from drivelink.canopen.sdo import Program, SdoAbort, read_number
from drivelink.errors import DriveError

Entry = tuple[int, int, int]  # index, subindex, bits

ABSENT = frozenset({0x06020000, 0x06090011})  # SDO aborts: no such object, no such subindex
INVALID = 1 << 31
NO_RTR = 1 << 30
EXTENDED = 1 << 29
SYNC_TYPES = range(1, 241)
FRAME_BITS = 64

_MOST_TPDOS = 16  # TPDO numbers that are read; no known drive uses higher ones
_MOST_ENTRIES = 64  # objects of one bit
_ALWAYS = 4  # some makers leave gaps among the first four


@dataclass(frozen=True, slots=True, kw_only=True)
class Tpdo:
    """One TPDO of a node."""

    number: int  # 1 for 0x1800/0x1A00
    cob: int  # 0x1800:01: bit 31 invalid, bit 30 no RTR, and the identifier
    transmission_type: int  # 0x1800:02
    inhibit_100us: int = 0  # 0x1800:03
    event_ms: int = 0  # 0x1800:05
    entries: tuple[Entry, ...] = ()  # what is mapped, in order
    fixed: bool = False  # whether its mapping cannot be changed
    most: int = 64  # objects that can be mapped into it
    known: bool = True  # whether the entries are known

    @property
    def cob_id(self) -> int:
        """Identifier of its frames."""
        return self.cob & 0x7FF

    @property
    def enabled(self) -> bool:
        """Whether it is enabled."""
        return not self.cob & INVALID

    @property
    def communication(self) -> int:
        """Index of its communication parameter."""
        return 0x17FF + self.number

    @property
    def mapping(self) -> int:
        """Index of its mapping parameter."""
        return 0x19FF + self.number


def entry_text(entry: Entry) -> str:
    """Return an entry as text."""
    index, subindex, bits = entry
    return f"0x{index:04X}:{subindex:02X} ({bits} bit)"


def describe(tpdos: Iterable[Tpdo]) -> str:
    """Return the mappings in one line."""
    parts = []
    for tpdo in tpdos:
        objects = " + ".join(f"0x{index:04X}:{subindex:02X}" for index, subindex, _ in tpdo.entries)
        parts.append(f"TPDO{tpdo.number} = {objects or ('empty' if tpdo.known else 'unknown')}")
    return "; ".join(parts) or "no TPDO"


def read_optional(node: int, index: int, subindex: int, *, exactly: bool = False) -> Program[int | None]:
    """Read an unsigned value; None if it is not available, with `exactly` only if there is no such object."""
    try:
        return (yield from read_number(node, index, subindex))
    except SdoAbort as abort:
        if exactly and abort.code not in ABSENT:
            raise
        return None


def read_identity(node: int) -> Program[tuple[int, int, int, int]]:
    """Return vendor, product code, revision and serial number of 0x1018; 0 where not reported."""
    vendor = (yield from read_optional(node, 0x1018, 1)) or 0
    product = (yield from read_optional(node, 0x1018, 2)) or 0
    revision = (yield from read_optional(node, 0x1018, 3)) or 0
    return vendor, product, revision, (yield from read_optional(node, 0x1018, 4)) or 0


def read_tpdo(node: int, number: int, *, exactly: bool = False) -> Program[Tpdo | None]:
    """Read one TPDO; None if it does not exist.

    Args:
        exactly: raise if part of the mapping cannot be read, because frames will be decoded by it.

    Raises:
        SdoAbort: `exactly`, and a read was aborted.
    """
    read = partial(read_optional, exactly=exactly)
    communication, mapping = 0x17FF + number, 0x19FF + number
    values = {(communication, 1): (yield from read(node, communication, 1))}
    if values[communication, 1] is None:
        return None
    values[communication, 2] = yield from read(node, communication, 2)
    for subindex in (3, 5):
        values[communication, subindex] = yield from read_optional(node, communication, subindex)
    count = values[mapping, 0] = yield from read(node, mapping, 0)
    for subindex in range(1, min(count or 0, _MOST_ENTRIES) + 1):
        raw = values[mapping, subindex] = yield from read(node, mapping, subindex)
        if not raw:
            break
    (tpdo,) = tpdos_of({address: value for address, value in values.items() if value is not None})
    return tpdo


def read_tpdos(node: int) -> Program[tuple[Tpdo, ...]]:
    """Return all TPDOs of a node."""
    found = []
    for number in range(1, _MOST_TPDOS + 1):
        tpdo = yield from read_tpdo(node, number)
        if tpdo is not None:
            found.append(tpdo)
        elif number > _ALWAYS:
            break
    return tuple(found)


def tpdos_of(values: Mapping[Address, int]) -> tuple[Tpdo, ...]:
    """Return TPDOs from the unsigned values of 0x1800 to 0x1BFF in a data sheet or the traffic.

    One with an incomplete mapping is not `known`.
    """
    found = []
    for communication in sorted(i for i, subindex in values if 0x1800 <= i <= 0x19FF and subindex == 1):
        entries = _entries(values, communication + 0x200)
        found.append(
            Tpdo(
                number=communication - 0x17FF,
                cob=values[communication, 1],
                transmission_type=values.get((communication, 2), 255),
                inhibit_100us=values.get((communication, 3), 0),
                event_ms=values.get((communication, 5), 0),
                entries=entries or (),
                known=entries is not None,
            )
        )
    return tuple(found)


def objects_of(tpdo: Tpdo, number: int) -> dict[Address, int]:
    """Return the values of 0x1800 to 0x1BFF that make a TPDO of this number: the inverse of `tpdos_of`."""
    communication, mapping = 0x17FF + number, 0x19FF + number
    entries = {
        (mapping, place): index << 16 | subindex << 8 | bits
        for place, (index, subindex, bits) in enumerate(tpdo.entries, start=1)
    }
    return {
        (communication, 1): tpdo.cob,
        (communication, 2): tpdo.transmission_type,
        (mapping, 0): len(tpdo.entries),
        **entries,
    }


def _entries(values: Mapping[Address, int], mapping: int) -> tuple[Entry, ...] | None:
    """Return the entries; None if one of them is unknown, or they are more than a frame carries."""
    count = values.get((mapping, 0))
    entries: list[Entry] = []
    for subindex in range(1, (_MOST_ENTRIES if count is None else min(count, _MOST_ENTRIES)) + 1):
        raw = values.get((mapping, subindex))
        if not raw:  # some count empty entries; a data sheet without a count: the first one ends the list
            if raw is None and (count is not None or not entries):
                return None
            break
        entries.append((raw >> 16 & 0xFFFF, raw >> 8 & 0xFF, raw & 0xFF))
    known = (count is not None or entries) and sum(bits for _, _, bits in entries) <= FRAME_BITS
    return tuple(entries) if known else None


def decode(
    tpdos: Sequence[Tpdo], candidates: Mapping[Signal, Sequence[MappedObject]]
) -> tuple[TpdoLayout, ...]:
    """Return the layouts of the frames, from the mapping read back.

    Of several mapped objects for one signal the best one is used; of an object that is mapped twice, its
    place in a frame sent at every SYNC, else the first. An object serves the first signal it can. Others are
    skipped.

    Args:
        candidates: for each signal the objects that can give it, best first.
    """
    mapped = {(index, subindex) for tpdo in tpdos for index, subindex, _ in tpdo.entries}
    chosen: dict[Address, MappedObject] = {}
    for objects in candidates.values():
        left = mapped - chosen.keys()  # an object does not check itself
        best = next((candidate for candidate in objects if candidate.address in left), None)
        if best is not None:
            chosen[best.address] = best
    order = sorted(range(len(tpdos)), key=lambda k: (tpdos[k].transmission_type != 1, k))
    layouts = {k: _layout(tpdos[k], chosen) for k in order}
    return tuple(layouts[k] for k in range(len(tpdos)))


def _layout(tpdo: Tpdo, chosen: dict[Address, MappedObject]) -> TpdoLayout:
    """Return one frame; what it carries is taken out of `chosen`."""
    objects = []
    for index, subindex, bits in tpdo.entries:
        other = MappedObject(signal=Signal.OTHER, index=index, subindex=subindex, bits=bits, signed=False)
        objects.append(replace(chosen.pop((index, subindex), other), bits=bits))
    return TpdoLayout(
        cob_id=tpdo.cob_id,
        objects=tuple(objects),
        transmission_type=tpdo.transmission_type,
        number=tpdo.number,
        inhibit_s=tpdo.inhibit_100us * 1e-4,
    )


_ORDER = tuple(Signal)
CHECKS = _ORDER[_ORDER.index(Signal.TORQUE_CHECK) : -1]
OPTIONAL = (Signal.MOTOR_VELOCITY, Signal.STATUSWORD, *CHECKS)

Available = Mapping[Signal, Sequence[MappedObject]]


@dataclass(frozen=True, slots=True, kw_only=True)
class Assignment:
    """One TPDO and its assigned objects."""

    tpdo: Tpdo  # as it is in the node
    objects: tuple[MappedObject, ...] | None  # objects to map in order; None: keep its mapping

    @property
    def entries(self) -> tuple[Entry, ...]:
        """What is mapped then, in order."""
        if self.objects is None:
            return self.tpdo.entries
        return tuple((*candidate.address, candidate.bits) for candidate in self.objects)


def pack(objects: Iterable[MappedObject], most: int = FRAME_BITS) -> list[tuple[MappedObject, ...]]:
    """Return the frames of at most eight bytes and `most` objects, first fit, in the order of importance."""
    frames: list[list[MappedObject]] = []
    for candidate in sorted(objects, key=lambda candidate: _ORDER.index(candidate.signal)):
        for frame in frames:
            if len(frame) < most and sum(other.bits for other in frame) + candidate.bits <= FRAME_BITS:
                frame.append(candidate)
                break
        else:
            frames.append([candidate])
    return [tuple(frame) for frame in frames]


def unused(wanted: Available, objects: Sequence[MappedObject]) -> tuple[MappedObject, ...]:
    """Return objects that do not serve a signal already: an object does not check itself."""
    used = {candidates[0].address for candidates in wanted.values() if candidates}
    return tuple(candidate for candidate in objects if candidate.address not in used)


def assign(
    role: Role, available: Available, tpdos: Sequence[Tpdo], *, prefer_unused: bool
) -> tuple[Assignment, ...]:
    """Assign signals to TPDOs.

    Args:
        available: for each signal wanted, the objects the node has for it, best first.
        prefer_unused: prefer disabled TPDOs, because another master may rely on the enabled ones.

    Raises:
        DriveError: a needed signal cannot be mapped; the message shows the mappings.
    """
    wanted = {signal: list(candidates) for signal, candidates in available.items() if candidates}
    if (result := _free(list(wanted.items()), tpdos, prefer_unused)) is not None:
        return result
    kept: list[Assignment] = []
    fixed = [tpdo for tpdo in tpdos if tpdo.fixed]
    while wanted:
        best = max(fixed, key=lambda tpdo: len(_carried(tpdo, wanted)), default=None)
        carried = _carried(best, wanted) if best is not None else []
        if best is None or not carried:
            break
        fixed.remove(best)
        kept.append(Assignment(tpdo=best, objects=None))
        for signal in carried:
            del wanted[signal]
    rest = _free(list(wanted.items()), tpdos, prefer_unused)
    if rest is None:
        needed = [(signal, objects) for signal, objects in wanted.items() if signal not in OPTIONAL]
        rest = _free(needed, tpdos, prefer_unused)
    if rest is None:
        raise DriveError(_cannot(role, wanted, tpdos))
    return tuple(kept) + rest


def _free(
    wanted: Sequence[tuple[Signal, Sequence[MappedObject]]], tpdos: Sequence[Tpdo], prefer_unused: bool
) -> tuple[Assignment, ...] | None:
    """Assign all signals to TPDOs that carry them or can be mapped; None if there are too few."""
    left = list(tpdos)
    result, unplaced = [], []
    most = min((tpdo.most for tpdo in tpdos if not tpdo.fixed), default=FRAME_BITS)
    for frame in pack((candidates[0] for _, candidates in wanted), most):
        entries = {(*candidate.address, candidate.bits) for candidate in frame}
        carrying = [tpdo for tpdo in left if entries <= set(tpdo.entries)]
        # Prefer the one that is sent at every SYNC already.
        ready = min(
            carrying, key=lambda t: (not t.enabled or t.transmission_type != 1, t.number), default=None
        )
        if ready is None:
            unplaced.append(frame)
        else:
            left.remove(ready)
            result.append(Assignment(tpdo=ready, objects=None))
    usable = [tpdo for tpdo in left if not tpdo.fixed]
    if len(unplaced) > len(usable):
        return None
    if prefer_unused:
        usable.sort(key=lambda tpdo: (tpdo.enabled, tpdo.number))
    result += [Assignment(tpdo=tpdo, objects=frame) for tpdo, frame in zip(usable, unplaced, strict=False)]
    return tuple(result)


def _carried(tpdo: Tpdo, wanted: Mapping[Signal, Sequence[MappedObject]]) -> list[Signal]:
    mapped = {(index, subindex) for index, subindex, _ in tpdo.entries}
    return [signal for signal, objects in wanted.items() if any(one.address in mapped for one in objects)]


def _cannot(role: Role, wanted: Available, tpdos: Sequence[Tpdo]) -> str:
    lacking = ", ".join(
        f"{signal} (" + " or ".join(f"0x{c.address[0]:04X}:{c.address[1]:02X}" for c in candidates) + ")"
        for signal, candidates in wanted.items()
        if signal not in OPTIONAL
    )
    return f"{role.subject} refuses the mapping and none of its TPDOs carries {lacking}: {describe(tpdos)}"


def choose_cob_id(node: int, tpdo: Tpdo, taken: set[int]) -> int:
    """Return the identifier for a TPDO: its own if usable, else the predefined one, else a free one.

    Args:
        tpdo: the TPDO; a DCF may have given it another node's identifier.
        taken: identifiers that other TPDOs on this bus have.

    Raises:
        DriveError: no identifier is left.
    """
    predefined = 0x80 + 0x100 * tpdo.number + node if tpdo.number <= 4 else 0
    own = tpdo.cob_id
    candidates = [own] if 0x181 <= own <= 0x57F and own & 0x7F == node else []
    candidates += [predefined] if predefined else []
    candidates += [own] if 0x181 <= own <= 0x57F and not 0x181 <= own <= 0x4FF else []
    candidates += [0x80 + 0x100 * number + node for number in (4, 3, 2, 1)]
    for candidate in candidates:
        if candidate not in taken:
            return candidate
    raise DriveError(f"node {node}: no identifier is free for its TPDO{tpdo.number}")
