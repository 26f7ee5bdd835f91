"""Services of a simulated device besides SDO and PDO: EMCY, heartbeat, storing of parameters (CiA 301)."""

from __future__ import annotations

import struct
from collections.abc import Callable
from typing import TYPE_CHECKING

from sim.canopen.dictionary import Abort, Dictionary, Entry, SdoAbortedError
from sim.canopen.pdo import COB_INVALID

if TYPE_CHECKING:
    from sim.canopen.node import Node

_HISTORY = 8
_GENERIC = 0x01
_GROUPS = ((0x1000, 0xFFFF), (0x1000, 0x1FFF), (0x2000, 0xFFFF))
"""Indices of sub-index 1 (all), 2 (communication), 3 (application) of 0x1010 and 0x1011."""


class Emergency:
    """Active and past errors of one device, and the message when they change (7.2.7).

    Args:
        node: its dictionary holds 0x1001, 0x1003, 0x1014, 0x1015.
    """

    def __init__(self, node: Node) -> None:
        find = node.dictionary.find
        self._node = node
        self._register, self._cob, self._count = find(0x1001, 0), find(0x1014, 0), find(0x1003, 0)
        self._inhibit = node.dictionary.optional(0x1015)
        self._fields = [find(0x1003, k) for k in range(1, _HISTORY + 1)]
        self._active: dict[int, int] = {}
        self._queue: list[bytes] = []
        self._count.check = self._check_clear
        self._count.changed = self._clear_history
        for number, entry in enumerate(self._fields, start=1):
            entry.refresh = self._reader(number)

    @property
    def active(self) -> bool:
        """Whether any error is."""
        return bool(self._active)

    def reset(self) -> None:
        """Forget all errors."""
        self._active.clear()
        self._queue.clear()
        self._register.value = 0
        self._clear_history()

    def raise_error(self, code: int, register: int = 0, vendor: bytes = b"") -> None:
        """Set an error; its message is sent once until it is cleared."""
        if code in self._active:
            return
        self._active[code] = register | _GENERIC
        for older, newer in zip(self._fields[:0:-1], self._fields[-2::-1], strict=True):
            older.value = newer.value
        self._fields[0].value = code | int.from_bytes(vendor[:2].ljust(2, b"\0"), "little") << 16
        self._count.value = min(self._count.number + 1, _HISTORY)
        self._emit(code, vendor)

    def clear_error(self, code: int) -> None:
        """Clear an error; after the last one the message "error reset" is sent."""
        if self._active.pop(code, None) is not None:
            self._emit(0, struct.pack("<H", code) if self._active else b"")

    def _emit(self, code: int, vendor: bytes) -> None:
        register = 0
        for bits in self._active.values():
            register |= bits
        self._register.value = register
        if not self._cob.number & COB_INVALID:
            self._queue.append(struct.pack("<HB5s", code, register, vendor))
            self._flush()

    def _flush(self) -> None:
        timers, inhibit_s = self._node.timers, self._inhibit.number * 1e-4
        while self._queue and "emergency" not in timers:
            data = self._queue.pop(0)
            if self._node.may_send_emergency:
                self._node.send(self._cob.number & 0x7FF, data)
            if inhibit_s:
                timers.set("emergency", inhibit_s, self._flush)

    def _check_clear(self, value: int) -> None:
        if value:
            raise SdoAbortedError(Abort.INVALID_VALUE)

    def _clear_history(self) -> None:
        self._count.value = 0
        for entry in self._fields:
            entry.value = 0

    def _reader(self, number: int) -> Callable[[], None]:
        def refresh() -> None:
            if number > self._count.number:
                raise SdoAbortedError(Abort.NO_DATA)

        return refresh


class HeartbeatProducer:
    """Sends the heartbeat with the period of 0x1017 (7.2.8.3.2)."""

    def __init__(self, node: Node) -> None:
        self._node = node
        self._period = node.dictionary.find(0x1017, 0)
        self._period.changed = self.restart

    def restart(self) -> None:
        """Apply a changed period; the first heartbeat is one period from now."""
        self._node.timers.cancel("heartbeat")
        if self._period.number:
            self._node.timers.set("heartbeat", self._period.number * 1e-3, self._beat)

    def _beat(self) -> None:
        self.restart()
        self._node.send(0x700 + self._node.node_id, bytes([self._node.state]))


class HeartbeatConsumer:
    """Monitors the nodes of 0x1016, each from its first heartbeat on; tells its own node of losses."""

    def __init__(self, node: Node) -> None:
        self._node = node
        self._entries = [e for e in node.dictionary if e.item.index == 0x1016 and e.item.subindex]
        self._heard: set[int] = set()
        self._missing: set[int] = set()
        for entry in self._entries:
            entry.check = self._checker(entry)
            entry.changed = self.restart

    @property
    def watched(self) -> dict[int, float]:
        """Node id to heartbeat time in seconds."""
        words = (entry.number for entry in self._entries)
        return {
            word >> 16 & 0x7F: (word & 0xFFFF) * 1e-3 for word in words if word >> 16 & 0x7F and word & 0xFFFF
        }

    def restart(self) -> None:
        """Forget what was heard and wait for first heartbeats."""
        for node_id in self._heard:
            self._node.timers.cancel(("heartbeat", node_id))
        self._heard.clear()
        self._missing.clear()
        self._node.reroute()

    def receive(self, node_id: int) -> None:
        """Process a heartbeat or boot-up message of a watched node."""
        time_s = self.watched.get(node_id)
        if time_s is None:
            return
        self._heard.add(node_id)
        self._node.timers.set(("heartbeat", node_id), time_s, lambda: self._expired(node_id))
        if node_id in self._missing:
            self._missing.discard(node_id)
            self._node.heartbeat_back()

    def _expired(self, node_id: int) -> None:
        self._missing.add(node_id)
        self._node.heartbeat_lost(node_id)

    def _checker(self, entry: Entry) -> Callable[[int], None]:
        def check(value: int) -> None:
            node, time = value >> 16, value & 0xFFFF
            if node > 127:
                raise SdoAbortedError(Abort.INVALID_VALUE)
            others = (other.number for other in self._entries if other is not entry)
            if time and node and any(word >> 16 == node and word & 0xFFFF for word in others):
                raise SdoAbortedError(Abort.INCOMPATIBLE)

        return check


def watch_storing(dictionary: Dictionary) -> None:
    """Connect 0x1010 and 0x1011 of a dictionary, if present (7.5.2.13, 7.5.2.14)."""
    for index, text, act in (
        (0x1010, b"save", dictionary.store),
        (0x1011, b"load", dictionary.restore_defaults),
    ):
        for group, bounds in enumerate(_GROUPS, start=1):
            entry = dictionary.get(index, group)
            if entry is not None:
                _connect(entry, int.from_bytes(text, "little"), act, bounds)


def _connect(entry: Entry, signature: int, act: Callable[[int, int], None], bounds: tuple[int, int]) -> None:
    def check(value: int) -> None:
        if value != signature:
            raise SdoAbortedError(Abort.DATA_TRANSFER)

    def changed() -> None:
        entry.value = 1  # on reading: stored on command
        act(*bounds)

    entry.check, entry.changed = check, changed
