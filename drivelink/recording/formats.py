"""Selects the writer of a recording by its file name."""

from __future__ import annotations

from pathlib import Path

from drivelink.errors import RecordingError
from drivelink.jointfile import JointFile
from drivelink.recording.canlog import CAN_FORMATS
from drivelink.recording.mf4file import Mf4Sink
from drivelink.recording.sinks import CanSink, CsvSink, McapSink, Sink


def open_sink(path: Path, joint: JointFile, joint_text: str = "", *, force: bool = False) -> Sink:
    """Open the writer for the file's ending.

    Args:
        path: the recording.
        joint: the joint.
        joint_text: its joint file, stored if the format allows.
        force: replace an existing file.

    Raises:
        RecordingError: no such format, or the file cannot be written.
    """
    suffix = path.suffix.lower()
    if suffix == ".mcap":
        return McapSink(path, joint, joint_text, force=force)
    if suffix == ".csv":
        return CsvSink(path, joint, force=force)
    if suffix == ".mf4":
        return Mf4Sink(path, joint, joint_text, force=force)
    written = [ending for ending, kind in CAN_FORMATS.items() if kind.writer]
    if suffix in written:
        return CanSink(path, joint, force=force)
    raise RecordingError(f"{path}: expected a name that ends in .mcap, .csv, .mf4 or {', '.join(written)}")
