"""Plots in one style that remains distinguishable in black and white.

Figures are made without pyplot: no global state, no window, safe in any thread.

    figure, axes = new_figure("Elbow", rows=2)
    xy(axes[0], {"estimate": medians(phi, sigma, std=std)}, "deflection / rad", "stiffness / (N·m/rad)")
    over_time(axes[1], {"flexibility torque": PlotCurve(t, torque)}, "torque / N·m")
    save(figure, Path("joint.png"))
"""

import io
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.text import Text

from drivelink.files import write_whole
from drivelink.output.numbers import shared_range
from drivelink.plaintext import clean_text
from estimator.sample import SIGMA_95, FloatArray

# Colours of Okabe and Ito (distinguishable with any colour vision), different in lightness for grey prints,
# each with its line style, marker and hatch.
COLORS = ("#005f9e", "#e0701a", "#000000", "#009e73", "#cc79a7", "#56b4e9")
LINES = ("-", "--", ":", "-.", (0, (5, 1, 1, 1, 1, 1)), (0, (1, 2)))
MARKERS = ("o", "s", "^", "D", "v", "x")
HATCHES = ("", "///", "...", "xxx", "\\\\\\", "++")

STYLE: dict[Any, Any] = {
    "figure.dpi": 110,
    "font.size": 9,
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.titlesize": 10,
    "axes.titlelocation": "left",
    "grid.color": "#dddddd",
    "grid.linewidth": 0.6,
    "legend.frameon": False,
    "legend.fontsize": 8,
    "lines.linewidth": 1.3,
    "svg.hashsalt": "drivelink",  # reproducible files
    "svg.fonttype": "none",
}
_INK = ("#000000", "#222222")
_THEMED = {
    **dict.fromkeys(_INK, "currentColor"),
    "#dddddd": "var(--grid, #dddddd)",
    **{color: f"var(--curve-{k}, {color})" for k, color in enumerate(COLORS, 1) if color not in _INK},
}
_MAX_POINTS = 4000  # curves with more points are reduced to the extremes of each pixel column
_MIN_OF_SCATTERED = 3  # samples in a bin of `medians`
_MARKERS_A_CURVE = 12


class PlotCurve(NamedTuple):
    """One curve: y over x, with an optional standard deviation (drawn as a 95 % band)."""

    x: FloatArray
    y: FloatArray
    std: FloatArray | None = None


def blank(width: float, height: float) -> Figure:
    """Return an empty figure in the house style; inches."""
    with rc_context(STYLE):
        figure = Figure(figsize=(width, height), layout="constrained")
        FigureCanvasAgg(figure)
    return figure


def new_figure(
    title: str = "", rows: int = 1, width: float = 7.0, height: float = 2.6
) -> tuple[Figure, list[Axes]]:
    """Return a figure in the house style, and the axes of its rows; `height` in inches is that of one row."""
    figure = blank(width, height * rows)
    with rc_context(STYLE):
        axes = [figure.add_subplot(rows, 1, k + 1) for k in range(rows)]
        if title:
            figure.suptitle(title, fontsize=11, x=0.01, ha="left", fontweight="bold")
    return figure, axes


def xy(axes: Axes, curves: Mapping[str, PlotCurve], x_label: str, y_label: str, title: str = "") -> None:
    """Draw named curves, each with its colour, line style and marker."""
    for k, (name, curve) in enumerate(curves.items()):
        thin = _thinned(curve)
        _draw(axes, thin, name, k)
    _finish(axes, x_label, y_label, title, legend=len(curves) > 1)


def over_time(axes: Axes, curves: Mapping[str, PlotCurve], y_label: str, title: str = "") -> None:
    """Draw curves over time in seconds, with gaps where samples are missing."""
    xy(axes, {name: _with_gaps(curve) for name, curve in curves.items()}, "time / s", y_label, title)


def _with_gaps(curve: PlotCurve) -> PlotCurve:
    """Return a curve that is broken where more than one of its samples is missing."""
    apart = np.diff(curve.x)
    gaps = 1 + np.flatnonzero(apart > 2.0 * np.median(apart)) if len(apart) else np.array([], dtype=int)
    std = None if curve.std is None else np.insert(curve.std, gaps, np.nan)
    return PlotCurve(np.insert(curve.x, gaps, np.nan), np.insert(curve.y, gaps, np.nan), std)


def save(figure: Figure, path: Path) -> Path:
    """Write the figure in the format of the file name's ending (png, svg, pdf)."""
    write_whole(path, _drawn(figure, path.suffix[1:]), force=True)
    return path


def png(figure: Figure) -> bytes:
    """Return the figure as a PNG picture."""
    return _drawn(figure, "png")


def svg_text(figure: Figure) -> str:
    """Return the figure as inline SVG for an HTML page, transparent and in the page's text colour.

    A page may define `--curve-1`, `--curve-2`, … and `--grid` for a theme of its own.
    """
    text = _drawn(figure, "svg", transparent=True).decode()
    text = text[text.index("<svg") :].replace("<svg", '<svg fill="currentColor"', 1)
    for color, themed in _THEMED.items():
        text = text.replace(f": {color}", f": {themed}")
    return text


def _drawn(figure: Figure, kind: str, *, transparent: bool = False) -> bytes:
    buffer = io.BytesIO()
    metadata = {"Date": None} if kind == "svg" else None  # reproducible files
    for text in figure.findobj(Text):  # has names of recordings and joints
        said = text.get_text()
        if not all(map(str.isprintable, said.split("\n"))):
            text.set_text("\n".join(clean_text(line, len(line)) for line in said.split("\n")))
    with rc_context(STYLE):
        figure.savefig(buffer, format=kind, metadata=metadata, transparent=transparent)
    return buffer.getvalue()


def medians(x: FloatArray, y: FloatArray, bins: int = 80, std: FloatArray | None = None) -> PlotCurve:
    """Return medians of scattered samples, and of their deviations, in bins of x, without the outermost x."""
    known = np.isfinite(x) & np.isfinite(y)
    x, values = x[known], [one[known] for one in (y, std) if one is not None]
    if not len(x):
        return PlotCurve(x, *values)
    low, high = np.quantile(x, [0.002, 0.998])
    least = min(_MIN_OF_SCATTERED, len(x))
    bins = min(bins, max(1, len(x) // least))  # one of them, at least, is full
    edges = np.linspace(float(low), float(high), bins + 1)
    place = np.clip(np.searchsorted(edges, x) - 1, 0, bins - 1)
    middle = 0.5 * (edges[1:] + edges[:-1])
    filled = [k for k in range(bins) if np.count_nonzero(place == k) >= least]
    return PlotCurve(
        middle[filled], *(np.array([np.median(one[place == k]) for k in filled]) for one in values)
    )


def dots(axes: Axes, x: FloatArray, y: FloatArray, name: str | None = None) -> None:
    """Draw samples as dots, below the curves."""
    axes.plot(x, y, ".", color="#aaaaaa", markersize=2.5, rasterized=True, label=name)


def _draw(axes: Axes, curve: PlotCurve, name: str, k: int) -> None:
    color = COLORS[k % len(COLORS)]
    few = max(1, len(curve.x) // _MARKERS_A_CURVE)
    with rc_context(STYLE):
        axes.plot(
            curve.x,
            curve.y,
            label=name,
            color=color,
            linestyle=LINES[k % len(LINES)],
            marker=MARKERS[k % len(MARKERS)] if k else None,
            markevery=(few * k // 4 % few if few > 1 else 0, few),
            markersize=4,
            markerfacecolor="none",
        )
    if curve.std is not None:
        half = SIGMA_95 * curve.std
        axes.fill_between(
            curve.x,
            curve.y - half,
            curve.y + half,
            facecolor=color,
            alpha=0.22,
            linewidth=0.0,
            hatch=HATCHES[k % len(HATCHES)] or None,
            label="" if k else "95 %",  # one entry stands for every curve's band
        )


def _finish(axes: Axes, x_label: str, y_label: str, title: str, legend: bool) -> None:
    axes.set_xlabel(x_label)
    axes.set_ylabel(y_label)
    axes.yaxis.get_offset_text().set_horizontalalignment("right")  # a power of ten, beside the legend
    named = legend or len(axes.get_legend_handles_labels()[0]) > 1
    if title:
        axes.set_title(title, loc="left", pad=20.0 if named else None)
    if named:  # on a line of its own between title and axes
        axes.legend(
            loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=6, frameon=False, fontsize=8, borderaxespad=0.2
        )


def _thinned(curve: PlotCurve) -> PlotCurve:
    """At most so many points: the lowest and highest of each stretch, so that no peak is lost."""
    n = len(curve.x)
    if n <= _MAX_POINTS:
        return curve
    stretch = n // (_MAX_POINTS // 2) + 1
    pad = (-n) % stretch
    y = np.concatenate((curve.y, np.full(pad, np.nan))).reshape(-1, stretch)
    base = np.arange(len(y)) * stretch
    low = base + np.argmin(np.where(np.isfinite(y), y, np.inf), axis=1)
    high = base + np.argmax(np.where(np.isfinite(y), y, -np.inf), axis=1)
    gaps = np.flatnonzero(np.isnan(curve.x))
    keep = np.unique(np.minimum(np.concatenate((low, high, gaps)), n - 1))
    return PlotCurve(curve.x[keep], curve.y[keep], None if curve.std is None else curve.std[keep])


def plot_curves(columns: Mapping[str, FloatArray], motors: int, path: Path, title: str) -> Path:
    """Return the stiffness over deflection of each transmission; columns as in estimates.csv."""
    figure, axes = new_figure(title, height=3.6)
    seen = columns["observable"] > 0
    names = ("deflection_rad", "stiffness_nm_rad", "stiffness_std_nm_rad")
    curves = {}
    for i in range(1, motors + 1):
        phi, sigma, std = (columns[f"motor{i}_{name}"][seen] for name in names)
        curves[f"motor {i}"] = medians(phi, sigma, std=std)
    title = f"Stiffness of the transmission, {'where observable' if np.any(seen) else 'never observable'}"
    xy(axes[0], curves, "deflection / rad", "stiffness / (N·m/rad)", title)
    return save(figure, path)


def plot_over_time(columns: Mapping[str, FloatArray], path: Path, title: str) -> Path:
    """Draw flexibility torque and stiffness over the whole recording; grey where each is not valid."""
    figure, axes = new_figure(title, rows=2)
    t = columns["time_s"]
    axes[1].sharex(axes[0])
    axes[0].set_xlim(t[0], t[-1] if t[-1] > t[0] else None)
    for one, seen, name, label in (
        (axes[0], "torque_valid", "flexibility_torque", "torque / N·m"),
        (axes[1], "stiffness_valid", "stiffness", "stiffness / (N·m/rad)"),
    ):
        unit = "nm_rad" if name == "stiffness" else "nm"
        y, std, valid = columns[f"{name}_{unit}"], columns[f"{name}_std_{unit}"], columns[seen] > 0
        if not np.all(valid):
            whole = one.get_xaxis_transform()
            one.fill_between(
                t, 0, 1, where=~valid, transform=whole, color="#bbbbbb", lw=0, alpha=0.4, label="not valid"
            )
        curve = PlotCurve(t, np.where(valid, y, np.nan), std)
        over_time(one, {"estimate": curve}, label, name.replace("_", " ").capitalize())
        doubtful = _thinned(_with_gaps(PlotCurve(t, np.where(valid, np.nan, y))))
        one.plot(doubtful.x, doubtful.y, color="#999999", linewidth=0.8)
        # The wide band of the first samples would hide the rest.
        low, high = shared_range(y[valid].tolist(), y[~valid].tolist())
        margin = 0.1 * (high - low) + 0.02 * abs(high)
        if margin > 0.0:
            one.set_ylim(low - margin, high + margin)
    return save(figure, path)
