"""Events of a run, reported once: in the log and in the status document."""

from __future__ import annotations

import logging
import time
from collections import deque
from collections.abc import Callable
from typing import Any

__all__ = ["EventLog"]


class EventLog:
    """What has happened, said once: in the log, and among the last events of the status.

    A condition has a key. It is said when it begins, not while it lasts, and said again when it ends. What
    comes again within ten seconds, be it with other figures, is counted and not logged.

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
        self._said: dict[str, tuple[dict[str, Any], float, int]] = {}  # event, when it was logged, since then

    @property
    def active(self) -> dict[str, str]:
        """Conditions that hold now, by key."""
        return dict(self._active)

    def recent(self) -> list[dict[str, Any]]:
        """The last events, oldest first: {"time", "text", "count"}."""
        return [dict(event) for event in self._recent]

    def say(self, text: str, level: int = logging.INFO, key: str = "") -> None:
        """Something that has happened, once.

        Args:
            text: what.
            level: of the log line.
            key: the same of texts that say the same with other figures; left out: the text itself.
        """
        self._note(key or text, text, level)

    def begin(self, key: str, text: str, level: int = logging.WARNING) -> None:
        """A condition holds; what follows while it holds is not said."""
        if key in self._active:
            return
        self._active[key] = text
        self._note(f"{key} begins", text, level)

    def end(self, key: str, text: str = "", level: int = logging.INFO) -> None:
        """A condition holds no more."""
        if self._active.pop(key, None) is not None and text:
            self._note(f"{key} ends", text, level)

    def _note(self, key: str, text: str, level: int) -> None:
        now = self._clock()
        event, since, count = self._said.get(key, ({}, -self._QUIET_S, 0))
        if 0 <= now - since < self._QUIET_S:
            self._said[key] = (event, since, count + 1)
            event["text"] = text  # its figures of now
            event["count"] += 1
            return
        if len(self._said) > 256:
            self._said.clear()
        event = {"time": now, "text": text, "count": 1}
        self._said[key] = (event, now, 0)
        self._logger.log(level, "%s", f"{text} ({count} more times before)" if count else text)
        self._recent.append(event)
