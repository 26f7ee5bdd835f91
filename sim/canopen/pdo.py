"""Process data objects of a simulated device (CiA 301, 7.5.2.35 to 7.5.2.38).

A PDO's parameters are dictionary entries; writes are checked as strictly as any known device does. The layout
of a valid PDO is compiled to one `struct.Struct` and a tuple of entries.
"""

from __future__ import annotations

import struct
from collections.abc import Callable

from sim.canopen.aborts import Abort, SdoAbortedError
from sim.canopen.dictionary import Dictionary, Entry
from sim.canopen.quirks import Quirks

COB_INVALID = 1 << 31
COB_NO_RTR = 1 << 30
MAPPED_AT_MOST = 8  # objects in one PDO

_FRAME_29_BIT = 1 << 29
_LONGEST_BITS = 64
_DUMMIES = {2: 8, 3: 16, 4: 32, 5: 8, 6: 16, 7: 32}  # bits of the data types that stand for no object
_RESERVED_TYPES = range(241, 254)  # and RTR-only types, which this device does not do


def restricted(can_id: int) -> bool:
    """Whether an identifier is restricted: not allowed for PDO, SYNC or EMCY (CiA 301, table 40)."""
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
        dictionary: holds the parameters at `communication` and `mapping`.
        communication: index of the communication parameter record.
        mapping: index of the mapping parameter record.
        quirks: how this device deviates.
        operational: whether the device is in NMT state operational.
        changed: called after a change of validity or parameters.

    Attributes:
        valid: bit 31 of the COB-ID is clear.
        generation: counts changes of the parameters.
        can_id: its identifier on the bus.
        type: transmission type.
        event_s: event timer or deadline; 0: none.
        entries: mapped entries in order; None: a dummy.
        layout: the frame.
    """

    def __init__(
        self,
        dictionary: Dictionary,
        communication: int,
        mapping: int,
        quirks: Quirks,
        operational: Callable[[], bool],
        changed: Callable[[], None],
    ) -> None:
        self._dictionary = dictionary
        self._quirks = quirks
        self._operational = operational
        self._notify = changed
        self._cob = dictionary.find(communication, 1)
        self._type = dictionary.find(communication, 2)
        self._count = dictionary.find(mapping, 0)
        self._slots = [dictionary.find(mapping, k) for k in range(1, MAPPED_AT_MOST + 1)]
        self._event = dictionary.optional(communication, 5)
        self.entries: tuple[Entry | None, ...] = ()
        self.layout = struct.Struct("<")
        self.valid = False
        self.generation = 0
        self.can_id = 0
        self.type = 0
        self.event_s = 0.0
        self._cob.check = self._check_cob
        self._cob.changed = self.compile
        self._type.check = self._check_type
        self._type.changed = self.compile
        self._event.changed = self.compile
        self._count.check = self._check_count
        for slot in self._slots:
            slot.check = self._check_slot

    def compile(self) -> None:
        """Take over changed parameters."""
        self.generation += 1
        self.valid = not self._cob.number & COB_INVALID
        self.can_id = self._cob.number & 0x7FF
        self.type = self._type.number
        self.event_s = self._event.number * 1e-3
        self.entries = tuple(self._mapped(slot.number) for slot in self._slots[: self._count.number])
        bits = [slot.number & 0xFF for slot in self._slots[: self._count.number]]
        codes = (entry.code if entry else f"{n // 8}x" for entry, n in zip(self.entries, bits, strict=True))
        self.layout = struct.Struct("<" + "".join(code or "" for code in codes))
        self._notify()

    def _mapped(self, word: int) -> Entry | None:
        return self._dictionary.get(word >> 16, (word >> 8) & 0xFF)

    def _check_cob(self, value: int) -> None:
        if self._quirks.fixed_pdos:
            raise SdoAbortedError(Abort.READ_ONLY)
        valid = not value & COB_INVALID
        can_id = value & 0x7FF
        wrong = (
            value & (_FRAME_29_BIT | 0x1FFFF800)
            or (self.valid and valid and can_id != self.can_id)
            or (valid and restricted(can_id))
            or (valid and self._count.number == 0)
            or (self._quirks.keep_bit_30 and (value ^ self._cob.number) & COB_NO_RTR)
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
        if self._quirks.fixed_mapping or self._quirks.fixed_pdos:
            raise SdoAbortedError(Abort.READ_ONLY)
        if self._quirks.mapping_in_preoperational and self._operational():
            raise SdoAbortedError(Abort.DEVICE_STATE)
        if self.valid:
            raise SdoAbortedError(Abort.UNSUPPORTED_ACCESS)

    def _check_count(self, value: int) -> None:
        self._check_mapping_access()
        if value > self._quirks.objects_per_pdo:
            raise SdoAbortedError(Abort.PDO_LENGTH)
        total = 0
        for slot in self._slots[:value]:
            self._check_mappable(slot.number)
            total += slot.number & 0xFF
        if total > _LONGEST_BITS:
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
            entry = self._dictionary.find(index, subindex)
            mappable, length = self._allows(entry), entry.bits
        if not mappable or bits != length:
            raise SdoAbortedError(Abort.NOT_MAPPABLE)

    def _allows(self, entry: Entry | None) -> bool:
        """Whether the entry (None: a dummy) may be in this kind of PDO."""
        raise NotImplementedError
