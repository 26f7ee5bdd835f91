"""Writes the report of a diagnosis: report.json for programs, report.html for people."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from functools import partial
from itertools import groupby
from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure

from drivelink.output import plots
from drivelink.output.comparison import fits_json
from drivelink.output.document import (
    PARAMETER_HEAD,
    Block,
    Chart,
    Document,
    Grid,
    Lines,
    Paragraph,
    Rows,
    Section,
    Share,
    cell_text,
    page,
    parameter_rows,
)
from drivelink.output.numbers import Units, among, number
from drivelink.output.sentences import SURE, free_curve, others_of, sentence, title_of, unexplained
from estimator.choices import choice
from estimator.diagnosis import Curve, Diagnosis, Finding, StiffnessCurve
from estimator.effects import LIBRARY, in_words
from estimator.freerun import FreeRun
from estimator.reasons import percent
from estimator.sample import SIGMA_95

_SCHEMA = "drivelink.diagnosis/1"
_CURVE_POINTS = 200
_RIVALS = 8
_COLUMN = 4.6  # inches of a plot in half the page, or on a phone
_AXES = {
    "position": "motor position / rad",
    "velocity": "motor velocity / (rad/s)",
    "acceleration": "motor acceleration / (rad/s²)",
    "deflection": "deflection / rad",
    "deflection_rate": "deflection rate / (rad/s)",
    "torque": "motor torque / N·m",
    "torque_rate": "torque rate / (N·m/s)",
    "flexibility_torque": "flexibility torque / N·m",
    "link_position": "link position / rad",
    "link_velocity": "link velocity / (rad/s)",
    "link_acceleration": "link acceleration / (rad/s²)",
    "time": "time / s",
}


class Title(NamedTuple):
    """Subject of the report."""

    joint: str
    recording: str
    validation: str | None
    linear: bool = False


def as_json(outcome: Diagnosis, runs: Mapping[str, FreeRun], of: str) -> dict[str, Any]:
    """Return the content of report.json.

    Args:
        runs: free runs of the joint as "declared" and with what was "found", where it can be simulated.
        of: the recording that they are of.
    """
    unlisted = free_curve(outcome)
    return {
        "schema": _SCHEMA,
        "verdict": outcome.verdict,
        "bandwidth_hz": outcome.bandwidth_hz,
        "effects": [_effect(finding, unlisted) for finding in outcome.effects],
        "error": {"train": outcome.train._asdict(), "validation": outcome.validation._asdict()},
        "transmissions": [asdict(one) for one in outcome.transmissions],
        "recordings": [
            {"train": one.train._asdict(), "validation": one.validation and one.validation._asdict()}
            for one in outcome.recordings
        ],
        "alignment": dict(outcome.alignment),
        "alignment_std": dict(outcome.alignment_std),
        "candidates": [_numbered(rival._asdict()) for rival in outcome.rivals],
        "advice": list(outcome.advice),
        "notes": list(outcome.notes),
        "free_run": fits_json(runs, of),
    }


def _effect(finding: Finding, unlisted: Curve | None) -> dict[str, Any]:
    entry = _numbered(asdict(finding))
    if not finding.coordinates:
        del entry["coordinates"]
    elif unlisted is not None:
        entry["curve"] = _points(unlisted)
    return entry


def _numbered(entry: dict[str, Any]) -> dict[str, Any]:
    """Return an entry with the number of its motor, not the index; without any at the link."""
    motor = entry.pop("motor")
    return entry if motor is None else {**entry, "motor": motor + 1}


def _points(curve: Curve) -> dict[str, list[float]]:
    """Return the fitted curve, a few hundred points in order of the first coordinate."""
    order = np.argsort(curve.x)
    pick = order[np.unique(np.linspace(0, len(order) - 1, _CURVE_POINTS).astype(int))]
    points = {curve.coordinates[0]: curve.x[pick].tolist()}
    if curve.second is not None:
        points[curve.coordinates[1]] = curve.second[pick].tolist()
    return {**points, "torque_nm": curve.fitted_nm[pick].tolist()}


def html_page(outcome: Diagnosis, title: Title, more: Sequence[Section] = ()) -> str:
    """Draw the report as one self-contained page; `more` follows what was found."""
    on, band = title.validation or "held-out blocks of the same recording", f"{outcome.bandwidth_hz:.3g} Hz"
    about = f"Diagnosis of {title.recording}, validated on {on}; all channels filtered alike at {band}."
    made = [*sections(outcome, Units(title.linear)), *more]
    return page(Document(f"{title.joint}: diagnosis", about, made))


def sections(outcome: Diagnosis, units: Units) -> list[Section]:
    """Describe and draw what was found, for a page and for a terminal."""
    sure = all(finding.probability >= SURE for finding in outcome.effects)
    label = f"{'' if sure else 'likely '}{outcome.verdict.replace('_', ' ')}"
    verdict = Paragraph(sentence(outcome), label, f"verdict {outcome.verdict}")
    wide = max(len(outcome.curves), len(outcome.stiffness)) > 1
    made = [
        Section("", [verdict, Paragraph(unexplained(outcome, units))]),
        Section("Error of the motor torque balance", [_errors(outcome, units)]),
        Section("What reveals it", [_curve_chart(curve, units) for curve in outcome.curves], wide),
        Section("Stiffness before and after", [_stiffness_chart(s, units) for s in outcome.stiffness], wide),
        Section("Parameters", _parameters(outcome, units), wide=False),
        Section("Where the candidates stood", _candidates(outcome), wide=False),
        Section("What could not be separated, and what would separate it", _doubts(outcome)),
        Section("Notes", [Lines(outcome.notes)] if outcome.notes else []),
    ]
    if outcome.series is not None:
        measured = partial(_series_figure, outcome, units, {"measured": "torque_nm"}, "Measured torque")
        charts = measured, partial(residual_figure, outcome, units)
        made.append(Section("Over time", [Chart(draw) for draw in charts]))
    return [section for section in made if section.blocks]


def _errors(outcome: Diagnosis, units: Units) -> Grid:
    unit = units.shown("N·m")
    rows: Rows = []
    for name, one in (("training", outcome.train), ("validation", outcome.validation)):
        most = max(one.before_rms_nm, one.after_rms_nm)
        before, after = (
            f"{among(rms, min(most, 100.0 * rms))} {unit}, {percent(relative, 2)}"  # two digits at least
            for rms, relative in (
                (one.before_rms_nm, one.before_relative), (one.after_rms_nm, one.after_relative)
            )
        )  # fmt: skip
        part = one.after_rms_nm / max(one.before_rms_nm, 1e-300)
        rows.append((name, before, after, Share(percent(part, 0), part)))
    named = any(finding.name != "unlisted" for finding in outcome.effects)
    after = "with the effects" if named else "with a free curve" if free_curve(outcome) else "refitted"
    return Grid(("", "as declared", after, "after / before"), rows)


def _parameters(outcome: Diagnosis, units: Units) -> list[Block]:
    rows: Rows = []
    for finding in outcome.effects:
        rows += [(title_of(finding, outcome),)] if finding.parameters else []
        for name, value in finding.parameters.items():
            rows += parameter_rows(name, value, finding.std.get(name), units)
    for k, one in enumerate(outcome.transmissions, start=1):
        rows += [(f"motor {k}, refitted",)] if one.parameters else []
        for name, value in one.parameters.items():
            rows += parameter_rows(name, value, one.std[name], units)
    rows += [("corrected in the readings",)] if outcome.alignment else []
    for name, value in outcome.alignment.items():
        rows += parameter_rows(name, value, outcome.alignment_std.get(name), units)
    return [Grid(PARAMETER_HEAD, rows)] if rows else []


def _candidates(outcome: Diagnosis) -> list[Block]:
    """Each promising effect alone, and why the chosen ones were chosen."""
    if not outcome.rivals:
        return []
    found = {(f.name, f.motor): f.probability for f in outcome.effects}
    shown = [r for k, r in enumerate(outcome.rivals) if k < _RIVALS or (r.name, r.motor) in found]
    most = max(rival.error_relative for rival in shown)
    rows: Rows = []
    several = len(outcome.transmissions) > 1
    for rival in shown:
        mine = found.get((rival.name, rival.motor))
        p = rival.probability if mine is None else mine
        motor = f", motor {rival.motor + 1}" if rival.motor is not None and several else ""
        named = f"{'' if mine is None else '▶ '}{in_words(rival.name)}{motor}"
        even = choice("even")
        chance = (f"< {even:g}" if mine is None and p <= even else f"{p:.2f}",) if found else ()
        left = Share(percent(rival.error_relative, 2), rival.error_relative / most)
        rows.append((named, *chance, left))
    head = ("candidate", *(("probability",) if found else ()), "error left with it alone")
    chosen = [rival.error_relative for rival in shown if (rival.name, rival.motor) in found]
    return [Grid(head, _together(rows)), Paragraph(_choice_of(outcome, chosen))]


def _together(rows: Rows) -> Rows:
    """Return the rows; of several in a row that leave the same, and are not chosen, the first one."""
    made: Rows = []
    for _, group in groupby(rows, lambda row: (str(row[0]).startswith("▶"), *map(cell_text, row[1:]))):
        first, *others = group
        made += [first, (f"and {len(others)} more", *first[1:])] if others[1:] else [first, *others]
    return made


def _choice_of(outcome: Diagnosis, chosen: list[float]) -> str:
    """Why the chosen candidates were chosen, where another one leaves less error alone."""
    if not chosen:
        error, curve = outcome.validation, free_curve(outcome)
        if curve is not None and error.after_rms_nm < error.before_rms_nm:
            over = " and ".join(map(in_words, curve.coordinates))
            return f"None was chosen: what is missing has no name; a free curve over {over} stands for it."
        return "None was chosen: alone or together they predict other stretches no better."
    left = percent(outcome.train.after_relative, 2)
    together = f" together; together they leave {left}" if len(chosen) > 1 else ""
    text = f"▶ chosen{together}."
    if outcome.rivals[0].error_relative < min(chosen):
        text += (
            f" Though {in_words(outcome.rivals[0].name)} alone leaves less: an effect with more freedom fits "
            "any recording better. What counts is how likely an effect is to predict other stretches of the "
            "recording, with parameters of a plausible size."
        )
    return text


def _curve_chart(curve: Curve, units: Units) -> Chart:
    over = " and ".join(name.replace("_", " ") for name in curve.coordinates)
    name = "a free curve" if curve.name == "unlisted" else in_words(curve.name)
    about = f": {LIBRARY[curve.name].description}" if curve.name in LIBRARY else ""
    caption = f"Residual of the declared model over {over}, and {name}{about}."
    return Chart(partial(_curve_figure, curve, units), caption)


def _curve_figure(curve: Curve, units: Units) -> Figure:
    figure, (axes,) = plots.new_figure(width=_COLUMN, height=3.0)
    across, torque = units.label(_AXES[curve.coordinates[0]]), units.label("torque / N·m")
    plots.dots(axes, curve.x, curve.residual_nm)
    order = np.argsort(curve.x)
    name = "free curve" if curve.name == "unlisted" else in_words(curve.name)
    if curve.second is None and _is_function(curve):
        curves = {"residual": plots.medians(curve.x, curve.residual_nm)}
        curves[name] = plots.medians(curve.x, curve.fitted_nm)
        plots.xy(axes, curves, across, torque)
    else:
        axes.plot(curve.x[order], curve.fitted_nm[order], ".", color=plots.COLORS[1], markersize=2.0)
        axes.plot([], [], ".", color="#aaaaaa", label="residual")
        axes.plot([], [], ".", color=plots.COLORS[1], label=name)
        plots.xy(axes, {}, across, torque)
    return figure


def _is_function(curve: Curve) -> bool:
    """Return whether the fitted torque is nearly one function of the coordinate, in spite of the filter."""
    line = plots.medians(curve.x, curve.fitted_nm)
    left = curve.fitted_nm - np.interp(curve.x, line.x, line.y)
    return float(np.std(left)) < 0.35 * float(np.std(curve.fitted_nm)) + 1e-300


def _stiffness_chart(curve: StiffnessCurve, units: Units) -> Chart:
    zero = int(np.argmin(np.abs(curve.deflection_rad)))
    before, after = (
        f"{number(100.0 * SIGMA_95 * std[zero] / abs(value[zero]), 2)} %" if value[zero] else "no stiffness"
        for value, std in (
            (curve.before_nm_rad, curve.before_std_nm_rad), (curve.after_nm_rad, curve.after_std_nm_rad)
        )
    )  # fmt: skip
    caption = (
        f"Stiffness of motor {curve.motor + 1}'s transmission, with 95 % bands: at zero ± {before} as "
        f"declared, ± {after} refitted. The declared model's band assumes that its other parameters are "
        "exact and complete."
    )
    return Chart(partial(_stiffness_figure, curve, units), caption)


def _stiffness_figure(curve: StiffnessCurve, units: Units) -> Figure:
    """Stiffness over deflection, before and after, each with its 95 % band."""
    figure, (axes,) = plots.new_figure(width=_COLUMN, height=3.0)
    phi = curve.deflection_rad
    curves = {
        "as declared": plots.PlotCurve(phi, curve.before_nm_rad, curve.before_std_nm_rad),
        "refitted": plots.PlotCurve(phi, curve.after_nm_rad, curve.after_std_nm_rad),
    }
    plots.xy(axes, curves, units.label("deflection / rad"), units.label("stiffness / (N·m/rad)"))
    return figure


def residual_figure(outcome: Diagnosis, units: Units) -> Figure:
    """Draw what the model leaves of the motor torque over time, before and after; empty without a series."""
    return _series_figure(outcome, units, {"left before": "before_nm", "left after": "after_nm"}, "Residual")


def _series_figure(outcome: Diagnosis, units: Units, names: Mapping[str, str], title: str) -> Figure:
    figure, (axes,) = plots.new_figure(width=_COLUMN, height=2.6)
    if (series := outcome.series) is not None:
        named = {label: getattr(series, name) for label, name in names.items()}
        curves = {label: plots.PlotCurve(series.time_s, values) for label, values in named.items()}
        plots.over_time(axes, curves, units.label("torque / N·m"), title)
    return figure


def _doubts(outcome: Diagnosis) -> list[Block]:
    lines = [
        f"{title_of(f, outcome)}, probability {f.probability:.2f}, could also be: {others_of(f)}."
        for f in outcome.effects
        if f.alternatives
    ]
    lines += outcome.advice
    if any(finding.name != "unlisted" for finding in outcome.effects) and not lines:
        lines.append("No other effect explains these data as well.")
    return [Lines(tuple(lines))] if lines else []
