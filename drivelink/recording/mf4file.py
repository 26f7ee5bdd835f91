"""Recordings as ASAM MDF 4 (.mf4) by asammdf: `pip install drivelink-vsa[mf4]`.

An MDF file is not readable after a kill. Samples are therefore written to an MCAP file beside it and
converted at the end.
"""

from __future__ import annotations

import logging
import os
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from drivelink.errors import RecordingError
from drivelink.infile import open_regular
from drivelink.jointfile import JointFile
from drivelink.jointfile.columns import COLUMNS
from drivelink.outfile import check_target, put_in_place, sync
from drivelink.recording.columnmap import ColumnMap, renamed
from drivelink.recording.columns import record_from_columns, sample_columns, sample_row
from drivelink.recording.limits import require_samples
from drivelink.recording.mcapsamples import read_mcap
from drivelink.recording.sinks import McapSink
from estimator.sample import FloatArray, Record

_LOG = logging.getLogger("drivelink.recording")


class Mf4Sink(McapSink):
    """Samples as MF4; until `close` they are in `FILE.mcap`."""

    wants = frozenset({"sample"})

    def __init__(self, path: Path, joint: JointFile, joint_text: str = "", *, force: bool = False) -> None:
        _asammdf(path)  # before anything is recorded
        self._path, self._joint_file, self._force = path, joint, force
        self._journal = path.with_name(path.name + ".mcap")
        check_target(self._journal)  # samples of a killed recording: never replaced
        super().__init__(self._journal, joint, joint_text)

    def close(self) -> None:
        """Convert the recorded samples to the .mf4 file."""
        super().close()
        if not self.counts["sample"]:
            self._journal.unlink()
            raise RecordingError(f"{self._path}: not written: there were no samples")
        record = read_mcap(self._journal, self._joint_file, keep_nan=True)
        write_mf4(self._path, record, force=self._force)
        self._journal.unlink()

    def abandon(self) -> None:
        """Keep the recorded samples as MCAP."""
        super().abandon()
        _LOG.warning("%s: not written; the samples are in %s", self._path, self._journal)


def write_mf4(path: Path, record: Record, *, force: bool = False) -> None:
    """Write a record as MF4, a channel for each column.

    Args:
        path: the file.
        record: its content.
        force: replace an existing file.

    Raises:
        RecordingError: asammdf is not installed, or the file cannot be written.
    """
    mdf_module = _asammdf(path)
    table = np.array([sample_row(sample, record.period_s)[1:] for sample in record.samples()])
    times = record.time_s
    with mdf_module.MDF(version="4.10") as mdf:
        signals = [
            mdf_module.Signal(samples=column, timestamps=times, name=name, unit=_unit(name))
            for name, column in zip(sample_columns(record.motors)[1:], table.T, strict=True)
            if np.any(np.isfinite(column))
        ]
        mdf.append(signals, comment="drivelink")
        try:
            with TemporaryDirectory(dir=path.parent, prefix=".mf4-") as folder:
                made = Path(mdf.save(Path(folder, "r.mf4")))
                with made.open("rb") as file:
                    sync(file.fileno())
                put_in_place(made, Path(os.path.realpath(path)), force=force)
        except OSError as error:
            raise RecordingError(f"{path}: cannot be written: {error.strerror}") from error


def read_mf4(
    path: Path, joint: JointFile | None = None, keep_nan: bool = False, names: ColumnMap | None = None
) -> Record:
    """Read an MF4 file whose channels are named like the CSV columns.

    Raises:
        RecordingError: asammdf is not installed, or the file is incomplete.
    """
    mdf_module = _asammdf(path)
    try:
        open_regular(path).close()
        with mdf_module.MDF(path) as mdf:
            wanted = {source.column for source in (names or {}).values()} | COLUMNS - {"time_s"}
            for group in mdf.groups:
                require_samples(group.channel_group.cycles_nr, str(path))
            found = [name for name in mdf.channels_db if name in wanted]
            signals = [mdf.get(name) for name in found]
    except RecordingError:
        raise
    except Exception as error:  # asammdf raises whatever a broken byte leads it to
        raise RecordingError(f"{path}: cannot be read as MF4: {error}") from error
    if not signals:
        raise RecordingError(f"{path}: expected channels named motor1_position_rad, …, found none")
    times = np.asarray(signals[0].timestamps, dtype=np.float64)
    columns: dict[str, FloatArray] = {"time_s": times}
    for name, signal in zip(found, signals, strict=True):
        columns[name] = _at(times, signal)
    return record_from_columns(renamed(columns, names or {}, str(path)), str(path), joint, keep_nan)


def _at(times: FloatArray, signal: Any) -> FloatArray:
    """A channel at the times of the first one, held between its samples."""
    values = np.asarray(signal.samples, dtype=np.float64)
    own = np.asarray(signal.timestamps, dtype=np.float64)
    if len(own) == len(times) and np.array_equal(own, times):
        return values
    place = np.searchsorted(own, times, side="right") - 1
    return np.where(place >= 0, values[np.maximum(place, 0)], np.nan)


def _unit(name: str) -> str:
    endings = {"_rad_s": "rad/s", "_rad": "rad", "_nm": "N·m"}
    return next((unit for ending, unit in endings.items() if name.endswith(ending)), "")


def _asammdf(path: Path) -> Any:
    try:
        import asammdf
    except ImportError as error:
        raise RecordingError(f'{path}: MF4 needs asammdf: pip install "drivelink-vsa[mf4]"') from error
    return asammdf
