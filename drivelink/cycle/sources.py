"""Selects the fastest way to read a bus."""

from __future__ import annotations

from collections.abc import Callable

import can

from drivelink.cycle.framesource import BusSource, FrameSource, Pumped, VirtualSource
from drivelink.cycle.socketcan import SocketCanSource
from drivelink.cycle.socketcand import SocketcandSource


def open_source(bus: can.BusABC, devices: Callable[[], object] | None = None) -> FrameSource:
    """Open the fastest source for this bus, also with devices in this thread."""
    if devices is not None:
        return Pumped(VirtualSource(bus) if type(bus).__name__ == "VirtualBus" else BusSource(bus), devices)
    if type(bus).__name__ == "SocketcanBus":
        return SocketCanSource(bus)
    if type(bus).__name__ == "SocketCanDaemonBus":
        return SocketcandSource(bus)
    if type(bus).__name__ == "VirtualBus":
        return VirtualSource(bus)
    return BusSource(bus)
