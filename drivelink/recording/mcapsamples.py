"""Reads the samples of an MCAP recording, one by one or as a record."""

from __future__ import annotations

import math
from array import array
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np

from drivelink.errors import RecordingError
from drivelink.jointfile import JointFile
from drivelink.jointfile.columns import COLUMNS
from drivelink.recording.columns import record_from_columns
from drivelink.recording.cycles import Cycle
from drivelink.recording.limits import require_samples
from drivelink.recording.mcapfile import message_fields, read_messages
from drivelink.recording.messages import read_sample
from estimator.sample import Record, Status

_STALE = int(Status.STALE)
_SERVICE = Status.having("replayed")
_APART = 64  # largest distance in cycles between a sample and its estimate in the file


def recorded_cycles(path: Path, motors: int, scale: Mapping[str, float] | None = None) -> Iterator[Cycle]:
    """Yield the cycles of a recording in order.

    A sample gets the flags of its estimate; a stale estimate is a cycle without sample.

    Args:
        scale: factors by column, as `[recording]` of the joint file gives them.

    Raises:
        RecordingError: no samples in it.
    """
    waiting: dict[int, Cycle] = {}
    newest, found = -1, False
    for message in read_messages(path, frozenset({"sample", "estimate"})):
        try:
            fields = message_fields(message.data)
            if message.topic.endswith("/sample"):
                for name, factor in (scale or {}).items():
                    if isinstance(fields.get(name), float):
                        fields[name] *= factor
                if not found and f"motor{motors + 1}_position_rad" in fields:
                    raise RecordingError(f"{path}: has more motors than the joint file, which has {motors}")
                sample = read_sample(fields, motors)
                _require_number(sample.sequence)
                found = True
                before = waiting.get(sample.sequence)
                cycle = Cycle(sample.sequence, message.log_time_ns, sample, before.flags if before else 0)
            else:
                sequence, flags = int(fields["sequence"]), int(fields["status"]) & (_SERVICE | _STALE)
                _require_number(sequence)
                before = waiting.get(sequence)
                cycle = Cycle(sequence, message.log_time_ns, before.sample if before else None, flags)
        except (ValueError, KeyError, TypeError, OverflowError, RecursionError) as error:
            raise _strange(path, message.topic, error) from error
        if cycle.sequence < newest - _APART:  # the daemon restarted: numbering begins again
            yield from _released(waiting, newest + 1)
            newest = -1
        newest = max(newest, cycle.sequence)
        waiting[cycle.sequence] = cycle
        if len(waiting) > 2 * _APART:
            yield from _released(waiting, newest - _APART)
    yield from _released(waiting, newest + 1)
    if not found:
        raise RecordingError(f"{path}: no samples in it (with raw frames in it: replay --frames)")


def _released(waiting: dict[int, Cycle], until: int) -> Iterator[Cycle]:
    """Yield the cycles before `until` in order; drop estimates without a recorded sample."""
    for sequence in sorted(waiting):
        if sequence >= until:
            break
        cycle = waiting.pop(sequence)
        if cycle.sample is not None or cycle.flags & _STALE:
            yield cycle._replace(flags=cycle.flags & _SERVICE)


def read_mcap(path: Path, joint: JointFile | None, keep_nan: bool) -> Record:
    """Read the samples of an MCAP recording.

    Raises:
        RecordingError: it cannot be read, or has no or too many samples.
    """
    columns: dict[str, array[float]] = {}
    count = 0
    for message in read_messages(path, frozenset({"sample"})):
        try:
            row = message_fields(message.data)
            if not count:
                columns = {name: array("d") for name in row if name in COLUMNS}
            for name, values in columns.items():
                value = row.get(name)
                values.append(math.nan if value is None else value)
        except (ValueError, TypeError, OverflowError, RecursionError) as error:
            raise _strange(path, message.topic, error) from error
        count += 1
        require_samples(count, str(path))
    if not count:
        raise RecordingError(f"{path}: no samples in it (with raw frames in it: replay --frames)")
    table = {name: np.frombuffer(values, dtype=np.float64) for name, values in columns.items()}
    return record_from_columns(table, str(path), joint, keep_nan)


def _require_number(sequence: int) -> None:
    if not 0 <= sequence < 1 << 62:
        raise ValueError(f"expected a sequence from 0 to 2^62, got {sequence}")


def _strange(path: Path, topic: str, error: Exception) -> RecordingError:
    return RecordingError(f"{path}: {topic[:80]} is no message of drivelink: {error}")
