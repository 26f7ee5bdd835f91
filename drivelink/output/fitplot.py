"""The plot of `drivelink fit`: each transmission, and residuals over deflection and velocity."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from drivelink.errors import UsageError
from drivelink.jointfile import JointFile
from drivelink.output import plots
from drivelink.output.units import Units
from estimator.batch import TransmissionFit
from estimator.sample import FloatArray
from estimator.transmissions import MODELS, RIGID

_CURVE_POINTS = 200
_WIDTH = 10.0  # inches
_IN_BIN = 15  # rows per median point of the lines through the residuals


def fit_plot(fits: Sequence[TransmissionFit], joint: JointFile) -> Figure:
    """Draw stiffness, torque and residuals of each flexible transmission; residuals show a loop or a step.

    Args:
        fits: one per motor.
        joint: its joint file.

    Raises:
        UsageError: every transmission is rigid.
    """
    flexible = [(number, one) for number, one in enumerate(fits, start=1) if one.model != RIGID]
    if not flexible:
        raise UsageError("--plots: expected a flexible transmission, every one is rigid")
    units, title = Units(joint.axis == "linear"), f"{joint.name}: fitted transmissions"
    figure, axes = plots.new_figure(title, rows=2 * len(flexible), columns=2, width=_WIDTH, height=3.0)
    for row, (number, one) in enumerate(flexible):
        mine = axes[4 * row : 4 * row + 4]
        _transmission(mine[0], mine[1], one, f"motor {number}: ", units)
        _left(mine[2], mine[3], one, units)
    return figure


def _transmission(stiffness: Axes, torque: Axes, one: TransmissionFit, whose: str, units: Units) -> None:
    """Stiffness with its interval, and torque."""
    law = MODELS[one.model]
    reach = float(np.max(np.abs(one.deflection_rad)))
    phi = np.linspace(-reach, reach, _CURVE_POINTS)
    slopes = law.stiffness_jacobian(phi, one.alpha)
    std = np.sqrt(np.maximum(np.einsum("ij,jk,ik->i", slopes, one.covariance, slopes), 0.0))
    fitted = plots.PlotCurve(phi, law.stiffness(phi, one.alpha), std)
    across = units.label("deflection / rad")
    label = units.label("stiffness / (N·m/rad)")
    plots.xy(stiffness, {"fitted": fitted}, across, label, f"{whose}stiffness")
    plots.dots(torque, one.deflection_rad, one.torque_nm, "from the motor's balance")
    curve = plots.PlotCurve(phi, law.torque(phi, one.alpha))
    plots.xy(torque, {"fitted": curve}, across, units.label("torque / N·m"), f"{whose}flexibility torque")


def _left(over_deflection: Axes, over_velocity: Axes, one: TransmissionFit, units: Units) -> None:
    """Residuals of the fit: hysteresis separates the two directions, Coulomb friction is a step."""
    phi, velocity, left = one.deflection_rad, one.velocity_rad_s, one.unexplained_nm
    label = units.label("torque / N·m")
    plots.dots(over_deflection, phi, left)
    grows = one.deflection_rate_rad_s > 0.0
    directions = {"deflection grows": grows, "shrinks": ~grows}
    curves = {name: _line(phi[rows], left[rows]) for name, rows in directions.items()}
    plots.xy(over_deflection, curves, units.label("deflection / rad"), label, "residual over deflection")
    plots.dots(over_velocity, velocity, left)
    across = units.label("motor velocity / (rad/s)")
    plots.xy(over_velocity, {"median": _line(velocity, left)}, across, label, "residual over velocity")


def _line(x: FloatArray, y: FloatArray) -> plots.PlotCurve:
    return plots.medians(x, y, max(4, len(x) // _IN_BIN)) if len(x) else plots.PlotCurve(x, y)
