"""TPDOs: sent with a SYNC, on an event, or by a timer (CiA 301, 7.5.2.37)."""

from __future__ import annotations

from collections.abc import Callable

from sim.canopen.dictionary import Dictionary, Entry
from sim.canopen.pdo import Pdo
from sim.canopen.quirks import Quirks
from sim.canopen.timers import Timer, Timers


class Tpdo(Pdo):
    """A PDO that the device sends.

    Attributes:
        emit: puts (identifier, data) on the bus; faults are injected by wrapping it.
    """

    def __init__(
        self,
        dictionary: Dictionary,
        number: int,
        quirks: Quirks,
        operational: Callable[[], bool],
        changed: Callable[[], None],
        timers: Timers,
        emit: Callable[[int, bytes], None],
    ) -> None:
        super().__init__(dictionary, 0x1800 + number - 1, 0x1A00 + number - 1, quirks, operational, changed)
        self.number = number
        self.emit = emit
        self._timers = timers
        self._inhibit = dictionary.optional(0x1800 + number - 1, 3)
        self._start = dictionary.optional(0x1800 + number - 1, 6)
        self._inhibit.check = self._refuse_while_valid
        self._start.check = self._refuse_while_valid
        self._condition: tuple[bool, bool, int] | None = None
        self._syncs = 0
        self._waiting = False  # for the SYNC that carries the start value
        self._last: bytes | None = None
        self._inhibited = False
        self._event_timer: Timer | None = None
        self._inhibit_timer: Timer | None = None

    def _allows(self, entry: Entry | None) -> bool:
        return entry is not None and entry.transmittable

    @property
    def synchronous(self) -> bool:
        """Whether it is sent with a SYNC."""
        return self.type <= 240

    def activate(self, active: bool, counting: bool) -> None:
        """Start or stop transmitting, after a change of the NMT state or of parameters.

        Args:
            active: the device is operational and the PDO valid.
            counting: SYNC messages carry a counter (0x1019).
        """
        condition = (active, counting, self.generation)
        if condition == self._condition:
            return
        self._condition = condition
        for timer in (self._event_timer, self._inhibit_timer):
            if timer:
                timer.cancel()
        self._event_timer = self._inhibit_timer = None
        self._inhibited = False
        self._syncs = 0
        self._last = None
        self._waiting = bool(active and counting and self._start.number)
        if active and not self.synchronous and self.event_s:
            self._event_timer = self._timers.after(self.event_s, self._event_due)

    def pack(self) -> bytes:
        """The frame with the present values."""
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
        if not self._inhibited:
            data = self.pack()
            if data != self._last:
                self._send_event(data)

    def _event_due(self) -> None:
        self._event_timer = None
        if self._inhibited:
            self._event_timer = self._timers.after(self._inhibit.number * 1e-4, self._event_due)
        else:
            self._send_event(self.pack())

    def _send_event(self, data: bytes) -> None:
        self._last = data
        if self._inhibit.number:
            self._inhibited = True
            self._inhibit_timer = self._timers.after(self._inhibit.number * 1e-4, self._release)
        if self.event_s:
            if self._event_timer:
                self._event_timer.cancel()
            self._event_timer = self._timers.after(self.event_s, self._event_due)
        self.emit(self.can_id, data)

    def _release(self) -> None:
        self._inhibited = False
        self.event()
