"""Starts the cycles: on absolute deadlines, or with the SYNC of another master.

A late cycle does not shift the next one. One that is too late is skipped and counted, and is a gap to the
estimators. Housekeeping runs in the slack between a cycle's work and the next SYNC.
"""

from __future__ import annotations

import time

from drivelink.cycle.loop import CycleLoop
from drivelink.cycle.realtime import Alarm

_LATEST = 0.4  # of a period: a later SYNC is skipped, being nearer to the next one
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
    latest = int(_LATEST * period)
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
        loop.tick(deadline + loop.unix_ns, jump)
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
