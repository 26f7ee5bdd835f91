"""The cycle's work: SYNC, frames, estimate, publication, for all joints of one bus.

A cycle is `tick` and `receive`. `drivelink.cycle.realtime` calls them by the clock or by the SYNC of another
master; `run_lockstep` without a clock.
"""

import logging
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Protocol

from drivelink._core import LATE, SYNC_COB_ID, JointPipeline, LatencyHistogram, Tick
from drivelink.cycle.housekeeping import Housekeeping
from drivelink.cycle.sources import BusLostError, CanFrame, FrameSource, LostSource
from drivelink.cycle.syncclock import MEASURED_SYNCS, SyncClock

logger = logging.getLogger(__name__)

Listener = Callable[[int, bytes], None]

_MOST_BEHIND_NS = 10_000_000_000  # a larger difference is a stamp of another clock
_CLOCK_STEP_NS = 20_000_000  # NTP slews by less between two checks; more is a clock that was set


class CycleSink(Protocol):
    """Receives estimates and samples."""

    def put(self, tick: Tick) -> None:
        """Publish a cycle: its estimate, then its sample, if any."""


@dataclass(slots=True, eq=False)
class LoopJoint:
    """One joint in the loop."""

    name: str  # of the joint
    pipeline: JointPipeline  # frames to estimates
    sink: CycleSink | None  # receives its output, or None
    # the exception that ended its estimates, or empty; a new estimator in the pipeline clears it
    fault: str = ""
    broken: object = None  # the estimator that failed
    estimates: int = 0  # published from fresh samples
    stale: int = 0  # cycles without a sample
    work: LatencyHistogram = field(default_factory=LatencyHistogram)  # from the last frame to the estimate
    response: LatencyHistogram = field(default_factory=LatencyHistogram)  # from SYNC to the last frame


def _log_fault(where: str, error: Exception) -> None:
    logger.error("%s: %s: %s", where, type(error).__name__, error, exc_info=error)


class CycleLoop:
    """The one thread's work for all joints of one bus.

    Args:
        produce: make SYNC; else follow it.
        counter_overflow: 0x1019; 0: SYNC carries no counter.
        world_steps: only SYNC advances the (simulated) world, so a skipped SYNC is no gap.
    """

    def __init__(
        self,
        source: FrameSource,
        loop_joints: Sequence[LoopJoint],
        *,
        period_s: float,
        produce: bool = True,
        counter_overflow: int = 0,
        world_steps: bool = False,
    ) -> None:
        self.world_steps = world_steps
        self.source = source  # the bus; replaced when it is lost and reopened
        self.loop_joints = tuple(loop_joints)
        self.housekeeping = Housekeeping()  # what is done in the slack
        self.listeners: dict[int, Listener] = {}  # further handlers by identifier: SDO, heartbeat, EMCY
        self.after_sync: list[Callable[[], None]] = []  # called at each SYNC, after the joints have taken it
        self.clock: Callable[[], int] = time.monotonic_ns  # the clock of supervision, ns
        # called with each frame that `send` has sent
        self.on_sent: Callable[[int, bytes], None] = lambda _cob_id, _data: None
        self.on_lost: Callable[[str], None] = lambda _reason: None  # called when the bus is lost
        # called with an exception of one joint or node, and its name; the loop continues without it
        self.on_fault: Callable[[str, Exception], None] = _log_fault
        self.housekeeping.on_fault = lambda error: self.on_fault("housekeeping", error)
        self.behind = 0  # when following, SYNCs read more than a period after their stamp
        self.skipped_periods = 0  # when following, periods without SYNC
        self.cycles = 0  # SYNCs since the start
        # those on the bus; when producing, one more than `cycles` while frames before it are processed
        self.syncs = 0
        self.overruns = 0  # periods skipped because this process was late
        self.foreign_syncs = 0  # SYNCs of another master while we produce it, or that were not due
        self.late_syncs = 0  # when following, SYNCs that came after their period
        self.counter_jumps = 0  # SYNCs whose counter did not continue the previous one
        # when following, stamps of the last SYNCs
        self.sync_stamps: deque[int] = deque(maxlen=MEASURED_SYNCS)
        self.clock_step_ns = 0  # last change of the system's clock
        self.clock_steps = 0  # number of such changes
        self.silent = False  # when following: there is no SYNC
        # of SYNC against its deadline; when following, against the previous SYNC
        self.lateness = LatencyHistogram()
        self.produce = produce
        self.period_ns = round(period_s * 1e9)  # the communication cycle
        self._sync_clock = SyncClock(period_s)
        self._overflow = counter_overflow
        self._counter = 0
        self._loop_joints_of: dict[int, list[LoopJoint]] = {}
        self.reroute()
        self.unix_ns = time.time_ns() - time.monotonic_ns()  # UNIX time less monotonic time
        # monotonic times of the present SYNC and of the last reception
        self.sync_ns = self.received_ns = time.monotonic_ns()
        self.stopped = False  # `stop` was called

    @property
    def complete(self) -> bool:
        """Whether every joint has its sample of this cycle."""
        return all([pipeline.complete for pipeline in self._pipelines])  # noqa: C419 - twice as fast

    def reroute(self) -> None:
        """Rebuild the table of which joint receives which frame."""
        self._loop_joints_of.clear()
        sound = [loop_joint for loop_joint in self.loop_joints if not loop_joint.fault]
        self._pipelines = [loop_joint.pipeline for loop_joint in sound]
        for loop_joint in sound:
            for cob_id in loop_joint.pipeline.assembler.cob_ids:
                self._loop_joints_of.setdefault(cob_id, []).append(loop_joint)

    def receive_ids(self) -> set[int]:
        """Return the identifiers with a receiver."""
        return {SYNC_COB_ID, *self._loop_joints_of, *self.listeners}

    def send(self, cob_id: int, data: bytes) -> None:
        """Send a frame other than SYNC; the joints see it, as in a log."""
        try:
            self.source.send(cob_id, data)
        except BusLostError as error:
            self._lose(error)
        for loop_joint in list(self._loop_joints_of.get(cob_id, ())):
            self._feed(loop_joint, cob_id, data)
        self.on_sent(cob_id, data)

    def stop(self) -> None:
        """End the pacing after the present cycle; callable from any thread or signal handler."""
        self.stopped = True

    def run_lockstep(self, cycles: int, start_ns: int = 0) -> None:
        """Run so many cycles without waiting, for devices that answer within `send`.

        Supervision and housekeeping use the stamps as their clock.

        Args:
            start_ns: stamp of the first SYNC; the others follow by periods.
        """
        for stamp_ns in range(start_ns, start_ns + cycles * self.period_ns, self.period_ns):
            self.clock = partial(int, stamp_ns)
            self.tick(stamp_ns)
            self.receive()
            self.housekeeping.run(stamp_ns, self.period_ns)

    def tick(self, stamp_ns: int, jump: int = 1, deadline_ns: int | None = None) -> None:
        """Produce SYNC. Frames received before it belong to the previous cycle.

        Args:
            jump: periods since the one before.
            deadline_ns: monotonic time at which it was due; None: it is on time.
        """
        self.syncs += 1
        try:
            frames = self.source.receive()
            self.source.send(SYNC_COB_ID, self._next_counter())
        except BusLostError as error:
            frames = []
            self._lose(error)
        now = self.sync_ns = time.monotonic_ns()
        if frames:
            self._dispatch(frames, now)
        self._sync(b"", stamp_ns, jump, now, 0 if deadline_ns is None else now - deadline_ns)

    def receive(self) -> None:
        """Process the received frames."""
        try:
            frames = self.source.receive()
        except BusLostError as error:
            self._lose(error)
            return
        if frames:
            self.received_ns = time.monotonic_ns()
            self._dispatch(frames, self.received_ns)

    def refresh_unix_time(self) -> None:
        """Adjust the stamps to the system's clock, between two cycles."""
        before, self.unix_ns = self.unix_ns, time.time_ns() - time.monotonic_ns()
        if abs(self.unix_ns - before) > _CLOCK_STEP_NS:
            self.clock_step_ns = self.unix_ns - before
            self.clock_steps += 1

    def _next_counter(self) -> bytes:
        if not self._overflow:
            return b""
        self._counter = self._counter % self._overflow + 1
        return bytes((self._counter,))

    def _dispatch(self, frames: list[CanFrame], now_ns: int) -> None:
        interested, listeners = self._loop_joints_of, self.listeners
        for cob_id, data, stamp_ns in frames:
            if cob_id == SYNC_COB_ID:
                self._foreign_sync(data, stamp_ns, now_ns)
                continue
            for loop_joint in interested.get(cob_id, ()):
                if (tick := self._feed(loop_joint, cob_id, data)) is not None:
                    self._publish(loop_joint, tick, now_ns)
                    loop_joint.response.add(now_ns - self.sync_ns)
            if cob_id in listeners:
                try:
                    listeners[cob_id](cob_id, data)
                except Exception as error:  # noqa: BLE001 - one frame of one node
                    self.on_fault(f"frame 0x{cob_id:03X}", error)

    def _foreign_sync(self, data: bytes, stamp_ns: int, now_ns: int) -> None:
        if self.produce:
            self.foreign_syncs += 1
            self._sync(data, 0, 0, now_ns)
            return
        self.sync_stamps.append(stamp_ns)
        behind_ns = now_ns + self.unix_ns - stamp_ns
        self.behind += self.period_ns < behind_ns < _MOST_BEHIND_NS
        jump = self._sync_clock.jump(stamp_ns, now_ns)
        if jump == 0:
            self.foreign_syncs += 1
        elif jump == LATE:
            self.late_syncs += 1
        else:
            self.skipped_periods += jump - 1
            self.lateness.add(abs(now_ns - self.sync_ns - jump * self.period_ns) if self.cycles else 0)
            self.sync_ns = now_ns
        if len(data) == 1:
            expected = self._counter % self._overflow + 1 if self._overflow else data[0]
            self.counter_jumps += data[0] != expected and self.cycles > 0
            self._counter = data[0]
        self._sync(data, stamp_ns, jump, now_ns)

    def _sync(self, data: bytes, stamp_ns: int, jump: int, now_ns: int, late_ns: int = 0) -> None:
        if jump > 0:
            self.cycles += 1
            self.syncs = self.cycles
            self.silent = False
        for loop_joint in self.loop_joints:
            if loop_joint.fault:
                tick = self._carry_on_faulted(loop_joint, jump, stamp_ns)
            else:
                tick = self._feed(loop_joint, SYNC_COB_ID, data, jump, stamp_ns, late_ns)
            if tick is not None:
                self._publish(loop_joint, tick, now_ns)
        for follow in self.after_sync:
            follow()

    def _feed(
        self,
        loop_joint: LoopJoint,
        cob_id: int,
        data: bytes,
        jump: int = 1,
        stamp_ns: int = 0,
        late_ns: int = 0,
    ) -> Tick | None:
        """Pass a frame to one joint; an exception ends only its estimates."""
        try:
            return loop_joint.pipeline.feed(cob_id, data, jump, stamp_ns, late_ns)
        except Exception as error:  # noqa: BLE001 - see above
            loop_joint.fault = f"{type(error).__name__}: {error}"
            loop_joint.broken = loop_joint.pipeline.estimator
            self.reroute()
            self.on_fault(loop_joint.name, error)
            return None

    def _carry_on_faulted(self, loop_joint: LoopJoint, jump: int, stamp_ns: int) -> Tick | None:
        """At a SYNC, mark the last estimate of a joint in fault as stale."""
        pipeline = loop_joint.pipeline
        if pipeline.estimator is not loop_joint.broken:  # the joint file was mended
            loop_joint.fault, loop_joint.broken = "", None
            self.reroute()
        if pipeline.estimate is None or jump <= 0:
            return None
        return pipeline.carry_on(pipeline.estimate.sequence + jump, stamp_ns=stamp_ns)

    def _publish(self, loop_joint: LoopJoint, tick: Tick, since_ns: int) -> None:
        if loop_joint.sink is not None:
            try:
                loop_joint.sink.put(tick)
            except Exception as error:  # noqa: BLE001 - the other joints' estimates are published
                self.on_fault(loop_joint.name, error)
        if tick.current:
            loop_joint.work.add(time.monotonic_ns() - since_ns)
        if tick.fresh:
            loop_joint.estimates += 1
        else:
            loop_joint.stale += 1

    def wait(self, timeout_s: float) -> None:
        """Wait for frames and receive them; a lost bus ends the wait."""
        try:
            if self.source.wait(timeout_s):
                self.receive()
        except BusLostError as error:
            self._lose(error)

    def _lose(self, error: BusLostError) -> None:
        self.source = LostSource()
        self.on_lost(str(error))

    def carry_on(self) -> None:
        """Mark the last estimates as stale, without SYNC."""
        self.silent = True
        for loop_joint in self.loop_joints:
            tick = loop_joint.pipeline.carry_on(loop_joint.pipeline.assembler.sequence)
            if tick is not None:
                self._publish(loop_joint, tick, time.monotonic_ns())
