"""The object dictionary of a simulated device: typed entries with access rights, limits and hooks.

A dictionary is made of canopen's description of an EDS file and holds the live `Entry` of each sub-index.
PDOs are packed from `Entry.value`, without a dictionary access. Refusals are SDO aborts
(CiA 301, 7.2.4.3.17); `canopen.SdoAbortedError` carries one to the client.
"""

import struct
from collections.abc import Callable, Iterable, Iterator
from enum import IntEnum

from canopen.objectdictionary import ODArray, ODRecord, ODVariable, datatypes
from canopen.sdo.exceptions import SdoAbortedError

__all__ = ["Abort", "SdoAbortedError"]


class Abort(IntEnum):
    """The codes that a simulated device answers with, besides those of canopen's server."""

    TIMEOUT = 0x05040000
    COMMAND = 0x05040001  # client/server command specifier not valid
    UNSUPPORTED_ACCESS = 0x06010000
    WRITE_ONLY = 0x06010001
    READ_ONLY = 0x06010002
    NO_OBJECT = 0x06020000
    NOT_MAPPABLE = 0x06040041
    PDO_LENGTH = 0x06040042
    INCOMPATIBLE = 0x06040043
    TOO_LONG = 0x06070012
    TOO_SHORT = 0x06070013
    NO_SUBINDEX = 0x06090011
    INVALID_VALUE = 0x06090030
    TOO_HIGH = 0x06090031
    TOO_LOW = 0x06090032
    DATA_TRANSFER = 0x08000020
    DEVICE_STATE = 0x08000022
    NO_DATA = 0x08000024


Value = int | bytes
Object = ODVariable | ODRecord | ODArray

LONGEST_STRING = 889  # bytes


def variables(described: Object) -> list[ODVariable]:
    """Return the sub-indices of an object; a variable is its own."""
    return [described] if isinstance(described, ODVariable) else list(described.subindices.values())


class Entry:
    """One live sub-index."""

    __slots__ = ("changed", "check", "code", "default", "item", "refresh", "value")

    def __init__(self, item: ODVariable, node_id: int) -> None:
        self.item = item  # its description
        packed = ODVariable.STRUCT_TYPES.get(item.data_type or 0)
        # its format in a `struct.Struct`; None: a string or domain
        self.code = packed.format.lstrip("<") if packed else None
        if packed:
            self.default: Value = (item.default or 0) + (node_id if item.relative else 0)  # power-on value
        else:
            self.default = str(item.default or "").encode()
        self.value = self.default  # the present value; an int, or bytes for strings and domains
        # called before an SDO read, for values taken from the simulated joint
        self.refresh: Callable[[], None] | None = None
        # called with the new value before it is stored; raises `SdoAbortedError` to refuse it
        self.check: Callable[[int], None] | None = None
        self.changed: Callable[[], None] | None = None  # called after a write has been stored

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
        return self.item.pdo_mappable and self.item.access_type in ("ro", "rw", "rwr", "const")

    @property
    def receivable(self) -> bool:
        """Whether an RPDO may carry it."""
        return self.item.pdo_mappable and self.item.access_type in ("wo", "rw", "rww")

    def upload(self) -> bytes:
        """Return the value's bytes, as an SDO read gives them."""
        if self.item.access_type == "wo":
            raise SdoAbortedError(Abort.WRITE_ONLY)
        if self.refresh:
            self.refresh()
        if isinstance(self.value, bytes):
            return self.value
        return struct.pack("<" + (self.code or "I"), self.value)

    def writable(self) -> None:
        """Raise unless the entry may be written at all."""
        if self.item.access_type in ("ro", "const"):
            raise SdoAbortedError(Abort.READ_ONLY)

    def download(self, data: bytes) -> None:
        """Check and store the bytes of an SDO write."""
        self.writable()
        size = self.bits // 8
        if len(data) > (size or LONGEST_STRING):
            raise SdoAbortedError(Abort.TOO_LONG)
        if len(data) < size:
            raise SdoAbortedError(Abort.TOO_SHORT)
        if self.code is not None:
            self.write(struct.unpack("<" + self.code, data)[0])
            return
        self.value = bytes(data)
        if self.changed:
            self.changed()

    def write(self, value: int) -> None:
        """Check and store an integer, from SDO or RPDO."""
        item = self.item
        if item.max is not None and value > item.max:
            raise SdoAbortedError(Abort.TOO_HIGH)
        if item.min is not None and value < item.min:
            raise SdoAbortedError(Abort.TOO_LOW)
        if self.check:
            self.check(value)
        self.value = value
        if self.changed:
            self.changed()


class Dictionary:
    """All entries of one device."""

    def __init__(self, objects: Iterable[Object], node_id: int) -> None:
        self.objects = self.object_dictionary = {described.index: described for described in objects}
        self._entries = {
            (item.index, item.subindex): Entry(item, node_id)
            for described in self.objects.values()
            for item in variables(described)
        }
        self._stored: dict[tuple[int, int], Value] = {}

    def __contains__(self, key: object) -> bool:
        return key in self._entries

    def __iter__(self) -> Iterator[Entry]:
        return iter(self._entries.values())

    def get(self, index: int, subindex: int = 0) -> Entry | None:
        """Return the entry, or None."""
        return self._entries.get((index, subindex))

    def find(self, index: int, subindex: int) -> Entry:
        """Return the entry.

        Raises:
            SdoAbortedError: there is none.
        """
        entry = self._entries.get((index, subindex))
        if entry is None:
            raise SdoAbortedError(Abort.NO_SUBINDEX if index in self.objects else Abort.NO_OBJECT)
        return entry

    def get_data(self, index: int, subindex: int, check_readable: bool = True) -> bytes:
        """Serve an SDO upload (the interface of `canopen.LocalNode`)."""
        return self.find(index, subindex).upload()

    def set_data(self, index: int, subindex: int, data: bytes, check_writable: bool = True) -> None:
        """Serve an SDO download (the interface of `canopen.LocalNode`)."""
        self.find(index, subindex).download(bytes(data))

    def optional(self, index: int, subindex: int = 0) -> Entry:
        """Return the entry, or a hidden one with the value 0 if this device lacks it."""
        absent = ODVariable("absent", index, subindex)
        absent.data_type = datatypes.INTEGER32
        return self._entries.get((index, subindex)) or Entry(absent, 0)

    def store(self, low: int, high: int) -> None:
        """Make the present values of writable entries their power-on values (0x1010)."""
        for key, entry in self._entries.items():
            if low <= key[0] <= high and entry.item.access_type not in ("ro", "const"):
                self._stored[key] = entry.value

    def restore_defaults(self, low: int, high: int) -> None:
        """Forget stored values (0x1011); takes effect with the next reset."""
        self._stored = {key: value for key, value in self._stored.items() if not low <= key[0] <= high}

    def reset(self, low: int, high: int) -> None:
        """Set the power-on values of an index range."""
        for key, entry in self._entries.items():
            if low <= key[0] <= high:
                entry.value = self._stored.get(key, entry.default)
