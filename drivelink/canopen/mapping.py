"""Maps the signals of the joint into a node's TPDOs, and reads the result back.

The order is the one that all drives accept: pre-operational; 0x1800:01 invalid with its bit 30 kept; :02 = 1;
0x1A00:00 = 0; entries; count; valid again (CiA 301, 7.5.2.36). A node that is already configured is not
written to and stays operational, also after a restart of the daemon.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NoReturn

from drivelink.canopen.layout import MappedObject, Role, Signal, TpdoLayout
from drivelink.canopen.pdo import (
    EXTENDED,
    INVALID,
    NO_RTR,
    OPTIONAL,
    SYNC_TYPES,
    Assignment,
    Entry,
    Tpdo,
    assign,
    choose_cob_id,
    decode,
    describe,
    read_optional,
    read_tpdo,
)
from drivelink.canopen.sdo import Nmt, Pause, Program, Read, SdoAbort, Write, abort_text
from drivelink.errors import DriveError
from drivelink.notice import Findings, Severity

NMT_START = 0x01
NMT_PRE_OPERATIONAL = 0x80
_TIMING_NAMES = {2: "transmission type", 3: "inhibit time", 5: "event timer", 6: "SYNC start value"}
SETTLE_S = 0.02  # for a change of the NMT state, which is not acknowledged

_NOT_NOW = frozenset({0x08000020, 0x08000021, 0x08000022})  # local control, present state of the device
_READ_ONLY = frozenset({0x06010000, 0x06010002})
_TOO_MANY = 0x06040042
_NO_SUBINDEX = 0x06090011
_STATE_S = 1.5  # until a node is pre-operational and accepts what it refused before
_STATE_POLL_S = 0.05


class _MapFixed(Exception):  # noqa: N818
    """A TPDO refuses another mapping, or one of this length."""


@dataclass(slots=True)
class _ObjectRefused(Exception):  # noqa: N818
    """A TPDO refuses one object."""

    candidate: MappedObject
    code: int


@dataclass(slots=True)
class Mapper:
    """Mapping of one node."""

    role: Role  # what the node is there for
    # for each signal, the objects that the node has for it, best first
    available: Mapping[Signal, Sequence[MappedObject]]
    tpdos: dict[int, Tpdo]  # as they are in the node, by number
    taken: set[int]  # identifiers in use elsewhere on the bus
    prefer_unused: bool  # see `pdo.assign`
    findings: Findings  # added to
    period_s: float = 0.001  # communication cycle, at which a TPDO is asked for that cannot be sent on SYNC
    # further signals that are read if they are mapped anyway
    readable: Mapping[Signal, Sequence[MappedObject]] = field(default_factory=dict)
    _pre_operational: bool = field(default=False, init=False)
    _chosen: dict[int, int] = field(default_factory=dict, init=False)
    _patience_s: float = field(default=_STATE_S, init=False)
    _refusal: str = field(default="", init=False)

    def program(self) -> Program[tuple[TpdoLayout, ...]]:
        """Return the program: map, read back, decode.

        Raises:
            DriveError: the node lacks a needed signal, or does not keep the mapping.
        """
        available = {signal: list(candidates) for signal, candidates in self.available.items()}
        while True:
            try:
                tpdos = tuple(self.tpdos.values())
                assignments = assign(self.role, available, tpdos, prefer_unused=self.prefer_unused)
            except DriveError as error:
                raise DriveError(f"{error}{self._refusal}") from error
            try:
                for assignment in assignments:
                    yield from self._apply(assignment)
                break
            except _MapFixed:
                continue
            except _ObjectRefused as refused:
                self._drop(available, refused)
        return (yield from self._read_back([assignment.tpdo.number for assignment in assignments]))

    def _drop(self, available: dict[Signal, list[MappedObject]], refused: _ObjectRefused) -> None:
        signal = refused.candidate.signal
        index, subindex = refused.candidate.address
        available[signal].remove(refused.candidate)
        text = f"0x{index:04X}:{subindex:02X} cannot be mapped, SDO abort {abort_text(refused.code)}"
        if not available[signal] and signal not in OPTIONAL:
            raise DriveError(
                f"{self.role.subject} refuses the mapping: {text}, and it has no other object for {signal}"
            )
        severity = Severity.INFO if available[signal] else Severity.WARNING
        self.findings.add(severity, self.role.subject, text)

    def _apply(self, assignment: Assignment) -> Program[None]:
        """Configure one TPDO, if necessary."""
        tpdo, entries = assignment.tpdo, assignment.entries
        mine = {chosen for number, chosen in self._chosen.items() if number != tpdo.number}
        mine |= {one.cob_id for number, one in self.tpdos.items() if one.enabled and number != tpdo.number}
        cob_id = choose_cob_id(self.role.node_id, tpdo, self.taken | mine)
        self._chosen[tpdo.number] = cob_id
        if tpdo.enabled and tpdo.cob_id == cob_id and tpdo.transmission_type == 1 and tpdo.entries == entries:
            return
        try:
            self.tpdos[tpdo.number] = yield from self._write(tpdo, cob_id, entries, assignment.objects)
        except (_MapFixed, _ObjectRefused):
            del self._chosen[tpdo.number]
            raise

    def _write(
        self, tpdo: Tpdo, cob_id: int, entries: tuple[Entry, ...], objects: tuple[MappedObject, ...] | None
    ) -> Program[Tpdo]:
        if not self._pre_operational:
            self._pre_operational = True
            yield Nmt(self.role.node_id, NMT_PRE_OPERATIONAL)
            yield Pause(SETTLE_S)
        no_rtr = tpdo.cob & NO_RTR
        try:
            yield from self._cob(tpdo, tpdo.cob & ~EXTENDED | INVALID)
        except SdoAbort as abort:
            self._stays_on(tpdo, abort, objects)
            yield from self._timing(tpdo)
            return tpdo
        yield from self._timing(tpdo)
        if objects is not None and tpdo.entries != entries:
            try:
                yield from self._entries(tpdo, objects)
            except (_MapFixed, _ObjectRefused):
                yield from self._restore(tpdo)
                raise
        try:
            yield from self._cob(tpdo, cob_id | no_rtr)
        except SdoAbort:  # an identifier that cannot be changed is used, if it is unique
            if tpdo.cob_id in self.taken:
                raise
            yield from self._cob(tpdo, tpdo.cob & ~INVALID)
        return replace(tpdo, cob=cob_id | no_rtr, transmission_type=1, entries=entries)

    def _put(self, index: int, subindex: int, value: int, size: int) -> Program[None]:
        """Write, with retries for a node that is slow to enter pre-operational."""
        while True:
            try:
                yield Write(self.role.node_id, index, subindex, value, size)
                return
            except SdoAbort as abort:
                if abort.code not in _NOT_NOW or self._patience_s <= 0:
                    raise
            self._patience_s -= _STATE_POLL_S
            yield Nmt(self.role.node_id, NMT_PRE_OPERATIONAL)  # the first one may have been lost
            yield Pause(_STATE_POLL_S)

    def _cob(self, tpdo: Tpdo, value: int) -> Program[None]:
        yield from self._put(tpdo.communication, 1, value, 4)

    def _stays_on(self, tpdo: Tpdo, abort: SdoAbort, objects: tuple[MappedObject, ...] | None) -> None:
        """The TPDO cannot be disabled: its mapping is fixed.

        Raises:
            _MapFixed: another map was wanted.
            SdoAbort: it is off, and that cannot be changed.
        """
        if objects is not None and not tpdo.fixed:
            self._learn(tpdo, "is fixed", abort, fixed=True)
        if not tpdo.enabled:
            raise abort

    def _learn(self, tpdo: Tpdo, what: str, abort: SdoAbort, **known: Any) -> NoReturn:
        """Note what a TPDO's mapping does not allow.

        Raises:
            _MapFixed: always: the signals are to be assigned anew.
        """
        self.tpdos[tpdo.number] = replace(tpdo, **known)
        answer = f"0x{abort.index:04X}:{abort.subindex:02X} answers {abort_text(abort.code)}"
        self.findings.info(self.role.subject, f"TPDO{tpdo.number} {what} ({answer})")
        self._refusal = self._refusal or f"; writing {answer}"
        raise _MapFixed from abort

    def _timing(self, tpdo: Tpdo) -> Program[None]:
        """Set transmission at every SYNC, without inhibit time or event timer. A TPDO that cannot be
        synchronous gets an event timer of one period.
        """
        start = yield from read_optional(self.role.node_id, tpdo.communication, 6)
        on_sync = yield from self._ask(tpdo, 2, tpdo.transmission_type, 1)
        every_ms = (
            0 if on_sync or tpdo.transmission_type in SYNC_TYPES else max(1, round(1e3 * self.period_s))
        )
        yield from self._ask(tpdo, 3, tpdo.inhibit_100us, 0)
        yield from self._ask(tpdo, 5, tpdo.event_ms, every_ms)
        yield from self._ask(tpdo, 6, start or 0, 0)

    def _ask(self, tpdo: Tpdo, subindex: int, has: int, wanted: int) -> Program[bool]:
        """Write a communication parameter if it differs; return whether it has the wanted value."""
        if has == wanted:
            return True
        try:
            yield from self._put(tpdo.communication, subindex, wanted, 2 if subindex in (3, 5) else 1)
        except SdoAbort as abort:
            if subindex == 2 and abort.code in _NOT_NOW:
                raise  # not essential, unlike transmission at SYNC
            old = ": its values may be older than their SYNC" if subindex == 2 else ""
            text = f"TPDO{tpdo.number} keeps {_TIMING_NAMES[subindex]} {has} instead of {wanted}{old}"
            severity = Severity.WARNING if subindex == 2 else Severity.INFO
            text = f"{text} (SDO abort {abort_text(abort.code)})"
            self.findings.add(severity, self.role.subject, text)
            return False
        return True

    def _entries(self, tpdo: Tpdo, objects: tuple[MappedObject, ...]) -> Program[None]:
        try:
            yield from self._put(tpdo.mapping, 0, 0, 1)
        except SdoAbort as abort:
            self._learn(tpdo, "has a fixed map", abort, fixed=True)
        for position, candidate in enumerate(objects, start=1):
            index, subindex = candidate.address
            value = index << 16 | subindex << 8 | candidate.bits
            try:
                yield from self._put(tpdo.mapping, position, value, 4)
            except SdoAbort as abort:
                if abort.code in _READ_ONLY:
                    self._learn(tpdo, "has a fixed map", abort, fixed=True)
                if position > 1 and (yield from self._is_full(tpdo, position, abort)):
                    self._learn(tpdo, _takes(position - 1), abort, most=position - 1)
                raise _ObjectRefused(candidate, abort.code) from abort
        try:
            yield from self._put(tpdo.mapping, 0, len(objects), 1)
        except SdoAbort as abort:
            if abort.code == _TOO_MANY and len(objects) > 1:
                self._learn(tpdo, _takes(len(objects) - 1), abort, most=len(objects) - 1)
            self._learn(tpdo, "has a fixed map", abort, fixed=True)

    def _is_full(self, tpdo: Tpdo, position: int, abort: SdoAbort) -> Program[bool]:
        """Return whether the mapping is full, rather than the object unknown to the node."""
        if abort.code != _NO_SUBINDEX:
            return abort.code == _TOO_MANY
        try:
            yield Read(self.role.node_id, tpdo.mapping, position)
        except SdoAbort:
            return True
        return False

    def _restore(self, tpdo: Tpdo) -> Program[None]:
        """Restore mapping and identifier after a refusal."""
        node = self.role.node_id
        try:
            if tpdo.known and not self.tpdos[tpdo.number].fixed:
                yield Write(node, tpdo.mapping, 0, 0, 1)
                for position, (index, subindex, bits) in enumerate(tpdo.entries, start=1):
                    yield Write(node, tpdo.mapping, position, index << 16 | subindex << 8 | bits, 4)
                yield Write(node, tpdo.mapping, 0, len(tpdo.entries), 1)
            yield from self._cob(tpdo, tpdo.cob)
        except SdoAbort as abort:
            self.findings.warn(self.role.subject, f"TPDO{tpdo.number} could not be put back: {abort}")

    def _read_back(self, numbers: Iterable[int]) -> Program[tuple[TpdoLayout, ...]]:
        used: list[Tpdo] = []
        for number in numbers:
            tpdo = yield from read_tpdo(self.role.node_id, number, exactly=True)
            if tpdo is None or not tpdo.enabled:
                raise DriveError(f"{self.role.subject}: TPDO{number} stays disabled after its configuration")
            self.tpdos[number] = replace(tpdo, fixed=self.tpdos[number].fixed)
            used.append(tpdo)
        rest = {signal: objects for signal, objects in self.readable.items() if signal not in self.available}
        layouts = decode(used, {**self.available, **rest})
        given = {mapped.signal for layout in layouts for mapped in layout.objects}
        for signal in self.available:
            if signal not in given and signal not in OPTIONAL:
                raise DriveError(
                    f"{self.role.subject} does not keep the mapping: {signal} is not in what reads back: "
                    f"{describe(used)}"
                )
            if signal not in given:
                self.findings.warn(self.role.subject, f"gives no {signal}: {describe(used)}")
        return layouts


def disable(node: int, tpdo: Tpdo) -> Program[None]:
    """Disable an unused TPDO."""
    yield Write(node, tpdo.communication, 1, tpdo.cob & ~EXTENDED | INVALID, 4)


def _takes(most: int) -> str:
    return f"takes {most} object{'s' if most > 1 else ''}"
