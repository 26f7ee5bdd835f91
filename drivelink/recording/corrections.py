"""Formats the gate's findings on units, signs, gears and time, with lines for the joint file."""

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from drivelink.errors import RecordingError
from drivelink.jointfile import DriveSection, EncoderSection, JointFile
from drivelink.recording.canframes import is_frame_log
from drivelink.recording.columns import record_of_samples
from drivelink.recording.playback import Played
from estimator.errors import EstimatorError
from estimator.gate import Change, Discrepancy, Judgement, check, is_held, judge
from estimator.model import JointModel
from estimator.sample import Record, Sample

_SCALE = "recording.scale"
_ON_THE_BUS = (".drive", ".encoder")
_HELD = (
    "the link position does not change: the link is taken to be held, and its dynamics are left out; "
    "if it moves, its encoder is silent"
)
_LONGEST_S = 60.0  # of a run that is examined; more adds no information


class Correction(NamedTuple):
    """A corrected key of the joint file."""

    table: str  # e.g. "motor[1].drive" or "recording.scale".
    key: str
    value: float | int | None  # its new value; None: only the factor is known
    factor: float  # new value over old one

    def __str__(self) -> str:
        if self.value is None:
            return f"{self.table}.{self.key}: {self.factor:.7g} times what the drive reports"
        return f"{self.table}.{self.key} = {self.value:.7g}"


def gate(path: Path, joint: JointFile, record: Record, *, strict: bool) -> list[str]:
    """Check units, signs, gears and time of a recording against the joint as declared.

    Returns:
        What is wrong, with the line to paste, or what the motion does not reveal, and that the link is held.

    Raises:
        RecordingError: strict, and something is wrong.
    """
    model = joint.model()
    try:
        check(record, model)
        judgement = judge(record, model)
    except EstimatorError:  # the verb itself says what is unusable
        return []
    line = _line(joint, judgement, live=is_frame_log(path))
    if strict and judgement.findings:
        raise RecordingError(f"{path}: {line}")
    held = _HELD if is_held(record, model) else ""
    return [said for said in (line, held) if said]


def _line(joint: JointFile, judgement: Judgement, *, live: bool) -> str:
    if not judgement.findings:
        return judgement.remark
    fix = _text_of(joint, judgement.findings, live=live)
    return f"{judgement.remark}; if so, {fix}"


class Gathered:
    """Keeps the samples of a minute for a later check of units and signs."""

    def __init__(self, joint: JointFile, period_s: float) -> None:
        self._joint, self._period_s = joint, period_s
        self._most = round(_LONGEST_S / joint.bus.period_s)  # the file's may be of another unit
        self._samples: list[Sample] = []

    def write(self, played: Played) -> None:
        """Add a cycle of a replay."""
        if (sample := played.tick.sample) is not None and len(self._samples) < self._most:
            self._samples.append(sample)

    def remarks(self, *, live: bool) -> list[str]:
        """Return findings with corrections, or what the motion does not reveal, one line each."""
        model, judgement = self._joint.model(), Judgement(reason="no samples in one run of numbers")
        try:
            if (record := _record_of(self._samples, model, self._period_s, self._most)) is not None:
                judgement = judge(record, model)
        except EstimatorError as error:
            return [f"units and signs cannot be checked: {error}"]
        return [line] if (line := _line(self._joint, judgement, live=live)) else []


def _record_of(samples: Sequence[Sample], model: JointModel, period_s: float, most: int) -> Record | None:
    """Return the complete samples as a recording; None if they are not one run.

    Of a run with gaps, the `most` periods that have the most samples: the judge allocates the gaps.
    """
    linked = model.has_deflection
    rows = [s for s in samples if all(map(math.isfinite, (*s.motor_position_rad, *s.motor_torque_nm)))]
    rows = [s for s in rows if not linked or math.isfinite(s.link_position_rad)]
    sequence = np.array([s.sequence for s in rows], dtype=np.int64)
    if np.any(np.diff(sequence) < 1) or not rows:  # restarted numbering: two runs in one file
        return None
    counts = np.searchsorted(sequence, sequence + most) - np.arange(len(rows))
    begin = int(np.argmax(counts))
    rows = rows[begin : begin + int(counts[begin])]
    if len(rows) < 3:
        return None
    record = record_of_samples(rows, len(model.motors), period_s, "samples")
    link = record.link_position_rad if linked else None
    return replace(record, motor_velocity_rad_s=None, link_position_rad=link)


def _text_of(joint: JointFile, findings: Sequence[Discrepancy], *, live: bool) -> str:
    """Return the correction as text for the joint file."""
    changes = [change for finding in findings for change in finding.changes]
    found = corrections(joint, changes, live=live)
    parts = [f"{c}" for c in found if c.table != _SCALE]
    if scale := {c.key: c.value for c in found if c.table == _SCALE}:
        whole = ", ".join(f"{key} = {value:.7g}" for key, value in (joint.recording.scale | scale).items())
        parts.insert(0, f"{_place(joint)}scale = {{ {whole} }}")
    if any(change.channel == "deflection" for change in changes):
        parts.append("record link_position_rad as 2 motor1_position_rad - link_position_rad")
    text = "; ".join(parts)
    if not live and any(motor.drive for motor in joint.motor):
        keys = [f"{c}" for c in corrections(joint, changes, live=True) if c.table.endswith(_ON_THE_BUS)]
        if keys:
            text += f" (for what drivelink itself reads from the drives: {'; '.join(keys)})"
    return text


def _place(joint: JointFile) -> str:
    """Return where the line of scales goes: a TOML table may not be begun twice."""
    if joint.recording.scale:
        return "instead of the scale in the joint file: recording."
    declared = "recording" in joint.model_fields_set
    return "in [recording] of the joint file: " if declared else "at the top of the joint file: recording."


def corrections(joint: JointFile, needed: Sequence[Change], *, live: bool) -> list[Correction]:
    """Return the corrections of the joint file.

    Args:
        live: correct the keys of drives and encoder, used by `run` and recordings of frames; else the factors
            of `[recording]`, used by files with columns.
    """
    changes, found = {change.channel: change for change in needed}, list[Correction]()
    for number, motor in enumerate(joint.motor, start=1):
        position, torque = changes.get(f"motor{number}_position"), changes.get(f"motor{number}_torque")
        if (inertia := changes.get(f"motor{number}_inertia")) is not None:
            value = motor.inertia_kg_m2 * inertia.factor
            found.append(Correction(f"motor[{number}]", "inertia_kg_m2", value, inertia.factor))
        if live and motor.drive is not None:
            found += _of_drive(motor.drive, f"motor[{number}].drive", position, torque)
        else:
            found += [_column(joint, change, number) for change in (position, torque) if change is not None]
    link, time = changes.get("link_position"), changes.get("time")
    if link is not None:
        encoder = joint.link.encoder if live else None
        found.append(_of_link(encoder, link) if encoder else _column(joint, link))
    if time is not None:
        found.append(_column(joint, time))
    return found


def _column(joint: JointFile, change: Change, number: int = 0) -> Correction:
    """Return a factor for a column, times the present one."""
    names = {"time": "time_s", "link_position": "link_position_rad"}
    names |= {f"motor{number}_position": f"motor{number}_position_rad"}
    name = names.get(change.channel, f"motor{number}_torque_nm")
    now = joint.recording.scale.get(name, 1.0)
    return Correction(_SCALE, name, change.factor * now, change.factor)


def _of_drive(
    drive: DriveSection, table: str, position: Change | None, torque: Change | None
) -> list[Correction]:
    """Return the keys of a motor's drive: directions, counts, gear ratio, torque's scale."""
    a = position.factor if position else 1.0
    b = torque.factor if torque else 1.0
    found = []
    now = drive.torque_direction or drive.direction
    if a < 0.0:
        found.append(Correction(table, "direction", -drive.direction, -1.0))
    if b < 0.0 or (a < 0.0 and drive.torque_direction is None):
        wanted = -now if b < 0.0 else now
        if wanted != (-drive.direction if a < 0.0 else drive.direction) or drive.torque_direction is not None:
            found.append(Correction(table, "torque_direction", wanted, b))
    a, b = abs(a), abs(b)
    if abs(a * b - 1.0) < 1e-9 and a != 1.0:  # both by the gear
        return [*found, Correction(table, "gear_ratio", drive.gear_ratio / a, 1.0 / a)]
    if a != 1.0:
        counts = None if drive.counts_per_rev is None else drive.counts_per_rev / a
        found.append(Correction(table, "counts_per_rev", counts, 1.0 / a))
    if b != 1.0:
        key = "rated_torque_nm" if drive.rated_torque_nm is not None else "torque_constant_nm_a"
        now_scale = getattr(drive, key)
        found.append(Correction(table, key, None if now_scale is None else now_scale * b, b))
    return found


def _of_link(encoder: EncoderSection, link: Change) -> Correction:
    if link.factor < 0.0:
        return Correction("link.encoder", "direction", -encoder.direction, -1.0)
    counts = None if encoder.counts_per_rev is None else encoder.counts_per_rev / link.factor
    return Correction("link.encoder", "counts_per_rev", counts, 1.0 / link.factor)
