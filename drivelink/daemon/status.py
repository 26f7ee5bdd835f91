"""What the status key says: the state of a joint, its rates, how late things are, what has gone wrong.

Counting costs a fraction of a microsecond in the cycle; percentiles are drawn from the counts in the slack.
"""

from __future__ import annotations

import logging
import time
from array import array
from collections import deque
from collections.abc import Callable
from typing import Any

import numpy as np

__all__ = ["EventLog", "Meter"]

_RANGE_US = 5_000  # anything longer is counted as this long; the maximum is kept exactly


class Meter:
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


class EventLog:
    """What has happened, said once: in the log, and among the last events of the status.

    A condition has a key. It is said when it begins, not while it lasts, and said again when it ends.

    Args:
        logger: where the lines go.
        keep: how many events the status shows.
        clock: UNIX time, s.
    """

    _QUIET_S = 10.0  # a condition that comes and goes is counted, not repeated, for so long

    def __init__(
        self, logger: logging.Logger, keep: int = 16, clock: Callable[[], float] = time.time
    ) -> None:
        self._logger = logger
        self._clock = clock
        self._recent: deque[dict[str, Any]] = deque(maxlen=keep)
        self._active: dict[str, str] = {}
        self._said: dict[str, tuple[float, int]] = {}

    @property
    def active(self) -> dict[str, str]:
        """Conditions that hold now, by key."""
        return dict(self._active)

    def recent(self) -> list[dict[str, Any]]:
        """The last events, oldest first: {"time", "text", "count"}."""
        return [dict(event) for event in self._recent]

    def say(self, text: str, level: int = logging.INFO) -> None:
        """Something that has happened, once."""
        self._note(text, level)

    def begin(self, key: str, text: str, level: int = logging.WARNING) -> None:
        """A condition holds; what follows while it holds is not said."""
        if key in self._active:
            return
        self._active[key] = text
        self._note(text, level)

    def end(self, key: str, text: str = "", level: int = logging.INFO) -> None:
        """A condition holds no more."""
        if self._active.pop(key, None) is not None and text:
            self._note(text, level)

    def _note(self, text: str, level: int) -> None:
        now = self._clock()
        since, count = self._said.get(text, (-self._QUIET_S, 0))
        if 0 <= now - since < self._QUIET_S:
            self._said[text] = (since, count + 1)
            for event in self._recent:
                if event["text"] == text:
                    event["count"] += 1
            return
        if len(self._said) > 256:
            self._said.clear()
        self._said[text] = (now, 0)
        self._logger.log(level, "%s", f"{text} ({count} more times before)" if count else text)
        self._recent.append({"time": now, "text": text, "count": 1})
