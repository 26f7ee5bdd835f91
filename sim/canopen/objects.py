"""Objects of the communication profile area (CiA 301), for dictionaries and EDS files."""

from __future__ import annotations

import struct
from dataclasses import dataclass
from functools import partial

from sim.canopen.dictionary import DataType, Item, Kind, Object, Value

__all__ = [
    "Identity",
    "PdoDefault",
    "array",
    "communication_objects",
    "highest",
    "mapping",
    "record",
    "rpdo_objects",
    "tpdo_objects",
    "var",
]

U8, U16, U32 = DataType.UNSIGNED8, DataType.UNSIGNED16, DataType.UNSIGNED32
TEXT = DataType.VISIBLE_STRING

COB_INVALID = 1 << 31
COB_NO_RTR = 1 << 30
MAPPED_AT_MOST = 8  # objects in one PDO


@dataclass(frozen=True, slots=True, kw_only=True)
class Identity:
    """Identity of a device: 0x1008 to 0x100A and 0x1018."""

    name: str
    vendor_id: int = 0x0000_0D1C
    product_code: int = 0
    revision: int = 0x0001_0000
    serial: int = 1
    hardware: str = "sim"
    software: str = "1.0"


@dataclass(frozen=True, slots=True, kw_only=True)
class PdoDefault:
    """Power-on parameters of one PDO.

    Attributes:
        base: identifier without the node id, e.g. 0x180.
        enabled: bit 31 clear.
        type: transmission type.
        mapping: mapped objects, `index << 16 | subindex << 8 | bits`.
        inhibit: inhibit time in 100 us (TPDO).
        event_ms: event timer, or the deadline of an RPDO.
    """

    base: int
    enabled: bool = True
    type: int = 255
    mapping: tuple[int, ...] = ()
    inhibit: int = 0
    event_ms: int = 0


def mapping(*objects: tuple[int, int, int]) -> tuple[int, ...]:
    """Mapping entries from (index, subindex, bits)."""
    return tuple(index << 16 | subindex << 8 | bits for index, subindex, bits in objects)


def var(
    index: int, name: str, type_: DataType, access: str = "ro", default: Value = 0, **rest: object
) -> Object:
    """An object with one value at sub-index 0."""
    item = partial(Item, name=name, type=type_, access=access, default=default)
    return Object(index=index, name=name, kind=Kind.VAR, items=(item(**rest),))  # type: ignore[arg-type]


def highest(number: int, access: str = "const", **rest: int) -> Item:
    """Sub-index 0 of an array or record."""
    return Item(name="Highest sub-index supported", type=U8, access=access, default=number, **rest)  # type: ignore[arg-type]


def array(index: int, name: str, items: tuple[Item, ...]) -> Object:
    """An array: sub-index 0 is added unless given."""
    if items[0].subindex != 0:
        items = (highest(items[-1].subindex), *items)
    return Object(index=index, name=name, kind=Kind.ARRAY, items=items)


def record(index: int, name: str, items: tuple[Item, ...]) -> Object:
    """A record: sub-index 0 is added unless given."""
    if items[0].subindex != 0:
        items = (highest(items[-1].subindex), *items)
    return Object(index=index, name=name, kind=Kind.RECORD, items=items)


def communication_objects(device_type: int, identity: Identity, heartbeat_ms: int = 0) -> list[Object]:
    """Everything from 0x1000 to 0x1200 but the PDOs."""
    return [
        var(0x1000, "Device type", U32, "ro", device_type),
        var(0x1001, "Error register", U8, "ro", pdo=True),
        array(
            0x1003,
            "Pre-defined error field",
            (
                Item(name="Number of errors", type=U8, access="rw"),
                *(
                    Item(subindex=k, name=f"Standard error field {k}", type=U32, access="ro")
                    for k in range(1, 9)
                ),
            ),
        ),
        var(0x1005, "COB-ID SYNC message", U32, "rw", 0x80),
        var(0x1006, "Communication cycle period", U32, "rw"),
        var(0x1007, "Synchronous window length", U32, "rw"),
        var(0x1008, "Manufacturer device name", TEXT, "const", identity.name.encode()),
        var(0x1009, "Manufacturer hardware version", TEXT, "const", identity.hardware.encode()),
        var(0x100A, "Manufacturer software version", TEXT, "const", identity.software.encode()),
        _parameters(0x1010, "Store parameters", "Save"),
        _parameters(0x1011, "Restore default parameters", "Restore"),
        var(0x1014, "COB-ID EMCY", U32, "rw", 0x80, plus_node_id=True),
        var(0x1015, "Inhibit time EMCY", U16, "rw"),
        array(
            0x1016,
            "Consumer heartbeat time",
            tuple(
                Item(subindex=k, name=f"Consumer heartbeat time {k}", type=U32, access="rw")
                for k in range(1, 5)
            ),
        ),
        var(0x1017, "Producer heartbeat time", U16, "rw", heartbeat_ms),
        record(
            0x1018,
            "Identity object",
            (
                Item(subindex=1, name="Vendor-ID", type=U32, default=identity.vendor_id),
                Item(subindex=2, name="Product code", type=U32, default=identity.product_code),
                Item(subindex=3, name="Revision number", type=U32, default=identity.revision),
                Item(subindex=4, name="Serial number", type=U32, default=identity.serial),
            ),
        ),
        var(0x1019, "Synchronous counter overflow value", U8, "rw"),
        array(
            0x1029,
            "Error behaviour",
            (Item(subindex=1, name="Communication error", type=U8, access="rw", high=2),),
        ),
        record(
            0x1200,
            "SDO server parameter",
            (
                Item(
                    subindex=1,
                    name="COB-ID client to server (rx)",
                    type=U32,
                    default=0x600,
                    plus_node_id=True,
                ),
                Item(
                    subindex=2,
                    name="COB-ID server to client (tx)",
                    type=U32,
                    default=0x580,
                    plus_node_id=True,
                ),
            ),
        ),
    ]


def _parameters(index: int, name: str, verb: str) -> Object:
    groups = ("all", "communication", "application")
    items = (
        Item(subindex=k, name=f"{verb} {group} parameters", type=U32, access="rw", default=1)
        for k, group in enumerate(groups, start=1)
    )
    return array(index, name, tuple(items))


def tpdo_objects(number: int, pdo: PdoDefault) -> list[Object]:
    """Communication and mapping parameters of TPDO `number` (from 1)."""
    communication = (
        highest(6),
        _cob_id("COB-ID used by TPDO", pdo),
        Item(subindex=2, name="Transmission type", type=U8, access="rw", default=pdo.type),
        Item(subindex=3, name="Inhibit time", type=U16, access="rw", default=pdo.inhibit),
        Item(subindex=5, name="Event timer", type=U16, access="rw", default=pdo.event_ms),
        Item(subindex=6, name="SYNC start value", type=U8, access="rw", high=240),
    )
    return [
        record(0x1800 + number - 1, f"TPDO{number} communication parameter", communication),
        _mapping(0x1A00 + number - 1, f"TPDO{number} mapping parameter", pdo),
    ]


def rpdo_objects(number: int, pdo: PdoDefault) -> list[Object]:
    """Communication and mapping parameters of RPDO `number` (from 1)."""
    communication = (
        highest(5),
        _cob_id("COB-ID used by RPDO", pdo),
        Item(subindex=2, name="Transmission type", type=U8, access="rw", default=pdo.type),
        Item(subindex=5, name="Event timer", type=U16, access="rw", default=pdo.event_ms),
    )
    return [
        record(0x1400 + number - 1, f"RPDO{number} communication parameter", communication),
        _mapping(0x1600 + number - 1, f"RPDO{number} mapping parameter", pdo),
    ]


def _cob_id(name: str, pdo: PdoDefault) -> Item:
    flags = 0 if pdo.enabled else COB_INVALID
    default = flags | COB_NO_RTR | pdo.base
    return Item(subindex=1, name=name, type=U32, access="rw", default=default, plus_node_id=True)


def _mapping(index: int, name: str, pdo: PdoDefault) -> Object:
    objects = pdo.mapping + (0,) * (MAPPED_AT_MOST - len(pdo.mapping))
    items = (
        Item(subindex=k, name=f"Application object {k}", type=U32, access="rw", default=entry)
        for k, entry in enumerate(objects, start=1)
    )
    count = Item(name="Number of mapped application objects in PDO", type=U8, access="rw")
    return record(index, name, (_with_default(count, len(pdo.mapping)), *items))


def _with_default(item: Item, default: int) -> Item:
    return Item(name=item.name, type=item.type, access=item.access, default=default)


def signature(text: str) -> int:
    """The value that 0x1010 and 0x1011 want written: "save" or "load" in ASCII."""
    return int(struct.unpack("<I", text.encode())[0])
