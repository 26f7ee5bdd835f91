"""Plots in text: curves of braille dots (2 by 4 in a character) and sparklines."""

import math
from collections.abc import Sequence

from rich.text import Text

from drivelink.output.numbers import axis_ticks, ticks_on_rows, usual_range

_BARS = "▁▂▃▄▅▆▇█"
# Bit of the dot at column c (0, 1) and row r (0 on top) of a braille character.
_DOTS = ((0x01, 0x02, 0x04, 0x40), (0x08, 0x10, 0x20, 0x80))
_BLANK = 0x2800


def sparkline(values: Sequence[float], width: int) -> str:
    """Return the values as at most `width` bars, each the mean of its share; blank if not finite.

    Outliers get the lowest or highest bar.
    """
    if not values or width < 1:
        return ""
    share = max(1, math.ceil(len(values) / width))
    means = []
    for start in range(0, len(values), share):
        finite = [value for value in values[start : start + share] if math.isfinite(value)]
        means.append(sum(finite) / len(finite) if finite else math.nan)
    low, high = usual_range(means)
    if not math.isfinite(low):
        return " " * len(means)
    scale = (len(_BARS) - 1) / (high - low) if high - low > 1e-9 * max(abs(low), 1e-300) else 0.0
    return "".join(
        _BARS[round((min(max(m, low), high) - low) * scale)] if math.isfinite(m) else " " for m in means
    )


def gauge(value: float, full: float, width: int) -> str:
    """Return a bar of so many characters, full at `full`; empty if the value is not finite."""
    eighths = round(8 * width * min(max(value / full, 0.0), 1.0)) if math.isfinite(value) else 0
    whole, rest = divmod(eighths, 8)
    return ("█" * whole + (" ▏▎▍▌▋▊▉"[rest] if rest else "")).ljust(width, "░")


class DotPlot:
    """Dots on a grid of characters, with the ranges of the axes.

    Args:
        width: characters of the whole plot, labels included.
        height: lines of the whole plot, title and axis included.
    """

    def __init__(self, width: int, height: int, x: tuple[float, float], y: tuple[float, float]) -> None:
        self.rows = max(2, height - 2)
        self._x = _opened(*x)
        self._y, ticks = ticks_on_rows(*_opened(*y), self.rows)
        low, high = self._y
        self._labels = {round((high - y) / (high - low) * (self.rows - 1)): label for y, label in ticks}
        self._margin = max(6, *map(len, self._labels.values()))
        self.columns = max(4, width - self._margin - 1)
        self._cells = [[0] * self.columns for _ in range(self.rows)]
        self._styles = [[""] * self.columns for _ in range(self.rows)]
        self._marks: dict[tuple[int, int], str] = {}
        self._note = ""

    def curve(self, points: Sequence[tuple[float, float]], style: str, every: int = 1) -> None:
        """Join the points by lines, dotted for `every` > 1. Non-finite points break the line."""
        last: tuple[float, float] | None = None
        count = 0
        for x, y in points:
            if not (math.isfinite(x) and math.isfinite(y)):
                last = None
                continue
            here = self._place(x, y)
            begin = last if last is not None else here
            steps = max(1, round(max(abs(here[0] - begin[0]), abs(here[1] - begin[1]))))
            for k in range(1, steps + 1):
                count += 1
                if count % every == 0:
                    part = k / steps
                    self._dot(
                        begin[0] + part * (here[0] - begin[0]), begin[1] + part * (here[1] - begin[1]), style
                    )
            last = here

    def band(self, points: Sequence[tuple[float, float, float]], style: str) -> None:
        """Draw the edges of a band as dotted lines, from (x, low, high), inside the plot."""
        below, above = self._y
        self.curve([(x, low if low >= below else math.nan) for x, low, _ in points], style, every=3)
        self.curve([(x, high if high <= above else math.nan) for x, _, high in points], style, every=3)

    def mark(self, x: float, y: float, style: str) -> None:
        """Draw a highlighted point, if inside the plot."""
        if math.isfinite(x) and math.isfinite(y):
            across, down = self._place(x, y)
            column, row = math.floor(across / 2), math.floor(down / 4)
            if 0 <= column < self.columns and 0 <= row < self.rows:
                self._marks[row, column] = style

    def note(self, text: str) -> None:
        """Show a message in place of the axes."""
        self._note = text

    def render(self, title: str, x_unit: str = "") -> Text:
        """Return the plot as lines of text."""
        text = Text(no_wrap=True)
        width = self._margin + 1 + self.columns
        pad = " " * min(self._margin + 1, max(0, width - len(title)))
        text.append(pad + title[:width], style="bold")
        if self._note:
            pad = " " * (self._margin + 1 + max(0, (self.columns - len(self._note)) // 2))
            above, below = self.rows // 2, self.rows - self.rows // 2
            text.append("\n" * (above + 1) + pad + self._note[: self.columns] + "\n" * below, style="dim")
            return text
        for row, (cells, styles) in enumerate(zip(self._cells, self._styles, strict=True)):
            label = self._labels.get(row, "")
            text.append(f"\n{label:>{self._margin}}", style="dim")
            text.append("┤" if label else "│", style="dim")
            for column, (dots, style) in enumerate(zip(cells, styles, strict=True)):
                mark = self._marks.get((row, column))
                if mark is not None:
                    text.append("●", style=mark)
                else:
                    text.append(chr(_BLANK + dots) if dots else " ", style=style)
        text.append("\n" + " " * (self._margin + 1) + self._below(x_unit), style="dim")
        return text

    def _below(self, unit: str) -> str:
        """Return the labels of the x axis, each below its place, the last one with the unit."""
        ticks = axis_ticks(*self._x)
        count = len(ticks)
        laid = (self._laid(ticks[:n:k], unit) for k in range(1, count + 1) for n in (count, count - 1))
        return next((axis for axis in laid if axis is not None), "")

    def _laid(self, ticks: Sequence[tuple[float, str]], unit: str) -> str | None:
        """Return the labels as a line; None where they do not fit, or one is not below its place."""
        low, high = self._x
        axis = ""
        for k, (x, label) in enumerate(ticks):
            text = f"{label} {unit}".rstrip() if k == len(ticks) - 1 else label
            at = round((x - low) / (high - low) * (self.columns - 1))
            place = max(0, min(at - len(label) // 2, self.columns - len(text)))
            if place < len(axis) + bool(axis) or at > place + len(label) + 1:
                return None
            axis = axis.ljust(place) + text
        return axis

    def _place(self, x: float, y: float) -> tuple[float, float]:
        """Column and row of the dot; far points are clipped to just outside."""
        (x0, x1), (y0, y1) = self._x, self._y
        across, down = min(max((x - x0) / (x1 - x0), -0.1), 1.1), min(max((y1 - y) / (y1 - y0), -0.1), 1.1)
        return across * (2 * self.columns - 1), down * (4 * self.rows - 1)

    def _dot(self, column: float, row: float, style: str) -> None:
        c, r = round(column), round(row)
        if 0 <= c < 2 * self.columns and 0 <= r < 4 * self.rows:
            self._cells[r // 4][c // 2] |= _DOTS[c % 2][r % 4]
            self._styles[r // 4][c // 2] = style


def _opened(low: float, high: float) -> tuple[float, float]:
    """Widen an empty range around its value."""
    if not math.isfinite(high - low):
        return 0.0, 1.0
    if high - low <= 1e-9 * max(abs(low), abs(high)):
        half = 0.05 * abs(low) or 1.0
        return low - half, high + half
    return low, high
