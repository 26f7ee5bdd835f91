"""Reads a recording in parts that fit into a worker's memory."""

from __future__ import annotations

import csv
import logging
import math
import tempfile
from collections.abc import Iterator
from itertools import chain
from pathlib import Path
from typing import NamedTuple

from drivelink import recording
from drivelink.errors import RecordingError
from drivelink.jointfile import JointFile
from drivelink.recording.canframes import FrameLog, is_frame_log
from drivelink.recording.columns import sample_columns, sample_row
from drivelink.recording.cycles import Cycle
from drivelink.recording.formats import FORMATS
from drivelink.recording.mcapsamples import recorded_cycles
from estimator.sample import Record

# Rise of the peak memory of fit, diagnosis and report over that of the file's size. Of a CSV it is measured
# (26 at 1 kHz, benchmarks/fleet_memory.py) and rounded up. A text log has about as
# many bytes a sample, compressed formats have a fraction.
_EXPANSION_TEXT, _EXPANSION_OTHER = 30.0, 100.0
_BASE_BYTES = 550 << 20  # memory of a worker without a recording: interpreter, libraries, Dask, caches
_LEAST_BYTES = 64 << 20  # minimum for a part, which must contain enough motion
_USED = 0.7  # share of the limit that is used: Dask pauses a worker at 0.8 and ends it at 0.95


class Piece(NamedTuple):
    """One part of a recording, numbered from 1."""

    record: Record
    part: int
    parts: int


def pieces(path: Path, joint: JointFile, base_dir: Path, limit_bytes: float) -> Iterator[Piece]:
    """Read a recording, in equal parts in time if it does not fit.

    Args:
        base_dir: folder in which the joint's EDS files are found.
        limit_bytes: memory of the worker; not above 0: no limit.

    Raises:
        RecordingError: it cannot be read, or is too large in a format that cannot be split.
    """
    parts = _parts(path, limit_bytes)
    if parts == 1:
        yield Piece(recording.read(path, joint, base_dir=base_dir), 1, 1)
        return
    logging.getLogger("drivelink.fleet").warning(
        "%s: larger than the memory of a worker: cut into %d parts", path.name, parts
    )
    with tempfile.TemporaryDirectory(prefix="drivelink-parts-") as folder:
        table = path if path.suffix.lower() == ".csv" else _as_csv(path, joint, base_dir, Path(folder))
        for number, piece in enumerate(_cut(table, parts, Path(folder) / path.with_suffix(".csv").name), 1):
            yield Piece(recording.read(piece, joint, base_dir=base_dir), number, parts)


def _parts(path: Path, limit_bytes: float) -> int:
    if limit_bytes <= 0:
        return 1
    budget = max(_USED * limit_bytes - _BASE_BYTES, min(_LEAST_BYTES, limit_bytes))
    kind = FORMATS.get(path.suffix.lower(), FORMATS[".csv"])
    needed = path.stat().st_size * (_EXPANSION_TEXT if kind.text else _EXPANSION_OTHER)
    return max(1, math.ceil(needed / budget))


def _as_csv(path: Path, joint: JointFile, base_dir: Path, folder: Path) -> Path:
    """Convert the samples of a recording to CSV, cycle by cycle."""
    motors = len(joint.motor)
    cycles: Iterator[Cycle]
    if is_frame_log(path):
        log = FrameLog(path, joint, base_dir)
        cycles, period_s = log.cycles(), log.period_s
    elif path.suffix.lower() == ".mcap":
        cycles, period_s = recorded_cycles(path, motors), joint.bus.period_s
    else:
        raise RecordingError(f"{path}: larger than the memory of a worker, and {path.suffix} cannot be cut")
    target = folder / "samples.csv"
    with target.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(sample_columns(motors))
        writer.writerows(sample_row(c.sample, period_s) for c in cycles if c.sample is not None)
    return target


def _cut(table: Path, parts: int, target: Path) -> Iterator[Path]:
    """Split a CSV into parts of about the same size, each with the header; one temporary file is reused."""
    share = math.ceil(table.stat().st_size / parts)
    with table.open("rb") as file:
        head = []
        for line in file:
            head.append(line)
            if line.strip() and not line.lstrip().startswith(b"#"):
                break
        lines: Iterator[bytes] = iter(file)
        while (first := next(lines, None)) is not None:
            with target.open("wb") as out:
                size = 0
                out.writelines(head)
                for line in chain([first], lines):
                    out.write(line)
                    size += len(line)
                    if size >= share:
                        break
            yield target
