"""Writes a diagnosis into a joint file: effects, refitted transmission, provenance."""

from __future__ import annotations

from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from drivelink import jointfile
from drivelink.jointfile import JointFile, JointText, plain_parameters
from drivelink.jointfile.residual_baseline import floor_entry
from drivelink.version import __version__
from estimator.diagnosis import Diagnosis
from estimator.effects import LIBRARY
from estimator.model import Effect, JointModel, ParameterValue
from estimator.sample import Record


def write(
    source: JointText,
    target: Path,
    outcome: Diagnosis,
    record: Record,
    recording: str,
    *,
    force: bool = False,
) -> JointFile:
    """Copy a joint file with the effects found, and validate the copy.

    Args:
        source: the joint file the diagnosis was made with.
        target: path of the copy.
        outcome: the diagnosis.
        record: the recording it was made from.
        recording: its name.
        force: replace an existing file.

    Raises:
        JointFileError: the copy cannot be written.
    """
    joint = source.joint
    motors, at_link = _entries(joint, outcome)
    changes: dict[str, Any] = {"motor": motors}
    if at_link:
        changes["link"] = {"effect": at_link}
    changes["provenance"] = {
        **floor_entry(record, diagnosed_model(joint, outcome), outcome.surplus),
        "diagnosis": {
            "recording": recording,
            "seconds": float((record.sequence[-1] - record.sequence[0]) * record.period_s),
            "verdict": outcome.verdict,
            "effects": [finding.name for finding in outcome.effects],
            "bandwidth_hz": outcome.bandwidth_hz,
            "transmission_std": [plain_parameters(one.std) for one in outcome.transmissions],
            "error_before_relative": outcome.validation.before_relative,
            "error_after_relative": outcome.validation.after_relative,
            "written": datetime.now(UTC).isoformat(timespec="seconds"),
            "version": __version__,
        },
    }
    return jointfile.write_model(source, target, changes, force=force)


def diagnosed_model(joint: JointFile, outcome: Diagnosis) -> JointModel:
    """The model that `write` writes."""
    motors, at_link = _entries(joint, outcome)
    model = joint.model()
    changed = []
    for motor, change in zip(model.motors, motors, strict=True):
        transmission = motor.transmission
        if "transmission" in change:
            parameters = _values(change["transmission"]["parameters"])
            transmission = replace(transmission, parameters=parameters)
        changed.append(replace(motor, transmission=transmission, effects=_effects(change["effect"])))
    return replace(model, motors=tuple(changed), link_effects=_effects(at_link))


def _entries(joint: JointFile, outcome: Diagnosis) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """Changes of each motor's table, and the effects at the link."""
    motors = [
        {"effect": _all_effects(section.effect, outcome, i), **_transmission(joint, outcome, i)}
        for i, section in enumerate(joint.motor)
    ]
    return motors, _all_effects(joint.link.effect, outcome, None)


def _effects(entries: list[dict[str, Any]]) -> tuple[Effect, ...]:
    return tuple(Effect(name=e["name"], parameters=_values(e["parameters"])) for e in entries)


def _values(parameters: dict[str, Any]) -> dict[str, ParameterValue]:
    return {name: tuple(v) if isinstance(v, list) else v for name, v in parameters.items()}


def _all_effects(declared: tuple[Effect, ...], outcome: Diagnosis, motor: int | None) -> list[dict[str, Any]]:
    """Effects of one table: declared, corrections of the readings, found."""
    made = [{"name": e.name, "parameters": plain_parameters(e.parameters)} for e in declared]
    made += _readings(outcome, motor)
    for finding in outcome.effects:
        kind = LIBRARY.get(finding.name)
        if kind is None:
            continue
        # A common zero of all deflections belongs to every motor.
        common = kind.channel == "deflection" and finding.motor is None and motor is not None
        here = kind.on_link if motor is None else not kind.on_link and finding.motor == motor
        if here or common:
            made.append({"name": finding.name, "parameters": plain_parameters(finding.parameters)})
    return made


def _readings(outcome: Diagnosis, motor: int | None) -> list[dict[str, Any]]:
    """Skew and offsets between the channels, which also exist on the bus."""
    if outcome.verdict == "insufficient_excitation":
        return []
    if motor is None:
        places = {"link_position_delay_s": ("encoder_delay", "delay_s")}
    else:
        places = {
            f"motor{motor + 1}_torque_delay_s": ("torque_delay", "delay_s"),
            f"motor{motor + 1}_deflection_offset_rad": ("deflection_offset", "offset_rad"),
        }
    return [
        {"name": name, "parameters": {parameter: float(outcome.alignment[key])}}
        for key, (name, parameter) in places.items()
        if key in outcome.alignment
    ]


def _transmission(joint: JointFile, outcome: Diagnosis, motor: int) -> dict[str, Any]:
    """The transmission's refitted parameters; empty if it is rigid or undetermined."""
    parameters = outcome.transmissions[motor].parameters
    if not parameters or outcome.verdict in ("insufficient_excitation", "unexplained"):
        return {}
    section = joint.motor[motor].transmission
    change: dict[str, Any] = {"model": section.model, "parameters": plain_parameters(parameters)}
    if section.model == "polynomial":
        change["order"] = len(change["parameters"]["coefficients_nm_rad"])
    return {"transmission": change}
