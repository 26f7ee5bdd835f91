"""Two models beside each other, and beside the machine: free runs, correlations of the residual, curves."""

import contextlib
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure

from drivelink.output import plots
from drivelink.output.document import Block, Chart, Document, Grid, Paragraph, Rows, Section, as_text
from drivelink.output.numbers import Units, number, value_and_interval
from estimator.comparison import Correlation, Curve, correlations, friction_curve, stiffness_curve
from estimator.errors import EstimatorError
from estimator.freerun import FreeRun, free_run, simulation_s
from estimator.model import JointModel
from estimator.reasons import percent
from estimator.sample import SIGMA_95, Record

_POINTS = 200
_SHOWN_S = 10.0  # of a free run in the picture
_REACH_RAD, _SPEED_RAD_S = 0.2, 1.0  # of curves where no recording says how far
_DIVERGES = -100.0  # %: further off than twice the motion's size
_WIDTH = 4.6  # inches: half a page


class Side(NamedTuple):
    """One of the two: a model, and the recording that it is fitted to, if it is one."""

    name: str
    model: JointModel
    record: Record | None


class Difference(NamedTuple):
    """Two curves where they differ most: stiffness at a deflection, rad; friction at a velocity, rad/s."""

    motor: int
    kind: str
    at: float
    a: float
    b: float
    std: float


@dataclass(frozen=True, slots=True)
class Comparison:
    """Both sides, and free runs of both models over each recording.

    Attributes:
        sides: A and B.
        runs: (recording's side, run of A, run of B) of each.
        units: of the axis.
    """

    sides: tuple[Side, Side]
    runs: tuple[tuple[Side, FreeRun, FreeRun], ...]
    units: Units

    def __repr__(self) -> str:
        return as_text([Section("", [Paragraph(self.about)]), *self.sections()])

    def residuals(self, side: Side, run: FreeRun) -> tuple[Correlation, Correlation]:
        """Return the correlations of the residual of one free run: that of the first motor's last channel."""
        assert side.record is not None
        return correlations(run, side.record, self.channel(run), 0, run.horizon_s / 4.0)

    def channel(self, run: FreeRun) -> int:
        """Return the first motor's deflection, or its position where that is rigid."""
        return run.channels.index(
            next((c for c in run.channels if c == "motor1_deflection"), run.channels[0])
        )

    def curves(self, motor: int) -> dict[str, list[tuple[str, Curve]]]:
        """Return the stiffness over deflection and friction over velocity of one motor, of both sides."""
        reach, speed = _ranges([side.record for side in self.sides if side.record is not None], motor)
        phi, velocity = np.linspace(-reach, reach, _POINTS), np.linspace(-speed, speed, _POINTS)
        made: dict[str, list[tuple[str, Curve]]] = {"stiffness": [], "friction": []}
        for letter, side in zip("AB", self.sides, strict=True):
            own = side.model.motors[motor]
            if (curve := stiffness_curve(own, phi)) is not None:
                made["stiffness"].append((letter, curve))
            made["friction"].append((letter, friction_curve(own, velocity)))
        return made

    def differences(self) -> list[Difference]:
        """Return where each pair of curves differs by most standard deviations, or most at all."""
        made = []
        for motor in range(len(self.sides[0].model.motors)):
            for kind, curves in self.curves(motor).items():
                if len(curves) == 2:
                    (_, a), (_, b) = curves
                    apart, std = b.y - a.y, np.hypot(a.std, b.std)
                    k = int(np.argmax(np.abs(apart) / std if np.all(std > 0.0) else np.abs(apart)))
                    place = [float(values[k]) for values in (a.x, a.y, b.y, std)]
                    made.append(Difference(motor + 1, kind, *place))
        return made

    def as_json(self) -> dict[str, Any]:
        """Return what the page says, as numbers."""
        document: dict[str, Any] = {"schema": "drivelink.comparison/1"}
        document |= {letter: side.name for letter, side in zip("ab", self.sides, strict=True)}
        document["curves"] = [one._asdict() for one in self.differences()]
        document["free_runs"] = [
            {
                "recording": side.name,
                "horizon_s": [run.horizon_s for run in runs],
                "fit_percent": dict(zip("ab", (dict(run.fit_percent) for run in runs), strict=True)),
                "coasting_percent": dict(runs[0].coasting_percent),
            }
            for side, *runs in self.runs
        ]
        return document

    def document(self) -> Document:
        """Return the page."""
        return Document("A beside B", self.about, self.sections())

    @property
    def about(self) -> str:
        """Which is A, and which B."""
        return " · ".join(f"{letter}: {side.name}" for letter, side in zip("AB", self.sides, strict=True))

    def sections(self) -> list[Section]:
        """Return the page's sections."""
        sections = [Section("Where the curves differ most", [self._differences()])]
        for side, *runs in self.runs:
            sections.append(fits(dict(zip("AB", runs, strict=True)), side.name))
            over = Chart(partial(self._over, side, runs), "measured and simulated")
            text = "residual of that channel; bands: 95 % of chance"
            left = Chart(partial(self._correlated, side, runs), text)
            sections.append(Section(f"Over {side.name}", [over, left]))
        for motor in range(len(self.sides[0].model.motors)):
            kinds = [kind for kind, curves in self.curves(motor).items() if curves]
            charts: list[Block] = [Chart(partial(self._curve, motor, kind)) for kind in kinds]
            sections.append(Section(f"Motor {motor + 1}", charts))
        return sections

    def _differences(self) -> Grid:
        rows: Rows = []
        found = {(one.motor, one.kind): one for one in self.differences()}
        for motor in range(len(self.sides[0].model.motors)):
            rows.append((f"motor {motor + 1}",))
            flexible = all(side.model.motors[motor].flexible for side in self.sides)
            if flexible and (motor + 1, "stiffness") not in found:
                known = [letter for letter, _ in self.curves(motor)["stiffness"]]
                each = ["known" if letter in known else "not known" for letter in "AB"]
                rows.append(("stiffness", *each, "", ""))
            kinds = ("stiffness", "friction")
            rows += [self._row(found[motor + 1, kind]) for kind in kinds if (motor + 1, kind) in found]
        return Grid(("", "A", "B", "at", "apart"), rows)

    def _row(self, one: Difference) -> tuple[str, ...]:
        unit = self.units.shown("(N·m/rad)" if one.kind == "stiffness" else "N·m")
        apart = f"{abs(one.b - one.a) / one.std:.1f} σ" if one.std > 0.0 else "–"
        at = f"{number(one.at, 3)} {self.units.shown('rad' if one.kind == 'stiffness' else 'rad/s')}"
        both = one.a, one.b
        a, b = (value_and_interval(x, SIGMA_95 * one.std, max(map(abs, both)))[0] for x in both)
        return (f"{one.kind} / {unit}", a, b, at, apart)

    def _over(self, side: Side, runs: Sequence[FreeRun]) -> Figure:
        run, j = runs[0], self.channel(runs[0])
        n = int(np.searchsorted(run.time_s, run.time_s[0] + _SHOWN_S))
        curves = {"measured": plots.PlotCurve(run.time_s[:n], run.measured_rad[:n, j])}
        for letter, one in zip("AB", runs, strict=True):
            curves[letter] = plots.PlotCurve(one.time_s[:n], one.simulated_rad[:n, j])
        figure, (axes,) = plots.new_figure(width=_WIDTH)
        label = self.units.label(f"{_in_words(run.channels[j])} / rad")
        plots.over_time(axes, curves, label, side.name)
        return figure

    def _correlated(self, side: Side, runs: Sequence[FreeRun]) -> Figure:
        figure, all_axes = plots.new_figure(rows=2, width=_WIDTH, height=2.0)
        both = zip(*(self.residuals(side, run) for run in runs), strict=True)
        titles = "residual with itself", "residual with motor torque"
        for axes, title, ones in zip(all_axes, titles, both, strict=True):
            curves = {a: plots.PlotCurve(one.lag_s, one.value) for a, one in zip("AB", ones, strict=True)}
            plots.xy(axes, curves, "lag / s", "correlation", title)
            band = max(one.band for one in ones)
            axes.axhspan(-band, band, color="#000000", alpha=0.12)
        return figure

    def _curve(self, motor: int, kind: str) -> Figure:
        figure, (axes,) = plots.new_figure(width=_WIDTH)
        labels = {
            "stiffness": ("deflection / rad", "stiffness / (N·m/rad)"),
            "friction": ("motor velocity / (rad/s)", "friction / N·m"),
        }
        across, up = (self.units.label(text) for text in labels[kind])
        curves = {letter: plots.PlotCurve(*curve) for letter, curve in self.curves(motor)[kind]}
        plots.xy(axes, curves, across, up, kind)
        return figure


def simulated(record: Record, **models: JointModel) -> dict[str, FreeRun]:
    """Return the free runs of a report, by name, of those models that can be simulated."""
    made = {}
    for name, model in models.items():
        with contextlib.suppress(EstimatorError):
            made[name] = free_run(record, model, simulation_s(record))
    return made


def fits(runs: Mapping[str, FreeRun], of: str) -> Section:
    """Tabulate how well free runs of a recording fit, by channel; empty without a run."""
    first = next(iter(runs.values()), None)
    if first is None:
        return Section("", [])
    columns = {name: [_fit(run.fit_percent[c]) for c in first.channels] for name, run in runs.items()}
    if any(fit >= 0.0 for fit in first.coasting_percent.values()):  # the mean is a better rival else
        at_constant = [first.coasting_percent[channel] for channel in first.channels]
        columns["at constant velocity"] = [_fit(fit) if not fit < 0.0 else "below 0 %" for fit in at_constant]
    rows: Rows = list(zip(map(_in_words, first.channels), *columns.values(), strict=True))
    heads = (f"fit of {of}", *columns)
    return Section(f"Free run, from measured states every {first.horizon_s:.3g} s", [Grid(heads, rows)])


def _fit(fit_percent: float) -> str:
    if math.isnan(fit_percent):  # a channel that does not vary
        return "–"
    return "diverges" if fit_percent < _DIVERGES else percent(0.01 * fit_percent, 1)


def fits_json(runs: Mapping[str, FreeRun], of: str) -> dict[str, Any]:
    """Return the same as a document."""
    document: dict[str, Any] = {"recording": of}
    for name, run in runs.items():
        document |= {"horizon_s": run.horizon_s, "constant_velocity": dict(run.coasting_percent)}
        document[name] = dict(run.fit_percent)
    return document


def beside(
    name: str, models: Sequence[JointModel], runs: Mapping[str, FreeRun], record: Record, units: Units
) -> list[Section]:
    """Return a report's sections: a model as declared (A) and as found (B) beside the machine.

    None where one of them cannot be simulated.
    """
    if len(runs) < len(models):
        return []
    (before, after), (first, second) = models, runs.values()
    declared, found = Side("as declared", before, record), Side("as found", after, None)
    made = Comparison((declared, found), ((declared._replace(name=name), first, second),), units)
    about = Paragraph("A: the model as declared. B: with what was found.")
    return [Section("Model beside machine", [about]), *made.sections()]


def _in_words(channel: str) -> str:
    return channel.replace("motor", "motor ").replace("_", " ")


def _ranges(records: Sequence[Record], motor: int) -> tuple[float, float]:
    """Largest deflection and motor velocity of the recordings."""
    reach, speed = 0.0, 0.0
    for record in records:
        theta = record.motor_position_rad[:, motor]
        speed = max(speed, float(np.percentile(np.abs(np.gradient(theta, record.time_s)), 99.0)))
        if record.link_position_rad is not None:
            reach = max(reach, float(np.max(np.abs(record.link_position_rad - theta))))
    return reach or _REACH_RAD, speed or _SPEED_RAD_S
