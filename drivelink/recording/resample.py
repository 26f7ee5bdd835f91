"""Puts rows that were sampled at irregular times on a uniform grid."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import PchipInterpolator

from estimator.sample import FloatArray

_BRIDGED = 3.5  # periods between two rows, at most; more is a gap
_HELD = ("torque_nm", "current_a")  # from one row to the next, as a drive holds it


def stamps_are_instants(time_s: FloatArray, number: FloatArray, x: FloatArray) -> bool:
    """Return whether a signal is smoother over its stamps than over its rows' numbers.

    If it is, the rows were taken when the stamps say; else the stamps are arrival times of uniform samples.
    Each sample is compared with the line through its neighbours.

    Args:
        time_s: (n,) stamps, not decreasing.
        number: (n,) of each row on the grid, increasing.
        x: (n,) a position.
    """
    rows = np.isfinite(x)
    rows[1:] &= np.diff(time_s) > 0.0
    if np.count_nonzero(rows) < 3:
        return False
    over_time, over_number = (_roughness(s[rows], x[rows]) for s in (time_s, number))
    return over_time**2 < 0.5 * over_number**2


def _roughness(s: FloatArray, x: FloatArray) -> float:
    share = (s[1:-1] - s[:-2]) / (s[2:] - s[:-2])
    return float(np.median(np.abs(x[1:-1] - x[:-2] - share * (x[2:] - x[:-2]))))


def resampled(columns: Mapping[str, FloatArray], rows: NDArray[np.bool_]) -> dict[str, FloatArray]:
    """Return the columns on a grid of the median step; torques and currents keep their
    impulse, gaps stay gaps.

    Args:
        columns: (n,) each, `time_s` among them; all finite in the rows used.
        rows: (n,) that are used; their stamps increase.
    """
    time = columns["time_s"][rows]
    period = float(np.median(np.diff(time)))
    grid = time[0] + period * np.arange(int((time[-1] - time[0]) / period))
    before = np.clip(np.searchsorted(time, grid, side="right") - 1, 0, len(time) - 2)
    grid = grid[time[before + 1] - time[before] <= _BRIDGED * period]
    found = {"time_s": grid}
    for name, values in columns.items():
        x = values[rows]
        if name.endswith(_HELD):
            impulse = np.concatenate(([0.0], np.cumsum(x[:-1] * np.diff(time))))
            ends = (np.interp(at, time, impulse) for at in (grid + period, grid))
            found[name] = np.subtract(*ends) / period
        elif name != "time_s":
            found[name] = np.asarray(PchipInterpolator(time, x)(grid))
    return found
