"""Reads ASAM MDF 4 (.mf4) by asammdf: `pip install drivelink-vsa[mf4]`."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from drivelink.errors import RecordingError
from drivelink.infile import open_regular
from drivelink.jointfile.columns import COLUMNS
from drivelink.recording.columnmap import ColumnMap
from drivelink.recording.limits import require_samples
from estimator.sample import FloatArray


def read_mf4_columns(path: Path, names: ColumnMap) -> tuple[dict[str, FloatArray], tuple[str, ...]]:
    """Read the channels named like the CSV columns, at the times of the first one, held in between.

    Args:
        names: columns with other names in the file.

    Returns:
        (rows,) values of each by its name in the file; no names of others.

    Raises:
        RecordingError: asammdf is not installed, or the file cannot be read.
    """
    try:
        from asammdf import MDF
    except ImportError as error:
        raise RecordingError(f'{path}: MF4 needs asammdf: pip install "drivelink-vsa[mf4]"') from error
    wanted = {source.column for source in names.values()} | COLUMNS - {"time_s"}
    try:
        open_regular(path).close()
        with MDF(path) as mdf:
            for group in mdf.groups:
                require_samples(group.channel_group.cycles_nr, str(path))
            signals = mdf.select([name for name in mdf.channels_db if name in wanted])
        if not signals:
            raise RecordingError(f"{path}: expected channels named motor1_position_rad, …, found none")
        times = signals[0].timestamps
        columns = {one.name: one.interp(times, 0, 0).samples for one in signals}
    except RecordingError:
        raise
    except Exception as error:  # asammdf raises whatever a broken byte leads it to
        raise RecordingError(f"{path}: cannot be read as MF4: {error}") from error
    return {k: np.asarray(v, dtype=np.float64) for k, v in {"time_s": times, **columns}.items()}, ()
