"""Recorded cycles as input of the pipeline; those of raw frames are numbered by later SYNCs.

Recorded stamps are often arrival times, which come in bursts. After a late SYNC others catch up; after a lost
one all stay behind. `SyncClock` has to decide at once and cannot distinguish them.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator
from typing import NamedTuple

from drivelink._core import SYNC_COB_ID, JointPipeline, Tick
from drivelink.canopen.passive import PassiveConfigurator
from drivelink.cycle.following import follow_log
from drivelink.cycle.objectcheck import RecentSamples
from drivelink.cycle.pipeline import make_assembler
from drivelink.cycle.syncclock import SyncClock, measure_period
from drivelink.errors import DriveError
from drivelink.jointfile import JointFile
from drivelink.recording.canlog import NO_STAMP, LoggedFrame
from estimator.sample import Sample

OF_SDO = range(0x581, 0x680)
OF_MAPS = frozenset({0, *OF_SDO, *range(0x701, 0x780)})  # NMT, SDO, boot-up


class Cycle(NamedTuple):
    """One recorded cycle."""

    sequence: int  # number of its SYNC
    stamp_ns: int  # UNIX time of its SYNC
    sample: Sample | None  # of this cycle, or None
    flags: int  # its service bits of `Status`


def estimated(cycles: Iterable[Cycle], pipeline: JointPipeline) -> Iterator[Tick]:
    """Pass the cycles through the pipeline; yield the output that the live loop publishes."""
    for sequence, stamp_ns, sample, flags in cycles:
        if sample is not None:
            yield pipeline.step(sample, flags, stamp_ns)
        elif (tick := pipeline.carry_on(sequence, flags, stamp_ns)) is not None:
            yield tick


_AHEAD = 64  # later SYNCs used to number one
_EXTRA = -0.5  # periods too early: a SYNC of another master
_FOLLOW = 0.05  # of the deviation, per SYNC: the two clocks drift


def numbered_at_once(frames: Iterable[LoggedFrame], period_s: float) -> Iterator[tuple[LoggedFrame, int]]:
    """Each frame with the jump of its SYNC, decided as in the live loop."""
    clock = SyncClock(period_s)
    for frame in frames:
        if frame.can_id == SYNC_COB_ID and frame.stamp_ns != NO_STAMP:
            yield frame, clock.jump(frame.stamp_ns)
        else:
            yield frame, 1


def numbered_ahead(frames: Iterable[LoggedFrame], period_s: float) -> Iterator[tuple[LoggedFrame, int]]:
    """Each frame with the jump of its SYNC: periods since the previous one, 0 if not due."""
    numbering = SyncNumbering(period_s)
    for frame in frames:
        yield from numbering.push(frame)
    yield from numbering.rest()


class SyncNumbering:
    """Numbers the SYNCs of a stream once enough others have followed.

    Args:
        measure: use the period of the first SYNCs if it differs.
    """

    def __init__(self, period_s: float, *, measure: bool = False) -> None:
        self.period_s = period_s  # in use
        self._measure = measure
        self._last: int | None = None
        self._due_ns: float | None = None
        self._cycles: deque[list[LoggedFrame]] = deque()  # each waiting SYNC and its frames
        self._stamps: deque[int] = deque()  # of these SYNCs

    def push(self, frame: LoggedFrame) -> list[tuple[LoggedFrame, int]]:
        """Take a frame; return the frames decided now, each with its jump."""
        if frame.can_id == SYNC_COB_ID:
            self._cycles.append([frame])
            self._stamps.append(frame.stamp_ns)
            return self._released() if len(self._cycles) > _AHEAD else []
        if self._cycles:
            self._cycles[-1].append(frame)
            return []
        return [(frame, 1)]

    def rest(self) -> list[tuple[LoggedFrame, int]]:
        """End the stream; return all waiting frames."""
        return [numbered for _ in range(len(self._cycles)) for numbered in self._released()]

    def _released(self) -> list[tuple[LoggedFrame, int]]:
        """Release the first waiting cycle."""
        sync, *others = self._cycles.popleft()
        return [(sync, self._jump()), *[(frame, 1) for frame in others]]

    def _jump(self) -> int:
        """The jump of the first waiting SYNC."""
        stamps = self._stamps
        if self._measure:
            self._measure = False
            measured = measure_period(list(stamps), self.period_s) if NO_STAMP not in stamps else None
            self.period_s = self.period_s if measured is None else measured.period_s
        period_ns = self.period_s * 1e9
        stamp = stamps.popleft()
        if stamp == NO_STAMP:
            return 1
        due, last, self._last = self._due_ns, self._last, stamp
        if due is None or (last is not None and stamp < last - period_ns):  # the clock was set back
            earliest = min([float(stamp), *(s - (k + 1) * period_ns for k, s in enumerate(stamps))])
            self._due_ns = earliest + period_ns
            return 1
        late = (stamp - due) / period_ns
        if late < _EXTRA:
            return 0
        lost = 0
        if late > 0.5:
            lost = max(
                0, round(min([late, *((s - due) / period_ns - (k + 1) for k, s in enumerate(stamps))]))
            )
        left = late - lost
        self._due_ns = due + (1 + lost + (_FOLLOW * left if abs(left) < 0.5 else 0.0)) * period_ns
        return 1 + lost


class Assembly:
    """Makes the cycles of numbered frames, and follows what else they say of the nodes' mapping.

    Args:
        joint: with the period of SYNC.
        listener: knows the mapping of its nodes.

    Raises:
        DriveError: the mapping lacks a signal.
    """

    def __init__(self, joint: JointFile, listener: PassiveConfigurator) -> None:
        self.assembler = make_assembler(joint, tuple(listener.layouts.values()))  # makes the samples
        self._recent = RecentSamples(joint.bus.period_s)
        self.follower = follow_log(listener, self.assembler, self._recent)
        self._stamp_ns = self._before_ns = 0  # of the newest SYNC, and of the one before

    def cycle(self, can_id: int, data: bytes, jump: int, stamp_ns: int) -> Cycle | None:
        """Take a frame; return the cycle that it ends, if any."""
        assembler = self.assembler
        sample = assembler.feed(can_id, data, jump)
        if can_id == SYNC_COB_ID and jump > 0:
            self._before_ns, self._stamp_ns = self._stamp_ns, stamp_ns
        if sample is not None:
            at_ns = self._before_ns if sample.sequence != assembler.sequence else self._stamp_ns
            return Cycle(sample.sequence, at_ns, sample, assembler.flags)
        if can_id == SYNC_COB_ID and jump and (missed := assembler.missed) >= 0:
            return Cycle(missed, self._before_ns, None, assembler.flags)
        return None

    def follow(self, can_id: int, data: bytes, sample: Sample | None, now_s: float) -> None:
        """Compare a frame with the mapping, after its cycle was made."""
        if sample is not None:
            self._recent.add(sample)
        if can_id in OF_MAPS or can_id == SYNC_COB_ID:
            self.follower.feed(can_id, data, now_s)


class FrameSamples:
    """Takes frames in bus order and makes the samples of one joint, as its daemon would.

    Args:
        listener: knows the mapping of its nodes, or takes it from the frames.
    """

    def __init__(self, joint: JointFile, listener: PassiveConfigurator) -> None:
        self._joint, self._listener = joint, listener
        self._numbering = SyncNumbering(joint.bus.period_s, measure=True)
        self._assembly: Assembly | None = None
        self._lacking = ""  # missing parts of a known mapping

    @property
    def period_s(self) -> float:
        """Of SYNC, measured."""
        return self._numbering.period_s

    @property
    def joint(self) -> JointFile:
        """The joint, with the measured period of SYNC."""
        return self._joint.timed(self.period_s)

    @property
    def missing(self) -> str:
        """Why there are no samples; empty: not known."""
        reasons = [self._lacking, *map(str, self._listener.missing.values()), *self._listener.doubts.values()]
        return next((text for text in reasons if text), "")

    def feed(self, frame: LoggedFrame) -> list[tuple[Sample, int]]:
        """Take a frame; return the samples that are certain now, and the stamps of their SYNCs."""
        return self._made(self._numbering.push(frame))

    def rest(self) -> list[tuple[Sample, int]]:
        """Return the samples that wait for later SYNCs."""
        return self._made(self._numbering.rest())

    def _made(self, numbered: list[tuple[LoggedFrame, int]]) -> list[tuple[Sample, int]]:
        found = []
        for (stamp_ns, can_id, data, _), jump in numbered:
            assembly = self._assembly or self._begun(can_id, data, stamp_ns * 1e-9)
            if assembly is not None:
                made = assembly.cycle(can_id, data, jump, stamp_ns)
                sample = None if made is None else made.sample
                assembly.follow(can_id, data, sample, stamp_ns * 1e-9)
                found += [] if made is None or sample is None else [(sample, made.stamp_ns)]
        return found

    def _begun(self, can_id: int, data: bytes, now_s: float) -> Assembly | None:
        """Take the mapping from a frame; None: that of some node is not known yet."""
        listener, passive = self._listener, not self._joint.bus.configure
        if self._lacking:
            return None
        if can_id in (OF_MAPS if passive else OF_SDO):
            listener.feed(can_id, data, now_s)
            listener.poll(now_s)
        if not listener.busy:
            try:
                self._assembly = Assembly(self.joint, listener)
            except DriveError as error:
                self._lacking = str(error)
        return self._assembly
