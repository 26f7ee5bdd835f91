"""Recorded cycles as input of the pipeline; those of raw frames are numbered by later SYNCs.

Recorded stamps are often arrival times, which come in bursts. After a late SYNC others catch up; after a lost
one all stay behind. `SyncClock` has to decide at once and cannot distinguish them.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator
from itertools import islice
from typing import NamedTuple

from drivelink._core import SYNC_COB_ID, Assembler, JointPipeline, Tick
from drivelink.canopen.passive import PassiveConfigurator
from drivelink.cycle.following import MapFollower, follow_log
from drivelink.cycle.objectcheck import RecentSamples
from drivelink.cycle.pipeline import make_assembler
from drivelink.cycle.syncclock import SyncClock, measure_period
from drivelink.errors import DriveError, DrivelinkError
from drivelink.jointfile import JointFile
from drivelink.recording.canlog import NO_STAMP, LoggedFrame
from estimator.sample import Sample

_BATCH = 512


class Cycle(NamedTuple):
    """One recorded cycle."""

    sequence: int  # number of its SYNC
    stamp_ns: int  # UNIX time of its SYNC
    sample: Sample | None  # of this cycle, or None
    flags: int  # its service bits of `Status`


def estimated(cycles: Iterable[Cycle], pipeline: JointPipeline) -> Iterator[Tick]:
    """Pass the cycles through the pipeline; yield the output that the live loop publishes.

    Reading and estimating alternate in batches, which is faster than per cycle.
    """
    for batch in batches(cycles):
        for cycle in batch:
            sequence, stamp_ns, sample, flags = cycle
            if sample is not None:
                yield pipeline.take(sample, flags, stamp_ns)
            elif (tick := pipeline.carry_on(sequence, flags, stamp_ns)) is not None:
                yield tick


def batches(cycles: Iterable[Cycle]) -> Iterator[list[Cycle]]:
    """Yield lists of cycles; before an error of the recording, those up to it."""
    source = iter(cycles)
    error: DrivelinkError | None = None
    while error is None:
        batch: list[Cycle] = []
        try:
            batch.extend(islice(source, _BATCH))
        except DrivelinkError as broken:
            error = broken
        if batch:
            yield batch
        elif error is None:
            return
    raise error


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


class FrameSamples:
    """Takes frames in bus order and makes the samples of one joint, as its daemon would.

    Args:
        listener: knows the mapping of its nodes, or takes it from the frames.
    """

    def __init__(self, joint: JointFile, listener: PassiveConfigurator) -> None:
        self._joint, self._listener = joint, listener
        self._numbering = SyncNumbering(joint.bus.period_s, measure=True)
        self._recent = RecentSamples(joint.bus.period_s)
        self._assembler: Assembler | None = None
        self._follower: MapFollower | None = None
        self._lacking = ""  # missing parts of a known mapping
        self._stamp_ns = 0

    @property
    def period_s(self) -> float:
        """Of SYNC, measured."""
        return self._numbering.period_s

    @property
    def joint(self) -> JointFile:
        """The joint, with the measured period of SYNC."""
        bus = self._joint.bus.model_copy(update={"period_s": self.period_s})
        return self._joint.model_copy(update={"bus": bus})

    @property
    def assembling(self) -> bool:
        """Whether samples can be made: the mapping is known."""
        return self._assembler is not None

    @property
    def missing(self) -> str:
        """Why there are no samples; empty: not known."""
        reasons = [self._lacking, *map(str, self._listener.missing.values()), *self._listener.doubts.values()]
        return next((text for text in reasons if text), "")

    def take(self, frame: LoggedFrame) -> list[tuple[Sample, int]]:
        """Take a frame; return the samples that are certain now, and the stamps of their SYNCs."""
        return self._made(self._numbering.push(frame))

    def rest(self) -> list[tuple[Sample, int]]:
        """Return the samples that wait for later SYNCs."""
        return self._made(self._numbering.rest())

    def _made(self, numbered: list[tuple[LoggedFrame, int]]) -> list[tuple[Sample, int]]:
        return [made for frame, jump in numbered if (made := self._assemble(frame, jump)) is not None]

    def _assemble(self, frame: LoggedFrame, jump: int) -> tuple[Sample, int] | None:
        stamp_ns, cob_id, data, _ = frame
        if self._assembler is None and not self._begin(cob_id, data, stamp_ns * 1e-9):
            return None
        assert self._assembler is not None and self._follower is not None
        before_ns = self._stamp_ns
        if cob_id == SYNC_COB_ID and jump > 0:
            self._stamp_ns = stamp_ns
        sample = self._assembler.feed(cob_id, data, jump)
        if sample is not None:
            self._recent.add(sample)
        self._follower.feed(cob_id, data, stamp_ns * 1e-9)
        if sample is None:
            return None
        return sample, before_ns if sample.sequence != self._assembler.sequence else self._stamp_ns

    def _begin(self, cob_id: int, data: bytes, now_s: float) -> bool:
        """Take the mapping from a frame; return whether that of every node is known now."""
        listener, passive = self._listener, not self._joint.bus.configure
        if self._lacking:
            return False
        if 0x581 <= cob_id <= 0x67F or (passive and (cob_id == 0 or cob_id >= 0x700)):
            listener.feed(cob_id, data, now_s)
            listener.poll(now_s)
        if listener.busy:
            return False
        try:
            self._assembler = make_assembler(self.joint, tuple(listener.layouts.values()))
        except DriveError as error:
            self._lacking = str(error)
            return False
        self._follower = follow_log(listener, self._assembler, self._recent)
        return True
