"""systemd's notification socket (sd_notify(3)): ready, stopping, watchdog. Optional."""

from __future__ import annotations

import os
import socket
import time

from drivelink.cycle.loop import CycleLoop

_LEAST_SHARE = 0.5  # of the cycles that are due


def notify(*lines: str) -> bool:
    """Send lines such as "READY=1"; return whether systemd listens."""
    address = os.environ.get("NOTIFY_SOCKET", "")
    if not address.startswith(("/", "@")):
        return False
    if address.startswith("@"):
        address = "\0" + address[1:]  # an abstract socket
    try:
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC) as out:
            out.setblocking(False)
            out.sendto("\n".join(lines).encode(), address)
    except OSError:
        return False
    return True


def watchdog_period_s() -> float | None:
    """Return the interval of "WATCHDOG=1", a quarter of systemd's timeout, s; None: no watchdog."""
    if os.environ.get("WATCHDOG_PID", str(os.getpid())) != str(os.getpid()):
        return None
    try:
        allowed_us = int(os.environ["WATCHDOG_USEC"])
    except (KeyError, ValueError):
        return None
    return allowed_us * 0.25e-6 if allowed_us > 0 else None


class Watchdog:
    """Feeds systemd's watchdog while the loop makes its cycles.

    A loop that skips most of them, because something else holds the interpreter or the processor, is not fed.
    """

    def __init__(self, loop: CycleLoop) -> None:
        self._loop = loop
        self._before = self._now()

    def check(self) -> bool:
        """Tell systemd of the progress since the last call; return whether there was enough."""
        before, self._before = self._before, self._now()
        due = (self._before[0] - before[0]) / self._loop.period_ns
        missed = self._before[1] - before[1]
        progress = missed <= (1.0 - _LEAST_SHARE) * due
        if progress:
            notify("WATCHDOG=1")
        return progress

    def _now(self) -> tuple[int, int]:
        """Time, ns, and periods that were skipped, or read too late, by this process."""
        return time.monotonic_ns(), self._loop.overruns + self._loop.behind
