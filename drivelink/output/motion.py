"""The motion to record next: a CSV file for the controller, a picture, the odds it is expected to give."""

import io
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from drivelink.files import write_whole
from drivelink.output import plots
from drivelink.output.document import Chart, Grid, Paragraph, Rows, Section
from drivelink.output.numbers import Units, number
from estimator.diagnosis.motion import NextMotion
from estimator.effects import in_words
from estimator.sample import FloatArray

_COLUMNS = ("position_rad", "velocity_rad_s", "acceleration_rad_s2", "torque_nm")
_MOST = 1e6  # odds beyond are written as more than that
_WIDTH, _ON_PAGE = 9.2, 4.6  # inches: of the picture, and of one that a phone's page shows


def write(motion: NextMotion, path: Path, units: Units, *, force: bool = False) -> list[Path]:
    """Write the CSV file, and its picture beside it.

    Raises:
        OSError: a file exists, or cannot be written.
    """
    names, columns = ["time_s"], [motion.time_s]
    for i in range(motion.position_rad.shape[1]):
        for name in _COLUMNS:
            names.append(f"motor{i + 1}_{name}")
            columns.append(getattr(motion, name)[:, i])
    text = io.StringIO()
    np.savetxt(text, np.column_stack(columns), "%.9g", ",", header=",".join(names), comments="")
    write_whole(path, text.getvalue(), force=force)
    picture = path.with_suffix(".png")
    write_whole(picture, plots.png(figure(motion, units)), force=force)
    return [path, picture]


def as_json(motion: NextMotion) -> dict[str, Any]:
    """Return the odds for report.json."""
    return {
        "seconds": round(len(motion.time_s) * float(motion.time_s[1] - motion.time_s[0]), 6),
        "decides": motion.decides,
        "decided": motion.decided,
        "rivals": [
            {"effects": name, "probability": now, "told": told, "least_log_odds": least}
            for name, now, told, least in zip(
                motion.rivals, motion.now, np.diag(motion.told).tolist(), _least(motion).tolist(), strict=True
            )
        ],
        "reaches": {name: np.max(np.abs(getattr(motion, name)), axis=0).tolist() for name in _COLUMNS},
    }


def section(motion: NextMotion | None, units: Units) -> Section:
    """Describe and draw it, or say how to have it designed."""
    if motion is None:
        hint = Paragraph("drivelink diagnose --motion next.csv designs the motion that tells most.")
        return Section("What to move next", [hint])
    told, before, long = f"{motion.decides:.2f}", f"{motion.decided:.2f}", f"{motion.time_s[-1]:.3g} s"
    said = (
        f"This motion of {long} is expected to tell which it is with a probability of {told}, "
        f"{before} without it. Record it with the drive's position loop, and diagnose that recording."
        if float(told) > float(before)
        else f"No motion of {long} within the limits is expected to tell which it is better than "
        f"the recordings do ({before}): allow more in [motion] of the joint file, or a longer one."
    )
    rows: Rows = []
    for one in as_json(motion)["rivals"]:
        odds = float(np.exp(np.clip(one["least_log_odds"], 0.0, np.log(_MOST))))
        against = f"{'> ' if odds > 0.99 * _MOST else ''}{number(odds, 2)} : 1"
        rows.append((in_words(one["effects"]), f"{one['probability']:.2f}", f"{one['told']:.2f}", against))
    head = ("effect", "probability now", "after the motion", "odds to the next")
    caption = "Motion of the motors, and the torque that the likeliest needs."
    chart = Chart(lambda: figure(motion, units, _ON_PAGE), caption)
    return Section("What to move next", [Paragraph(said), Grid(head, rows), chart])


def figure(motion: NextMotion, units: Units, width: float = _WIDTH) -> Figure:
    """Draw position, velocity and torque over time; inches."""
    drawn, axes = plots.new_figure(rows=3, width=width, height=1.7)
    labels = ("position / rad", "velocity / (rad/s)", "torque / N·m")
    for one, name, label in zip(axes, (*_COLUMNS[:2], _COLUMNS[3]), labels, strict=True):
        values = getattr(motion, name)
        curves = {f"motor {i + 1}": plots.PlotCurve(motion.time_s, x) for i, x in enumerate(values.T)}
        plots.over_time(one, curves, units.label(label))
    return drawn


def _least(motion: NextMotion) -> FloatArray:
    """Log odds of each rival over the next best, where it is the true one."""
    others = np.where(np.eye(len(motion.told), dtype=bool), 0.0, motion.told)
    odds = np.diag(motion.told) / np.maximum(np.max(others, axis=1), 1.0 / _MOST)
    return np.asarray(np.log(np.maximum(odds, 1.0 / _MOST)))
