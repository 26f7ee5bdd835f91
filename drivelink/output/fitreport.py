"""What `drivelink fit` reports: tables of the fitted numbers, and a plot of each transmission."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from drivelink.errors import UsageError
from drivelink.jointfile import JointFile, effect_entry, link_entry
from drivelink.output import plots
from drivelink.output.comparison import fits, fits_json
from drivelink.output.document import PARAMETER_HEAD, Grid, Lines, Rows, Section, parameter_rows
from drivelink.output.numbers import Units, among, bare_name, number
from estimator.batch import TransmissionFit
from estimator.freerun import FreeRun
from estimator.identify import Identified
from estimator.model import Effect, Motor
from estimator.reasons import percent
from estimator.sample import SIGMA_95, FloatArray
from estimator.transmissions import MODELS, RIGID

_CURVE_POINTS = 200
_WIDTH, _HEIGHT = 10.0, 7.0  # inches of a transmission
_IN_BIN = 15  # rows per median point of the lines through the residuals
_SHOWN = 3  # parameters beside the curve


def as_json(
    found: Identified, names: Sequence[str], runs: Sequence[Mapping[str, FreeRun]], notes: Iterable[str]
) -> dict[str, Any]:
    """Return the content of fit.json.

    Args:
        runs: of each recording: the free run of the fitted model.
        notes: what the gate says of them.
    """
    pairs = zip(found.fits, found.model.motors, strict=True)
    document: dict[str, Any] = {"transmissions": [_entry(one, motor) for one, motor in pairs]}
    document["free_runs"] = [fits_json(*one) for one in zip(runs, names, strict=True)]
    if link := link_entry(found.model):
        document["link"] = link
    if found.link_std:
        document["link_std"] = found.link_std
    if len(names) > 1:
        document["recordings"] = [
            {"recording": name, "train": one.train._asdict(), "validation": one.validation._asdict()}
            for name, one in zip(names, found.recordings, strict=True)
        ]
    if notes := [*notes, *found.notes]:
        document["notes"] = notes
    return document


def _entry(one: TransmissionFit, motor: Motor) -> dict[str, Any]:
    parameters = motor.transmission.parameters if one.parameters else {}
    entry: dict[str, Any] = {"model": one.model, "parameters": parameters, "std": one.std}
    entry["motor"] = {
        "inertia_kg_m2": motor.inertia_kg_m2,
        "viscous_damping_nm_s_rad": motor.viscous_damping_nm_s_rad,
        "inertia_std_kg_m2": one.nuisance_std["inertia"],
        "viscous_damping_std_nm_s_rad": motor.viscous_damping_std_nm_s_rad,
    }
    if motor.effects:
        entry["effects"] = [effect_entry(effect) for effect in motor.effects]
    entry["error_rms_nm"] = one.error_rms_nm
    entry["error_relative"] = one.error_rms_nm / one.torque_rms_nm
    if one.model != RIGID:
        entry["unmodelled"] = {"coulomb_nm": one.coulomb_nm, "offset_nm": one.offset_nm}
        entry["excited"] = one.excited
    return entry


def sections(
    found: Identified, names: Sequence[str], runs: Sequence[Mapping[str, FreeRun]], units: Units
) -> list[Section]:
    """Tabulate what was fitted; arguments as in `as_json`."""
    made = []
    for index, (one, motor) in enumerate(zip(found.fits, found.model.motors, strict=True), start=1):
        rows: Rows = []
        for name, value in one.parameters.items():
            rows += parameter_rows(name, value, one.std[name], units)
        for name, key in (("inertia_kg_m2", "inertia"), ("viscous_damping_nm_s_rad", "damping")):
            rows += parameter_rows(name, getattr(motor, name), one.nuisance_std[key], units)
        rows += _effects(motor.effects, units)
        title = f"motor {index}: {'rigid' if one.model == RIGID else one.model}"
        left = f"{number(one.error_rms_nm, 3)} {units.shown('N·m')} rms left"
        whole = "flexibility torque" if one.excited else "motor torque"
        balance = f"torque balance: {left}, {_share(one)} of the {whole}"
        made.append(Section(title, [Grid(PARAMETER_HEAD, rows), Lines((balance, *_remarks(one)))]))
    if found.model.link is not None or found.model.link_effects:
        rows = []
        for name, x in link_entry(found.model).get("dynamics", {}).items():
            if "_std" not in name:
                rows += parameter_rows(name, x, found.link_std.get(name), units)
        rows += _effects(found.model.link_effects, units)
        made.append(Section("link", [Grid(PARAMETER_HEAD, rows)]))
    made += [fits(*one) for one in zip(runs, names, strict=True)]
    made.append(Section("", [Lines(tuple(found.notes))]))
    if len(names) > 1:
        unit = units.shown("N·m")
        most = max(left.rms_nm for one in found.recordings for left in one)
        each: Rows = [
            (name, *(f"{among(left.rms_nm, most, 3)} {unit}  {percent(left.relative, 2)}" for left in one))
            for name, one in zip(names, found.recordings, strict=True)
        ]
        made.append(Section("error of the torque balance", [Grid(("recording", "fitted", "left out"), each)]))
    return made


def _effects(effects: Iterable[Effect], units: Units) -> Rows:
    return [
        row
        for effect in effects
        for name, value in effect.parameters.items()
        for row in parameter_rows(f"{effect.name}.{name}", value, effect.std.get(name), units)
    ]


def _share(one: TransmissionFit) -> str:
    return percent(one.error_rms_nm / one.torque_rms_nm, 2)


def _remarks(one: TransmissionFit) -> list[str]:
    remarks: list[str] = []
    if one.model == RIGID:
        return remarks
    if not one.excited:
        remarks.append(
            "the 95 % interval of the stiffness is wider than ± 50 %, so none is reported: "
            "record one with more deflection, driven both ways and by either side"
        )
    elif not one.stiffens:
        remarks.append(
            "the stiffness or its interval is not above zero, as a spring's is. "
            "Check the signs of position and torque, and the inertia"
        )
    if abs(one.coulomb_nm) > max(4.0 * one.nuisance_std["coulomb"], 0.01 * one.torque_rms_nm):
        remarks.append(
            f"friction that the model lacks, about {number(one.coulomb_nm, 3)} N·m: "
            "`drivelink diagnose` names it"
        )
    return remarks


def fit_plot(fits: Sequence[TransmissionFit], joint: JointFile) -> Figure:
    """Draw each flexible transmission: stiffness, its interval, torque; and the residuals, larger.

    Raises:
        UsageError: every transmission is rigid.
    """
    flexible = [(number, one) for number, one in enumerate(fits, start=1) if one.model != RIGID]
    if not flexible:
        raise UsageError("--plots: expected a flexible transmission, every one is rigid")
    units = Units(joint.axis == "linear")
    figure = plots.blank(width=_WIDTH, height=_HEIGHT * len(flexible))
    parts = figure.subfigures(len(flexible), 1, squeeze=False)[:, 0]
    for part, (index, one) in zip(parts, flexible, strict=True):
        numbers = _numbers(one, units)
        more = ", …" if len(numbers) > _SHOWN else ""
        left = f"residual {number(one.error_rms_nm, 2)} {units.shown('N·m')} rms"
        title = f"{joint.name}, motor {index} ({one.model}), {left}, {_share(one)} of the torque"
        title += f"\n{', '.join(numbers[:_SHOWN])}{more}"
        part.suptitle(title, fontsize=10, x=0.01, ha="left")
        grid = part.add_gridspec(2, 6, height_ratios=(2, 3))
        with rc_context(plots.STYLE):
            above = [part.add_subplot(grid[0, 2 * k : 2 * k + 2]) for k in range(3)]
            below = [part.add_subplot(grid[1, 3 * k : 3 * k + 3]) for k in range(2)]
        _transmission(above, one, units)
        _residuals(below, one, units)
    return figure


def _numbers(one: TransmissionFit, units: Units) -> list[str]:
    """Return the parameters with their intervals."""
    return [
        f"{label.replace(name, bare_name(name))} = {text}{f' ± {half}' if half else ''} {unit}".rstrip()
        for name, value in one.parameters.items()
        for label, text, half, unit in parameter_rows(name, value, one.std[name], units)
    ]


def _transmission(axes: Sequence[Axes], one: TransmissionFit, units: Units) -> None:
    """Stiffness with its band, the band in percent, and torque."""
    law = MODELS[one.model]
    reach = float(np.max(np.abs(one.deflection_rad)))
    phi = np.linspace(-reach, reach, _CURVE_POINTS)
    slopes = law.stiffness_jacobian(phi, one.alpha)
    std = np.sqrt(np.maximum(np.einsum("ij,jk,ik->i", slopes, one.covariance, slopes), 0.0))
    sigma = law.stiffness(phi, one.alpha)
    across = units.label("deflection / rad")
    label = units.label("stiffness / (N·m/rad)")
    plots.xy(axes[0], {"fitted": plots.PlotCurve(phi, sigma, std)}, across, label, "stiffness")
    percent = plots.PlotCurve(phi, np.zeros_like(phi), 100.0 * std / np.maximum(np.abs(sigma), 1e-300))
    plots.xy(axes[1], {"": percent}, across, "% of the stiffness", "its 95 % interval")
    most = 1.3 * SIGMA_95 * float(np.max(percent.std))  # type: ignore[arg-type]
    axes[1].set_ylim(-most or -1.0, most or 1.0)
    plots.dots(axes[2], one.deflection_rad, one.torque_nm, "balance")
    curve = plots.PlotCurve(phi, law.torque(phi, one.alpha))
    plots.xy(axes[2], {"fitted": curve}, across, units.label("torque / N·m"), "flexibility torque")


def _residuals(axes: Sequence[Axes], one: TransmissionFit, units: Units) -> None:
    """Residuals of the fit: hysteresis separates the two directions, Coulomb friction is a step."""
    phi, velocity, left = one.deflection_rad, one.velocity_rad_s, one.unexplained_nm
    label = units.label("torque / N·m")
    plots.dots(axes[0], phi, left)
    grows = one.deflection_rate_rad_s > 0.0
    directions = {"deflection grows": grows, "shrinks": ~grows}
    curves = {name: _line(phi[rows], left[rows]) for name, rows in directions.items()}
    plots.xy(axes[0], curves, units.label("deflection / rad"), label, "residual over deflection")
    plots.dots(axes[1], velocity, left)
    across = units.label("motor velocity / (rad/s)")
    plots.xy(axes[1], {"median": _line(velocity, left)}, across, label, "residual over velocity")


def _line(x: FloatArray, y: FloatArray) -> plots.PlotCurve:
    return plots.medians(x, y, max(4, len(x) // _IN_BIN))
