"""Plays a recording through the pipeline of live data: frames or samples in, estimates out."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Iterator
from itertools import dropwhile
from pathlib import Path
from typing import NamedTuple

from drivelink._core import Assembler, JointPipeline, Tick
from drivelink.cycle.pipeline import build
from drivelink.errors import DrivelinkError
from drivelink.jointfile import JointFile
from drivelink.recording import read
from drivelink.recording.canframes import FrameLog, is_frame_log
from drivelink.recording.columns import ColumnMap
from drivelink.recording.cycles import Cycle, estimated
from drivelink.recording.mapping import joint_of
from drivelink.recording.mcapfile import SNAPSHOT, read_attachment, recorded_cycles
from estimator.sample import Sample

_LOG = logging.getLogger("drivelink.recording")


class Played(NamedTuple):
    """One recorded cycle and its estimate."""

    time_s: float  # of its SYNC, in the recording's time
    # output as published by the daemon, stamped with the UNIX time of its SYNC if recorded, else with
    # `time_s` in ns
    tick: Tick


class Playback:
    """The cycles of a recording in order, estimated on iteration."""

    def __init__(
        self,
        joint: JointFile,
        period_s: float,
        total: int | None,
        cycles: Callable[[JointPipeline], Iterator[Played]],
    ) -> None:
        self.motors = len(joint.motor)  # number of motors
        self.period_s = period_s  # of recording and estimator
        self.total = total  # number of cycles, if known
        # Samples are its input, by whatever they were made.
        self.pipeline = JointPipeline(Assembler((), 0), *build(joint.timed(period_s)))
        self._cycles = cycles

    def __iter__(self) -> Iterator[Played]:
        return self._cycles(self.pipeline)


def open_playback(
    path: Path,
    joint: JointFile,
    base_dir: Path,
    *,
    frames: bool | None = None,
    channel: str | None = None,
    names: ColumnMap | None = None,
) -> Playback:
    """Open a recording of any format for playback.

    Args:
        base_dir: folder of the joint file, base of its EDS files.
        frames: of an MCAP file, play the raw frames (True) or the samples (False); None: the samples, and
            the frames where there are none.
        channel: of a raw CAN log with several.
        names: columns of a CSV file with other names or units.

    Raises:
        RecordingError: it cannot be read, or is incomplete.
    """
    period_s, recorded, state = joint.bus.period_s, None, None
    if is_frame_log(path, frames):
        log = FrameLog(path, joint, base_dir, channel)
        period_s, recorded = log.period_s, log.cycles()
    elif path.suffix.lower() == ".mcap":
        recorded = recorded_cycles(path, len(joint.motor), joint.recording.scale)
        state = _state(path, joint)
    if recorded is not None:
        return Playback(
            joint,
            period_s,
            None,
            lambda pipeline: _played(estimated(_after(state, recorded, pipeline, path), pipeline), period_s),
        )
    record = read(path, joint, keep_nan=True, names=names)
    times = record.time_s.tolist()
    return Playback(
        joint,
        record.period_s,
        len(record),
        lambda pipeline: _from_samples(record.samples(), times, pipeline),
    )


def _from_samples(samples: Iterable[Sample], times: list[float], pipeline: JointPipeline) -> Iterator[Played]:
    step = pipeline.step
    for time_s, sample in zip(times, samples, strict=True):
        yield Played(time_s, step(sample, 0, round(time_s * 1e9)))


def _state(path: Path, joint: JointFile) -> bytes | None:
    """Return the state in which a recording's estimator begins; None: none of this joint file's model."""
    state = read_attachment(path, SNAPSHOT)
    if state is None:
        return None
    try:
        own = joint_of(path, None).joint
    except DrivelinkError:
        own = None
    if own is None or (own.model(), own.estimator) != (joint.model(), joint.estimator):
        _LOG.warning("%s: the estimator begins anew: its state is of another model or other settings", path)
        return None
    return state


def _after(
    state: bytes | None, cycles: Iterable[Cycle], pipeline: JointPipeline, path: Path
) -> Iterable[Cycle]:
    """Return the cycles after a recorded state, which the pipeline takes; all of them where there is none.

    A state of another version of drivelink is not used.
    """
    if state is None:
        return cycles
    try:
        last = pipeline.restore(state)
    except ValueError as error:
        _LOG.warning("%s: the estimator begins anew: %s", path, error)
        return cycles
    return dropwhile(lambda cycle: cycle.sequence <= last, cycles)


def _played(ticks: Iterable[Tick], period_s: float) -> Iterator[Played]:
    for tick in ticks:
        yield Played(tick.sequence * period_s, tick)
