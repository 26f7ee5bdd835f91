"""The formats of recordings, by the ending of the file's name: reader of columns, writer."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from drivelink.errors import RecordingError
from drivelink.jointfile import JointFile
from drivelink.recording.canlog import CAN_FORMATS
from drivelink.recording.columnmap import ColumnMap
from drivelink.recording.csvfile import read_csv_columns
from drivelink.recording.mf4file import read_mf4_columns
from drivelink.recording.sinks import CanSink, CsvSink, McapSink, Sink
from estimator.sample import FloatArray

Columns = tuple[dict[str, FloatArray], tuple[str, ...]]


class Format(NamedTuple):
    """A format of recordings."""

    sink: Callable[..., Sink] | None = None  # its writer; None: only read
    # reads columns by their names in the file, and names of those left out; None: it has none
    columns: Callable[[Path, ColumnMap], Columns] | None = None
    # whether it is text, some thirty times smaller than the memory that its analysis takes
    text: bool = False


FORMATS = {
    ".mcap": Format(McapSink),
    ".csv": Format(CsvSink, read_csv_columns, text=True),
    ".mf4": Format(columns=read_mf4_columns),
} | {suffix: Format(CanSink if kind.writer else None, text=kind.text) for suffix, kind in CAN_FORMATS.items()}


def open_sink(path: Path, joint: JointFile, joint_text: str = "", *, force: bool = False) -> Sink:
    """Open the writer for the file's ending.

    Args:
        joint_text: its joint file, stored if the format allows.
        force: replace an existing file.

    Raises:
        RecordingError: no such format, or the file cannot be written.
    """
    kind = FORMATS.get(path.suffix.lower())
    if kind is None or kind.sink is None:
        written = [ending for ending, one in FORMATS.items() if one.sink]
        raise RecordingError(f"{path}: expected a name that ends in {', '.join(written)}")
    return kind.sink(path, joint, joint_text, force=force)
