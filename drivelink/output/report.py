"""Writes the report of a diagnosis: report.json for programs, report.html for people."""

from __future__ import annotations

import html
import json
from dataclasses import asdict
from pathlib import Path
from string import Template
from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure

from drivelink.outfile import write_whole
from drivelink.output import plots
from drivelink.output.units import Units, in_words
from estimator.diagnosis import Curve, Diagnosis, Errors, Finding, StiffnessCurve
from estimator.effects import LIBRARY

_SCHEMA = "drivelink.diagnosis/1"
_CURVE_POINTS = 200
_RIVALS = 8
_SURE, _LIKELY = 0.9, 0.3  # probabilities at which an effect is missing, and at which it has a name
_WIDTH = 9.6  # inches of a plot as wide as the page
_COLUMN = 5.4  # and of one in half of it
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


def write(outcome: Diagnosis, title: Title, folder: Path) -> list[Path]:
    """Write report.json and report.html."""
    made = []
    for name, text in (
        ("report.json", json.dumps(as_json(outcome), indent=2) + "\n"),
        ("report.html", page(outcome, title)),
    ):
        path = folder / name
        write_whole(path, text, force=True)
        made.append(path)
    return made


def as_json(outcome: Diagnosis) -> dict[str, Any]:
    """The content of report.json."""
    unlisted = _curve_of_unlisted(outcome)
    return {
        "schema": _SCHEMA,
        "verdict": outcome.verdict,
        "bandwidth_hz": outcome.bandwidth_hz,
        "effects": [_effect(finding, unlisted) for finding in outcome.effects],
        "error": {"train": outcome.train._asdict(), "validation": outcome.validation._asdict()},
        "transmissions": [asdict(one) for one in outcome.transmissions],
        "recordings": [
            {
                "train": one.train._asdict(),
                "validation": None if one.validation is None else one.validation._asdict(),
            }
            for one in outcome.recordings
        ],
        "alignment": dict(outcome.alignment),
        "candidates": [rival._asdict() for rival in outcome.rivals],
        "advice": list(outcome.advice),
        "notes": list(outcome.notes),
    }


def _curve_of_unlisted(outcome: Diagnosis) -> Curve | None:
    return next((c for c in outcome.curves if c.name == "unlisted"), None)


def _effect(finding: Finding, unlisted: Curve | None) -> dict[str, Any]:
    entry: dict[str, Any] = {
        "name": finding.name,
        "location": finding.location,
        "parameters": dict(finding.parameters),
        "std": dict(finding.std),
        "probability": finding.probability,
        "alternatives": list(finding.alternatives),
        "alternative_probabilities": list(finding.alternative_probabilities),
        "share": finding.share,
    }
    if finding.motor is not None:
        entry["motor"] = finding.motor + 1
    if finding.coordinates:
        entry["coordinates"] = list(finding.coordinates)
        if unlisted is not None:
            entry["curve"] = _points(unlisted)
    return entry


def _points(curve: Curve) -> dict[str, list[float]]:
    """The fitted curve, a few hundred points in order of the first coordinate."""
    order = np.argsort(curve.x)
    pick = order[np.unique(np.linspace(0, len(order) - 1, _CURVE_POINTS).astype(int))]
    points = {curve.coordinates[0]: curve.x[pick].tolist()}
    if curve.second is not None:
        points[curve.coordinates[1]] = curve.second[pick].tolist()
    return {**points, "torque_nm": curve.fitted_nm[pick].tolist()}


def sentence(outcome: Diagnosis) -> str:
    """The verdict in one sentence."""
    lower = outcome.validation.after_rms_nm <= outcome.validation.before_rms_nm
    fall = (
        f"the torque balance's error on held-out data {'falls' if lower else 'rises'} from "
        f"{outcome.validation.before_relative:.2%} to {outcome.validation.after_relative:.2%}"
    )
    if outcome.verdict == "effect":
        return f"{lacks(outcome)}: {fall}."
    names = " and ".join(title_of(finding, outcome) for finding in outcome.effects)
    if outcome.verdict == "unexplained":
        where = outcome.effects[0]
        place = _place(where, outcome)
        over = " and ".join(name.replace("_", " ") for name in where.coordinates)
        return (
            f"The model lacks something at the {place} that is not in the library, a function of {over}: "
            f"{'with a free curve' if _curve_of_unlisted(outcome) else 'with it'} {fall}."
        )
    if outcome.verdict == "insufficient_excitation":
        said = f" (it might be {names})" if names else ""
        return f"The motion does not reveal what could be missing{said}: record a richer one."
    return (
        f"The model is sufficient: what it leaves, {outcome.validation.after_relative:.2%} of the torque, "
        "belongs to no effect."
    )


def lacks(outcome: Diagnosis) -> str:
    """What is missing, said as surely as it is known."""
    sure = [title_of(f, outcome) for f in outcome.effects if f.probability >= _SURE]
    likely = [
        f"{title_of(f, outcome)} ({f.probability:.2f})" + (f", else {others_of(f)}" if f.alternatives else "")
        for f in outcome.effects
        if _LIKELY <= f.probability < _SURE
    ]
    unsure = sorted({_place(f, outcome) for f in outcome.effects if f.probability < _LIKELY})
    said = []
    if sure:
        said.append(f"The model lacks {' and '.join(sure)}")
    if likely:
        said.append(f"most likely {'' if sure else 'the model lacks '}{' and '.join(likely)}")
    if unsure:
        to_do = outcome.advice[0] if outcome.advice else "record another motion, faster, slower and wider"
        said.append(f"something at the {' and '.join(unsure)} has no likely name yet ({to_do})")
    text = "; ".join(said)
    return text[0].upper() + text[1:]


def unexplained(outcome: Diagnosis, units: Units | None = None) -> str:
    """The remaining error in one sentence."""
    unit = (units or Units(False)).shown("N·m")
    left = outcome.validation
    text = f"{left.after_relative:.2%} of the torque ({left.after_rms_nm:.3g} {unit} rms) stays unexplained"
    if outcome.verdict == "unexplained":
        return f"{text} even with the free curve, which has no name in the library."
    if outcome.verdict == "insufficient_excitation":
        return f"{text}; this motion does not reveal whether anything is missing."
    return f"{text}: noise, or effects too small to be separated from it in these data."


def title_of(finding: Finding, outcome: Diagnosis) -> str:
    """An effect in words, with its place."""
    if finding.name == "unlisted":
        return f"an unlisted effect at the {_place(finding, outcome)}"
    return f"{in_words(finding.name)} ({_place(finding, outcome)})"


def others_of(finding: Finding) -> str:
    """Alternatives of an effect, with their probabilities."""
    pairs = zip(finding.alternatives, finding.alternative_probabilities, strict=True)
    return ", ".join(f"{in_words(name)} ({p:.2f})" for name, p in pairs)


def _place(finding: Finding, outcome: Diagnosis) -> str:
    """Its location, with the motor's number where there are two."""
    several = len(outcome.transmissions) > 1 and finding.motor is not None
    return f"{finding.location} {(finding.motor or 0) + 1}" if several else finding.location


def page(outcome: Diagnosis, title: Title) -> str:
    """The report as one self-contained page."""
    units = Units(title.linear)
    template = Template(Path(__file__).with_name("report.html").read_text(encoding="utf-8"))
    return template.substitute(
        title=html.escape(title.joint),
        recording=html.escape(title.recording),
        validation=html.escape(title.validation or "held-out blocks of the same recording"),
        bandwidth=f"{outcome.bandwidth_hz:.3g}",
        verdict=outcome.verdict.replace("_", " "),
        verdict_class=outcome.verdict,
        sentence=html.escape(sentence(outcome)),
        unexplained=html.escape(unexplained(outcome, units)),
        errors="".join(
            _error_row(n, e, units)
            for n, e in (("training", outcome.train), ("validation", outcome.validation))
        ),
        effects=_effects(outcome, units),
        curves=_curves(outcome, units),
        stiffness=_stiffness(outcome, units),
        rivals=_rivals_figure(outcome),
        series=_series_figure(outcome, units),
        doubts=_doubts(outcome),
    )


def _error_row(name: str, errors: Errors, units: Units) -> str:
    bar = 100.0 * min(errors.after_rms_nm / max(errors.before_rms_nm, 1e-300), 1.0)
    unit = units.shown("N·m")
    return (
        f"<tr><th>{name}</th><td>{errors.before_rms_nm:.4g} {unit}</td><td>{errors.before_relative:.2%}</td>"
        f"<td>{errors.after_rms_nm:.4g} {unit}</td><td>{errors.after_relative:.2%}</td>"
        f'<td class="bar"><span style="width:{bar:.1f}%"></span></td></tr>'
    )


def _effects(outcome: Diagnosis, units: Units) -> str:
    rows = []
    for finding in outcome.effects:
        rows.append(f'<tr class="effect"><th colspan="2">{html.escape(title_of(finding, outcome))}</th></tr>')
        if finding.name in LIBRARY:
            rows.append(f'<tr><td colspan="2">{html.escape(LIBRARY[finding.name].description)}</td></tr>')
        for name, value in finding.parameters.items():
            text = html.escape(units.value(name, value, finding.std.get(name)))
            rows.append(f"<tr><td><code>{html.escape(name)}</code></td><td>{text}</td></tr>")
    for number, one in enumerate(outcome.transmissions, start=1):
        if one.parameters:
            rows.append(f'<tr class="effect"><th colspan="2">motor {number}, refitted</th></tr>')
        for name, value in one.parameters.items():
            text = units.value(name, value, one.std[name])
            rows.append(f"<tr><td><code>{html.escape(name)}</code></td><td>{text}</td></tr>")
    if outcome.alignment:
        rows.append('<tr class="effect"><th colspan="2">corrected in the readings</th></tr>')
    for name, value in outcome.alignment.items():
        rows.append(f"<tr><td><code>{name}</code></td><td>{units.value(name, value, None)}</td></tr>")
    return "".join(rows)


def _curves(outcome: Diagnosis, units: Units) -> str:
    if not outcome.curves:
        return ""
    return "<h2>What reveals it</h2>" + "".join(_curve_figure(curve, units) for curve in outcome.curves)


def _curve_figure(curve: Curve, units: Units) -> str:
    figure, (axes,) = plots.new_figure(width=_WIDTH, height=3.2)
    across, torque = units.label(_AXES[curve.coordinates[0]]), units.label("torque / N·m")
    plots.dots(axes, curve.x, curve.residual_nm)
    order = np.argsort(curve.x)
    name = in_words(curve.name)
    if curve.second is None and _is_function(curve):
        curves = {"residual of the model": plots.medians(curve.x, curve.residual_nm)}
        curves[name] = plots.medians(curve.x, curve.fitted_nm)
        plots.xy(axes, curves, across, torque)
    else:
        axes.plot(curve.x[order], curve.fitted_nm[order], ".", color=plots.COLORS[1], markersize=2.0)
        axes.plot([], [], ".", color="#aaaaaa", label="residual of the model")
        axes.plot([], [], ".", color=plots.COLORS[1], label=name)
        plots.xy(axes, {}, across, torque)
    return f"<figure>{plots.svg_text(figure)}<figcaption>{_caption(curve)}</figcaption></figure>"


def _caption(curve: Curve) -> str:
    over = " and ".join(name.replace("_", " ") for name in curve.coordinates)
    return f"Residual of the declared model over {over}, and {html.escape(in_words(curve.name))}."


def _is_function(curve: Curve) -> bool:
    """Whether the fitted torque is nearly one function of the coordinate, in spite of the filter."""
    line = plots.medians(curve.x, curve.fitted_nm)
    left = curve.fitted_nm - np.interp(curve.x, line.x, line.y)
    return float(np.std(left)) < 0.35 * float(np.std(curve.fitted_nm)) + 1e-300


def _stiffness(outcome: Diagnosis, units: Units) -> str:
    if not outcome.stiffness:
        return ""
    figures = "".join(_stiffness_figure(one, units) for one in outcome.stiffness)
    return f"<h2>Stiffness before and after</h2>{figures}"


def _stiffness_figure(curve: StiffnessCurve, units: Units) -> str:
    """Stiffness over deflection, before and after, each with its 95 % band."""
    figure, (axes,) = plots.new_figure(width=_WIDTH, height=3.0)
    phi = curve.deflection_rad
    curves = {
        "as declared": plots.PlotCurve(phi, curve.before_nm_rad, curve.before_std_nm_rad),
        "refitted": plots.PlotCurve(phi, curve.after_nm_rad, curve.after_std_nm_rad),
    }
    plots.xy(axes, curves, units.label("deflection / rad"), units.label("stiffness / (N·m/rad)"))
    caption = (
        f"Stiffness of motor {curve.motor + 1}'s transmission, with 95 % bands. The declared model's band "
        "assumes that its other parameters are exact and complete."
    )
    return f"<figure>{plots.svg_text(figure)}<figcaption>{caption}</figcaption></figure>"


def _rivals_figure(outcome: Diagnosis) -> str:
    if not outcome.rivals:
        return ""
    shown = outcome.rivals[:_RIVALS]
    figure, (axes,) = plots.new_figure(width=_COLUMN, height=0.7 + 0.3 * len(shown))
    chosen = {(finding.name, finding.motor) for finding in outcome.effects}
    won = [(r.name, r.motor) in chosen for r in shown]
    names = [
        ("▶ " if mine else "") + in_words(r.name) + (f" {r.motor + 1}" if r.motor else "")
        for r, mine in zip(shown, won, strict=True)
    ]
    values = [100.0 * r.error_relative for r in shown]
    place = np.arange(len(shown))
    fills = [plots.COLORS[1] if mine else "#bbbbbb" for mine in won]
    axes.barh(place, values, color=fills, edgecolor="#222222", linewidth=0.8)
    axes.set_yticks(place, names)
    for label, mine in zip(axes.get_yticklabels(), won, strict=True):
        label.set_fontweight("bold" if mine else "normal")
    axes.invert_yaxis()
    plots.xy(axes, {}, "error left with this effect alone / % of the torque (weighted)", "")
    caption = "▶ chosen" if any(won) else "None was chosen."
    return f"<figure>{plots.svg_text(figure)}<figcaption>{caption}</figcaption></figure>"


def _series_figure(outcome: Diagnosis, units: Units) -> str:
    if outcome.series is None:
        return ""
    return f"<figure>{plots.svg_text(residual_figure(outcome, units))}</figure>"


def residual_figure(outcome: Diagnosis, units: Units) -> Figure:
    """Measured torque, and what the model leaves of it, before and after; empty without a series."""
    figure, axes = plots.new_figure(rows=2, width=_WIDTH, height=2.2)
    torque, series = units.label("torque / N·m"), outcome.series
    if series is None:
        return figure
    plots.over_time(axes[0], {"measured": plots.PlotCurve(series.time_s, series.torque_nm)}, torque)
    curves = {
        "left before": plots.PlotCurve(series.time_s, series.before_nm),
        "left after": plots.PlotCurve(series.time_s, series.after_nm),
    }
    plots.over_time(axes[1], curves, torque)
    return figure


def _doubts(outcome: Diagnosis) -> str:
    lines = [
        f"{title_of(f, outcome)}, probability {f.probability:.2f}, could also be: {others_of(f)}."
        for f in outcome.effects
        if f.alternatives
    ]
    lines += [*outcome.advice, *outcome.notes]
    if not lines:
        return "<p>No other effect explains these data as well.</p>"
    return "<ul>" + "".join(f"<li>{html.escape(line)}</li>" for line in lines) + "</ul>"
