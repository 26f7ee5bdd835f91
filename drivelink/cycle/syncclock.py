"""Converts stamps of SYNC to whole periods between them."""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from drivelink._core import LATE

FloatArray = NDArray[np.float64]

MEASURED_SYNCS = 256  # of 2 % that stall for 20 periods, the median is then not one
_FEWEST = 8
_SAME = 0.01  # relative: periods that count as the same; 2 % of inertia torque
_BURST = 0.2  # of the mean step: shorter ones are of SYNCs that were read in one go
_CHANCE = 1e-3  # that times without a common phase agree so well with the declared period
_JITTERY = 0.15  # median deviation of the steps, in periods
_SIGMAS = 3.0

_CLOCK_STEP_NS = 50_000_000  # stamps and receptions differ by less, unless one clock was set


class MeasuredPeriod(NamedTuple):
    """The period of a master."""

    period_s: float  # measured; the expected one if the stamps cannot separate the two
    same: bool  # whether it is the expected one
    steady: bool  # whether most steps are as long: one master, without much jitter


def measure_period(stamps_ns: Sequence[int], expected_s: float) -> MeasuredPeriod | None:
    """Return the period of SYNCs from their stamps, robust to jitter, stalls and lost SYNCs.

    The median of the steps between them, over more and more of them; where they jitter too much for that,
    the slope of a line through the stamps over their numbers. The expected one where that is within three
    standard deviations, or SYNCs agree with its times better than with those found; else rounded to a value
    within them.

    Args:
        stamps_ns: of SYNCs one after the other.
        expected_s: the joint file's period, or its default.

    Returns:
        None for fewer than eight or constant stamps.
    """
    if len(stamps_ns) < _FEWEST or stamps_ns[-1] <= stamps_ns[0]:
        return None
    stamps = ((np.asarray(stamps_ns, dtype=np.int64) - stamps_ns[0]) * 1e-9).astype(np.float64)
    gaps = np.diff(stamps)
    period_s = float(np.median(gaps[gaps > _BURST * np.mean(gaps)]))
    steps = gaps / expected_s
    on_grid = float(np.median(np.abs(steps - np.rint(steps)))) < _JITTERY
    if on_grid and period_s > 1.5 * expected_s and abs(float(np.quantile(steps, 0.1)) - 1) < 3 * _SAME:
        period_s = expected_s  # most of its SYNCs are lost
    found, std, steady = _over_periods(stamps, period_s)
    chance = max(-math.log(_CHANCE), _agreement(stamps / found) if steady else 0.0)
    if period_s < 1.5 * expected_s and _agreement(stamps / expected_s) > chance:
        return MeasuredPeriod(expected_s, True, steady)
    if not steady:
        # A step of nearly two periods may be jitter; only larger ones count as lost.
        lost = np.where(gaps > 2.2 * period_s, np.rint(gaps / period_s) - 1, 0)
        found, std = slope_of(stamps, np.concatenate(([0.0], np.cumsum(1 + lost))))
    tolerance = _SIGMAS * std
    if abs(found - expected_s) <= max(_SAME * expected_s, tolerance):
        return MeasuredPeriod(expected_s, True, steady)
    rounded = (float(f"{found:.{digits}g}") for digits in range(1, 6))
    found = next((r for r in rounded if abs(r - found) <= max(tolerance, 1e-3 * found)), found)
    return MeasuredPeriod(found, False, steady)


def _over_periods(stamps: FloatArray, period_s: float) -> tuple[float, float, bool]:
    """Return the median step over whole periods, its standard deviation, and whether there is one.

    Differences of stamps further and further apart, each divided by the whole periods in it, as long as their
    number is certain. Over many periods a jitter counts for less, and so does that late SYNCs are followed by
    short steps, of which there are more.
    """
    best, std, apart = period_s, math.inf, 1
    while apart <= stamps.size // 2:
        differences = stamps[apart:] - stamps[:-apart]
        numbers = np.rint(differences / best)
        some = numbers > 0
        differences, numbers = differences[some], numbers[some]
        off = float(np.median(np.abs(differences / best - numbers))) if numbers.size else 1.0
        if off > _JITTERY:
            break
        each = differences / numbers
        best = float(np.median(each))
        std = float(np.median(np.abs(each - best))) * math.sqrt(apart / each.size)
        apart *= 2
    return best, std, math.isfinite(std)


def _agreement(places: FloatArray) -> float:
    """Return how well times, in periods, have a common phase: Rayleigh's statistic."""
    return float(np.abs(np.mean(np.exp(2j * np.pi * places))) ** 2 * places.size)


def slope_of(times_s: FloatArray, numbers: NDArray[Any]) -> tuple[float, float]:
    """Return the slope of a line through times over their numbers, and its standard deviation."""
    n, t = numbers - numbers.mean(), times_s - times_s.mean()
    slope = float(n @ t / (n @ n))
    return slope, float(np.sqrt(np.mean((t - slope * n) ** 2) / (n @ n)))


class SyncClock:
    """Counts the periods between successive SYNCs, from their stamps.

    A second-order phase-locked loop compares each stamp with its prediction. It is fast at first and slow
    later, when a jitter of half a period must not move it. It follows rates within two per cent of the
    expected one. A SYNC counts as the next one unless it is off by half a period, or by more if its master
    jitters more.
    """

    _SLOWEST = 0.01  # of the deviation, per SYNC: jitter of half a period then moves it by 2 % of a period
    _OFF_RATE = 0.02
    _SIGMAS = 2.2  # allowed deviation of a SYNC; uniform jitter ends at 1.73, the rest is the loop's own
    _MOST_OFF = 0.8  # periods: a deviation of a whole one is another SYNC

    def __init__(self, period_s: float) -> None:
        self._expected_ns = self._period_ns = period_s * 1e9
        self._due_ns = math.nan  # before the first SYNC
        self._last = (0, 0)
        self._count = 0
        self._variance = 0.0  # of the deviations, periods squared
        self._skipped = 0  # periods without SYNC that may only be late

    def jump(self, stamp_ns: int, monotonic_ns: int | None = None) -> int:
        """Return periods since the previous SYNC: 1 is normal, more is a gap, 0 is a SYNC that was not due.

        A SYNC that comes after its period was counted as lost is `LATE`.

        Args:
            stamp_ns: time of the SYNC, by any clock, even one that may be set.
            monotonic_ns: time of reception, by a monotonic clock; separates a step of the other clock from a
                gap.
        """
        if math.isnan(self._due_ns):
            self._due_ns = float(stamp_ns)
            self._last = (stamp_ns, monotonic_ns or 0)
            return 1
        elapsed = stamp_ns - self._last[0]
        if monotonic_ns is not None:
            seen = monotonic_ns - self._last[1]
            if not -_CLOCK_STEP_NS < elapsed < seen + _CLOCK_STEP_NS:
                self._due_ns += elapsed - seen
        self._last = (stamp_ns, monotonic_ns or 0)
        deviation = (stamp_ns - self._due_ns) / self._period_ns
        off = deviation - 1.0
        most_off = min(max(0.5, self._SIGMAS * self._variance**0.5), self._MOST_OFF)
        if off < -1.5:  # the clock was set back by an unknown amount
            self._due_ns = float(stamp_ns)
            return 1
        if off < -most_off:
            if not self._skipped:
                return 0
            self._skipped -= 1
            return LATE
        periods = 1 if off < most_off else max(2, round(deviation))
        self._skipped = periods - 1
        self._follow(deviation - periods, periods)
        return periods

    def _follow(self, error: float, periods: int) -> None:
        """Update the loop: the SYNC came so many periods after its prediction."""
        self._count += 1
        phase = max(1.0 / (self._count + 1), self._SLOWEST)
        rate = min(phase, 0.1) ** 2 / (2.0 - min(phase, 0.1))  # Benedict and Bordner, 1962
        self._due_ns += (periods + phase * error) * self._period_ns
        period = self._period_ns + rate * error / periods * self._period_ns
        off = self._OFF_RATE * self._expected_ns
        self._period_ns = min(max(period, self._expected_ns - off), self._expected_ns + off)
        self._variance += max(phase, 0.02) * (error**2 - self._variance)
