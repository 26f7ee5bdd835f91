"""RPDOs: act when they come, or with the next SYNC (CiA 301, 7.5.2.35)."""

from __future__ import annotations

from collections.abc import Callable

from sim.canopen.aborts import SdoAbortedError
from sim.canopen.dictionary import Dictionary, Entry
from sim.canopen.pdo import Pdo
from sim.canopen.quirks import Quirks
from sim.canopen.timers import Timer, Timers


class Rpdo(Pdo):
    """A PDO that the device receives.

    Args:
        timed_out: called when its deadline (sub-index 5) passes without a frame.
        wrong_length: called with whether the frame was too short.
    """

    def __init__(
        self,
        dictionary: Dictionary,
        number: int,
        quirks: Quirks,
        operational: Callable[[], bool],
        changed: Callable[[], None],
        timers: Timers,
        timed_out: Callable[[], None],
        wrong_length: Callable[[bool], None],
    ) -> None:
        super().__init__(dictionary, 0x1400 + number - 1, 0x1600 + number - 1, quirks, operational, changed)
        self._timers = timers
        self._timed_out = timed_out
        self._wrong_length = wrong_length
        self._condition: tuple[bool, int] | None = None
        self._pending: bytes | None = None
        self._deadline: Timer | None = None

    def _allows(self, entry: Entry | None) -> bool:
        return entry is None or entry.receivable

    def activate(self, active: bool) -> None:
        """Start or stop receiving, after a change of state or parameters; pending data are dropped."""
        if (active, self.generation) == self._condition:
            return
        self._condition = (active, self.generation)
        self._pending = None
        if self._deadline:
            self._deadline.cancel()
            self._deadline = None

    def receive(self, data: bytes) -> None:
        """Handle a frame now or, if synchronous, with the next SYNC."""
        if len(data) < self.layout.size:
            self._wrong_length(True)
            return
        if len(data) > self.layout.size:
            self._wrong_length(False)
        if self._deadline:
            self._deadline.cancel()
            self._deadline = None
        if self.event_s:
            self._deadline = self._timers.after(self.event_s, self._timed_out)
        self._pending = data
        if self.type > 240:
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
