"""Reads the TPDOs of a node: communication parameter 0x1800+n, mapping 0x1A00+n (CiA 301, 7.5.2).

By programs of `drivelink.canopen.sdo`, because canopen's PDO code blocks until each answer.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

from drivelink.canopen.layout import MappedObject, Signal, TpdoLayout
from drivelink.canopen.sdo import Program, SdoAbort, read_number

Address = tuple[int, int]
Entry = tuple[int, int, int]  # index, subindex, bits

ABSENT = frozenset({0x06020000, 0x06090011})  # SDO aborts: no such object, no such subindex
INVALID = 1 << 31
NO_RTR = 1 << 30
EXTENDED = 1 << 29
SYNC_TYPES = range(1, 241)

_MOST_TPDOS = 16  # TPDO numbers that are read; no known drive uses higher ones
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
        objects = " + ".join(f"0x{index:04X}:{subindex:02X}" for index, subindex, _ in tpdo.entries) or (
            "empty" if tpdo.known else "unknown"
        )
        parts.append(f"TPDO{tpdo.number} = {objects}")
    return "; ".join(parts) or "no TPDO"


def read_optional(node: int, index: int, subindex: int) -> Program[int | None]:
    """Read an unsigned value; None if it is not available."""
    try:
        return (yield from read_number(node, index, subindex))
    except SdoAbort:
        return None


def read_identity(node: int) -> Program[tuple[int, int, int, int]]:
    """Return vendor, product code, revision and serial number of 0x1018; 0 where not reported."""
    vendor = (yield from read_optional(node, 0x1018, 1)) or 0
    product = (yield from read_optional(node, 0x1018, 2)) or 0
    revision = (yield from read_optional(node, 0x1018, 3)) or 0
    return vendor, product, revision, (yield from read_optional(node, 0x1018, 4)) or 0


def _read_exactly(node: int, index: int, subindex: int) -> Program[int | None]:
    try:
        return (yield from read_number(node, index, subindex))
    except SdoAbort as abort:
        if abort.code in ABSENT:
            return None
        raise


def read_tpdo(node: int, number: int, *, exactly: bool = False) -> Program[Tpdo | None]:
    """Read one TPDO; None if it does not exist.

    Args:
        number: from 1.
        exactly: raise if part of the mapping cannot be read, because frames will be decoded by it.

    Raises:
        SdoAbort: `exactly`, and a read was aborted.
    """
    read = _read_exactly if exactly else read_optional
    communication, mapping = 0x17FF + number, 0x19FF + number
    cob = yield from read(node, communication, 1)
    if cob is None:
        return None
    transmission_type = yield from read(node, communication, 2)
    inhibit = yield from read_optional(node, communication, 3)
    event = yield from read_optional(node, communication, 5)
    count = yield from read(node, mapping, 0)
    known = count is not None
    entries: list[Entry] = []
    for subindex in range(1, min(count or 0, 64) + 1):
        raw = yield from read(node, mapping, subindex)
        known = known and raw is not None
        if not raw:  # some count empty entries
            break
        entries.append((raw >> 16, raw >> 8 & 0xFF, raw & 0xFF))
    return Tpdo(
        number=number,
        cob=cob,
        transmission_type=255 if transmission_type is None else transmission_type,
        inhibit_100us=inhibit or 0,
        event_ms=event or 0,
        entries=tuple(entries) if (known := known and sum(bits for _, _, bits in entries) <= 64) else (),
        known=known,
    )


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
    """Return TPDOs from the values of 0x1800 to 0x1BFF; one with an incomplete mapping is not `known`.

    Args:
        values: unsigned values by (index, subindex), from a data sheet or the traffic.
    """
    found = []
    for communication in sorted({index for index, _ in values if 0x1800 <= index <= 0x19FF}):
        cob = values.get((communication, 1))
        if cob is None:
            continue
        entries = _entries(values, communication + 0x200)
        found.append(
            Tpdo(
                number=communication - 0x17FF,
                cob=cob,
                transmission_type=values.get((communication, 2), 255),
                inhibit_100us=values.get((communication, 3), 0),
                event_ms=values.get((communication, 5), 0),
                entries=entries or (),
                known=entries is not None,
            )
        )
    return tuple(found)


def _entries(values: Mapping[Address, int], mapping: int) -> tuple[Entry, ...] | None:
    """The entries; None if one of them is unknown."""
    count = values.get((mapping, 0))
    entries: list[Entry] = []
    for subindex in range(1, 65 if count is None else min(count, 64) + 1):
        raw = values.get((mapping, subindex), 0)
        if not raw:  # a data sheet without a count: the first empty entry ends the list
            return tuple(entries) if count is None and entries else None
        entries.append((raw >> 16 & 0xFFFF, raw >> 8 & 0xFF, raw & 0xFF))
    return tuple(entries)


def decode(
    tpdos: Sequence[Tpdo], candidates: Mapping[Signal, Sequence[MappedObject]]
) -> tuple[TpdoLayout, ...]:
    """Return the layouts of the frames, from the mapping read back.

    Of several mapped objects for one signal the best one is used; of an object that is mapped twice, its
    place in a frame sent at every SYNC, else the first. An object serves the first signal it can. Others are
    skipped.

    Args:
        tpdos: as read back, taken from the traffic, or declared.
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
    """One frame; what it carries is taken out of `chosen`."""
    objects = []
    for index, subindex, bits in tpdo.entries:
        candidate = chosen.pop((index, subindex), None)
        if candidate is not None:
            objects.append(replace(candidate, bits=bits))
            continue
        objects.append(
            MappedObject(signal=Signal.OTHER, index=index, subindex=subindex, bits=bits, signed=False)
        )
    return TpdoLayout(
        cob_id=tpdo.cob_id,
        objects=tuple(objects),
        transmission_type=tpdo.transmission_type,
        number=tpdo.number,
        inhibit_s=tpdo.inhibit_100us * 1e-4,
    )
