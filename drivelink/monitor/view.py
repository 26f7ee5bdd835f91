"""Terminal widgets of a joint's live view, for `monitor` and `demo`; at home in 80 columns by 24 lines.

view = JointView("elbow", subtitle="vsa-ii on the virtual bus")
with rich.live.Live(view, refresh_per_second=10) as live:
    view.update(estimate, time_s, truth)     # every cycle if you like, some microseconds
    view.status = latest_status              # the JSON of the status key
print(view.line())                           # the same in one plain line, where there is no terminal
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from rich.console import Console, ConsoleOptions, Group, RenderableType, RenderResult
from rich.panel import Panel
from rich.table import Table
from rich.text import Text

from drivelink.monitor.braille import DotPlot, number, sparkline
from drivelink.monitor.history import EstimateLike, History, TruthLike
from drivelink.monitor.statuslines import status_lines, status_text
from estimator.sample import Status

__all__ = ["JointView", "joints_table"]

ESTIMATE = "cyan"
TRUTH = "yellow"
BAND = "blue"
_SECOND = "magenta"  # the second transmission
_SIGMA_95 = 1.96

_FLAGS = (  # bit, what is shown when set, style
    (Status.MODEL_ALARM, "model alarm", "bold red"),
    (Status.DRIVE_FAULT, "drive fault", "bold red"),
    (Status.BUS_FAULT, "bus fault", "bold red"),
    (Status.STALE, "stale", "bold red"),
    (Status.CHANGED, "joint changed", "yellow"),
    (Status.INPUT_REJECTED, "input rejected", "yellow"),
    (Status.GAP, "gap", "yellow"),
    (Status.RESTARTED, "restarted", "yellow"),
)


class JointView:
    """One joint, live: numbers with their band, curves, cycle, drives; a renderable of `rich`.

    Args:
        name: the joint's name.
        subtitle: what it is, e.g. its case or bus.
        seconds: how far back the plots over time reach.
        height: lines it may take; left out: those of the terminal, at most 24.

    Attributes:
        history: everything the view remembers.
        status: the joint's status message; empty until there is one.
        gone: the daemon was there and is not any more.
        footer: a line at the lower edge, e.g. how to leave.
    """

    def __init__(
        self, name: str, *, subtitle: str = "", seconds: float = 12.0, height: int | None = None
    ) -> None:
        self.name = name
        self.subtitle = subtitle
        self.footer = "Ctrl-C ends"
        self.history = History(seconds)
        self.status: Mapping[str, Any] = {}
        self.gone = False
        self._height = height

    def update(self, estimate: EstimateLike, time_s: float, truth: TruthLike | None = None) -> None:
        """Enter one estimate and, in a simulation, the truth at the same instant."""
        self.history.add(estimate, time_s, truth)

    @property
    def state(self) -> str:
        """What the daemon says of itself, or that it is gone."""
        return "daemon gone" if self.gone else str(self.status.get("state", ""))

    def line(self) -> str:
        """The joint in one plain line, for pipes and logs."""
        estimate = self.history.latest
        if estimate is None:
            return f"{self.name}: no estimate yet"
        parts = [
            f"{self.name}:",
            f"stiffness {number(estimate.stiffness_nm_rad)} ± {number(_half(estimate), 2)} N·m/rad,",
            f"torque {number(estimate.flexibility_torque_nm)} N·m,",
            "deflection " + " ".join(number(one.deflection_rad, 3) for one in estimate.transmissions),
            "rad, " + ", ".join(text for text, _ in flags(estimate.status)),
        ]
        stiffness, _ = self.history.relative_errors()
        if math.isfinite(stiffness):
            parts[-1] += f", stiffness error {100 * stiffness:.2f} %"
        if self.status:
            parts[-1] += f", {status_text(self.status)}"
        return " ".join(parts)

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        width = options.max_width
        height = self._height or min(console.size.height - 1, 24)
        title = Text.assemble((self.name, "bold"), f" · {self.subtitle}" if self.subtitle else "")
        if self.state:
            title.append(f" · {self.state}", style="bold red" if self.gone else "")
        numbers, below = self._numbers(width - 4), status_lines(self.status, width - 4)
        if self.history.latest is not None:
            below.append(self._flags())
        room = height - 2 - numbers.row_count - len(below) - 1
        body: list[RenderableType] = [numbers, Text("")]
        if room >= 5 and self.history.latest is not None:
            body.append(self._plots(width - 4, room))
        yield Panel(
            Group(*body, *below),
            title=title,
            title_align="left",
            subtitle=self.footer,
            subtitle_align="right",
            padding=(0, 1),
            width=width,
        )

    def _numbers(self, width: int) -> Table:
        """Stiffness, torque, deflection: value, band, truth, sparkline."""
        table = Table.grid(padding=(0, 2, 0, 0))
        for least in (10, 25, 26):
            table.add_column(no_wrap=True, min_width=least)
        table.add_column(no_wrap=True, ratio=1)
        estimate, window = self.history.latest, self.history.window()
        if estimate is None:
            waiting = Table.grid()
            waiting.add_row(Text("waiting for the first estimate …", style="dim"))
            return waiting
        last = window[-1]
        errors = self.history.relative_errors()
        spark = max(6, width - 69)
        known = math.isfinite(last.true_stiffness_nm_rad)
        half = _half(estimate)
        band = f" ± {number(half, 2)}" if math.isfinite(half) else ""
        for label, value, extra, unit, true, error, series in (
            ("stiffness", last.stiffness_nm_rad, band, "N·m/rad", last.true_stiffness_nm_rad, errors[0],
             [m.stiffness_nm_rad for m in window]),
            ("torque", last.torque_nm, "", "N·m", last.true_torque_nm, errors[1],
             [m.torque_nm for m in window]),
        ):  # fmt: skip
            table.add_row(
                label,
                Text.assemble((number(value), f"bold {ESTIMATE}"), extra, f" {unit}"),
                Text.assemble(
                    "truth ",
                    (number(true), TRUTH),
                    f"  error {100 * error:.2f} %" if math.isfinite(error) else "",
                )
                if known
                else "",
                Text(sparkline(series, spark), style=ESTIMATE),
            )
        deflection = "   ".join(number(one.deflection_rad, 4) for one in estimate.transmissions)
        table.add_row("deflection", f"{deflection} rad", self._each(estimate) if not known else "", "")
        return table

    @staticmethod
    def _each(estimate: EstimateLike) -> str:
        if len(estimate.transmissions) < 2:
            return ""
        return "each " + " | ".join(number(one.stiffness_nm_rad) for one in estimate.transmissions)

    def _plots(self, width: int, height: int) -> Table:
        half = (width - 2) // 2
        grid = Table.grid(padding=(0, 2, 0, 0))
        grid.add_row(self._curve_plot(half, height), self._torque_plot(width - 2 - half, height))
        return grid

    def _curve_plot(self, width: int, height: int) -> Text:
        curves = [curve.points() for curve in self.history.curves]
        points = [point for curve in curves for point in curve]
        stiffness = [point[1] for point in points]
        margin = 0.15 * (max(stiffness) - min(stiffness)) + 0.02 * abs(max(stiffness)) if stiffness else 0.0
        y = (min(stiffness) - margin, max(stiffness) + margin) if stiffness else (math.nan, math.nan)
        x = (min(p[0] for p in points), max(p[0] for p in points)) if points else (math.nan, math.nan)
        plot = DotPlot(width, height, x, y)
        for k, curve in enumerate(curves):
            plot.band([(p, s - _SIGMA_95 * d, s + _SIGMA_95 * d) for p, s, d in curve], BAND)
            plot.curve([(p, s) for p, s, _ in curve], ESTIMATE if k == 0 else _SECOND)
        if not points:
            plot.note("not observable yet")
        title = "stiffness against deflection"
        return plot.render(title if width >= 38 else "stiffness", "rad")

    def _torque_plot(self, width: int, height: int) -> Text:
        window = self.history.window()
        end = window[-1].time_s if window else 0.0
        values = [v for m in window for v in (m.torque_nm, m.true_torque_nm) if math.isfinite(v)]
        y = (min(values), max(values)) if values else (math.nan, math.nan)
        plot = DotPlot(width, height, (-self.history.seconds, 0.0), y)
        plot.curve([(m.time_s - end, m.true_torque_nm) for m in window], TRUTH)
        plot.curve([(m.time_s - end, m.torque_nm) for m in window], ESTIMATE)
        if not values:
            plot.note("no torque yet")
        return plot.render("torque over time", "s")

    def _flags(self) -> Text:
        estimate = self.history.latest
        text = Text(no_wrap=True)
        for label, style in flags(estimate.status if estimate else 0):
            text.append(f"● {label}  ", style=style)
        return text


def flags(status: int) -> list[tuple[str, str]]:
    """What the status bits say, each with its style, the two that matter most first."""
    found = [
        ("valid", "green") if status & Status.VALID else ("not valid", "red"),
        ("observable", "green") if status & Status.OBSERVABLE else ("not observable", "yellow"),
    ]
    return found + [(label, style) for bit, label, style in _FLAGS if status & bit]


def joints_table(views: Mapping[str, JointView], width: int) -> Table:
    """Several joints, one line each, for a terminal of so many columns."""
    table = Table(expand=True, box=None, pad_edge=False)
    for heading in ("joint", "stiffness / N·m/rad", "torque / N·m", "deflection / rad"):
        table.add_column(heading, no_wrap=True)
    table.add_column("state", no_wrap=True, ratio=1)
    for name, view in sorted(views.items()):
        estimate = view.history.latest
        state = view.state or "–"
        if estimate is None:
            table.add_row(Text(name, style="bold"), "–", "–", "–", state)
            continue
        window = view.history.window()
        spark = sparkline([m.stiffness_nm_rad for m in window], max(6, width - 72))
        worst = [(label, style) for label, style in flags(estimate.status) if style != "green"]
        if view.gone:
            worst = [(state, "bold red")]
        table.add_row(
            Text(name, style="bold"),
            Text.assemble(
                (number(estimate.stiffness_nm_rad), ESTIMATE), f" ± {number(_half(estimate), 2)} ", spark
            ),
            number(estimate.flexibility_torque_nm),
            " ".join(number(one.deflection_rad, 3) for one in estimate.transmissions),
            Text(*worst[0]) if worst else Text(state if state != "–" else "valid", style="green"),
        )
    return table


def _half(estimate: EstimateLike) -> float:
    """Half the 95 % interval of the joint's stiffness."""
    return _SIGMA_95 * estimate.stiffness_std_nm_rad
