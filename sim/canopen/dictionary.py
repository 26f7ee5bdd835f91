"""The object dictionary of a simulated device: typed entries with access rights, limits and hooks.

A dictionary is made of `Item` descriptions (the content of an EDS file) and holds the live `Entry` of each
sub-index. PDOs are packed from `Entry.value`, without a dictionary access.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from enum import IntEnum

from sim.canopen.aborts import Abort, SdoAbortError

Value = int | bytes

_LONGEST_STRING = 889  # bytes: 127 segments of 7, the most one block transfer moves at once


class DataType(IntEnum):
    """Static data types (CiA 301, table 44)."""

    BOOLEAN = 0x01
    INTEGER8 = 0x02
    INTEGER16 = 0x03
    INTEGER32 = 0x04
    UNSIGNED8 = 0x05
    UNSIGNED16 = 0x06
    UNSIGNED32 = 0x07
    VISIBLE_STRING = 0x09
    OCTET_STRING = 0x0A
    DOMAIN = 0x0F
    INTEGER64 = 0x15
    UNSIGNED64 = 0x1B


_FORMATS = {
    DataType.BOOLEAN: "B",
    DataType.INTEGER8: "b",
    DataType.INTEGER16: "h",
    DataType.INTEGER32: "i",
    DataType.UNSIGNED8: "B",
    DataType.UNSIGNED16: "H",
    DataType.UNSIGNED32: "I",
    DataType.INTEGER64: "q",
    DataType.UNSIGNED64: "Q",
}


class Kind(IntEnum):
    """Object codes (CiA 301, table 42)."""

    VAR = 0x07
    ARRAY = 0x08
    RECORD = 0x09


@dataclass(frozen=True, slots=True, kw_only=True)
class Item:
    """Description of one sub-index, as in a data sheet.

    Attributes:
        subindex: 0 for the value of a VAR.
        name: ParameterName.
        type: its data type.
        access: "ro", "rw", "wo", "const", "rww" (written by RPDO) or "rwr" (read by TPDO).
        default: power-on value.
        low: smallest value, where it is limited.
        high: largest value, where it is limited.
        pdo: whether it can be mapped; which direction follows from the access.
        plus_node_id: whether the node id is added to the default ($NODEID).
    """

    subindex: int = 0
    name: str
    type: DataType
    access: str = "ro"
    default: Value = 0
    low: int | None = None
    high: int | None = None
    pdo: bool = False
    plus_node_id: bool = False


@dataclass(frozen=True, slots=True, kw_only=True)
class Object:
    """Description of one index, as in a data sheet."""

    index: int
    name: str
    kind: Kind
    items: tuple[Item, ...]


class Entry:
    """One live sub-index.

    Attributes:
        item: its description.
        value: the present value; an int, or bytes for strings and domains.
        refresh: called before an SDO read, for values taken from the simulated joint.
        check: called with the new value before it is stored; raises `SdoAbortError` to refuse it.
        changed: called after a write has been stored.
    """

    __slots__ = ("changed", "check", "code", "default", "index", "item", "refresh", "value")

    def __init__(self, index: int, item: Item, node_id: int) -> None:
        self.index = index
        self.item = item
        self.code = _FORMATS.get(item.type)
        self.default: Value = item.default
        if item.plus_node_id and isinstance(item.default, int):
            self.default = item.default + node_id
        self.value: Value = self.default
        self.refresh: Callable[[], None] | None = None
        self.check: Callable[[int], None] | None = None
        self.changed: Callable[[], None] | None = None

    @property
    def number(self) -> int:
        """The value of an integer entry."""
        return self.value if isinstance(self.value, int) else 0

    @property
    def bits(self) -> int:
        """Length in a PDO; 0 if it is not fixed."""
        return struct.calcsize("<" + self.code) * 8 if self.code else 0

    @property
    def transmittable(self) -> bool:
        """Whether a TPDO may carry it."""
        return self.item.pdo and self.item.access in ("ro", "rw", "rwr", "const")

    @property
    def receivable(self) -> bool:
        """Whether an RPDO may carry it."""
        return self.item.pdo and self.item.access in ("wo", "rw", "rww")

    def upload(self) -> bytes:
        """The value's bytes, as an SDO read gives them."""
        if self.item.access == "wo":
            raise SdoAbortError(Abort.WRITE_ONLY)
        if self.refresh:
            self.refresh()
        if isinstance(self.value, bytes):
            return self.value
        return struct.pack("<" + (self.code or "I"), self.value)

    def writable(self) -> None:
        """Raise unless the entry may be written at all."""
        if self.item.access in ("ro", "const"):
            raise SdoAbortError(Abort.READ_ONLY)

    def download(self, data: bytes) -> None:
        """Check and store the bytes of an SDO write."""
        self.writable()
        if self.code is None:
            if len(data) > _LONGEST_STRING:
                raise SdoAbortError(Abort.TOO_LONG)
            self.value = bytes(data)
            if self.changed:
                self.changed()
            return
        size = struct.calcsize("<" + self.code)
        if len(data) != size:
            raise SdoAbortError(Abort.TOO_LONG if len(data) > size else Abort.TOO_SHORT)
        (value,) = struct.unpack("<" + self.code, data)
        self.write(value)

    def write(self, value: int) -> None:
        """Check and store an integer, from SDO or RPDO."""
        item = self.item
        if item.high is not None and value > item.high:
            raise SdoAbortError(Abort.TOO_HIGH)
        if item.low is not None and value < item.low:
            raise SdoAbortError(Abort.TOO_LOW)
        if self.check:
            self.check(value)
        self.value = value
        if self.changed:
            self.changed()


class Dictionary:
    """All entries of one device."""

    def __init__(self, objects: Iterable[Object], node_id: int) -> None:
        self.objects = {described.index: described for described in objects}
        self._entries = {
            (described.index, item.subindex): Entry(described.index, item, node_id)
            for described in self.objects.values()
            for item in described.items
        }
        self._stored: dict[tuple[int, int], Value] = {}

    def __contains__(self, key: object) -> bool:
        return key in self._entries

    def __iter__(self) -> Iterator[Entry]:
        return iter(self._entries.values())

    def get(self, index: int, subindex: int = 0) -> Entry | None:
        """The entry, or None."""
        return self._entries.get((index, subindex))

    def find(self, index: int, subindex: int) -> Entry:
        """The entry.

        Raises:
            SdoAbortError: there is none.
        """
        entry = self._entries.get((index, subindex))
        if entry is None:
            raise SdoAbortError(Abort.NO_SUBINDEX if index in self.objects else Abort.NO_OBJECT)
        return entry

    def optional(self, index: int, subindex: int = 0) -> Entry:
        """The entry, or a hidden one with the value 0 if this device lacks it."""
        absent = Item(subindex=subindex, name="absent", type=DataType.INTEGER32)
        return self._entries.get((index, subindex)) or Entry(index, absent, 0)

    def store(self, low: int, high: int) -> None:
        """Make the present values of writable entries their power-on values (0x1010)."""
        for key, entry in self._entries.items():
            if low <= key[0] <= high and entry.item.access not in ("ro", "const"):
                self._stored[key] = entry.value

    def restore_defaults(self, low: int, high: int) -> None:
        """Forget stored values (0x1011); takes effect with the next reset."""
        self._stored = {key: value for key, value in self._stored.items() if not low <= key[0] <= high}

    def reset(self, low: int, high: int) -> None:
        """Set the power-on values of an index range."""
        for key, entry in self._entries.items():
            if low <= key[0] <= high:
                entry.value = self._stored.get(key, entry.default)
