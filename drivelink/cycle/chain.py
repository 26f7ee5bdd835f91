"""One joint from frames to estimate: assembler, estimator, watch. The one path for live, lockstep and replay.

Pure as its parts are: no clock, no bus, no key. What the service knows of the estimate's quality is added
to the status here: drive faults, missing frames, and estimates carried on without fresh measurements.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Sequence
from typing import Any, Protocol

from drivelink.canopen.layout import NodeLayout
from drivelink.cycle.acquisition import Assembler
from drivelink.errors import DriveError
from drivelink.floor import make_watch
from drivelink.jointfile import JointFile
from estimator import Estimator, make_estimator
from estimator.sample import Estimate, Sample, Status

__all__ = ["Built", "Chain", "Watch", "build", "make_assembler", "make_chain"]

_OF_A_SAMPLE = int(Status.VALID | Status.NODE_RESTARTED)  # never of an estimate that is carried on
_STALE = int(Status.STALE)
_RESTARTED = int(Status.RESTARTED)
_NODE_RESTARTED = int(Status.NODE_RESTARTED)
_UNTIMED = int(Status.UNTIMED)
_MODEL_ALARM = int(Status.MODEL_ALARM)
_HOLD_S, _HOLD_PERIODS = 0.25, 10  # of silence, and at least so many, see `Assembler`


class Watch(Protocol):
    """Judges on line whether the model is still sufficient."""

    def step(self, sample: Sample, estimate: Estimate, residual_nm: float) -> bool:
        """Whether the alarm is on after this tick."""

    def describe(self) -> dict[str, Any]:
        """What it found, for the status key: residual against floor, likely location."""


Built = tuple[Estimator, Watch | None]


def build(joint: JointFile) -> Built:
    """Estimator and watch of a joint."""
    return make_estimator(joint.model(), joint.estimator, joint.bus.period_s), make_watch(joint)


def make_assembler(joint: JointFile, layouts: Sequence[NodeLayout]) -> Assembler:
    """The assembler of a joint file whose nodes send by these layouts.

    Raises:
        DriveError: the layouts lack something that the joint's model needs.
    """
    hold = max(_HOLD_PERIODS, round(_HOLD_S / joint.bus.period_s))
    assembler = Assembler(layouts, len(joint.motor), active=joint.bus.configure, hold_periods=hold)
    if joint.model().has_deflection and not assembler.has_link:
        raise DriveError(
            f"{joint.name}: no frame carries the link position: expected [link.encoder], "
            'or transmission.model = "none"'
        )
    return assembler


def make_chain(joint: JointFile, layouts: Sequence[NodeLayout], *, keep: int = 0) -> Chain:
    """The chain of a joint file whose nodes send by these layouts; arguments as for `Chain`.

    Raises:
        DriveError: the layouts lack something that the joint's model needs.
    """
    return Chain(make_assembler(joint, layouts), *build(joint), keep=keep)


class Chain:
    """Frames of one joint in, estimates out.

    Args:
        assembler: makes the samples.
        estimator: steps once a sample.
        watch: raises the model alarm, if there is one.
        keep: how many of the last samples are kept, for a new estimator to start from.

    Attributes:
        estimate: the last one, None before the first.
        sample: what the last estimate was made from; None where it was carried on.
        missed: cycles that gave no sample.
        history: the last samples.
    """

    def __init__(
        self, assembler: Assembler, estimator: Estimator, watch: Watch | None = None, *, keep: int = 0
    ) -> None:
        self.assembler = assembler
        self.estimator = estimator
        self.watch = watch
        self.estimate: Estimate | None = None
        self.sample: Sample | None = None
        self.missed = 0
        self.history: deque[Sample] = deque(maxlen=keep)

    def feed(self, cob_id: int, data: bytes, jump: int = 1) -> Estimate | None:
        """Take one frame (see `Assembler.feed`); returns the estimate that it leads to, if it does.

        A cycle that is closed without a sample gives the last estimate again, under its own sequence
        number, stale and not valid.
        """
        assembler = self.assembler
        sample = assembler.feed(cob_id, data, jump)
        if sample is not None:
            return self.take(sample, assembler.flags)
        if assembler.missed >= 0:
            missed, assembler.missed = assembler.missed, -1
            self.missed += 1
            return self.carry_on(missed, assembler.flags)
        return None

    def take(self, sample: Sample, flags: int = 0) -> Estimate:
        """Take one sample, as the assembler gives it or as it was recorded.

        Args:
            sample: of the cycle.
            flags: service bits of `Status` that hold for it.
        """
        estimator = self.estimator
        if flags & _NODE_RESTARTED:
            estimator.reset()
            flags |= _RESTARTED
        if flags & _UNTIMED:
            estimator.distrust()
        estimate = estimator.step(sample)
        if self.watch is not None and self.watch.step(sample, estimate, estimator.residual_nm):
            flags |= _MODEL_ALARM
        if flags:
            estimate = estimate._replace(status=int(estimate.status) | flags)
        self.history.append(sample)
        self.sample = sample
        self.estimate = estimate
        return estimate

    def carry_on(self, sequence: int, flags: int = 0) -> Estimate | None:
        """The last estimate under a new number: stale, not valid; None where there never was one."""
        if self.estimate is None:
            return None
        status = int(self.estimate.status) & ~_OF_A_SAMPLE | _STALE | flags
        self.sample = None
        self.estimate = self.estimate._replace(sequence=sequence, status=status)
        return self.estimate

    def exchange(self, estimator: Estimator, watch: Watch | None, unseen: Iterable[Sample] = ()) -> None:
        """Put another estimator in place between two cycles, after it has seen the last samples too."""
        for sample in unseen:
            estimator.step(sample)
        self.estimator, self.watch = estimator, watch
