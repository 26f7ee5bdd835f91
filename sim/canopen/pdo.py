"""Process data objects of a simulated device (CiA 301, 7.5.2.35 to 7.5.2.38).

A PDO's parameters are dictionary entries; writes are checked as strictly as any known device does. The layout
of a valid PDO is compiled to one `struct.Struct` and a tuple of entries.
"""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING

from sim.canopen.dictionary import Abort, Entry, SdoAbortedError

if TYPE_CHECKING:
    from sim.canopen.node import Node

COB_INVALID = 1 << 31
COB_NO_RTR = 1 << 30
MAPPED_AT_MOST = 8  # objects in one PDO

_FRAME_29_BIT = 1 << 29
_LONGEST_BITS = 64
_DUMMIES = {2: 8, 3: 16, 4: 32, 5: 8, 6: 16, 7: 32}  # bits of the data types that stand for no object
_RESERVED_TYPES = range(241, 254)  # and RTR-only types, which this device does not do
_TOO_SHORT, _TOO_LONG, _RPDO_TIMEOUT = 0x8210, 0x8220, 0x8250  # EMCY codes
_COMMUNICATION_ERROR = 0x10  # bit of the error register


def restricted(can_id: int) -> bool:
    """Return whether an identifier is restricted: not allowed for PDO, SYNC or EMCY (CiA 301, table 40)."""
    return (
        can_id <= 0x07F
        or 0x101 <= can_id <= 0x180
        or 0x581 <= can_id <= 0x5FF
        or 0x601 <= can_id <= 0x67F
        or 0x6E0 <= can_id <= 0x6FF
        or can_id >= 0x701
    )


class Pdo:
    """Common part of TPDOs and RPDOs: parameters, their checks, the compiled layout.

    Args:
        first: index of the communication parameter of number 1; the mapping is 0x200 behind it.
    """

    def __init__(self, node: Node, number: int, first: int) -> None:
        self._node, self.number = node, number
        find, communication = node.dictionary.find, first + number - 1
        self._cob, self._type = find(communication, 1), find(communication, 2)
        self._count = find(communication + 0x200, 0)
        self._slots = [find(communication + 0x200, k) for k in range(1, MAPPED_AT_MOST + 1)]
        self._event = node.dictionary.optional(communication, 5)
        self.entries: tuple[Entry | None, ...] = ()  # mapped entries in order; None: a dummy
        self.layout = struct.Struct("<")  # the frame
        self.valid = False  # bit 31 of the COB-ID is clear
        self.synchronous = False  # whether it belongs to a SYNC
        self.can_id = 0  # its identifier on the bus
        self.type = 0  # transmission type
        self._generation = 0
        self.event_s = 0.0  # event timer or deadline; 0: none
        self._condition: tuple[bool, bool, int] | None = None
        self._cob.check, self._type.check = self._check_cob, self._check_type
        self._cob.changed = self._type.changed = self._event.changed = self.compile
        self._count.check = self._check_count
        for slot in self._slots:
            slot.check = self._check_slot

    def compile(self) -> None:
        """Apply changed parameters."""
        self._generation += 1
        self.valid = not self._cob.number & COB_INVALID
        self.can_id = self._cob.number & 0x7FF
        self.type = self._type.number
        self.synchronous = self.type <= 240
        self.event_s = self._event.number * 1e-3
        words = [slot.number for slot in self._slots[: self._count.number]]
        self.entries = tuple(self._node.dictionary.get(word >> 16, word >> 8 & 0xFF) for word in words)
        codes = (
            entry.code if entry else f"{(n & 0xFF) // 8}x"
            for entry, n in zip(self.entries, words, strict=True)
        )
        self.layout = struct.Struct("<" + "".join(code or "" for code in codes))
        self._node.pdos_changed()

    def activate(self, active: bool, counting: bool) -> None:
        """Start or stop, after a change of the NMT state or of parameters.

        Args:
            active: the device is operational and the PDO valid.
            counting: SYNC messages carry a counter (0x1019).
        """
        condition = (active, counting, self._generation)
        if condition != self._condition:
            self._condition = condition
            self._node.timers.cancel(self)
            self._begin(active, counting)

    def _begin(self, active: bool, counting: bool) -> None:
        """Start in another state, or with other parameters."""
        raise NotImplementedError

    def _check_cob(self, value: int) -> None:
        if self._node.quirks.fixed_pdos:
            raise SdoAbortedError(Abort.READ_ONLY)
        valid = not value & COB_INVALID
        can_id = value & 0x7FF
        wrong = (
            value & (_FRAME_29_BIT | 0x1FFFF800)
            or (self.valid and valid and can_id != self.can_id)
            or (valid and restricted(can_id))
            or (valid and self._count.number == 0)
            or (self._node.quirks.keep_bit_30 and (value ^ self._cob.number) & COB_NO_RTR)
        )
        if wrong:
            raise SdoAbortedError(Abort.INVALID_VALUE)

    def _check_type(self, value: int) -> None:
        if value in _RESERVED_TYPES:
            raise SdoAbortedError(Abort.INVALID_VALUE)

    def _refuse_while_valid(self, _value: int) -> None:
        if self.valid:
            raise SdoAbortedError(Abort.INVALID_VALUE)

    def _check_mapping_access(self) -> None:
        quirks = self._node.quirks
        if quirks.fixed_mapping or quirks.fixed_pdos:
            raise SdoAbortedError(Abort.READ_ONLY)
        if quirks.mapping_in_preoperational and self._node.operational:
            raise SdoAbortedError(Abort.DEVICE_STATE)
        if self.valid:
            raise SdoAbortedError(Abort.UNSUPPORTED_ACCESS)

    def _check_count(self, value: int) -> None:
        self._check_mapping_access()
        if value > self._node.quirks.objects_per_pdo:
            raise SdoAbortedError(Abort.PDO_LENGTH)
        for slot in self._slots[:value]:
            self._check_mappable(slot.number)
        if sum(slot.number & 0xFF for slot in self._slots[:value]) > _LONGEST_BITS:
            raise SdoAbortedError(Abort.PDO_LENGTH)

    def _check_slot(self, value: int) -> None:
        self._check_mapping_access()
        if self._count.number:
            raise SdoAbortedError(Abort.UNSUPPORTED_ACCESS)
        if value:  # 0 empties the slot
            self._check_mappable(value)

    def _check_mappable(self, word: int) -> None:
        index, subindex, bits = word >> 16, (word >> 8) & 0xFF, word & 0xFF
        if index in _DUMMIES and subindex == 0:
            mappable, length = self._allows(None), _DUMMIES[index]
        else:
            entry = self._node.dictionary.find(index, subindex)
            mappable, length = self._allows(entry), entry.bits
        if not mappable or bits != length:
            raise SdoAbortedError(Abort.NOT_MAPPABLE)

    def _allows(self, entry: Entry | None) -> bool:
        """Return whether the entry (None: a dummy) may be in this kind of PDO."""
        raise NotImplementedError


class Tpdo(Pdo):
    """A PDO that the device sends: with a SYNC, on an event, or by a timer."""

    def __init__(self, node: Node, number: int) -> None:
        super().__init__(node, number, 0x1800)
        self.emit = node.send  # puts (identifier, data) on the bus; faults are injected by wrapping it
        self._inhibit = node.dictionary.optional(0x17FF + number, 3)
        self._start = node.dictionary.optional(0x17FF + number, 6)
        self._inhibit.check = self._start.check = self._refuse_while_valid
        self._syncs = 0
        self._waiting = False  # for the SYNC that carries the start value
        self._last: bytes | None = None

    def _allows(self, entry: Entry | None) -> bool:
        return entry is not None and entry.transmittable

    def _begin(self, active: bool, counting: bool) -> None:
        self._node.timers.cancel(self._inhibit)
        self._last = None
        self._syncs = 0
        self._waiting = bool(active and counting and self._start.number)
        if active and not self.synchronous and self.event_s:
            self._node.timers.set(self, self.event_s, self._event_due)

    def pack(self) -> bytes:
        """Return the frame with the present values."""
        return self.layout.pack(*[entry.value for entry in self.entries if entry])

    def sync(self, counter: int | None) -> None:
        """Handle a SYNC after the process data have been sampled."""
        if self.type == 1 and not self._waiting:
            self.emit(self.can_id, self.pack())
            return
        if self._waiting:
            if counter != self._start.number:
                return
            self._waiting = False
            self._syncs = self.type - 1
        if self.type == 0:
            data = self.pack()
            if data != self._last:
                self._last = data
                self.emit(self.can_id, data)
            return
        self._syncs += 1
        if self._syncs >= self.type:
            self._syncs = 0
            self.emit(self.can_id, self.pack())

    def event(self) -> None:
        """Send an event-driven PDO if its data have changed."""
        if self._inhibit not in self._node.timers:
            data = self.pack()
            if data != self._last:
                self._send_event(data)

    def _event_due(self) -> None:
        if self._inhibit in self._node.timers:
            self._node.timers.set(self, self._inhibit.number * 1e-4, self._event_due)
        else:
            self._send_event(self.pack())

    def _send_event(self, data: bytes) -> None:
        self._last = data
        if self._inhibit.number:
            self._node.timers.set(self._inhibit, self._inhibit.number * 1e-4, self.event)
        if self.event_s:
            self._node.timers.set(self, self.event_s, self._event_due)
        self.emit(self.can_id, data)


class Rpdo(Pdo):
    """A PDO that the device receives: it acts when it comes, or with the next SYNC."""

    def __init__(self, node: Node, number: int) -> None:
        super().__init__(node, number, 0x1400)
        self._pending: bytes | None = None

    def _allows(self, entry: Entry | None) -> bool:
        return entry is None or entry.receivable

    def _begin(self, active: bool, counting: bool) -> None:
        self._pending = None

    def _fail(self, code: int) -> None:
        self._node.emergency.raise_error(code, _COMMUNICATION_ERROR, bytes([self.number]))

    def receive(self, data: bytes) -> None:
        """Handle a frame now or, if synchronous, with the next SYNC."""
        if len(data) != self.layout.size:
            self._fail(_TOO_SHORT if len(data) < self.layout.size else _TOO_LONG)
        if len(data) < self.layout.size:
            return
        if self.event_s:
            self._node.timers.set(self, self.event_s, lambda: self._fail(_RPDO_TIMEOUT))
        self._pending = data
        if not self.synchronous:
            self.apply()

    def apply(self) -> None:
        """Store the mapped values of a pending frame."""
        data, self._pending = self._pending, None
        if data is None:
            return
        values = iter(self.layout.unpack_from(data))
        for entry in self.entries:
            if entry is None:  # a dummy entry
                continue
            try:
                entry.write(next(values))
            except SdoAbortedError:  # out of range: the object keeps its value, as drives do
                continue
