"""Plays a recording through the pipeline of live data, and writes, publishes and counts what comes out."""

import logging
import math
import time
from array import array
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from functools import partial
from itertools import dropwhile
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from drivelink._core import Assembler, JointPipeline, Tick
from drivelink.cycle.pipeline import build
from drivelink.errors import DrivelinkError, RecordingError, UsageError
from drivelink.jointfile import JointFile
from drivelink.output.numbers import number, with_interval
from drivelink.pubsub.publisher import JointPublisher, finite
from drivelink.recording import read
from drivelink.recording.canframes import FrameLog, is_frame_log
from drivelink.recording.columns import ColumnMap
from drivelink.recording.cycles import Cycle, estimated
from drivelink.recording.mapping import joint_of
from drivelink.recording.mcapfile import SNAPSHOT, read_attachment, recorded_cycles, warn_of_another
from drivelink.recording.messages import estimate_columns, estimate_row, external_columns, external_row
from drivelink.recording.sinks import SafeFile
from estimator.online import Estimator
from estimator.reasons import percent, why_not_valid
from estimator.sample import SIGMA_95, FloatArray, Status

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
        cycles: Callable[[JointPipeline], Iterable[Cycle]],
        start_s: float = 0.0,
    ) -> None:
        self.motors = len(joint.motor)  # number of motors
        self.period_s = period_s  # of recording and estimator
        self.total = total  # number of cycles, if known
        # Samples are its input, by whatever they were made.
        self.pipeline = JointPipeline(Assembler((), 0), *build(joint.timed(period_s)))
        self._cycles, self._start_s = cycles, start_s

    def __iter__(self) -> Iterator[Played]:
        start_s, last = self._start_s, None
        for tick in estimated(self._cycles(self.pipeline), self.pipeline):
            if last is not None and tick.sequence <= last.sequence:  # of a daemon that began again
                start_s += (last.sequence - tick.sequence) * self.period_s
                start_s += max(self.period_s, 1e-9 * (tick.stamp_ns - last.stamp_ns))
            last = tick
            yield Played(start_s + tick.sequence * self.period_s, tick)


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
        UsageError: `channel` or `frames` for what is no raw CAN log.
    """
    if is_frame_log(path, frames):
        log = FrameLog(path, joint, base_dir, channel)
        return Playback(joint, log.period_s, None, lambda _: log.cycles())
    if (option := "--channel" if channel is not None else "--frames" if frames else "") and path.exists():
        raise UsageError(f"{path}: {option}: expected a raw CAN log, this one has samples")
    if path.suffix.lower() == ".mcap":
        warn_of_another(path, joint.name)
        recorded = recorded_cycles(path, len(joint.motor), joint.recording.scale)
        resumed = partial(_resumed, recorded, path=path, joint=joint)
        return Playback(joint, joint.bus.period_s, None, resumed)
    record = read(path, joint, keep_nan=True, names=names)
    stamps = (round(time_s * 1e9) for time_s in record.time_s.tolist())
    cycles = (Cycle(one.sequence, at, one, 0) for one, at in zip(record.samples(), stamps, strict=True))
    return Playback(joint, record.period_s, len(record), lambda _: cycles, record.start_s)


def _resumed(
    cycles: Iterable[Cycle], pipeline: JointPipeline, path: Path, joint: JointFile
) -> Iterable[Cycle]:
    """Return the cycles after a recorded state, which the pipeline takes; all of them where there is none.

    A state of another model, of other settings, or of another version of drivelink is not used.
    """
    state = read_attachment(path, SNAPSHOT)
    if state is None:
        return cycles
    own = None
    with suppress(DrivelinkError):
        own = joint_of(path, None).joint
    try:
        if own is None or (own.model(), own.estimator) != (joint.model(), joint.estimator):
            raise ValueError("its state is of another model or other settings")
        last = pipeline.restore(state)
    except ValueError as error:
        _LOG.warning("%s: the estimator begins anew: %s", path, error)
        return cycles
    return dropwhile(lambda cycle: cycle.sequence <= last, cycles)


_STATUS_EVERY_S = 0.25
_ROWS = 2048  # rows per write
# Plain integers: an IntFlag costs a microsecond.
_VALID, _OBSERVABLE = int(Status.VALID), int(Status.OBSERVABLE)
_APART = {"torque_valid": int(Status.TORQUE_VALID), "stiffness_valid": int(Status.STIFFNESS_VALID)}


def _columns(motors: int) -> tuple[str, ...]:
    """Names of a cycle's values, in the order of `_row`."""
    return (*estimate_columns(motors), "valid", "status", *_APART, "flexibility_torque_std_nm")


def _row(played: Played, estimator: Estimator) -> tuple[float, ...]:
    """Return a cycle, the last of the estimator, as the values of `_columns`."""
    estimate = played.tick.estimate
    row = estimate_row(round(played.time_s, 9), estimate)
    apart = (int(estimate.status & bit > 0) for bit in _APART.values())
    return (*row, estimate.status & _VALID, estimate.status, *apart, estimator.flexibility_torque_std_nm)


class EstimatesFile:
    """Writes estimates.csv, one row per cycle; placed on `close`.

    Args:
        linked: with declared link dynamics; adds columns of the external torque.

    Raises:
        RecordingError: it cannot be opened or, later, written; an existing file is unchanged.
    """

    def __init__(
        self, path: Path, motors: int, estimator: Estimator, *, linked: bool = False, force: bool = False
    ) -> None:
        columns = _columns(motors) + (external_columns() if linked else ())
        self._linked, self._estimator = linked, estimator
        self._line = ",".join(["%r"] * len(columns)) + "\n"
        self._file, self._count = SafeFile(path, force=force), 0
        self._file.write((",".join(columns) + "\n").encode())

    def write(self, played: Played) -> None:
        """Write one row."""
        row = _row(played, self._estimator)
        row += external_row(played.tick.external) if self._linked else ()
        self._file.write((self._line % row).encode())
        self._count += 1
        if self._count % _ROWS == 0:
            self._write()

    def close(self) -> None:
        """Place the file, unless writing has failed."""
        if not self._file.closed:
            self._write()
            self._file.close()

    def _write(self) -> None:
        try:
            self._file.flush()
        except RecordingError:
            self._file.abandon()
            raise


class Publication:
    """Publishes the cycles like the daemon, with present stamps.

    Args:
        speed: recorded seconds per second; None: as fast as possible.
        about: text on the replay in the status document.
    """

    def __init__(self, publisher: JointPublisher | None, speed: float | None, about: dict[str, Any]) -> None:
        self._publisher = publisher
        self._speed = speed
        self._about = about
        self._begin_s = 0.0
        self._begin_ns = self._begin_unix_ns = 0
        self._status_due_s = 0.0
        self._count = 0

    def write(self, played: Played) -> None:
        """Wait until a cycle is due, and publish it."""
        if not self._count:
            self._begin_s = played.time_s
            self._begin_ns, self._begin_unix_ns = time.monotonic_ns(), time.time_ns()
        self._count += 1
        passed_s = played.time_s - self._begin_s
        if self._speed is not None:
            due_ns = self._begin_ns + round(passed_s / self._speed * 1e9)
            wait_ns = due_ns - time.monotonic_ns()
            if wait_ns > 0:
                time.sleep(wait_ns * 1e-9)
        if self._publisher is not None:
            stamp_ns = self._begin_unix_ns + round(passed_s / (self._speed or 1.0) * 1e9)
            self._publisher.put(played.tick.stamped(stamp_ns))
        if passed_s >= self._status_due_s:
            self._status_due_s = passed_s + _STATUS_EVERY_S * (self._speed or 1.0)
            self._status("replay", passed_s)

    def close(self) -> None:
        """Publish the end of the replay."""
        self._status("ended", self._status_due_s)

    def _status(self, state: str, passed_s: float) -> None:
        if self._publisher is not None:
            status = {**self._about, "state": state, "time_s": passed_s, "cycles": self._count}
            self._publisher.put_status(status)


class Summary:
    """Counts cycles, and why they are not valid; keeps the columns for plots."""

    def __init__(self, motors: int, estimator: Estimator, keep: bool) -> None:
        self._estimator = estimator
        self._why: dict[str, tuple[int, str, float]] = {}  # by its key: cycles, the last sentence, first time
        self.count = self.fresh = self.valid = self.observable = 0
        self._keep = keep
        self._width = len(_columns(motors))
        self._motors = motors
        self._values = array("d")
        self._last: Played | None = None
        self._first_s = 0.0
        self._sampled: tuple[int, ...] = ()  # number of the first sample, and of the last

    def write(self, played: Played) -> None:
        """Count one cycle."""
        if not self.count:
            self._first_s = played.time_s
        self.count += 1
        if played.tick.fresh:
            sequence = played.tick.estimate.sequence
            self._sampled = (self._sampled or (sequence,))[0], sequence
            self.fresh += 1
        status = played.tick.status
        if status & _VALID:
            self.valid += 1
        elif (why := why_not_valid(status, self._estimator)) is not None:
            key, text = why
            if key == "rejected" and (suspicion := self._estimator.suspicion()) is not None:
                key, text = suspicion["text"], f"{text}: {suspicion['text']}"
            count, _, first_s = self._why.get(key, (0, "", played.time_s))
            self._why[key] = count + 1, text, first_s
        self.observable += status & _OBSERVABLE != 0
        self._last = played
        if self._keep:
            self._values.extend(_row(played, self._estimator))

    def text(self, took_s: float) -> str:
        """Return the replay in one line."""
        if self._last is None:
            return "no cycle in it"
        seconds = self._last.time_s - self._first_s
        estimate = self._last.tick.estimate
        half = SIGMA_95 * estimate.stiffness_std_nm_rad
        missing, periods = self._missing()
        gaps = f"{missing} of {periods} samples missing, " if missing else ""
        stiffness = with_interval(estimate.stiffness_nm_rad, half, "N·m/rad")
        end = f"; at the end stiffness {stiffness}" if math.isfinite(estimate.stiffness_nm_rad) else ""
        return (
            f"{self.count} cycles, {gaps}{seconds:.6g} s, in {took_s:.3g} s "
            f"({number(seconds / max(took_s, 1e-9), 3)} × real time); "
            f"valid {100 * self.valid / self.count:.1f} %, "
            f"observable {100 * self.observable / self.count:.1f} %{end}"
        )

    def _missing(self) -> tuple[int, int]:
        """Return the periods without a sample, of how many from the first to the last one, as fit counts."""
        periods = self._sampled[-1] - self._sampled[0] + 1 if self._sampled else 0
        return max(periods - self.fresh, 0), periods

    def reasons(self) -> list[str]:
        """Return why cycles are not valid, most frequent first: share of the cycles, first time, sentence."""
        shares = [(count / self.count, text, first_s) for count, text, first_s in self._sorted()]
        return [
            f"{'less than 0.1 %' if share < 0.001 else percent(share, 1)} of the cycles, "
            f"first at {first_s:.3f} s: {text}"
            for share, text, first_s in shares
        ]

    def _sorted(self) -> list[tuple[int, str, float]]:
        return sorted(self._why.values(), reverse=True)

    def document(self) -> dict[str, Any]:
        """Return the summary of the replay as a JSON document; non-finite values are None."""
        estimate = self._last.tick.estimate if self._last is not None else None
        names = ("stiffness_nm_rad", "stiffness_std_nm_rad", "flexibility_torque_nm")
        return {
            "seconds": round(self._last.time_s - self._first_s, 6) if self._last is not None else 0.0,
            "cycles": self.count,
            "samples_missing": self._missing()[0],
            "valid": self.valid,
            "observable": self.observable,
            "not_valid": [
                {"reason": text, "cycles": n, "first_s": round(first, 6)} for n, text, first in self._sorted()
            ],
            "end": finite({name: getattr(estimate, name, None) for name in names}),
        }

    def plot(self, folder: Path, title: str) -> list[Path]:
        """Write stiffness over deflection, and torque and stiffness over time."""
        from drivelink.output.plots import plot_curves, plot_over_time  # matplotlib on demand

        folder.mkdir(parents=True, exist_ok=True)
        table = np.frombuffer(self._values, dtype=np.float64).reshape(-1, self._width)
        columns: dict[str, FloatArray] = dict(zip(_columns(self._motors), table.T, strict=True))
        return [
            plot_curves(columns, self._motors, folder / "stiffness.png", title),
            plot_over_time(columns, folder / "time.png", title),
        ]
