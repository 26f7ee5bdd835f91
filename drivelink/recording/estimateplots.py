"""Plots of a replay's estimates."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from drivelink.output import plots
from drivelink.output.plots import PlotCurve
from estimator.sample import FloatArray


def plot_curves(columns: Mapping[str, FloatArray], motors: int, path: Path, title: str) -> Path:
    """Return the stiffness over deflection of each transmission; columns as in estimates.csv."""
    figure, axes = plots.new_figure(title, height=3.6)
    seen = columns["observable"] > 0
    curves = {
        f"motor {i}": PlotCurve(
            columns[f"motor{i}_deflection_rad"][seen],
            columns[f"motor{i}_stiffness_nm_rad"][seen],
            columns[f"motor{i}_stiffness_std_nm_rad"][seen],
        )
        for i in range(1, motors + 1)
    }
    plots.stiffness_against_deflection(axes[0], curves, "Stiffness of the transmission, where observable")
    return plots.save(figure, path)


def plot_over_time(columns: Mapping[str, FloatArray], path: Path, title: str) -> Path:
    """Draw the joint's flexibility torque and stiffness over one time axis; gaps where each is not valid."""
    figure, axes = plots.new_figure(title, rows=2)
    t = columns["time_s"]
    valid = {name: np.where(columns["valid"] > 0, values, np.nan) for name, values in columns.items()}
    axes[1].sharex(axes[0])
    torque = np.where(columns["torque_valid"] > 0, columns["flexibility_torque_nm"], np.nan)
    curve = PlotCurve(t, torque, columns["flexibility_torque_std_nm"])
    plots.over_time(axes[0], {"estimate": curve}, "torque / N·m", "Flexibility torque")
    stiffness = PlotCurve(t, valid["stiffness_nm_rad"], valid["stiffness_std_nm_rad"])
    plots.over_time(axes[1], {"estimate": stiffness}, "stiffness / (N·m/rad)", "Stiffness")
    low, high = np.nanpercentile(stiffness.y, [1, 99]) if np.any(np.isfinite(stiffness.y)) else (0.0, 1.0)
    margin = 0.25 * (high - low) + 0.02 * abs(high)
    axes[1].set_ylim(low - margin, high + margin)  # the wide band of the first samples would hide the rest
    return plots.save(figure, path)
