"""What is asked of the operating system is given back; deadlines are whole periods; systemd is notified."""

import gc
import os
import socket
import sys
import threading
from itertools import pairwise
from types import SimpleNamespace

import pytest
from canlayouts import VSA, vsa_cycle

from drivelink._core import Assembler, JointPipeline
from drivelink.cycle import realtime
from drivelink.cycle.housekeeping import Housekeeping
from drivelink.cycle.loop import CycleLoop, LoopJoint
from drivelink.cycle.sources import CanFrame
from drivelink.systemd import unit
from drivelink.systemd.unit import Watchdog, notify, watchdog_period_s
from estimator.sample import Estimate

MS = 1_000_000


def test_what_was_taken_is_given_back():
    before = sys.getswitchinterval()
    obtained = realtime.acquire()
    assert not gc.isenabled() and sys.getswitchinterval() < before
    realtime.release(obtained)
    assert gc.isenabled() and sys.getswitchinterval() == pytest.approx(before)
    assert os.sched_getscheduler(0) == os.SCHED_OTHER


def test_what_is_refused_is_a_plain_line_with_the_remedy(monkeypatch):
    def refuse(*_):
        raise PermissionError(1, "Operation not permitted")

    monkeypatch.setattr(os, "sched_setscheduler", refuse)
    obtained = realtime.acquire()
    realtime.release(obtained)
    assert not obtained.scheduling
    (line,) = [line for line in obtained.lines if "SCHED_FIFO" in line]
    assert "LimitRTPRIO" in line
    assert "\n" not in line


class Echo:
    """A bus whose devices answer SYNC at once, and that can make the loop late."""

    def __init__(self) -> None:
        self.lost_sends, self.errors, self.pending, self.syncs, self.delay = 0, {}, [], 0, {}
        self.narrow = lambda _cob_ids: None

    def wait(self, timeout_s):
        return bool(self.pending)

    def receive(self):
        frames, self.pending = self.pending, []
        return frames

    def send(self, cob_id, data):
        self.syncs += 1
        self.pending = [CanFrame(*frame, 0) for frame in vsa_cycle(self.syncs)]
        threading.Event().wait(self.delay.pop(self.syncs, 0.0))


# An estimator that only repeats the sequence.
LAST = SimpleNamespace(
    residual_nm=0.0, step=lambda sample: Estimate(sample.sequence, 1, 0.0, 0.0, 0.0, ()), lose_zeros=lambda: None,
    parameters=list, suspicion=lambda: None,
)  # fmt: skip


class Stamps:
    def __init__(self, stop_after):
        self.stop_after, self.seen, self.loop = stop_after, [], None

    def put(self, tick):
        self.seen.append((tick.estimate.sequence, tick.stamp_ns))
        if len(self.seen) >= self.stop_after and self.loop is not None:
            self.loop.stop()


def test_deadlines_move_by_whole_periods_and_late_cycles_are_left_out_as_gaps():
    source, sink = Echo(), Stamps(100)
    source.delay = {20: 0.005, 50: 0.0101}
    loop_joint = LoopJoint("x", JointPipeline(Assembler(VSA, 2), LAST), sink)
    loop = sink.loop = CycleLoop(source, [loop_joint], period_s=0.001)
    realtime.run(loop)
    assert loop.overruns >= 4 + 9
    for (before, stamp_before), (after, stamp) in pairwise(sink.seen):
        assert stamp - stamp_before == (after - before) * MS
    assert sink.seen[-1][0] + 1 <= len(sink.seen) + loop.overruns  # some may follow the last one seen


def test_housekeeping_is_done_in_the_slack_one_task_at_a_time():
    done: list[str] = []
    housekeeping = Housekeeping()
    housekeeping.every(0.01, lambda: done.append("a"))
    housekeeping.every(0.02, lambda: done.append("b"))
    housekeeping.urgent.append(lambda _now: done.append("u"))
    housekeeping.run(0, 0)  # no slack, and nobody has waited long
    assert done == []
    for now in range(0, 40 * MS, MS):
        housekeeping.run(now, MS)
    assert (done.count("a"), done.count("b"), done.count("u")) == (4, 2, 40)


def test_a_long_task_is_done_in_parts_and_finished_before_the_next_begins_and_nothing_waits_for_ever():
    done, never = [], []

    def long():
        for part in "123":
            done.append(part)
            yield

    housekeeping = Housekeeping()
    housekeeping.every(10.0, long)
    housekeeping.every(10.0, lambda: done.append("other"))
    for now, slack, expected in ((0, MS, "1"), (MS, 0, "1"), (2 * MS, MS, "12")):
        housekeeping.run(now, slack)
        assert "".join(done) == expected
    housekeeping.run(1500 * MS, 0)  # the other has waited for so long that it no longer asks for slack
    assert done == ["1", "2", "3", "other"]
    housekeeping = Housekeeping()
    housekeeping.every(0.5, lambda: never.append(1))
    for now in range(0, 4000 * MS, MS):
        housekeeping.run(now, 0)
    assert 1 <= len(never) <= 4


def test_systemd_is_notified_and_its_absence_is_no_error(tmp_path, monkeypatch):
    for name in ("NOTIFY_SOCKET", "WATCHDOG_USEC", "WATCHDOG_PID"):
        monkeypatch.delenv(name, raising=False)
    assert not notify("READY=1") and watchdog_period_s() is None
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
        manager.bind(str(tmp_path / "notify"))
        monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "notify"))
        assert notify("READY=1", "STATUS=running")
        assert manager.recv(100) == b"READY=1\nSTATUS=running"
    monkeypatch.setenv("WATCHDOG_USEC", "2000000")
    assert watchdog_period_s() == 0.5  # four times as often as it asks
    monkeypatch.setenv("WATCHDOG_PID", "1")  # somebody else's
    assert watchdog_period_s() is None


def test_the_watchdog_is_fed_by_the_cycles_that_are_made(monkeypatch):
    loop, now_ns, fed = SimpleNamespace(period_ns=1_000_000, overruns=0, behind=0), [0], []
    monkeypatch.setattr(unit, "notify", fed.append)
    monkeypatch.setattr(unit.time, "monotonic_ns", lambda: now_ns[0])
    watchdog = Watchdog(loop)
    for overruns, behind, fine in ((0, 0, True), (100, 0, True), (450, 0, False), (450, 490, False)):
        now_ns[0] += 500_000_000
        loop.overruns, loop.behind = overruns, behind
        assert watchdog.check() is fine
    assert fed == ["WATCHDOG=1"] * 2
