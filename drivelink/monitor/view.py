"""Terminal widgets of a joint's live view, for `monitor` and `demo`, from 80 columns by 24 lines on.

view = JointView("elbow", subtitle="vsa-ii on the virtual bus")
with rich.live.Live(view, auto_refresh=False) as live:
    view.update(estimate, time_s, truth)     # every cycle if you like, some microseconds
    view.status = latest_status              # the JSON of the status key
    live.refresh()                           # some times a second, by the thread that updates
print(view.line())                           # the same in one plain line, where there is no terminal
"""

import math
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

from rich.console import Console, ConsoleOptions, Group, RenderableType, RenderResult
from rich.panel import Panel
from rich.table import Table
from rich.text import Text

from drivelink.monitor.braille import DotPlot, sparkline
from drivelink.monitor.history import JointHistory, TruePoint, model_curves
from drivelink.monitor.legend import joint_legend
from drivelink.monitor.statuslines import external_doubt, shape, status_lines, status_text
from drivelink.output.numbers import (
    among,
    number,
    shared_range,
    usual_range,
    value_and_interval,
    with_interval,
)
from drivelink.pubsub.wire import EstimateMessage, ExternalMessage
from estimator.sample import SIGMA_95, Status

ESTIMATE = "cyan"
TRUTH = "yellow"
BAND = "blue"
_SECOND = "magenta"  # the second transmission
_GREY = "bright_black"  # what is not valid, and the model's curve

_ONE = {Status.TORQUE_VALID: "torque valid", Status.STIFFNESS_VALID: "stiffness valid"}
_UNSHOWN = Status.VALID | Status.OBSERVABLE | Status.PARTIAL | Status.TORQUE_VALID | Status.STIFFNESS_VALID
_UNUSABLE = Status.having("unusable")
_TWO_ROWS = 20  # lines of the plots from which there are four
SILENT_S = 1.0  # without an estimate, until the shown one is marked as old


class JointView:
    """One joint, live: numbers with their band, curves, cycle, drives; a renderable of `rich`.

    Args:
        subtitle: e.g. its case or bus.
        height: lines; default: those of the terminal.
    """

    def __init__(self, name: str, *, subtitle: str = "", height: int | None = None) -> None:
        self.name = name
        self.subtitle = subtitle
        self.footer = ""  # the last line, e.g. how to quit.
        self.history = JointHistory()  # data of the view
        self._status: Mapping[str, Any] = {}
        self.model: Mapping[str, Any] = {}  # the model document, or empty
        self.finding: Mapping[str, Any] = {}  # the newest finding, or empty
        # relative rms errors of stiffness and torque against the truth of a simulation, or nan
        self.errors = (math.nan, math.nan)
        self.gone = False  # the daemon has ended or died
        self.hint = ""  # why there is no estimate, or empty
        self.silent_s = 0.0  # time since the last estimate
        self.help = False  # show the legend in place of the plots
        self._height = height

    def update(self, estimate: EstimateMessage, time_s: float, truth: TruePoint | None = None) -> None:
        """Enter one estimate and, in a simulation, the truth at the same instant."""
        self.history.add(estimate, time_s, truth)

    def update_external(self, message: ExternalMessage, time_s: float) -> None:
        """Enter one external torque."""
        self.history.add_external(message, time_s)

    @property
    def status(self) -> Mapping[str, Any]:
        """The joint's status message; why no estimate is valid, only while none is."""
        latest = self.history.latest
        if latest is None or not latest.status & Status.VALID or "not_valid" not in self._status:
            return self._status
        return {**self._status, "not_valid": ""}

    @status.setter
    def status(self, status: Mapping[str, Any]) -> None:
        if status is self._status:
            return
        self._status = status
        ratio = shape(status).ratio
        if ratio is not None:
            self.history.add_residual(ratio)

    @property
    def live(self) -> bool:
        """Whether the numbers are current."""
        return not self.gone and self.silent_s < SILENT_S

    @property
    def state(self) -> str:
        """The daemon's state, or that it is gone, silent or was never there."""
        if self.hint and self.history.latest is None:
            return self.hint
        if self.live:
            return shape(self.status).state
        since = f", last estimate {self.silent_s:.0f} s ago" if self.silent_s >= SILENT_S else ""
        return f"{'daemon gone' if self.gone else 'no estimates'}{since}"

    @property
    def flags(self) -> list[tuple[str, str]]:
        """The newest estimate's status bits with their styles; only the fact if it is old."""
        estimate = self.history.latest
        if estimate is None:
            return []
        if not self.live:
            return [(self.state, "bold red")]
        touch = self.history.touch
        return flags(estimate.status) + ([("contact", "yellow")] if touch and touch.contact else [])

    @property
    def well(self) -> bool:
        """Whether the newest estimate is there, current and usable."""
        return bool(self.flags) and not any("red" in style for _, style in self.flags)

    def line(self) -> str:
        """Return the joint in one plain line, for pipes and logs."""
        estimate = self.history.latest
        if estimate is None:
            return f"{self.name}: {self.hint or 'no estimate yet'}"
        if not self.live:
            return f"{self.name}: {self.state.partition(',')[0]}"
        parts = [
            f"{self.name}:",
            f"stiffness {with_interval(estimate.stiffness_nm_rad, half_interval(estimate), 'N·m/rad')},",
            f"torque {''.join(self._torque_and_interval(estimate.flexibility_torque_nm))} N·m,",
            *self._external_words(),
            f"deflection {self.deflections(' ')}",
            "rad, " + ", ".join(text for text, _ in self.flags),
        ]
        if math.isfinite(self.errors[0]) and estimate.status & Status.VALID:
            parts[-1] += f", stiffness rms error {100 * self.errors[0]:.2f} %"
        if said := status_text(self.status, self.model, self.finding):
            parts[-1] += f", {said}"
        return " ".join(parts)

    def _torque(self, value_nm: float) -> str:
        return among(value_nm, self.history.largest_torque_nm)

    def _torque_and_interval(self, value_nm: float) -> tuple[str, str]:
        """Return a torque, and half its 95 % interval by the newest status; empty where unknown."""
        value, half = value_and_interval(value_nm, SIGMA_95 * (shape(self.status or {}).torque_std_nm or 0.0))
        return (value, f" ± {half}") if half else (self._torque(value_nm), "")

    def deflections(self, between: str) -> str:
        """Return the deflection of each transmission now."""
        ones = self.history.latest.transmissions if self.history.latest else ()
        return between.join(among(one.deflection_rad, self.history.largest_deflection_rad, 3) for one in ones)

    def _external_words(self) -> list[str]:
        touch = self.history.touch
        if touch is None:
            return []
        said = with_interval(touch.torque_nm, SIGMA_95 * touch.std_nm, "N·m") if touch.valid else "not valid"
        why = f" ({doubt})" if (doubt := self.external_doubt(True)) else ""
        return [f"external {said}{why},"]

    def external_doubt(self, brief: bool = False) -> str:
        """Return why the external torque is not valid; empty: it is, or there is none.

        Args:
            brief: where the estimate's own reason is said beside it.
        """
        touch, estimate = self.history.touch, self.history.latest
        if touch is None or touch.valid:
            return ""
        valid = estimate is not None and bool(estimate.status & Status.VALID)
        return "as the estimate" if brief and not valid else external_doubt(self.status, valid)

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        width = options.max_width
        height = self._height or console.size.height - 1
        title = Text.assemble((self.name, "bold"), f" · {self.subtitle}" if self.subtitle else "")
        if self.state:
            title.append(f" · {self.state}", style="" if self.live else "bold red")
        numbers = self._numbers(width - 4)
        room = height - 2 - numbers.row_count - 1
        below = status_lines(self.status, width - 4, self.model, self.finding, max(0, room - 1))
        below = below if self.live else []
        if self.history.latest is not None:
            below.append(Text.assemble(*((f"● {label}  ", ink) for label, ink in self.flags), no_wrap=True))
        room -= len(below)
        body: list[RenderableType] = [numbers, *([Text("")] if room >= 0 else [])]
        if self.help:
            body, below = [self._legend()], []
        elif room >= 5 and self.history.latest is not None:
            body.append(self._plots(width - 4, room))
        yield Panel(
            Group(*body, *below),
            title=title,
            title_align="left",
            subtitle=Text(self.footer, style="dim") if self.footer else None,
            subtitle_align="right",
            padding=(0, 1),
            width=width,
        )

    def _numbers(self, width: int) -> Table:
        """Stiffness, torque, deflection: value, band, truth, sparkline."""
        estimate, window = self.history.latest, self.history.window()
        if estimate is None:
            waiting = Table.grid()
            waiting.add_row(Text("waiting for the first estimate …", style="dim"))
            return waiting
        last = window[-1]
        known = math.isfinite(last.true_stiffness_nm_rad)
        spark = width - (78 if known else 69)
        table = Table.grid(padding=(0, 2, 0, 0))
        for least in (10, 25, 26)[: 3 if width >= 65 else 2]:
            table.add_column(no_wrap=True, min_width=least)
        if spark >= 4:
            table.add_column(no_wrap=True, ratio=1)
        stiffness, half = value_and_interval(last.stiffness_nm_rad, half_interval(estimate))
        band = f" ± {half}" if half else ""
        torque, torque_band = self._torque_and_interval(last.torque_nm)
        rows: list[tuple[RenderableType, ...]] = []
        for label, value, extra, unit, true, error, series, valid in (
            ("stiffness", stiffness, band, "N·m/rad", last.true_stiffness_nm_rad, self.errors[0],
             [m.stiffness_nm_rad if m.stiffness_valid else math.nan for m in window], last.stiffness_valid),
            ("torque", torque, torque_band, "N·m", last.true_torque_nm, self.errors[1],
             [m.torque_nm if m.torque_valid else math.nan for m in window], last.torque_valid),
        ):  # fmt: skip
            ink = ESTIMATE if self.live and valid else "dim"
            truth = Text.assemble(
                "truth ",
                (number(true) if label == "stiffness" else self._torque(true), TRUTH),
                f"  rms error {100 * error:.2f} %" if valid and math.isfinite(error) else "",
            )
            shown = Text.assemble((value, f"bold {ink}"), extra, f" {unit}")
            rows.append((label, shown, truth if known else "", Text(sparkline(series, spark), style=ink)))
        rows += self._external(spark, ESTIMATE if self.live and last.torque_valid else "dim")
        several = [number(one.stiffness_nm_rad) for one in estimate.transmissions]
        each = f"each {' | '.join(several)}" if several[1:] and not known else ""
        rows.append(("deflection", f"{self.deflections('   ')} rad", each, ""))
        for row in rows:
            table.add_row(*row[: len(table.columns)])
        return table

    def _external(self, spark: int, ink: str) -> list[tuple[RenderableType, ...]]:
        """The row of the external torque; none without link dynamics."""
        touch = self.history.touch
        if touch is None:
            return []
        series = [t.torque_nm if t.valid else math.nan for t in self.history.touches]
        value, half = value_and_interval(touch.torque_nm, SIGMA_95 * touch.std_nm)
        shown = Text.assemble(
            (value if touch.valid else "not valid", f"bold {ink}"), f" ± {half} N·m" if touch.valid else ""
        )
        contact = Text("contact", style="bold yellow") if touch.contact and self.live else Text("")
        doubt = Text(self.external_doubt(True), style="dim")
        return [
            ("external", shown, contact if touch.valid else doubt, Text(sparkline(series, spark), style=ink))
        ]

    def _legend(self) -> Table:
        latest, window = self.history.latest, self.history.window()
        return joint_legend(
            motors=len(latest.transmissions) if latest else 1,
            external=self.history.touch is not None,
            truth=bool(window) and math.isfinite(window[-1].true_stiffness_nm_rad),
        )

    def _plots(self, width: int, height: int) -> Table:
        half = (width - 2) // 2
        torque = partial(self._over_time, "torque_nm", "torque over time, N·m")
        rows: list[tuple[Callable[[int, int], Text], ...]] = [(self._curve_plot, torque)]
        if height >= _TWO_ROWS:
            stiffness = partial(self._over_time, "stiffness_nm_rad", "stiffness over time, N·m/rad")
            rows.append((stiffness, self._last_plot))
        grid = Table.grid(padding=(0, 2, 0, 0))
        for left, right in rows:
            grid.add_row(left(half, height // len(rows)), right(width - 2 - half, height // len(rows)))
        return grid

    def _curve_plot(self, width: int, height: int) -> Text:
        curves = [curve.points() for curve in self.history.curves]
        grey = [curve.points() for curve in self.history.doubtful]
        fitted = model_curves(self.model, curves if any(curves) else grey)
        points = [point for curve in (*curves, *grey) for point in curve]
        low, high = shared_range(*([p[1] for curve in each for p in curve] for each in (curves, grey)))
        margin = 0.15 * (high - low) + 0.02 * abs(high)
        x = usual_range([point[0] for point in points])
        plot = DotPlot(width, height, x, (low - margin, high + margin))
        for line in fitted:
            plot.curve(line, _GREY, every=2)
        for curve in grey:
            plot.curve([(p, s) for p, s, _ in curve], _GREY)
        for k, curve in enumerate(curves):
            plot.band([(p, s - SIGMA_95 * d, s + SIGMA_95 * d) for p, s, d in curve], BAND)
            plot.curve([(p, s) for p, s, _ in curve], ESTIMATE if k == 0 else _SECOND)
        if self.live and self.history.latest is not None and points:
            for one in self.history.latest.transmissions:
                plot.mark(one.deflection_rad, one.stiffness_nm_rad, "bold")
        if not points:
            plot.note(self._no_stiffness())
        title = "stiffness over deflection, N·m/rad"
        return plot.render(title if width >= 41 else "stiffness, N·m/rad", "rad")

    def _why_empty(self) -> str:
        """Why there is no curve yet."""
        return shape(self.status).not_valid or "no values yet"

    def _no_stiffness(self) -> str:
        """Why there is no stiffness yet, or never."""
        return "a rigid joint has none" if shape({}, self.model).rigid else self._why_empty()

    def _time_plot(
        self,
        width: int,
        height: int,
        title: str,
        series: Sequence[tuple[float, float, bool]],
        truth: Sequence[float] = (),
        empty: str = "",
    ) -> Text:
        """(time, value, valid) over time; what is not valid is grey."""
        end = series[-1][0] if series else 0.0
        sure = [value for _, value, valid in series if valid]
        y = shared_range([*sure, *truth], [value for _, value, valid in series if not valid])
        plot = DotPlot(width, height, (-self.history.seconds, 0.0), y)
        if truth:
            times = [time_s - end for time_s, *_ in series]
            plot.curve(list(zip(times, truth, strict=True)), TRUTH)
        for wanted, ink in ((False, _GREY), (True, ESTIMATE)):
            plot.curve([(t - end, value if valid is wanted else math.nan) for t, value, valid in series], ink)
        if math.isnan(y[0]):
            plot.note(empty or self._why_empty())
        return plot.render(title, "s")

    def _over_time(self, name: str, title: str, width: int, height: int) -> Text:
        """Plot a value of the moments, with its truth where that is known."""
        moments = self.history.window()
        seen = "stiffness_valid" if name == "stiffness_nm_rad" else "torque_valid"
        series = [(m.time_s, getattr(m, name), getattr(m, seen)) for m in moments]
        truth = [getattr(m, f"true_{name}") for m in moments]
        return self._time_plot(width, height, title, series, truth)

    def _last_plot(self, width: int, height: int) -> Text:
        """Return the external torque where the link is known, else the residual."""
        if touches := self.history.touches:
            series = [(t.time_s, t.torque_nm, t.valid) for t in touches]
            return self._time_plot(width, height, "external torque over time, N·m", series)
        series = [(time_s, ratio, True) for time_s, ratio in self.history.residuals]
        title = "residual over time, × its baseline"
        return self._time_plot(width, height, title, series, empty=shape(self.status or {}).no_gauge)


def flags(status: int) -> list[tuple[str, str]]:
    """Return the status bits with their styles: validity, what forbids use (red), the rest."""
    found = [("valid", "green") if status & Status.VALID else ("not valid", "red")]
    if not status & Status.STALE:  # of no motion nobody knows what it reveals
        found.append(("observable", "green") if status & Status.OBSERVABLE else ("not observable", "yellow"))
    if not status & Status.VALID:
        found += [(one, "green") for bit, one in _ONE.items() if status & bit]
    bits = sorted((bit for bit in Status if status & bit & ~_UNSHOWN), key=lambda bit: not bit & _UNUSABLE)
    names = [str(bit.name).lower().replace("_", " ") for bit in bits]
    styles = ["bold red" if bit & _UNUSABLE else "yellow" for bit in bits]
    return found + list(zip(names, styles, strict=True))


def half_interval(estimate: EstimateMessage) -> float:
    """Return half the 95 % interval of the joint's stiffness."""
    return SIGMA_95 * estimate.stiffness_std_nm_rad
