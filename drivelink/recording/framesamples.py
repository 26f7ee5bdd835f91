"""Makes samples of a joint's frames without a daemon: mapping from the traffic, later SYNCs number one."""

from __future__ import annotations

from drivelink._core import SYNC_COB_ID, Assembler
from drivelink.canopen.passive import PassiveConfigurator
from drivelink.cycle.following import MapFollower, follow_log
from drivelink.cycle.objectcheck import RecentSamples
from drivelink.cycle.pipeline import make_assembler
from drivelink.errors import DriveError
from drivelink.jointfile import JointFile
from drivelink.recording.canlog import LoggedFrame
from drivelink.recording.syncnumbers import SyncNumbering
from estimator.sample import Sample


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
