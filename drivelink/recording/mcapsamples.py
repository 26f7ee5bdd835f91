"""The samples of an MCAP recording, one by one or as a record, and the joint file it carries."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from drivelink.errors import RecordingError
from drivelink.jointfile import JointFile
from drivelink.recording.columns import KNOWN, record_from_columns
from drivelink.recording.cycles import Cycle
from drivelink.recording.mcapfile import read_messages
from drivelink.recording.messages import read_sample
from estimator.sample import Record, Status

__all__ = ["read_mcap", "recorded_cycles", "recorded_joint"]

_STALE = int(Status.STALE)
_SERVICE = int(Status.DRIVE_FAULT | Status.BUS_FAULT | Status.UNTIMED | Status.NODE_RESTARTED)
_APART = 64  # cycles that a sample and its estimate may be apart in the file


def recorded_joint(path: Path) -> tuple[str, Path] | None:
    """Text and folder of the joint file that a recording carries, if it does."""
    for message in read_messages(path, frozenset({"joint"})):
        document = json.loads(message.data)
        return str(document["text"]), Path(document.get("folder") or ".")
    return None


def recorded_cycles(path: Path, motors: int) -> Iterator[Cycle]:
    """The cycles of a recording in order of their number.

    A sample gets the flags of its estimate; an estimate that was carried on is a cycle without sample.

    Raises:
        RecordingError: no samples in it.
    """
    waiting: dict[int, Cycle] = {}
    newest, found = -1, False
    for message in read_messages(path, frozenset({"sample", "estimate"})):
        try:
            fields: dict[str, Any] = json.loads(message.data)
            if message.topic.endswith("/sample"):
                sample = read_sample(fields, motors)
                found = True
                before = waiting.get(sample.sequence)
                cycle = Cycle(sample.sequence, message.log_time_ns, sample, before.flags if before else 0)
            else:
                sequence, flags = int(fields["sequence"]), int(fields["status"]) & (_SERVICE | _STALE)
                before = waiting.get(sequence)
                cycle = Cycle(sequence, message.log_time_ns, before.sample if before else None, flags)
        except (ValueError, KeyError, TypeError) as error:
            raise RecordingError(f"{path}: {message.topic} is no message of drivelink: {error}") from error
        if cycle.sequence < newest - _APART:  # the daemon was started anew: numbers begin again
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
    """Take the cycles before `until` out, in order; an estimate whose sample was not recorded is dropped."""
    for sequence in sorted(waiting):
        if sequence >= until:
            break
        cycle = waiting.pop(sequence)
        if cycle.sample is not None or cycle.flags & _STALE:
            yield cycle._replace(flags=cycle.flags & _SERVICE)


def read_mcap(path: Path, joint: JointFile | None, keep_nan: bool) -> Record:
    """Read the samples of an MCAP recording.

    Raises:
        RecordingError: it cannot be read, or has no samples in it.
    """
    rows: list[dict[str, Any]] = [
        json.loads(message.data) for message in read_messages(path, frozenset({"sample"}))
    ]
    if not rows:
        raise RecordingError(f"{path}: no samples in it (with raw frames in it: replay --frames)")
    columns = {
        name: np.array([row.get(name) for row in rows], dtype=np.float64) for name in rows[0] if name in KNOWN
    }
    return record_from_columns(columns, str(path), joint, keep_nan)
