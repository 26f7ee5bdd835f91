"""Reads single keys of the terminal without Enter; restores the terminal afterwards."""

from __future__ import annotations

import os
import select
import sys
import termios
import tty
from types import TracebackType
from typing import Any, Self


class Keys:
    """Keys pressed in the terminal on standard input; none without a terminal."""

    def __init__(self) -> None:
        self._before: list[Any] | None = None
        self._terminal = -1

    def __enter__(self) -> Self:
        if sys.stdin.isatty():
            self._terminal = sys.stdin.fileno()
            self._before = termios.tcgetattr(self._terminal)
            tty.setcbreak(self._terminal)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._before is not None:
            termios.tcsetattr(self._terminal, termios.TCSADRAIN, self._before)

    @property
    def there(self) -> bool:
        """Whether there is a terminal."""
        return self._before is not None

    def pressed(self) -> str:
        """Return the keys pressed since the last call; an arrow or function key gives several characters."""
        if self._before is None or not select.select([self._terminal], [], [], 0)[0]:
            return ""
        return os.read(self._terminal, 64).decode("utf-8", "replace")
