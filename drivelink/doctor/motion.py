"""Checks units and signs of positions, velocity and torque against each other.

The drives are only read; move the joint meanwhile, by hand or by its controller.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from drivelink.canopen.layout import Signal
from drivelink.canopen.node import NodeSurvey
from drivelink.doctor.livevalues import Readings
from drivelink.doctor.report import Section
from drivelink.jointfile import JointFile
from drivelink.recording.corrections import corrections
from estimator.errors import EstimatorError
from estimator.gate import Judgement, check, judge
from estimator.reasons import percent
from estimator.sample import Record

_WINDOW_S = 0.02  # differences over less are mostly quantisation
_LEAST_COUNTS = 50  # minimum number for a decision
_TOLERANCE = 0.15  # relative; velocities are filtered in the drive
_LINK_TOLERANCE = 0.35  # the transmission bends
_MOST_LOST = 0.05  # share of the samples, from which on a busy machine is the likeliest reason
_STILL = "move the joint during the check, by its controller (--seconds 20 gives more time)"
_LOST = "this machine is too busy to read every sample: end other programs, and run drivelink doctor again"
_MOVING = "the joint moves: look longer (--seconds 20), or at a faster and wider motion"


def judge_record(section: Section, joint: JointFile, record: Record | None) -> None:
    """Check units and signs of a moving joint by the gate for recordings (eq 5)."""
    if record is None:
        section.info(joint.name, "units and signs of torque: not every channel was read")
        return
    model = replace(joint.model(), period_s=record.period_s)
    try:
        check(record, model)
        judgement = judge(record, model)
    except EstimatorError as error:
        say = section.warn if _is_sparse(record) else section.info  # a joint at rest is no problem
        say(joint.name, f"units and signs cannot be checked: {error}", _advice(record))
        return
    section.facts["samples"] = len(record)
    _report_judgement(section, joint, judgement, record)


def _advice(record: Record) -> str:
    """Return what would decide what could not be decided."""
    if _is_sparse(record):
        return _LOST
    for position in record.motor_position_rad.T:
        steps = np.abs(np.diff(position))
        count = np.min(steps[steps > 0.0], initial=np.inf)
        if np.ptp(position) > _LEAST_COUNTS * count:
            return _MOVING
    return _STILL


def _is_sparse(record: Record) -> bool:
    """Return whether so many samples are missing that the rest says little."""
    return len(record) < (1.0 - _MOST_LOST) * int(record.sequence[-1] - record.sequence[0] + 1)


def _report_judgement(section: Section, joint: JointFile, judgement: Judgement, record: Record) -> None:
    section.facts["torque_left"] = None if np.isnan(judgement.left) else judgement.left
    if judgement.findings:
        needed = [change for finding in judgement.findings for change in finding.changes]
        first = judgement.findings[0]
        text = ", and ".join(map(str, judgement.findings))
        before, after = percent(first.left_before, 0), percent(first.left_after, 1)
        text += f": the torque balance leaves {before}, {after} put right"
        fix = "; ".join(map(str, corrections(joint, needed, live=True)))
        section.error(joint.name, text, f"in the joint file: {fix}")
    elif judgement.remark:
        fix = f"{_advice(record)}; or drivelink doctor --move"
        section.info(joint.name, judgement.remark, fix)
    else:
        left = percent(judgement.left, 1)
        text = f"no unit or sign of positions and torque looks wrong: the torque balance leaves {left}"
        if _is_sparse(record):
            section.warn(joint.name, text, _LOST)
        else:
            section.ok(joint.name, text)


def judge_motion(section: Section, survey: NodeSurvey, readings: Readings) -> bool:
    """Compare the channels of a drive; return whether the motor moved."""
    subject, key, motor = survey.role.subject, survey.role.key, survey.role.motor
    position = next(iter(survey.available.get(Signal.MOTOR_POSITION, ())), None)
    series = readings.get((Signal.MOTOR_POSITION, motor))
    if position is None or series is None or len(series.values) < 3:
        return False
    times, moved = series.times_s, series.values
    section.facts[f"{subject} travel_rad"] = max(moved) - min(moved)
    if max(moved) - min(moved) < _LEAST_COUNTS * abs(position.scale):
        fix = "turn the joint by hand during the check (--seconds 10: more time), or drivelink doctor --move"
        section.info(subject, "stands still: signs and units could not be checked against each other", fix)
        return False
    velocity = readings.get((Signal.MOTOR_VELOCITY, motor))
    windows = _windows(times)
    if velocity is not None:
        reported = [float(np.mean(velocity.values[start : end + 1])) for start, end in windows]
        rates = [(moved[end] - moved[start]) / (times[end] - times[start]) for start, end in windows]
        _judge_velocity(section, subject, key, _slope(reported, rates))
    link = readings.get((Signal.LINK_POSITION, None))
    if link is not None and Signal.LINK_POSITION in survey.available:
        motor_steps, link_steps = (
            [x[end] - x[start] for start, end in windows] for x in (moved, link.values)
        )
        _judge_link(section, subject, _slope(motor_steps, link_steps))
    return True


def _windows(times: Sequence[float]) -> list[tuple[int, int]]:
    """First and last place of each window, one after the other."""
    found, start = [], 0
    for k in range(1, len(times)):
        if times[k] - times[start] >= _WINDOW_S:
            found.append((start, k))
            start = k
    return found


def _slope(x: Sequence[float], y: Sequence[float]) -> float:
    """Return the least-squares factor k of y = k x."""
    square = float(np.dot(x, x))
    return float(np.dot(x, y)) / square if square else 0.0


def _judge_velocity(section: Section, subject: str, key: str, ratio: float) -> None:
    section.facts[f"{subject} velocity_ratio"] = ratio
    text = f"positions change {ratio:.3g} times as fast as the reported velocity 0x606C"
    if abs(ratio - 1) <= _TOLERANCE:
        section.ok(subject, f"velocity agrees with the differences of positions (ratio {ratio:.3f})")
    elif ratio < 0:
        fix = "bits 7 and 6 of the polarity 0x607E, with the maker's tool"
        section.warn(subject, f"{text}: they have opposite signs", fix)
    else:
        fix = f"correct {key}: counts_per_rev, or velocity_rad_s_per_count"
        section.warn(subject, f"{text}: counts_per_rev or the velocity unit is wrong", fix)


def _judge_link(section: Section, subject: str, ratio: float) -> None:
    section.facts[f"{subject} link_ratio"] = ratio
    if abs(ratio - 1) <= _LINK_TOLERANCE:
        section.ok(subject, f"the link follows the motor (ratio {ratio:.3f})")
        return
    text = f"the link moves {ratio:.3g} times as far as the motor, both at the joint side"
    if ratio < 0:
        section.warn(subject, text, "reverse the sign of link.encoder.direction, or the drive's")
    else:
        section.warn(subject, text, "correct gear_ratio, counts_per_rev or link.encoder.counts_per_rev")
