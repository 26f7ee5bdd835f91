"""Progress of anything that may take longer than two seconds: one bar on a terminal, plain lines elsewhere.

It writes to stderr, shows nothing for work that is done at once, and costs well under a microsecond an item.
"""

import time
from typing import Self

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeRemainingColumn

from drivelink.plaintext import clean_text

_QUIET_S = 1.0  # nothing is shown before
_LINE_S = 5.0  # between two plain lines


class Meter:
    """Progress of one job, reported by its owner.

    Use as a context manager; `update` it as often as you like. It ends with what has been reached, also
    after an exception.

    Args:
        what: the job in a few words, e.g. "replay".
        total: how much there is to do, where it is known.
    """

    def __init__(self, what: str, total: int | None = None, console: Console | None = None) -> None:
        self.done = 0
        self._what = clean_text(what)
        self._total = total
        self._stage = ""
        self._console = console or Console(stderr=True)
        self._begin = time.monotonic()
        self._next_line = self._begin + _LINE_S
        self._bar: Progress | None = None
        self._task = TaskID(0)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        if self._bar is not None:
            self._bar.update(self._task, completed=self.done)
            self._bar.stop()

    def stage(self, text: str) -> None:
        """Count one step more, and name what is being done now: "bandwidth"."""
        self._stage = text
        self.update(self.done + 1)

    def update(self, done: int) -> None:
        """Set the number of items done in all."""
        self.done = done
        now = time.monotonic()
        if now - self._begin < _QUIET_S:
            return
        if not self._console.is_terminal:
            self._line(now)
            return
        if self._bar is None:
            self._bar = Progress(
                TextColumn("{task.description}"),
                BarColumn(),
                MofNCompleteColumn(),
                TimeRemainingColumn(),
                console=self._console,
                transient=True,
            )
            self._task = self._bar.add_task(self._title(), total=self._total)
            self._bar.start()
        self._bar.update(self._task, completed=done, description=self._title())

    def _title(self) -> str:
        return f"{self._what} ({self._stage})" if self._stage else self._what

    def _line(self, now: float) -> None:
        if now < self._next_line:
            return
        self._next_line = now + _LINE_S
        share = f"{100 * self.done / self._total:.0f} %" if self._total else f"{self.done} steps"
        self._console.print(f"{self._title()}: {share} after {now - self._begin:.0f} s", highlight=False)
