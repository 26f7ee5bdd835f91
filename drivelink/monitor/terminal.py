"""The terminal of a view: several joints, one line each; single keys without Enter."""

import math
import os
import select
import sys
import termios
import tty
from collections.abc import Mapping
from typing import Any, Self

from rich.console import Console
from rich.table import Table
from rich.text import Text

from drivelink.monitor.braille import sparkline
from drivelink.monitor.view import ESTIMATE, JointView, half_interval
from drivelink.output.numbers import among, value_and_interval

_STATE = 12  # columns, at least


def joints_table(views: Mapping[str, JointView], width: int) -> Table:
    """Return several joints, one line each; columns that do not fit are omitted."""
    sparks = width - 100
    columns = [("stiffness / N·m/rad", 19), ("torque / N·m", 12)]
    if width >= 80:
        columns.append(("deflection / rad", 16))
    table = Table(expand=True, box=None, pad_edge=False)
    rest = sum(least + 2 for _, least in columns) + (sparks + 2 if sparks >= 8 else 0) + _STATE
    table.add_column("joint", overflow="fold", min_width=10, max_width=max(10, width - 2 - rest))
    for heading, least in columns:
        table.add_column(heading, no_wrap=True, min_width=least)
    if sparks >= 8:
        table.add_column("last seconds", no_wrap=True, min_width=sparks)
    table.add_column("state", ratio=1, overflow="fold", min_width=_STATE)
    for name, view in views.items():
        estimate = view.history.latest
        ink = ESTIMATE if view.live else "dim"
        cells = [Text(name, style="bold")]
        if estimate is None:
            cells += [Text("–")] * (len(table.columns) - 2) + [Text(view.state or "–")]
        else:
            value, half = value_and_interval(estimate.stiffness_nm_rad, half_interval(estimate))
            cells.append(Text.assemble((value, ink), f" ± {half}" if half else ""))
            cells.append(Text(among(estimate.flexibility_torque_nm, view.history.largest_torque_nm)))
            cells += [Text(view.deflections(" "))] if width >= 80 else []
            if sparks >= 8:
                moments = view.history.window()
                series = [m.stiffness_nm_rad if m.stiffness_valid else math.nan for m in moments]
                cells.append(Text(sparkline(series, sparks), style=ink))
            worst = [(label, style) for label, style in view.flags if style != "green"]
            cells.append(Text(*worst[0]) if worst else Text(view.state or "valid", style="green"))
        table.add_row(*cells)
    return table


def can_draw(console: Console) -> bool:
    """Return whether the console is a terminal that has the characters of the live views."""
    return console.is_terminal and not console.is_dumb_terminal and not console.options.ascii_only


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

    def __exit__(self, *_: object) -> None:
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
