"""Keeps the bus open; watches SYNC, the CAN controller and this machine's speed; reports each event once."""

import logging
import threading
import time
from collections import deque
from collections.abc import Callable
from contextlib import suppress

import can

from drivelink.canopen.bus import open_bus
from drivelink.cycle.loop import CycleLoop
from drivelink.cycle.sources import OVERFLOW, LostSource, open_source
from drivelink.cycle.startup import BusPort
from drivelink.cycle.syncclock import MEASURED_SYNCS, measure_period
from drivelink.daemon.status import EventLog
from drivelink.errors import BusError
from drivelink.jointfile import BusSection

_NS = 1_000_000_000
_SURE, _ALIKE = 3, 0.01  # measurements in a row that differ by less, relative: another period
_MANY_SYNCS = 3  # SYNCs beyond the number of periods in a second


class BusWatch:
    """The state of the bus, from the counters of the loop."""

    def __init__(self, loop: CycleLoop, events: EventLog) -> None:
        self._loop = loop
        self._events = events
        self._counter_jumps = self._lost_sends = self._clock_steps = 0
        self._bus_offs = self._restarts = self._measured_ns = 0
        self._slow = self._slow_ns = 0
        self._off_period: list[float] = []  # consecutive measurements
        # called with another period, once the master has kept to it for so long that it is sure
        self.on_period: Callable[[float], object] = lambda _period_s: None
        self._foreign = deque([(loop.clock(), 0, 0)])  # in the last second: SYNCs not due, periods without
        # last measured period of the followed master; None: not yet, or SYNC is produced
        self.sync_period_s: float | None = None

    def check(self) -> None:
        """Check for changes since the last call."""
        loop = self._loop
        self._check_foreign_syncs()
        self._check_period()
        self._check_speed()
        if loop.counter_jumps != self._counter_jumps:
            self._counter_jumps = loop.counter_jumps
            self._events.report(
                f"the SYNC counter jumped, {self._counter_jumps} times so far", key="SYNC counter jumped"
            )
        if loop.clock_steps != self._clock_steps:
            self._clock_steps = loop.clock_steps
            self._events.report(
                f"the system's clock was set by {loop.clock_step_ns / _NS:+.3f} s: stamps follow it, "
                "the cycle does not",
                key="clock set forward" if loop.clock_step_ns > 0 else "clock set back",
            )
        text = "no SYNC on the bus: the estimates are stale"
        self._events.keep("no sync", loop.silent, text, "SYNC is back", logging.ERROR)
        self._check_queue()
        self._check_controller()

    def _check_queue(self) -> None:
        lost_sends = self._loop.source.lost_sends
        if lost_sends == self._lost_sends:
            self._events.end("full queue", "the transmit queue drains again")
        elif lost_sends:
            text = "the transmit queue is full: SYNC is lost; is any node on the bus?"
            self._events.begin("full queue", text)
        self._lost_sends = lost_sends

    def _check_foreign_syncs(self) -> None:
        """Check whether two masters produce SYNC.

        When following, SYNCs that are not due prove nothing: one master produces some if it skips as many
        periods. Two masters produce more SYNCs than periods.
        """
        loop, now = self._loop, self._loop.clock()
        self._foreign.append((now, loop.foreign_syncs, loop.skipped_periods))
        while now - self._foreign[0][0] > _NS:
            self._foreign.popleft()
        _, foreign, skipped = self._foreign[0]
        if loop.produce and loop.foreign_syncs > foreign:
            what = "another master produces SYNC: its cycles are not used; "
            what += 'set bus.sync = "follow", or stop the other one'
        elif (loop.foreign_syncs - foreign) - (loop.skipped_periods - skipped) >= _MANY_SYNCS:
            what = "a second master produces SYNC too: its cycles are not used; stop one of the two"
        else:
            self._events.end("foreign sync", "the other master stopped producing SYNC")
            return
        self._events.begin("foreign sync", what, logging.ERROR)

    def _check_period(self) -> None:
        """Check that the followed master still has the period used by the estimators."""
        loop, now = self._loop, self._loop.clock()
        if loop.produce or now - self._measured_ns < _NS or len(loop.sync_stamps) < MEASURED_SYNCS:
            return
        self._measured_ns = now
        used_s = loop.period_ns / _NS
        measured = measure_period(list(loop.sync_stamps), used_s)
        if measured is None:
            return
        self.sync_period_s = measured.period_s
        if measured.same:
            self._off_period.clear()
            self._events.end("period", f"SYNC comes every {used_s * 1e3:g} ms again")
            return
        self._off_period.append(measured.period_s)
        if len(self._off_period) > 1:  # once may have been a stall
            text = f"SYNC comes every {measured.period_s * 1e3:.4g} ms now, {used_s * 1e3:g} ms is in use: "
            text += "cycles are lost or doubled until the master returns to it, or keeps to another one"
            self._events.begin("period", text, logging.ERROR)
        last = self._off_period[-_SURE:]
        if measured.steady and len(last) == _SURE and max(last) - min(last) < _ALIKE * min(last):
            self.on_period(measured.period_s)

    def _check_speed(self) -> None:
        """Check that this machine keeps up with the cycle."""
        loop, now = self._loop, self._loop.clock()
        unread = loop.source.errors.get(OVERFLOW, 0)
        total = loop.overruns + loop.behind + unread
        if total > self._slow:
            self._slow, self._slow_ns = total, now
            counted = [
                f"cycles left out so far: {loop.overruns}" if loop.overruns else "",
                f"{loop.behind} SYNCs read more than a period late" if loop.behind else "",
                f"{unread} frames lost unread" if unread else "",
            ]
            self._events.begin(
                "too slow",
                f"this machine does not keep up with the cycle of {loop.period_ns / 1e6:g} ms "
                f"(drivelink doctor says why): {', '.join(filter(None, counted))}",
            )
        elif now - self._slow_ns > _NS:
            self._slow = total  # the count restarts with a reopened bus
            text = f"this machine keeps up with the cycle again; cycles left out: {loop.overruns}"
            self._events.end("too slow", text)

    def _check_controller(self) -> None:
        errors = self._loop.source.errors
        bus_offs, restarts = errors.get("bus-off", 0), errors.get("restarted", 0)
        if bus_offs > self._bus_offs:
            text = "the CAN controller is bus-off: check wiring, termination and bit rate"
            text += "; it stays so unless restart-ms is set for the interface"
            self._events.begin("bus-off", text, logging.ERROR)
        if restarts > self._restarts:
            self._events.end("bus-off", "the CAN controller is on the bus again")
        self._bus_offs, self._restarts = bus_offs, restarts


_REOPEN_S = 0.5


class BusKeeper:
    """Reopens a lost bus in a thread and hands it to the loop.

    Args:
        devices: simulated devices in the loop's thread, or None.
    """

    def __init__(
        self, port: BusPort, section: BusSection, events: EventLog, devices: Callable[[], object] | None
    ) -> None:
        self._port = port
        self._section = section
        self._events = events
        self._devices = devices
        self._opening: threading.Thread | None = None
        self._opened: can.BusABC | None = None

    def lost(self, reason: str) -> None:
        """Handle a loss of the bus."""
        self._events.begin("bus", f"{self._section.channel}: the bus is lost: {reason}", logging.ERROR)

    def check(self) -> bool:
        """Try to reopen a lost bus in the slack of a cycle; return whether it is back."""
        loop = self._port.loop
        if loop is None or not isinstance(loop.source, LostSource):
            return False
        if self._opened is None:
            if self._opening is None or not self._opening.is_alive():
                self._opening = threading.Thread(target=self._reopen, name="reopen", daemon=True)
                self._opening.start()
            return False
        bus, self._opened = self._opened, None
        self._port.bus = bus
        loop.source = open_source(bus, self._devices)
        loop.source.narrow(loop.receive_ids())
        self._events.end("bus", f"{self._section.channel}: the bus is back")
        return True

    def _reopen(self) -> None:
        with suppress(can.CanError, OSError):
            self._port.bus.shutdown()
        with suppress(BusError):
            self._opened = open_bus(self._section)
        if self._opened is None:
            time.sleep(_REOPEN_S)

    def close(self) -> None:
        """Shut the bus."""
        if self._opening is not None:
            self._opening.join(timeout=2 * _REOPEN_S)
        for bus in (self._port.bus, self._opened):
            if bus is not None:
                with suppress(can.CanError, OSError):
                    bus.shutdown()
