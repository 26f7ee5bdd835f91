"""Histograms of durations: counted in a fraction of a microsecond, percentiles computed in the slack."""

from __future__ import annotations

from array import array
from typing import Any

import numpy as np

__all__ = ["LatencyHistogram"]

_RANGE_US = 5_000  # anything longer is counted as this long; the maximum is kept exactly


class LatencyHistogram:
    """A distribution of durations, in microseconds: counts per microsecond, and the maximum.

    Attributes:
        count: durations since the start.
        maximum_us: the longest of them.
    """

    def __init__(self) -> None:
        self._counts = array("Q", bytes(8 * (_RANGE_US + 1)))
        self._view = np.frombuffer(self._counts, dtype=np.uint64)
        self._before = np.zeros(_RANGE_US + 1, dtype=np.uint64)
        self._recent_maximum_us = 0.0
        self.count = 0
        self.maximum_us = 0.0

    def add(self, duration_ns: int) -> None:
        """Count one duration."""
        us = duration_ns // 1000
        self._counts[us if 0 <= us < _RANGE_US else (0 if us < 0 else _RANGE_US)] += 1
        self.count += 1
        if us > self._recent_maximum_us:
            self._recent_maximum_us = us
            if us > self.maximum_us:
                self.maximum_us = us

    def total(self) -> dict[str, float]:
        """Percentiles since the start, us: p50, p90, p99, p999, max."""
        return _percentiles(self._view, self.maximum_us)

    def recent(self) -> dict[str, float]:
        """Percentiles since the last call, us."""
        counts = self._view - self._before
        self._before[:] = self._view
        maximum, self._recent_maximum_us = self._recent_maximum_us, 0.0
        return _percentiles(counts, maximum)


def _percentiles(counts: np.ndarray[Any, np.dtype[np.uint64]], maximum_us: float) -> dict[str, float]:
    cumulative = counts.cumsum()
    total = int(cumulative[-1])
    if total == 0:
        return {}
    ranks = [0.5 * total, 0.9 * total, 0.99 * total, 0.999 * total]
    places = np.searchsorted(cumulative, ranks)
    names = ("p50_us", "p90_us", "p99_us", "p999_us")
    # The upper end of the bin that holds the rank, and never beyond what was seen.
    values = {name: float(min(place + 1, maximum_us + 1)) for name, place in zip(names, places, strict=True)}
    return {**values, "max_us": float(maximum_us)}
