"""Heartbeat producer (0x1017) and consumer (0x1016), CiA 301, 7.2.8.3.2."""

from __future__ import annotations

from collections.abc import Callable

from sim.canopen.aborts import Abort, SdoAbortedError
from sim.canopen.dictionary import Dictionary, Entry
from sim.canopen.timers import Timer, Timers


class HeartbeatProducer:
    """Calls `beat` with the period of 0x1017."""

    def __init__(self, dictionary: Dictionary, timers: Timers, beat: Callable[[], None]) -> None:
        self._timers = timers
        self._beat = beat
        self._period = dictionary.find(0x1017, 0)
        self._period.changed = self.restart
        self._timer: Timer | None = None

    def stop(self) -> None:
        """No further heartbeat."""
        if self._timer:
            self._timer.cancel()
            self._timer = None

    def restart(self) -> None:
        """Apply a changed period; the first heartbeat is one period from now."""
        self.stop()
        if self._period.number:
            self._timer = self._timers.every(self._period.number * 1e-3, self._beat)


class HeartbeatConsumer:
    """Monitors the nodes of 0x1016, each from its first heartbeat on.

    Args:
        lost: called with the node id on a timeout.
        back: called with the node id when its heartbeat returns.
        changed: called when the monitored nodes change.
    """

    def __init__(
        self,
        dictionary: Dictionary,
        timers: Timers,
        lost: Callable[[int], None],
        back: Callable[[int], None],
        changed: Callable[[], None],
    ) -> None:
        self._timers = timers
        self._lost = lost
        self._back = back
        self._changed = changed
        self._entries = [entry for entry in dictionary if entry.item.index == 0x1016 and entry.item.subindex]
        self._deadlines: dict[int, Timer] = {}
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
        for timer in self._deadlines.values():
            timer.cancel()
        self._deadlines.clear()
        self._missing.clear()
        self._changed()

    def receive(self, node_id: int) -> None:
        """A heartbeat or boot-up message of a watched node has come."""
        time_s = self.watched.get(node_id)
        if time_s is None:
            return
        if node_id in self._deadlines:
            self._deadlines[node_id].cancel()
        self._deadlines[node_id] = self._timers.after(time_s, lambda: self._expired(node_id))
        if node_id in self._missing:
            self._missing.discard(node_id)
            self._back(node_id)

    def _expired(self, node_id: int) -> None:
        self._missing.add(node_id)
        self._lost(node_id)

    def _checker(self, entry: Entry) -> Callable[[int], None]:
        def check(value: int) -> None:
            node, time = value >> 16, value & 0xFFFF
            if node > 127:
                raise SdoAbortedError(Abort.INVALID_VALUE)
            others = (other.number for other in self._entries if other is not entry)
            if time and node and any(word >> 16 == node and word & 0xFFFF for word in others):
                raise SdoAbortedError(Abort.INCOMPATIBLE)

        return check
