"""Writes a diagnosis into a joint file: effects, refitted transmission, provenance, residual baseline."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import replace
from datetime import UTC, datetime
from operator import mul
from pathlib import Path
from typing import TYPE_CHECKING, Any

from drivelink import jointfile
from drivelink.jointfile import JointFile, JointText
from drivelink.jointfile.digits import kept, kept_model, ten_digits
from drivelink.version import __version__
from estimator.effects import LIBRARY, sharpened
from estimator.errors import EstimatorError
from estimator.model import Effect, JointModel, Transmission
from estimator.model_monitor import ModelMonitor, ResidualBaseline, can_monitor, expecting, measure_baseline
from estimator.sample import Record

if TYPE_CHECKING:
    from estimator.diagnosis import Diagnosis  # the daemon need not load what diagnoses

_KEY = "floor"
_LOG = logging.getLogger(__name__)


def _baseline(
    records: Record | Sequence[Record], model: JointModel, surplus: float
) -> ResidualBaseline | None:
    try:
        found = measure_baseline(records, model, surplus) if can_monitor(model) else None
    except EstimatorError as error:
        _LOG.warning("no residual baseline is written, so the daemon cannot raise the model alarm: %s", error)
        return None
    return found and replace(
        found,
        residual_nm=kept(found.residual_nm, tuple(map(mul, found.residual_nm, found.log_std))),
        torque_nm=kept(found.torque_nm, tuple(map(mul, found.torque_nm, found.log_std))),
        log_std=kept(found.log_std, found.log_std),
    )


def floor_entry(record: Record | Sequence[Record], model: JointModel, surplus: float) -> dict[str, Any]:
    """Return the entry of [provenance] with the baseline (see `measure_baseline`); empty, with a
    log line, if it cannot be measured.
    """
    baseline = _baseline(record, model, surplus)
    return {} if baseline is None else {_KEY: baseline.as_dict()}


def as_read(model: JointModel, record: Record | Sequence[Record], surplus: float) -> JointModel:
    """Return a model as the file reads that is written of it: with the baseline of these recordings."""
    return expecting(model, _baseline(record, model, surplus))


def make_model_monitor(joint: JointFile) -> ModelMonitor | None:
    """Return the model monitor of a joint; None without complete model or baseline."""
    entry = joint.provenance.get(_KEY)
    baseline = ResidualBaseline.from_dict(entry) if isinstance(entry, dict) else None
    model = joint.model()
    if baseline is None or not can_monitor(model):
        return None
    rate = joint.estimator.false_alarms_per_hour
    return ModelMonitor(model, joint.bus.period_s, baseline, rate)


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

    Raises:
        JointFileError: the copy cannot be written.
    """
    model = diagnosed_model(source.joint, outcome)
    provenance = {
        **floor_entry(record, model, outcome.surplus),
        "diagnosis": origin(
            [record],
            recording,
            verdict=outcome.verdict,
            effects=[finding.name for finding in outcome.effects],
            bandwidth_hz=outcome.bandwidth_hz,
            error_before_relative=ten_digits(outcome.validation.before_relative),
            error_after_relative=ten_digits(outcome.validation.after_relative),
        ),
    }
    changes = jointfile.changes_to(model) | {"provenance": provenance}
    return jointfile.write_model(source, target, changes, force=force)


def origin(records: Sequence[Record], recording: str, **more: Any) -> dict[str, Any]:
    """Return an entry of [provenance]: from what the model was made, what of it, when."""
    seconds = round(sum(float((one.sequence[-1] - one.sequence[0]) * one.period_s) for one in records), 6)
    written = datetime.now(UTC).isoformat(timespec="seconds")
    return {"recording": recording, "seconds": seconds, **more, "written": written, "version": __version__}


def diagnosed_model(joint: JointFile, outcome: Diagnosis) -> JointModel:
    """Return the model that `write` writes."""
    model = sharpened(joint.model(), outcome.smoothing_rad_s if _decided(outcome) else None)
    motors = tuple(
        replace(
            motor,
            **_numbers(outcome, i),
            transmission=_transmission(motor.transmission, outcome, i),
            effects=_all_effects(motor.effects, outcome, i),
        )
        for i, motor in enumerate(model.motors)
    )
    whole = replace(model, motors=motors, link_effects=_all_effects(model.link_effects, outcome, None))
    return kept_model(whole)


def _numbers(outcome: Diagnosis, motor: int) -> dict[str, Any]:
    """Inertia and damping as found."""
    numbers = outcome.transmissions[motor].motor if _decided(outcome) else {}
    return {name: ten_digits(value) for name, value in numbers.items()}


def _all_effects(declared: tuple[Effect, ...], outcome: Diagnosis, motor: int | None) -> tuple[Effect, ...]:
    """Effects of one table: declared, corrections of the readings, found."""
    made = [*declared, *_readings(outcome, motor)]
    for finding in outcome.effects if _decided(outcome) else ():
        kind = LIBRARY.get(finding.name)
        if kind is None or (finding.name == "torque_offset" and "deflection_offset" in finding.alternatives):
            continue  # the latter is among the readings
        # A common zero of all deflections belongs to every motor.
        common = kind.channel == "deflection" and finding.motor is None and motor is not None
        here = kind.on_link if motor is None else not kind.on_link and finding.motor == motor
        if here or common:
            made.append(Effect(name=finding.name, parameters=finding.parameters, std=finding.std))
    return tuple(made)


def _readings(outcome: Diagnosis, motor: int | None) -> list[Effect]:
    """Skew and offsets between the channels, which also exist on the bus."""
    if outcome.verdict == "insufficient_excitation":
        return []
    places = {"link_position_delay_s": ("encoder_delay", "delay_s")}
    if motor is not None:
        places = {
            f"motor{motor + 1}_torque_delay_s": ("torque_delay", "delay_s"),
            f"motor{motor + 1}_torque_offset_nm": ("torque_offset", "torque_nm"),
            f"motor{motor + 1}_deflection_offset_rad": ("deflection_offset", "offset_rad"),
        }
    return [
        Effect(
            name=name,
            parameters={parameter: ten_digits(outcome.alignment[key])},
            std={parameter: outcome.alignment_std[key]} if key in outcome.alignment_std else {},
        )
        for key, (name, parameter) in places.items()
        if key in outcome.alignment
    ]


def _transmission(declared: Transmission, outcome: Diagnosis, motor: int) -> Transmission:
    """Return the transmission with its refitted parameters; as declared if it is rigid or undetermined."""
    found = outcome.transmissions[motor]
    if not found.parameters or not _decided(outcome):
        return declared
    size = len(found.covariance)
    order = size if declared.model == "polynomial" else declared.order
    return replace(declared, order=order, parameters=found.parameters, covariance=found.covariance)


def _decided(outcome: Diagnosis) -> bool:
    return outcome.verdict not in ("insufficient_excitation", "unexplained")
