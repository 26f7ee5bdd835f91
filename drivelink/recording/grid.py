"""Assigns the rows of a recording to a grid of whole periods by their time stamps, or resamples them.

All later code counts periods. Stamps are only used here, to find period, gaps and errors.
"""

import logging
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from drivelink.cycle.syncclock import slope_of
from drivelink.errors import RecordingError
from estimator.reasons import counted
from estimator.sample import FloatArray

_LOG = logging.getLogger("drivelink.recording")

MINIMUM_ROWS = 3
# A step that differs from a multiple of the period by more than this fraction is jitter.
_JITTER = 0.25
# With more than this fraction of longer steps the sampling is not uniform.
_MAX_GAP_SHARE = 0.35
# Largest deviation of a stamp from the grid, in periods (arrival times of a loaded machine).
_MAX_JITTER_PERIODS = 3.0
_LAST_S = 1e12  # of a stamp
_MOST_PERIODS = 2**53  # that a float counts
_AHEAD = 65  # stamps needed to distinguish a late one from a gap
_MAX_GAPS = 0.1  # fraction of rows, with jittering stamps


class NotUniformError(RecordingError):
    """The stamps fit no grid of whole periods."""


class Grid(NamedTuple):
    """Position of each row on the grid."""

    period_s: float  # the sampling period T
    sequence: NDArray[np.int64]  # (n,) whole periods since the first row, strictly increasing
    start_s: float  # time of sequence 0
    keep: NDArray[np.bool_]  # (rows,) rows of the input on the grid: those with a stamp, without repetitions
    jittering: float = 0.0  # largest distance of a stamp from the grid, periods; 0: as good as none


def find_grid(
    time_s: FloatArray, where: str, nominal_s: float | None = None, repeats: NDArray[np.bool_] | None = None
) -> Grid:
    """Find the period (from the median step) and each row's number on the grid.

    Args:
        time_s: (rows,) stamps; a row without one (NaN) becomes a gap.
        nominal_s: expected period, used if the stamps agree with it.
        repeats: (rows,) whether a row repeats the previous one; such rows are omitted.

    Raises:
        RecordingError: too few rows, constant or decreasing time, or non-uniform sampling.
    """
    keep = np.isfinite(time_s)
    if missing := int(np.count_nonzero(~keep)):
        _LOG.warning("%s: taken as gaps: %s without a time stamp", where, counted(missing, "row"))
    if repeats is not None and (repeated := int(np.count_nonzero(repeats & keep))):
        _LOG.warning("%s: omitted: %s equal to the row before", where, counted(repeated, "row"))
        keep &= ~repeats
    time = time_s[keep]
    if np.any(np.abs(time) > _LAST_S):
        raise RecordingError(f"{where}: expected time_s in seconds, below {_LAST_S:g}, got {time.max():g}")
    if len(time) < MINIMUM_ROWS:
        raise RecordingError(f"{where}: expected at least {MINIMUM_ROWS} samples, got {len(time)}")
    steps = np.diff(time)
    _require_forward(steps, np.flatnonzero(keep), time, where)
    if time[-1] == time[0]:
        raise RecordingError(f"{where}: time_s stands still: expected one stamp per sample, increasing")
    if np.count_nonzero(steps) < 0.5 * len(steps):
        raise NotUniformError(f"{where}: expected one stamp per sample, got most as the one before")
    period = float(np.median(steps))
    if time[-1] - time[0] > _MOST_PERIODS * period:
        raise RecordingError(f"{where}: time_s spans {time[-1] - time[0]:g} s in steps of {period:g} s")
    sequence, jittering = _number(time, period, where)
    period = _rounded(time, sequence, nominal_s)
    return Grid(period, sequence, float(time[0]), keep, jittering)


def report_gaps(sequence: NDArray[np.int64], period_s: float, where: str) -> None:
    """Report in one line how many periods of a sequence are missing, if any."""
    steps = np.diff(sequence)
    gaps = steps > 1
    if np.any(gaps):
        missing, whole = int(np.sum(steps[gaps] - 1)), int(sequence[-1] - sequence[0] + 1)
        longest_s = (int(steps.max()) - 1) * period_s
        at_s = int(sequence[int(steps.argmax())] - sequence[0]) * period_s
        text = "%s: %s, %d of %d samples missing, the longest %.6g s at %.6g s"
        number = counted(int(np.count_nonzero(gaps)), "gap")
        _LOG.warning(text, where, number, missing, whole, longest_s, at_s)


def _require_forward(steps: FloatArray, rows: NDArray[np.int64], time: FloatArray, where: str) -> None:
    backwards = np.flatnonzero(steps < 0.0)
    if len(backwards):
        k = int(backwards[0])
        raise RecordingError(
            f"{where}: time_s runs backwards {counted(len(backwards), 'time')}, first at sample "
            f"{rows[k + 1] + 1} ({time[k]:.9g} s to {time[k + 1]:.9g} s): expected increasing stamps "
            "(two recordings joined, or the clock was set?)"
        )


def _number(time: FloatArray, period: float, where: str) -> tuple[NDArray[np.int64], float]:
    """(n,) number of each stamp on a grid of the given period, adapted to the stamps' drift; their jitter,
    periods.
    """
    steps = np.diff(time)
    wide = np.count_nonzero(steps > 1.5 * period)
    if wide > _MAX_GAP_SHARE * len(steps):
        raise NotUniformError(
            f"{where}: expected uniform sampling, got steps from {steps.min():.3g} s to {steps.max():.3g} s "
            f"(median {period:.3g} s)"
        )
    whole = np.maximum(np.rint(steps / period), 0.0)
    if np.all(whole >= 1.0) and np.all(np.abs(steps - whole * period) <= _JITTER * period * np.sqrt(whole)):
        return np.concatenate(([0], np.cumsum(whole))).astype(np.int64), 0.0
    return _number_jittered(time, where)


def _number_jittered(time: FloatArray, where: str) -> tuple[NDArray[np.int64], float]:
    """Number stamps that jitter like arrival times: after a late one others catch up, after a gap they do
    not.

    A number is the previous one plus one, plus the periods by which all stamps of the next window are behind.
    """
    from scipy.ndimage import minimum_filter1d  # most stamps need no scipy, and `record` none

    index = np.arange(len(time))
    since = time - time[0]
    lag = max(1, min(_AHEAD, len(time) // 4))
    period = float(np.median(time[lag:] - time[:-lag])) / lag  # jitter averages out, rare gaps do not matter
    sequence = index
    for _ in range(3):  # repeat with the improved period
        behind = since / period - index
        least = minimum_filter1d(behind, _AHEAD, origin=-(_AHEAD // 2), mode="nearest")
        sequence = index + np.maximum.accumulate(np.rint(least - least[0]).astype(np.int64))
        period, _ = slope_of(since, sequence)
    off = since - sequence * period
    off -= np.median(off)
    worst = float(np.abs(off).max()) / period
    gaps = np.count_nonzero(np.diff(sequence) > 1)
    if float(np.sqrt(np.mean(off**2))) > _MAX_JITTER_PERIODS * period or gaps > _MAX_GAPS * len(time):
        raise NotUniformError(
            f"{where}: expected uniform sampling, got stamps up to {worst:.3g} periods of {period:.3g} s off"
        )
    return sequence, worst


def _rounded(time: FloatArray, sequence: NDArray[np.int64], nominal_s: float | None) -> float:
    """Return the period as slope of time over number, rounded if possible.

    A round value is used if it is within three standard deviations of the slope.
    """
    slope, spread = slope_of(time, sequence)
    tolerance = min(3.0 * spread + 1e-6 * slope, 0.25 * slope / float(sequence[-1]))
    nice = [] if nominal_s is None else [nominal_s]
    nice += [float(f"{slope:.{digits}g}") for digits in (1, 2)]
    nice += [1.0 / float(f"{1.0 / slope:.{digits}g}") for digits in (1, 2, 3)]
    nice += [float(f"{slope:.{digits}g}") for digits in (3, 4, 5, 6, 7)]
    return next((value for value in nice if abs(value - slope) <= tolerance), slope)


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
    from scipy.interpolate import PchipInterpolator  # as above

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
