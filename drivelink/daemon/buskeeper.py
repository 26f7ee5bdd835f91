"""Keeps the bus of a daemon open: a lost bus is reopened and handed to the loop."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from contextlib import suppress

import can

from drivelink.canopen.bus import open_bus
from drivelink.cycle.busport import BusPort
from drivelink.cycle.framesource import LostSource
from drivelink.cycle.sources import open_source
from drivelink.daemon.status import EventLog
from drivelink.errors import BusError
from drivelink.jointfile import BusSection

_REOPEN_S = 0.5


class BusKeeper:
    """Reopens a lost bus in a thread and hands it to the loop.

    Args:
        port: the daemon's port.
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
