"""Gives senders access to a daemon's bus: directly before the loop runs, through the loop afterwards."""

from __future__ import annotations

from typing import TYPE_CHECKING

import can

if TYPE_CHECKING:
    from drivelink.cycle.loop import CycleLoop


class BusPort:
    """The bus for senders of python-can messages: directly, or through the loop while it runs."""

    def __init__(self, bus: can.BusABC) -> None:
        self.bus = bus  # the open bus
        self.loop: CycleLoop | None = None  # the only reader, once it runs

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """Put a frame on the bus."""
        if self.loop is None:
            self.bus.send(msg, timeout)
        else:
            self.loop.send(msg.arbitration_id, bytes(msg.data))

    def recv(self, timeout: float | None = None) -> can.Message | None:
        """Return the next frame; only before the loop runs."""
        return self.bus.recv(timeout)
