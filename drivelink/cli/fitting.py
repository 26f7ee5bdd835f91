"""From recordings to transmission parameters: what `drivelink fit` computes, prints and writes."""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Iterable, Sequence
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from drivelink import jointfile, recording
from drivelink.cli.gating import warned
from drivelink.errors import RecordingError
from drivelink.jointfile import JointText, effect_entry, link_entry
from drivelink.jointfile.residual_baseline import floor_entry
from drivelink.outfile import check_target, write_whole
from drivelink.output.fitplot import fit_plot
from drivelink.output.units import Units
from drivelink.recording.columnmap import parse_column_map
from drivelink.version import __version__
from estimator.batch import TransmissionFit
from estimator.errors import EstimatorError
from estimator.identify import Identified, identify
from estimator.model import Effect, JointModel, Motor, ParameterValue
from estimator.model_monitor import harm
from estimator.sample import Record
from estimator.transmissions import RIGID


def fit_recording(args: argparse.Namespace, source: JointText, folder: Path | None) -> None:
    """Fit, print, and write the requested files.

    Args:
        args: of `drivelink fit`.
        source: the joint file that they name, or that the first recording carries.
        folder: where plots go; None: no plots.

    Raises:
        RecordingError: a recording cannot be read or fitted.
    """
    joint = source.joint
    names = parse_column_map(args.map)
    records = [recording.read(path, joint, base_dir=source.folder, names=names) for path in args.recording]
    notes = warned(args.recording, records, joint, strict=args.strict)
    bandwidth = None if args.bandwidth_hz is None else 2.0 * math.pi * args.bandwidth_hz
    try:
        found = identify(records, joint.model(), bandwidth)
    except EstimatorError as error:
        raise RecordingError(f"{_named(args)}: {error}") from error
    document = _as_json(replace(found, notes=(*notes, *found.notes)), args.recording)
    if args.json:
        print(json.dumps(document))
    else:
        # Before anything is written: a full disk loses no result.
        _print(found, args.recording, Units(joint.axis == "linear"))
    made = []
    if args.out is not None:
        made.append(args.out / "fit.json")
        _folder(args.out)
        check_target(made[0], _inputs(args), force=True)
        write_whole(made[0], json.dumps(document, indent=2) + "\n", force=True)
    if folder is not None:
        _folder(folder)
        made.append(fit_plot(found.fits, joint, folder / "fit.png"))
    if args.write is not None:
        _write(args, source, found, records, bandwidth)
        made.append(args.write)
    for path in [] if args.json else made:
        print(f"wrote {path}")


def _folder(path: Path) -> None:
    path.mkdir(parents=True, exist_ok=True)


def _named(args: argparse.Namespace) -> str:
    return ", ".join(str(path) for path in args.recording)


def _inputs(args: argparse.Namespace) -> list[Path]:
    return [*args.recording, *([args.joint] if args.joint else [])]


def _as_json(found: Identified, paths: Sequence[Path]) -> dict[str, Any]:
    pairs = zip(found.fits, found.model.motors, strict=True)
    document: dict[str, Any] = {"transmissions": [_entry(one, motor) for one, motor in pairs]}
    link = link_entry(found.model)
    if link:
        document["link"] = link
    if found.link_std:
        document["link_std"] = found.link_std
    if len(paths) > 1:
        document["recordings"] = [
            {
                "recording": path.name,
                "train": one.train._asdict(),
                "validation": one.validation._asdict(),
            }
            for path, one in zip(paths, found.recordings, strict=True)
        ]
    if found.notes:
        document["notes"] = list(found.notes)
    return document


def _entry(one: TransmissionFit, motor: Motor) -> dict[str, Any]:
    entry: dict[str, Any] = {"model": one.model, "parameters": one.parameters, "std": one.std}
    entry["motor"] = {
        "inertia_kg_m2": motor.inertia_kg_m2,
        "viscous_damping_nm_s_rad": motor.viscous_damping_nm_s_rad,
    }
    if motor.effects:
        entry["effects"] = [effect_entry(effect) for effect in motor.effects]
    std = one.nuisance_std
    entry["motor"] |= {"inertia_std_kg_m2": std["inertia"], "viscous_damping_std_nm_s_rad": std["damping"]}
    entry["error_rms_nm"] = one.error_rms_nm
    entry["error_relative"] = one.error_rms_nm / one.torque_rms_nm
    if one.model != RIGID:
        entry["unmodelled"] = {"coulomb_nm": one.coulomb_nm, "offset_nm": one.offset_nm}
        entry["excited"] = one.excited
    return entry


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


def _harm(
    records: Sequence[Record], declared: JointModel, found: Identified, bandwidth: float | None
) -> str | None:
    """Why a fit without the last quarter is worse there than the declared model; None: it is not."""
    halves = []
    for one in records:
        last = one.sequence >= one.sequence[len(one) * 3 // 4]
        halves.append((one.rows(~last), one.rows(last)))
    try:
        model = identify([kept for kept, _ in halves], declared, bandwidth).model
    except EstimatorError:  # too short to hold a part out
        return harm(declared, found.model, records)
    return harm(declared, model, [held for _, held in halves])


def _write(
    args: argparse.Namespace,
    source: JointText,
    found: Identified,
    records: Sequence[Record],
    bandwidth: float | None,
) -> None:
    fits = found.fits
    weak = [number for number, one in enumerate(fits, start=1) if one.model != RIGID and not one.excited]
    if weak:
        raise RecordingError(
            f"{_named(args)}: --write: expected a motion that determines the stiffness of motor {weak[0]}"
        )
    unusable = [number for number, one in enumerate(fits, start=1) if one.model != RIGID and not one.stiffens]
    if unusable:
        raise RecordingError(
            f"{_named(args)}: --write: expected a stiffness above zero, interval included, over all "
            f"deflections of the recording; that of motor {unusable[0]} is not"
        )
    harmful = _harm(records, source.joint.model(), found, bandwidth)
    if harmful:
        raise RecordingError(
            f"{_named(args)}: --write: {harmful}: nothing is written. "
            "`drivelink diagnose` may say what is missing"
        )
    changes = jointfile.changes_to(found.model)
    provenance = {
        **floor_entry(records, found.model, found.surplus),
        "fit": {
            "recording": ", ".join(path.name for path in args.recording),
            "seconds": sum(float((one.sequence[-1] - one.sequence[0]) * one.period_s) for one in records),
            "written": datetime.now(UTC).isoformat(timespec="seconds"),
            "version": __version__,
        },
    }
    jointfile.write_model(source, args.write, changes | {"provenance": provenance}, force=args.force)
