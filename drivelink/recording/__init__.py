"""Recordings: every file format, in and out, as a `Record`.

`read` reads any of them. Irregularities are one-line warnings of the logger `drivelink.recording`.
"""

from pathlib import Path

from drivelink.errors import RecordingError, UsageError
from drivelink.jointfile import JointFile
from drivelink.recording.canframes import is_frame_log, read_frame_record
from drivelink.recording.columns import ColumnMap, column_map, record_from_columns, renamed
from drivelink.recording.formats import CONVERTERS, FORMATS
from drivelink.recording.mcapfile import read_mcap, warn_of_another
from estimator.sample import Record

__all__ = ["read"]


def read(
    path: str | Path,
    joint: JointFile | None = None,
    *,
    base_dir: str | Path = "",
    channel: str | None = None,
    keep_nan: bool = False,
    names: ColumnMap | None = None,
) -> Record:
    """Read a recording.

    Args:
        path: the file; its ending selects the format.
        joint: the joint it was made with: number of motors, torque constants, PDO mapping of raw CAN logs.
        base_dir: folder of the joint file, base of its EDS files.
        channel: of a raw CAN log with several.
        keep_nan: keep rows with NaN, for use tick by tick; else they become gaps.
        names: columns of a CSV file with other names or units, beside those of the joint file.

    Raises:
        RecordingError: it cannot be read, or is incomplete.
        UsageError: `names` for a format with fixed names.
    """
    path = Path(path)
    if not path.exists():
        raise RecordingError(f"{path}: no such file")
    if path.is_dir():
        raise RecordingError(f"{path}: expected a file, got a folder")
    if command := CONVERTERS.get(path.suffix.lower()):
        raise RecordingError(f"{path}: not a format of recordings; to convert it: {command.format(path)}")
    if (read_columns := FORMATS.get(path.suffix.lower(), FORMATS[".csv"]).columns) is not None:
        names = column_map(joint, names)
        columns, ignored = read_columns(path, names)
        ours = renamed(columns, names, str(path), ignored)
        left = tuple(name for name in ignored if name not in ours)
        return record_from_columns(ours, str(path), joint, keep_nan, left)
    if names:
        raise UsageError(f"names: {path}: only CSV files have columns to be named")
    if is_frame_log(path):
        return read_frame_record(path, joint, Path(base_dir), channel)
    if joint is not None:
        warn_of_another(path, joint.name)
    return read_mcap(path, joint, keep_nan)
