"""The slaves on the bus that lies: each value identifies the SYNC it was sampled at, and one of them is a trap."""

from __future__ import annotations

import copy

from canopenkit import Item, Objects, Slave, drive_objects, tpdo, u32

__all__ = ["FuzzNode", "encoder_objects", "trap_objects"]

NO_RTR = 1 << 30


def encoder_objects(node: int) -> Objects:
    objects: Objects = {
        (0x1000, 0): u32(0x00020196), (0x1005, 0): u32(0x80, True), (0x1017, 0): Item(0, 2, True),
        (0x1018, 1): u32(0x4321), (0x6001, 0): u32(65536), (0x6002, 0): u32(1 << 24),
        (0x6004, 0): u32(0, mappable=True), (0x6501, 0): u32(65536), (0x6502, 0): Item(256, 2),
    }  # fmt: skip
    return objects | tpdo(1, NO_RTR | 0x180 + node, 254, 0x60040020)


def trap_objects(node: int) -> Objects:
    """A drive whose default TPDO1 has identifier and length of ours, comes at every SYNC, and means else."""
    objects = drive_objects(node)
    return objects | tpdo(1, NO_RTR | 0x180 + node, 1, 0x606C0020, 0x60770010, 0x60410010)


class FuzzNode:
    """One slave: the strict SDO server of the tests, and PDOs by its own present map.

    Args:
        node: node id.
        objects: its dictionary as it boots.
        starts_itself: goes operational by itself.
    """

    def __init__(self, node: int, objects: Objects, *, starts_itself: bool = False) -> None:
        self.node = node
        self._defaults = objects
        self._starts_itself = starts_itself
        self._beats = 0
        self.reset()

    def reset(self) -> None:
        self.slave = Slave(self.node, copy.deepcopy(self._defaults))
        self.slave.state = 5 if self._starts_itself else 0x7F

    def values(self, tick: int) -> dict[int, int]:
        """What it measures at a SYNC: every value identifies the tick, the position alone uniquely."""
        current = tick % 30000
        moved = {0x6064: 3 * tick + 1000 * self.node, 0x606C: 0x7000_0000 - tick, 0x6004: 5 * tick + 7}
        return {**moved, 0x6077: current, 0x6078: current, 0x6041: 0x0250}

    def handle(self, cob_id: int, data: bytes) -> list[tuple[int, bytes]]:
        if cob_id == 0:
            if len(data) != 2 or data[1] not in (0, self.node):
                return []
            if data[0] in (0x81, 0x82):
                self.reset()
                return [(0x700 + self.node, b"\x00")]
            self.slave.handle(cob_id, data)
            return []
        if cob_id == 0x600 + self.node and (self.slave.state == 4 or len(data) != 8 or data[0] >> 5 > 3):
            return []
        try:
            return self.slave.handle(cob_id, data)
        except (KeyError, IndexError, TypeError, AttributeError, OverflowError, AssertionError):
            return []  # garbage from the fuzzer, to a slave that was written for tests

    def answer(self, tick: int) -> list[tuple[int, bytes]]:
        """Its TPDOs for one SYNC, by its own map; a heartbeat now and then."""
        frames: list[tuple[int, bytes]] = []
        self._beats += 1
        if self._beats % 97 == 0:
            frames.append((0x700 + self.node, bytes([self.slave.state])))
        if self.slave.state != 5:
            return frames
        values, objects = self.values(tick), self.slave.objects
        for number in range(1, 5):
            cob = objects.get((0x17FF + number, 1))
            if cob is None or cob.value & 1 << 31 or not 1 <= objects[0x17FF + number, 2].value <= 240:
                continue
            data = b""
            for place in range(1, objects[0x19FF + number, 0].value + 1):
                entry = objects[0x19FF + number, place].value
                size = (entry & 0xFF) // 8
                data += (values.get(entry >> 16, 0) & (1 << 8 * size) - 1).to_bytes(size, "little")
            frames.append((cob.value & 0x7FF, data[:8]))
        return frames
