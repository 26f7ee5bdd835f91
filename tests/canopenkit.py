"""A CANopen slave written for these tests alone, as strict as CANopenNode and lely-core are, and its bus.

It shares no code with `sim` or `drivelink`: what both believe is checked against a third opinion.
"""

from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import can
from canopen.objectdictionary import datatypes

from drivelink.canopen.configure import configure_joints
from drivelink.canopen.eds import DataSheet
from drivelink.canopen.guard import check_frame
from drivelink.canopen.layout import NodeLayout, Signal
from drivelink.jointfile import parse

NOT_VALID_NOW = 0x06010000
READ_ONLY = 0x06010002
NO_OBJECT = 0x06020000
NOT_MAPPABLE = 0x06040041
TOO_MANY = 0x06040042
TOO_LONG, TOO_SHORT = 0x06070012, 0x06070013
NO_SUBINDEX = 0x06090011
RANGE = 0x06090030
DEVICE_STATE = 0x08000022

INVALID, NO_RTR = 1 << 31, 1 << 30


@dataclass
class Item:
    """One entry of the slave's object dictionary."""

    value: int | bytes
    size: int
    writable: bool = False
    mappable: bool = False


Objects = dict[tuple[int, int], Item]


def u8(value: int, writable: bool = False) -> Item:
    return Item(value, 1, writable)


def u16(value: int, writable: bool = False, mappable: bool = False) -> Item:
    return Item(value, 2, writable, mappable)


def u32(value: int, writable: bool = False, mappable: bool = False) -> Item:
    return Item(value, 4, writable, mappable)


def tpdo(number: int, cob: int, transmission_type: int, *entries: int, slots: int = 8) -> Objects:
    """Parameters of one TPDO; entries as index << 16 | subindex << 8 | bits."""
    communication, mapping = 0x17FF + number, 0x19FF + number
    objects = {
        (communication, 0): u8(5), (communication, 1): u32(cob, True), (communication, 2): u8(transmission_type, True),
        (communication, 3): u16(0, True), (communication, 5): u16(0, True), (mapping, 0): u8(len(entries), True),
    }  # fmt: skip
    values = (*entries, *[0] * (slots - len(entries)))
    return objects | {(mapping, k): u32(value, True) for k, value in enumerate(values, start=1)}


def drive_objects(node: int) -> Objects:
    """A plain CiA 402 drive with everything the standard knows."""
    objects: Objects = {
        (0x1000, 0): u32(0x00020192), (0x1005, 0): u32(0x80, True), (0x1006, 0): u32(0, True),
        (0x1008, 0): Item(b"Plain servo drive 2000", 22), (0x1017, 0): u16(0, True),
        (0x1018, 1): u32(0x1234), (0x1018, 2): u32(0x77), (0x1018, 3): u32(0x10002), (0x1018, 4): u32(99),
        (0x1019, 0): u8(0, True),
        (0x6040, 0): u16(0, True, True), (0x6041, 0): u16(0x0250, mappable=True), (0x6060, 0): u8(0, True),
        (0x6064, 0): u32(1000, mappable=True), (0x606C, 0): u32(0, mappable=True),
        (0x6071, 0): u16(0, True, True), (0x6075, 0): u32(4000), (0x6076, 0): u32(800),
        (0x6077, 0): u16(0, mappable=True), (0x6078, 0): u16(0, mappable=True), (0x607E, 0): u8(0, True),
        (0x608F, 1): u32(16384), (0x608F, 2): u32(1), (0x6091, 1): u32(50), (0x6091, 2): u32(1),
        (0x60A9, 0): u32(0x00B44700), (0x60E4, 1): u32(2000, mappable=True),
    }  # fmt: skip
    objects |= tpdo(1, NO_RTR | 0x180 + node, 255, 0x60410010)
    objects |= tpdo(2, NO_RTR | INVALID | 0x280 + node, 255, 0x60640020)
    objects |= tpdo(3, NO_RTR | INVALID | 0x380 + node, 255)
    return objects | tpdo(4, NO_RTR | INVALID | 0x480 + node, 255)


def sheet_objects(sheet: DataSheet, node: int) -> Objects:
    """The dictionary that an EDS describes."""
    objects: Objects = {}
    for (index, subindex), entry in sheet.objects.items():
        if entry.data_type in datatypes.INTEGER_TYPES:
            value = sheet.value(index, subindex) or 0
            objects[index, subindex] = Item(value, len(entry) // 8, entry.writable, entry.pdo_mappable)
    objects.setdefault((0x1000, 0), u32(0x00020192))
    return objects


@dataclass
class Slave:
    node: int
    objects: Objects
    refuse: dict[tuple[int, int], int] = field(default_factory=dict)
    silent: bool = False
    state: int = 0x7F
    writes: list[tuple[int, int, int]] = field(default_factory=list)
    forgets: bool = False
    keep_bit_30: bool = False
    _upload: bytes = b""
    _toggle: int = 0

    def handle(self, cob_id: int, data: bytes) -> list[tuple[int, bytes]]:
        if self.silent:
            return []
        if cob_id == 0 and data[1] in (0, self.node):
            self.state = {1: 5, 2: 4, 0x80: 0x7F}.get(data[0], self.state)
            return [(0x700 + self.node, b"\x00")] if data[0] in (0x81, 0x82) else []
        if cob_id != 0x600 + self.node:
            return []
        answer = self._sdo(data)
        return [(0x580 + self.node, answer)] if answer else []

    def _sdo(self, data: bytes) -> bytes:
        command, head = data[0] >> 5, data[1:4]
        address = (int.from_bytes(data[1:3], "little"), data[3])
        if command == 4:
            return b""
        if command == 3:
            return self._segment(data)
        if address not in self.objects:
            known = any(index == address[0] for index, _ in self.objects)
            return _abort(head, NO_SUBINDEX if known else NO_OBJECT)
        item = self.objects[address]
        if command == 2:
            raw = item.value if isinstance(item.value, bytes) else item.value.to_bytes(item.size, "little")
            if len(raw) <= 4:
                return bytes([0x43 | (4 - len(raw)) << 2]) + head + raw.ljust(4, b"\0")
            self._upload, self._toggle = raw, 0
            return b"\x41" + head + len(raw).to_bytes(4, "little")
        size = 4 - (data[0] >> 2 & 3)
        code = self._write(address, item, int.from_bytes(data[4 : 4 + size], "little"), size)
        return _abort(head, code) if code else b"\x60" + head + bytes(4)

    def _segment(self, data: bytes) -> bytes:
        part, self._upload = self._upload[:7], self._upload[7:]
        last = not self._upload
        head = (data[0] & 0x10) | (7 - len(part)) << 1 | last
        return bytes([head]) + part.ljust(7, b"\0")

    def _write(self, address: tuple[int, int], item: Item, value: int, size: int) -> int:
        if address in self.refuse:
            return self.refuse[address]
        if not item.writable:
            return READ_ONLY
        if size != item.size:
            return TOO_LONG if size > item.size else TOO_SHORT
        code = self._check_pdo(address, item, value)
        if code:
            return code
        if address == (0x1019, 0) and self.objects[0x1006, 0].value:
            return DEVICE_STATE
        self.writes.append((*address, value))
        if not (self.forgets and 0x1A00 <= address[0] <= 0x1BFF):
            item.value = value
        return 0

    def _check_pdo(self, address: tuple[int, int], item: Item, value: int) -> int:
        index, subindex = address
        if 0x1800 <= index <= 0x19FF:
            cob = self.objects[index, 1].value
            assert isinstance(cob, int) and isinstance(item.value, int)
            if subindex == 1:
                if self.keep_bit_30 and (value ^ cob) & NO_RTR:
                    return RANGE
                moved = (value ^ cob) & 0x7FF and not (cob & INVALID)
                return RANGE if moved else 0
            return RANGE if subindex in (3, 6) and not cob & INVALID else 0
        if 0x1A00 <= index <= 0x1BFF:
            if not self.objects[index - 0x200, 1].value & INVALID:  # type: ignore[operator]
                return NOT_VALID_NOW
            return self._check_map(index, subindex, value)
        return 0

    def _check_map(self, index: int, subindex: int, value: int) -> int:
        if subindex == 0:
            parts = [self.objects[index, n].value for n in range(1, value + 1)]
            return TOO_MANY if sum(part & 0xFF for part in parts) > 64 else 0  # type: ignore[operator]
        if self.objects[index, 0].value:
            return NOT_VALID_NOW
        target = self.objects.get((value >> 16, value >> 8 & 0xFF))
        if target is None:
            return NO_OBJECT
        return 0 if target.mappable and target.size * 8 == value & 0xFF else NOT_MAPPABLE


def _abort(head: bytes, code: int) -> bytes:
    return b"\x80" + head + code.to_bytes(4, "little")


class Wire:
    """A bus in memory: what is sent is answered at once, and everything is written down."""

    def __init__(self, slaves: Iterable[Slave] = ()) -> None:
        self.slaves = list(slaves)
        self.sent: list[tuple[int, bytes]] = []
        self.log: list[str] = []
        self.queue: deque[can.Message] = deque()

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        data = bytes(msg.data)
        self.sent.append((msg.arbitration_id, data))
        self._note(">", msg.arbitration_id, data)
        for slave in self.slaves:
            for cob_id, answer in slave.handle(msg.arbitration_id, data):
                self.put(cob_id, answer)

    def put(self, cob_id: int, data: bytes) -> None:
        self._note("<", cob_id, data)
        self.queue.append(can.Message(arbitration_id=cob_id, data=data, is_extended_id=False))

    def recv(self, timeout: float | None = None) -> can.Message | None:
        return self.queue.popleft() if self.queue else None

    def _note(self, arrow: str, cob_id: int, data: bytes) -> None:
        self.log.append(f"{arrow} {cob_id:03X} {data.hex(' ').upper()}")

    def written(self) -> list[tuple[int, int, int, int]]:
        """(node, index, subindex, value) of all downloads of the master."""
        value = partial(int.from_bytes, byteorder="little")
        return [
            (cob_id - 0x600, value(data[1:3]), data[3], value(data[4 : 8 - (data[0] >> 2 & 3)]))
            for cob_id, data in self.sent
            if 0x601 <= cob_id <= 0x67F and data[0] >> 5 == 1
        ]


JOINT = """
name = "elbow"
[[motor]]
inertia_kg_m2 = 0.1
[motor.drive]
node_id = 5
{drive}
[link]
{link}
[bus]
sdo_timeout_s = 0.02
{bus}
"""


def joint_text(drive: str = "", link: str = "", bus: str = "") -> str:
    """A joint of one motor at node 5."""
    return JOINT.format(drive=drive, link=link, bus=bus)


def configure(bus, joint, base_dir=Path(), *, idle=None):
    return tuple(configure_joints(bus, [joint], [base_dir], idle=idle).layouts.values())


def configured(slave: Slave, text: str = "", **sections: str) -> tuple[Wire, NodeLayout]:
    """The wire and the layout of a node that was configured by frames which cannot move a drive."""
    wire = Wire([slave])
    (layout,) = configure(wire, parse(text or joint_text(**sections)))
    for cob_id, data in wire.sent:
        check_frame(cob_id, data)
    return wire, layout


def signals(layout: NodeLayout) -> list[list[Signal]]:
    return [[mapped.signal for mapped in tpdo.objects] for tpdo in layout.tpdos]


def eds_text(head: str = "", **objects: tuple[int, str | int]) -> str:
    """A data sheet; "x6064" or "x1A00sub1" = (data type, default, "" for none); those of 0x6000 and more are mappable."""
    text = f"[DeviceInfo]\n{head}\n"
    for name, (kind, default) in objects.items():
        mappable = 1 if name[1] == "6" else 0
        value = "" if default == "" else f"DefaultValue={default}\n"
        text += f"[{name[1:]}]\nDataType={kind}\nAccessType=rw\n{value}PDOMapping={mappable}\n"
    return text
