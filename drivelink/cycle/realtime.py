"""Prepares process and thread for the cycle: scheduling, memory, timer, garbage collector.

Each is tried separately; a refusal is one line with the command that would permit it, and the daemon runs
without.
"""

from __future__ import annotations

import ctypes
import gc
import os
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass

PRIORITY = 80  # of 1 to 99: above the network's interrupt threads (50), below the kernel's watchdogs (99)
SWITCH_INTERVAL_S = 100e-6  # longest time for which another Python thread holds the interpreter

_MCL_CURRENT, _MCL_FUTURE = 1, 2  # mlockall(2)
_PR_SET_TIMERSLACK = 29  # prctl(2)


@dataclass(frozen=True, slots=True, kw_only=True)
class RealTime:
    """What was granted, and the previous settings."""

    scheduling: bool  # SCHED_FIFO was granted
    memory: bool  # the process is locked into memory
    lines: tuple[str, ...]  # refusals, one line each, with the remedy
    switch_interval_s: float  # previous value


def acquire(*, privileged: bool = True) -> RealTime:
    """Prepare the calling thread and the process for a cycle of a millisecond."""
    before = sys.getswitchinterval()
    sys.setswitchinterval(SWITCH_INTERVAL_S)
    gc.collect()
    gc.freeze()
    gc.disable()
    libc = ctypes.CDLL(None, use_errno=True)
    if hasattr(libc, "prctl"):
        libc.prctl(_PR_SET_TIMERSLACK, 1, 0, 0, 0)  # no timer slack (default 50 us)
    lines: list[str] = []
    scheduling = privileged and _attempt(_schedule, lines)
    memory = privileged and _attempt(lambda: _lock_memory(libc), lines)
    return RealTime(scheduling=scheduling, memory=memory, lines=tuple(lines), switch_interval_s=before)


def release(obtained: RealTime) -> None:
    """Undo `acquire`, for a process that continues after the loop."""
    if obtained.scheduling:
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
    if obtained.memory:
        ctypes.CDLL(None).munlockall()
    sys.setswitchinterval(obtained.switch_interval_s)
    gc.unfreeze()
    gc.enable()


def _attempt(action: Callable[[], None], lines: list[str]) -> bool:
    try:
        action()
    except OSError as error:
        lines.append(str(error.strerror))
        return False
    return True


def _schedule() -> None:
    try:
        # Threads and processes that it starts are ordinary ones.
        os.sched_setscheduler(0, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, os.sched_param(PRIORITY))
    except OSError as error:
        raise OSError(
            error.errno,
            "no real-time scheduling (SCHED_FIFO is not permitted): jitter will be larger; "
            "permit it with LimitRTPRIO=99 in the systemd unit, or `ulimit -r 99`",
        ) from error


def _lock_memory(libc: ctypes.CDLL) -> None:
    if libc.mlockall(_MCL_CURRENT | _MCL_FUTURE) != 0:
        raise OSError(
            ctypes.get_errno(),
            "memory is not locked (mlockall is not permitted): a page fault may delay a cycle; "
            "permit it with LimitMEMLOCK=infinity in the systemd unit, or `ulimit -l unlimited`",
        )


class Alarm:
    """Sleeps until a deadline of the monotonic clock.

    The kernel wakes late by a steady amount plus scatter. The steady part is estimated and subtracted; early
    wake-ups are polled away, and kept rare so that polling costs one or two microseconds per cycle.
    """

    _OFTEN = 0.2  # share of the cycles that wake early
    _STEP_NS = 500  # largest correction per cycle
    _MOST_NS = 200_000

    def __init__(self) -> None:
        self.early_ns = 0.0

    def sleep_until(self, deadline_ns: int) -> None:
        """Return at the deadline, or at once if it has passed."""
        clock = time.monotonic_ns
        left = deadline_ns - int(self.early_ns) - clock()
        if left > 0:
            time.sleep(left * 1e-9)
            share = self._OFTEN if clock() > deadline_ns else self._OFTEN - 1.0
            self.early_ns = min(max(self.early_ns + self._STEP_NS * share, 0.0), self._MOST_NS)
        while clock() < deadline_ns:
            pass
