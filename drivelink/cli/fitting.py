"""From recordings to transmission parameters: what `drivelink fit` computes, prints and writes."""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterable, Sequence
from pathlib import Path

from rich.console import Console
from rich.table import Table

from drivelink import analysis
from drivelink.cli.gating import warn
from drivelink.jointfile import link_entry
from drivelink.outfile import check_target, write_whole
from drivelink.output.units import Units
from estimator.batch import TransmissionFit
from estimator.identify import Identified
from estimator.model import Effect, ParameterValue
from estimator.transmissions import RIGID


def fit_recording(args: argparse.Namespace, folder: Path | None) -> None:
    """Fit, print, and write the requested files.

    Args:
        args: of `drivelink fit`.
        folder: where plots go; None: no plots.

    Raises:
        RecordingError: a recording cannot be read or fitted.
    """
    made = analysis.fit(
        args.recording,
        args.joint,
        bandwidth_hz=args.bandwidth_hz,
        names=args.map,
        strict=args.strict,
        warn=warn,
    )
    document = made.as_json()
    if args.json:
        print(json.dumps(document))
    else:
        # Before anything is written: a full disk loses no result.
        _print(made.found, args.recording, Units(made.runs.source.joint.axis == "linear"))
    written = []
    if args.out is not None:
        written.append(args.out / "fit.json")
        args.out.mkdir(parents=True, exist_ok=True)
        inputs = [*args.recording, *([args.joint] if args.joint else [])]
        check_target(written[0], inputs, force=True)
        write_whole(written[0], json.dumps(document, indent=2) + "\n", force=True)
    if folder is not None:
        folder.mkdir(parents=True, exist_ok=True)
        written.append(made.plot().save(folder / "fit.png"))
    if args.write is not None:
        written.append(made.write(args.write, force=args.force))
    for path in [] if args.json else written:
        print(f"wrote {path}")


def _print(found: Identified, paths: Sequence[Path], units: Units) -> None:
    console = Console()
    for number, (one, motor) in enumerate(zip(found.fits, found.model.motors, strict=True), start=1):
        table = _table(f"motor {number}: {'rigid' if one.model == RIGID else one.model}")
        for name, value in one.parameters.items():
            _add(table, name, value, one.std[name], units)
        for name, key in (("inertia_kg_m2", "inertia"), ("viscous_damping_nm_s_rad", "damping")):
            _add(table, name, getattr(motor, name), one.nuisance_std[key], units)
        _add_effects(table, motor.effects, units)
        console.print(table)
        share = one.error_rms_nm / one.torque_rms_nm
        whole = "flexibility torque" if one.excited else "motor torque"
        print(f"  torque balance: {one.error_rms_nm:.3g} N·m rms left, {100 * share:.2f} % of the {whole}")
        for line in _remarks(one):
            print(f"  {line}")
    link = found.model.link
    if link is not None or found.model.link_effects:
        table = _table("link")
        for name, x in link_entry(found.model).get("dynamics", {}).items():
            if "_std" not in name:
                _add(table, name, x, found.link_std.get(name), units)
        _add_effects(table, found.model.link_effects, units)
        console.print(table)
    for line in found.notes:
        print(f"  {line}")
    if len(paths) > 1:
        console.print(_left(found, paths))


def _left(found: Identified, paths: Sequence[Path]) -> Table:
    """Residual of each recording, relative to its motor torque."""
    table = Table(title="error of the torque balance", title_justify="left")
    for column in ("recording", "fitted", "left out"):
        table.add_column(column, justify="left" if column == "recording" else "right")
    for path, one in zip(paths, found.recordings, strict=True):
        cells = [f"{left.rms_nm:.3g} N·m  {left.relative:.2%}" for left in one]
        table.add_row(path.name, *cells)
    return table


def _table(title: str) -> Table:
    table = Table(title=title, title_justify="left")
    for column in ("parameter", "value", "± (95 %)", "unit"):
        table.add_column(column, justify="left" if column in ("parameter", "unit") else "right")
    return table


def _add_effects(table: Table, effects: Iterable[Effect], units: Units) -> None:
    for effect in effects:
        for name, value in effect.parameters.items():
            _add(table, f"{effect.name}.{name}", value, None, units)


def _add(table: Table, name: str, value: ParameterValue, std: ParameterValue | None, units: Units) -> None:
    """Add a parameter: one row, or one for each coefficient."""
    for k, cells in enumerate(units.parts(name, value, std), start=1):
        table.add_row(f"{name}[{k}]" if isinstance(value, tuple) else name, *cells)


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
    std = one.nuisance_std
    if abs(one.coulomb_nm) > max(4.0 * std["coulomb"], 0.01 * one.torque_rms_nm):
        remarks.append(
            f"friction that the model lacks, about {one.coulomb_nm:.3g} N·m: `drivelink diagnose` names it"
        )
    return remarks
