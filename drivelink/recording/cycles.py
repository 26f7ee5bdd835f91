"""Recorded cycles as input of the pipeline; those of raw frames are numbered by later SYNCs.

`SyncClock` has to decide at once, and cannot distinguish late SYNCs from what follows a lost one.
"""

from collections.abc import Iterable, Iterator, Sequence
from typing import NamedTuple

from drivelink._core import SYNC_COB_ID, JointPipeline, SyncNumbering, Tick
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
_FOLLOWED = OF_MAPS | {SYNC_COB_ID}


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


Numbered = tuple[Sequence[LoggedFrame], int]
"""Frames, and the jump of the SYNC that may be the first: periods since the one before, 0 if not due."""


def numbered_at_once(frames: Iterable[LoggedFrame], period_s: float) -> Iterator[Numbered]:
    """Each frame, its SYNC numbered as in the live loop."""
    clock = SyncClock(period_s)
    for frame in frames:
        if frame.can_id == SYNC_COB_ID and frame.stamp_ns != NO_STAMP:
            yield (frame,), clock.jump(frame.stamp_ns)
        else:
            yield (frame,), 1


def numbered_ahead(frames: Iterable[LoggedFrame], period_s: float) -> Iterator[Numbered]:
    """Each SYNC, numbered by later ones, with the frames until the next one."""
    numbering = SyncNumbering(period_s)
    yield from filter(None, map(numbering.push, frames))
    yield from iter(numbering.pop, None)


def measured_period(stamps_ns: Sequence[int], period_s: float) -> float:
    """Return the period of SYNCs from their stamps, or the expected one."""
    measured = None if NO_STAMP in stamps_ns else measure_period(stamps_ns, period_s)
    return period_s if measured is None else measured.period_s


def seconds(stamp_ns: int, sync: int, period_s: float) -> float:
    """Return the time of a frame; in a log without stamps, that of its SYNC."""
    return stamp_ns * 1e-9 if stamp_ns != NO_STAMP else sync * period_s


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
        self._period_s = joint.bus.period_s
        self._recent = RecentSamples(self._period_s)
        self.follower = follow_log(listener, self.assembler, self._recent)
        self._stamp_ns = self._before_ns = 0  # of the newest SYNC, and of the one before

    def cycles(self, frames: Iterable[LoggedFrame], jump: int) -> Iterator[Cycle]:
        """Process numbered frames; yield the cycles that they end."""
        assembler, feed = self.assembler, self.assembler.feed
        for stamp_ns, can_id, data, _ in frames:
            cycle, sample, is_sync = None, feed(can_id, data, jump), can_id == SYNC_COB_ID
            if sample is None and can_id not in _FOLLOWED:
                continue
            if is_sync and jump > 0:
                self._before_ns, self._stamp_ns = self._stamp_ns, stamp_ns
            if sample is not None:
                at_ns = self._before_ns if sample.sequence != assembler.sequence else self._stamp_ns
                cycle = Cycle(sample.sequence, at_ns, sample, assembler.flags)
                self._recent.add(sample)
            elif is_sync and jump and (missed := assembler.missed) >= 0:
                cycle = Cycle(missed, self._before_ns, None, assembler.flags)
            if is_sync:  # it is compared with the mapping after its cycle was made
                self.follower.sync()
            elif can_id in OF_MAPS:
                self.follower.feed(can_id, data, seconds(stamp_ns, assembler.sequence, self._period_s))
            if cycle is not None:
                yield cycle


class FrameSamples:
    """Takes frames in bus order and makes the samples of one joint, as its daemon would.

    Args:
        listener: knows the mapping of its nodes, or takes it from the frames.
    """

    def __init__(self, joint: JointFile, listener: PassiveConfigurator) -> None:
        self._joint, self._listener = joint, listener
        self._numbering = SyncNumbering(joint.bus.period_s, measured_period)
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
        """Process a frame; return the samples that are certain now, and the stamps of their SYNCs."""
        found = self._numbering.push(frame)
        return self._made(() if found is None else (found,))

    def rest(self) -> list[tuple[Sample, int]]:
        """Return the samples that wait for later SYNCs."""
        return self._made(iter(self._numbering.pop, None))

    def _made(self, numbered: Iterable[Numbered]) -> list[tuple[Sample, int]]:
        found = []
        for frame, jump in ((frame, jump) for frames, jump in numbered for frame in frames):
            assembly = self._assembly or self._begun(frame.can_id, frame.data, frame.stamp_ns * 1e-9)
            made = () if assembly is None else assembly.cycles((frame,), jump)
            found += [(cycle.sample, cycle.stamp_ns) for cycle in made if cycle.sample is not None]
        return found

    def _begun(self, can_id: int, data: bytes, now_s: float) -> Assembly | None:
        """Return the mapping from a frame; None: that of some node is not known yet."""
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
