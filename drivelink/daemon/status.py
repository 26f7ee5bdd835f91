"""Events of a run, for the log and the status document."""

from __future__ import annotations

import copy
import logging
import math
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

from drivelink.plaintext import clean_text


class _Said(NamedTuple):
    """What was logged last under a key."""

    event: dict[str, Any]
    logged_s: float
    last_s: float  # its last repetition
    quiet_s: float  # for so long repetitions are counted
    repeated: int = 0


@dataclass(slots=True)
class _Window:
    """A time in which lines are counted."""

    began_s: float = -math.inf
    lines: int = 0


class EventLog:
    """Logs each event once and keeps the last ones for the status document.

    A condition has a key and is reported when it begins and when it ends. Repetitions within ten seconds,
    also with other numbers, are counted instead of logged; while they go on, each line holds twice as long.

    An event is of one joint, or of all that share the bus: `of` returns the view of a joint.

    Args:
        clock: UNIX time, s.
    """

    _QUIET_S = 10.0  # for so long repetitions are counted instead of logged, at first
    _LONGEST_S = 600.0  # and after each other line twice as long, up to this
    _KINDS = 4  # different events of one source within that time; further ones count as one
    _LINES = 64  # log lines within that time; further ones are counted

    _KEPT = 16  # events for the status document

    def __init__(self, logger: logging.Logger, clock: Callable[[], float] = time.time) -> None:
        self._logger = logger
        self._clock = clock
        self._joint = ""  # whose events are reported and shown; empty: those of all
        self._recent: deque[tuple[str, dict[str, Any]]] = deque(maxlen=self._KEPT)  # whose, and what
        self._active: dict[str, tuple[str, str]] = {}
        self._logged: set[str] = set()  # of these, those whose beginning was logged
        self._said: dict[tuple[str, str], _Said] = {}
        self._sources: dict[str, tuple[float, set[str]]] = {}  # when the first of the keys came, and the keys
        self._window = _Window()

    def of(self, joint: str) -> EventLog:
        """Return the log of one joint: it reports as that joint, and does not show the others' events."""
        view = copy.copy(self)
        view._joint = joint
        return view

    def _shown(self, joint: str) -> bool:
        return not self._joint or joint in ("", self._joint)

    @property
    def active(self) -> dict[str, str]:
        """Conditions that hold now, by key."""
        return {key: text for key, (joint, text) in self._active.copy().items() if self._shown(joint)}

    def recent(self) -> list[dict[str, Any]]:
        """Return the last events, oldest first: {"time", "text", "count"}."""
        return [dict(event) for joint, event in self._recent.copy() if self._shown(joint)]

    def report(self, text: str, level: int = logging.INFO, key: str = "", source: str = "") -> None:
        """Report an event.

        Args:
            key: identifies texts that differ only in numbers; default: the text itself.
            source: who decides how many different events there are, such as a node.
        """
        self._note(self._limited(key or text, source), text, level)

    def begin(self, key: str, text: str, level: int = logging.WARNING) -> None:
        """Report that a condition begins; while it holds, only its text is renewed."""
        begins = key not in self._active
        self._active[key] = self._joint, text
        if begins and self._note(f"{key} begins", text, level):
            self._logged.add(key)

    def end(self, key: str, text: str = "") -> None:
        """Report that a condition has ended; the log has that of what it has begin."""
        if self._active.pop(key, None) is not None and text:
            self._note(f"{key} ends", text, logging.INFO, quiet=key not in self._logged)
        self._logged.discard(key)

    def keep(self, key: str, holds: bool, text: str, over: str, level: int = logging.WARNING) -> None:
        """Report `text` when a condition begins to hold, `over` when it has ended."""
        if holds:
            self.begin(key, text, level)
        else:
            self.end(key, over)

    def _limited(self, key: str, source: str) -> str:
        """Return the key, or the source's own where it has made too many different events."""
        if not source:
            return key
        now = self._clock()
        since, kinds = self._sources.get(source, (-math.inf, set()))
        if not 0 <= now - since < self._QUIET_S:
            self._sources[source] = since, kinds = now, set()
        if key not in kinds and len(kinds) >= self._KINDS:
            return source
        kinds.add(key)
        return key

    def _log(self, level: int, text: str, now: float) -> None:
        """Log a line, up to a number of lines in a time."""
        window = self._window
        if not 0 <= now - window.began_s < self._QUIET_S:
            left_out, window.began_s, window.lines = window.lines - self._LINES, now, 0
            if left_out > 0:
                self._logger.warning("%d messages were not logged: too many at a time", left_out)
        window.lines += 1
        if window.lines <= self._LINES:
            self._logger.log(level, "%s", text)

    def _note(self, key: str, text: str, level: int, quiet: bool | None = None) -> bool:
        """Log and keep an event, or count it if `quiet` (None: by its rate); return whether it is logged."""
        now, text, mine = self._clock(), clean_text(text), (self._joint, key)
        said = self._said.get(mine, _Said({}, -self._QUIET_S, -self._QUIET_S, self._QUIET_S))
        if said.event and (0 <= now - said.logged_s < said.quiet_s if quiet is None else quiet):
            self._said[mine] = said._replace(last_s=now, repeated=said.repeated + 1)
            said.event["text"] = text  # its present numbers
            said.event["count"] += 1
            return False
        if len(self._said) > 256:
            self._said.clear()
        event = {"time": now, "text": text, "count": 1}
        goes_on = 0 <= now - said.last_s < self._QUIET_S
        quiet_s = min(2.0 * said.quiet_s, self._LONGEST_S) if goes_on else self._QUIET_S
        self._said[mine] = _Said(event, now, now, quiet_s)
        again = f" (logged once for {said.repeated + 1} occurrences)" if said.repeated else ""
        self._log(level, text + again, now)
        self._recent.append((self._joint, event))
        return True
