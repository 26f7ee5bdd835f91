"""Prepares process and thread for the cycle; starts the cycles on deadlines, or with another master's SYNC.

Scheduling, memory, timer and garbage collector are each tried separately; a refusal is one line with the
command that would permit it, and the daemon runs without. A late cycle does not shift the next one. One that
is too late is skipped and counted, and is a gap to the estimators. Housekeeping runs in the slack between a
cycle's work and the next SYNC.
"""

import ctypes
import gc
import os
import sys
import time
from dataclasses import dataclass

from drivelink._core import LATEST
from drivelink.cycle.loop import CycleLoop

PRIORITY = 80  # of 1 to 99: above the network's interrupt threads (50), below the kernel's watchdogs (99)
SWITCH_INTERVAL_S = 100e-6  # longest time for which another Python thread holds the interpreter

_MCL_CURRENT, _MCL_FUTURE = 1, 2  # mlockall(2)
_PR_SET_TIMERSLACK = 29  # prctl(2)
_NO_SCHEDULING = (
    "no real-time scheduling (SCHED_FIFO is not permitted): jitter will be larger; "
    "permit it with LimitRTPRIO=99 in the systemd unit, or `ulimit -r 99`"
)
_NO_LOCK = (
    "memory is not locked (mlockall is not permitted): a page fault may delay a cycle; "
    "permit it with LimitMEMLOCK=infinity in the systemd unit, or `ulimit -l unlimited`"
)


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
    libc = ctypes.CDLL(None)
    if hasattr(libc, "prctl"):
        libc.prctl(_PR_SET_TIMERSLACK, 1, 0, 0, 0)  # no timer slack (default 50 us)
    lines, scheduling, memory = [], False, False
    if privileged:
        try:  # threads and processes that it starts are ordinary ones
            os.sched_setscheduler(0, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, os.sched_param(PRIORITY))
            scheduling = True
        except OSError:
            lines.append(_NO_SCHEDULING)
        memory = libc.mlockall(_MCL_CURRENT | _MCL_FUTURE) == 0
        if not memory:
            lines.append(_NO_LOCK)
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


_MARGIN_NS = 120_000  # before the deadline, when waiting for frames ends
_SILENCE_PERIODS = 5  # when following: time without SYNC until the estimates are stale
_SILENCE_NS = 20_000_000  # and at least
_LONGEST_WAIT_NS = 20_000_000


def run(loop: CycleLoop) -> None:
    """Run cycles until the loop is stopped."""
    if loop.produce:
        _produce(loop)
    else:
        _follow(loop)


class _Expectation:
    """Estimates when the cycle's last frame arrives after SYNC: until then the loop sleeps.

    Waking for every frame costs more than the rest of the cycle. The estimate is on the early side; a frame
    that comes earlier waits a few tens of microseconds.
    """

    _EARLIER, _LATER = 0.02, 0.1
    _MOST = 0.5  # of a period
    _MARGIN_NS = 30_000

    def __init__(self, period_ns: int) -> None:
        self._most_ns = int(self._MOST * period_ns)
        self.after_ns = 0.0

    def update(self, complete_ns: int, at_once: bool) -> None:
        """Update with the time from SYNC to the complete cycle, found at the first check or after waiting."""
        if at_once:
            self.after_ns *= 1.0 - self._EARLIER
        else:
            self.after_ns += self._LATER * (complete_ns - self._MARGIN_NS - self.after_ns)
        self.after_ns = min(max(self.after_ns, 0.0), self._most_ns)


def _produce(loop: CycleLoop) -> None:
    clock, period = time.monotonic_ns, loop.period_ns
    latest = int(LATEST * period)
    alarm = Alarm()
    expectation = _Expectation(period)
    deadline = clock() + period
    jump = 1
    while not loop.stopped:
        _gather(loop, deadline, expectation)
        alarm.sleep_until(deadline)
        late = clock() - deadline
        if late > latest:
            left_out = 1 + (late - latest) // period
            loop.overruns += left_out
            jump += 0 if loop.world_steps else left_out
            deadline += left_out * period
            continue
        loop.tick(deadline + loop.unix_ns, jump, None if loop.world_steps else deadline)
        loop.lateness.add(late)
        jump = 1
        deadline += period


def _gather(loop: CycleLoop, deadline_ns: int, expectation: _Expectation) -> None:
    """Receive until the cycle is complete; housekeeping then, or from the middle of the period on."""
    clock = time.monotonic_ns
    left = loop.sync_ns + int(expectation.after_ns) - clock()
    if left > 0:
        time.sleep(left * 1e-9)
    loop.receive()
    at_once = loop.complete
    complete = at_once or _receive_until(loop, deadline_ns - loop.period_ns // 2)
    if complete:
        expectation.update(loop.received_ns - loop.sync_ns, at_once)
    now = clock()
    loop.housekeeping.run(now, deadline_ns - now)
    if not complete:
        _receive_until(loop, deadline_ns - _MARGIN_NS)


def _receive_until(loop: CycleLoop, time_ns: int) -> bool:
    """Receive until the cycle is complete or the deadline; return whether it is complete."""
    while not loop.complete:
        left = time_ns - time.monotonic_ns()
        if left <= 0:
            return False
        loop.wait(left * 1e-9)
    return True


def _follow(loop: CycleLoop) -> None:
    clock, period = time.monotonic_ns, loop.period_ns
    silence = max(_SILENCE_PERIODS * period, _SILENCE_NS)
    longest_s = min(max(period, 1_000_000), _LONGEST_WAIT_NS) * 1e-9
    while not loop.stopped:
        now = clock()
        slack = loop.sync_ns + period - now
        if slack < period - silence:
            loop.carry_on()
            loop.sync_ns = now
            slack = silence
        if loop.complete or loop.silent or slack < period // 2:
            loop.housekeeping.run(now, max(slack, 0))
        loop.wait(longest_s)
