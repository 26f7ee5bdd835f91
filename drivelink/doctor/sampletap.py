"""Makes samples from the frames of a passive bus, as the daemon would."""

from __future__ import annotations

import time

import can

from drivelink._core import SYNC_COB_ID, Assembler
from drivelink.canopen.passive import PassiveConfigurator
from drivelink.cycle.pipeline import make_assembler
from drivelink.cycle.syncclock import MEASURED_SYNCS, SyncClock, measure_period
from drivelink.errors import DriveError
from drivelink.jointfile import JointFile
from drivelink.recording.gate import Gathered
from estimator.sample import Sample


class SampleTap:
    """Takes frames in bus order and makes the samples of one joint.

    Args:
        joint: the joint.
        configurator: knows the mapping of its nodes, or takes it from the frames.

    Attributes:
        joint: the joint, with the measured period of SYNC.
        gathered: the samples of the first minute.
        samples: number of samples.
        latest: the last sample, or None.
    """

    def __init__(self, joint: JointFile, configurator: PassiveConfigurator) -> None:
        self.joint = joint
        self.gathered = Gathered(joint, joint.bus.period_s)
        self.samples = 0
        self.latest: Sample | None = None
        self._missing = ""
        self._configurator = configurator
        self._syncs_ns: list[int] = []
        self._clock: SyncClock | None = None
        self._assembler: Assembler | None = None

    @property
    def missing(self) -> str:
        """Why there are no samples."""
        reasons = [*map(str, self._configurator.missing.values()), self._missing]
        return next((text for text in reasons if text), "no SYNC, or not all of its frames")

    def take(self, message: can.Message) -> None:
        """One more frame."""
        if message.is_extended_id or message.is_remote_frame or message.is_error_frame:
            return
        cob_id, data = message.arbitration_id, bytes(message.data)
        stamp_s = message.timestamp or time.time()
        self._configurator.feed(cob_id, data, stamp_s)
        if self._configurator.poll(stamp_s):
            self._assembler = None  # a node has another mapping now
        stamp_ns = round(stamp_s * 1e9)
        if self._clock is None:
            self._measure(cob_id, stamp_ns)
        elif self._assembler is None:
            self._begin()
        else:
            jump = self._clock.jump(stamp_ns) if cob_id == SYNC_COB_ID else 1
            sample = self._assembler.feed(cob_id, data, jump)
            if sample is not None:
                self.samples += 1
                self.latest = sample
                self.gathered.add(sample)

    def _measure(self, cob_id: int, stamp_ns: int) -> None:
        """Measure the period from the first SYNCs."""
        if cob_id != SYNC_COB_ID:
            return
        self._syncs_ns.append(stamp_ns)
        if len(self._syncs_ns) < MEASURED_SYNCS:
            return
        period_s = self.joint.bus.period_s
        measured = measure_period(self._syncs_ns, period_s)
        if measured is not None and not measured.same:
            period_s = measured.period_s
        bus = self.joint.bus.model_copy(update={"period_s": period_s})
        self.joint = self.joint.model_copy(update={"bus": bus})
        self.gathered = Gathered(self.joint, period_s)
        self._clock = SyncClock(period_s)

    def _begin(self) -> None:
        """Make the assembler once the mapping of every node is known."""
        if self._configurator.busy:
            return
        try:
            self._assembler = make_assembler(self.joint, tuple(self._configurator.layouts.values()))
        except DriveError as error:
            self._missing = str(error)
