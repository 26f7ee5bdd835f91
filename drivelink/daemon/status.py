"""Events of a run, for the log and the status document."""

from __future__ import annotations

import logging
import time
from collections import deque
from collections.abc import Callable
from typing import Any


class EventLog:
    """Logs each event once and keeps the last ones for the status document.

    A condition has a key and is reported when it begins and when it ends. Repetitions within ten seconds,
    also with other numbers, are counted instead of logged.

    Args:
        logger: receives the lines.
        keep: number of events in the status.
        clock: UNIX time, s.
    """

    _QUIET_S = 10.0  # for so long repetitions are counted instead of logged

    def __init__(
        self, logger: logging.Logger, keep: int = 16, clock: Callable[[], float] = time.time
    ) -> None:
        self._logger = logger
        self._clock = clock
        self._recent: deque[dict[str, Any]] = deque(maxlen=keep)
        self._active: dict[str, str] = {}
        self._said: dict[str, tuple[dict[str, Any], float, int]] = {}  # event, when logged, count since

    @property
    def active(self) -> dict[str, str]:
        """Conditions that hold now, by key."""
        return dict(self._active)

    def recent(self) -> list[dict[str, Any]]:
        """The last events, oldest first: {"time", "text", "count"}."""
        return [dict(event) for event in self._recent]

    def say(self, text: str, level: int = logging.INFO, key: str = "") -> None:
        """Report an event.

        Args:
            text: what.
            level: of the log line.
            key: identifies texts that differ only in numbers; default: the text itself.
        """
        self._note(key or text, text, level)

    def begin(self, key: str, text: str, level: int = logging.WARNING) -> None:
        """Report that a condition begins; ignored while it holds."""
        if key in self._active:
            return
        self._active[key] = text
        self._note(f"{key} begins", text, level)

    def end(self, key: str, text: str = "", level: int = logging.INFO) -> None:
        """Report that a condition has ended."""
        if self._active.pop(key, None) is not None and text:
            self._note(f"{key} ends", text, level)

    def keep(self, key: str, holds: bool, text: str, over: str, level: int = logging.WARNING) -> None:
        """Report `text` when a condition begins to hold, `over` when it has ended."""
        if holds:
            self.begin(key, text, level)
        else:
            self.end(key, over)

    def _note(self, key: str, text: str, level: int) -> None:
        now = self._clock()
        event, since, count = self._said.get(key, ({}, -self._QUIET_S, 0))
        if 0 <= now - since < self._QUIET_S:
            self._said[key] = (event, since, count + 1)
            event["text"] = text  # its present numbers
            event["count"] += 1
            return
        if len(self._said) > 256:
            self._said.clear()
        event = {"time": now, "text": text, "count": 1}
        self._said[key] = (event, now, 0)
        self._logger.log(level, "%s", f"{text} ({count} more times before)" if count else text)
        self._recent.append(event)
