"""Checks units and signs of positions, velocity and torque against each other.

The drives are only read; move the joint meanwhile, by hand or by its controller.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from drivelink.canopen.layout import MappedObject, Signal
from drivelink.canopen.node import NodeSurvey
from drivelink.canopen.sdo import Program, Read, SdoAbort
from drivelink.doctor.report import Section
from drivelink.jointfile import JointFile
from drivelink.notice import Severity
from drivelink.recording.gate import Gathered, corrections
from estimator.errors import EstimatorError
from estimator.gate import Judgement, check, judge
from estimator.sample import FloatArray, Record

_READ = (Signal.MOTOR_POSITION, Signal.MOTOR_VELOCITY, Signal.MOTOR_TORQUE, Signal.LINK_POSITION)
_WINDOW_S = 0.02  # differences over less are mostly quantisation
_LEAST_COUNTS = 50  # minimum number for a decision
_TOLERANCE = 0.15  # relative; velocities are filtered in the drive
_LINK_TOLERANCE = 0.35  # the transmission bends
_STALL = 4.0  # turns without an answer that make a gap,
_STALL_S = 0.01  # and their duration: at 10 Hz linear interpolation over it is off by (2 pi f t)²/8 = 5 %
_LONG_STALL_S = 0.25  # stall that ends the recording; a shorter one is a gap
_LEAST_PERIOD_S = 0.001  # of the recording made from the answers, enough for a joint's motion
_PROMPT = 1.5  # times the usual answer time; later answers have an uncertain time and are omitted
_LONGER = "move the joint during the check, by its controller (--seconds 20 gives more time)"


@dataclass(frozen=True, slots=True)
class MotionSample:
    """Answers of one node in one turn.

    Attributes:
        time_s: monotonic, of its position.
        values: SI at the joint side, by signal.
        times_s: monotonic, of each value: halfway between request and answer.
        waits_s: time between the two.
    """

    time_s: float
    values: dict[Signal, float]
    times_s: dict[Signal, float]
    waits_s: dict[Signal, float]


class MotionReader:
    """Reads positions, velocity and torque of the nodes in turn, as fast as they answer; writes nothing.

    Args:
        surveys: of the nodes.
        clock: monotonic seconds.
    """

    def __init__(self, surveys: Sequence[NodeSurvey], clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._counters = {
            survey.role.node_id: {
                signal: _Unwrapped(survey.available[signal][0])
                for signal in _READ
                if survey.available.get(signal)
            }
            for survey in surveys
        }

    def program(self, seconds: float) -> Program[dict[int, list[MotionSample]]]:
        """The samples of so many seconds by node id, with the signals that all samples of a node have."""
        clock = self._clock
        samples: dict[int, list[MotionSample]] = {node: [] for node in self._counters}
        end_s = clock() + seconds
        while clock() < end_s and any(self._counters.values()):
            for node, counters in self._counters.items():
                values, times_s, waits_s = {}, {}, {}
                begin_s = clock()
                for signal, counter in counters.items():
                    before_s = clock()
                    try:
                        data = yield Read(node, *counter.address)
                    except SdoAbort:  # some have no value before the drive runs
                        continue
                    values[signal] = counter.take(data)
                    waits_s[signal] = clock() - before_s
                    times_s[signal] = before_s + waits_s[signal] / 2
                at_s = times_s.get(Signal.MOTOR_POSITION, begin_s)
                samples[node].append(MotionSample(at_s, values, times_s, waits_s))
        return {node: _complete(found) for node, found in samples.items()}


def _complete(samples: list[MotionSample]) -> list[MotionSample]:
    """The signals that every sample has."""
    if not samples:
        return []
    everywhere = set(samples[0].values).intersection(*(sample.values for sample in samples))
    return [
        replace(sample, values={signal: sample.values[signal] for signal in everywhere})
        for sample in samples
        if everywhere
    ]


def record_of_motion(
    surveys: Sequence[NodeSurvey], samples: Mapping[int, Sequence[MotionSample]], motors: int, linked: bool
) -> Record | None:
    """The nodes' answers, each read at a different time, as a recording with one period.

    Slow answers are omitted because their time is uncertain. Several turns without an answer make a gap, a
    long stall ends the recording.

    Args:
        surveys: of the nodes.
        samples: answers by node id.
        motors: number of motors.
        linked: whether the link position is needed.

    Returns:
        The recording; None if a channel is missing or there are fewer than three turns.
    """
    series: dict[tuple[Signal, int | None], tuple[FloatArray, FloatArray]] = {}
    for survey in surveys:
        mine = samples.get(survey.role.node_id, ())
        for signal in mine[0].values if mine else ():
            waits = np.array([sample.waits_s[signal] for sample in mine])
            prompt = waits <= _PROMPT * np.median(waits)
            times = np.array([sample.times_s[signal] for sample in mine])[prompt]
            values = np.array([sample.values[signal] for sample in mine])[prompt]
            series[signal, None if signal is Signal.LINK_POSITION else survey.role.motor] = (times, values)
    needed = [(signal, i) for signal in (Signal.MOTOR_POSITION, Signal.MOTOR_TORQUE) for i in range(motors)]
    wanted: list[tuple[Signal, int | None]] = [*needed, *([(Signal.LINK_POSITION, None)] if linked else [])]
    if any(key not in series or len(series[key][0]) < 3 for key in wanted):
        return None
    begin = max(float(series[key][0][0]) for key in wanted)
    end = min(float(series[key][0][-1]) for key in wanted)
    period_s = max(float(np.median(np.diff(series[wanted[0]][0]))), _LEAST_PERIOD_S)
    if not (end - begin > 2.0 * period_s > 0.0):
        return None
    turns = np.asarray(begin + period_s * np.arange(int((end - begin) / period_s) + 1), dtype=np.float64)
    sequence = _known(turns, [series[key][0] for key in wanted], max(_STALL * period_s, _STALL_S))
    grid = turns[sequence]

    def column(signal: Signal, motor: int | None) -> FloatArray:
        return np.asarray(np.interp(grid, *series[signal, motor]))

    return Record(
        period_s=period_s,
        sequence=sequence,
        motor_position_rad=np.stack([column(Signal.MOTOR_POSITION, i) for i in range(motors)], axis=1),
        motor_torque_nm=np.stack([column(Signal.MOTOR_TORQUE, i) for i in range(motors)], axis=1),
        link_position_rad=column(Signal.LINK_POSITION, None) if linked else None,
    )


def _known(grid: FloatArray, channels: Sequence[FloatArray], most_s: float) -> NDArray[np.int64]:
    """Places of the grid where no channel's readings are further apart than that: those of the longest part
    that no long stall interrupts.
    """
    good = np.ones(len(grid), dtype=bool)
    for times in channels:
        for k in np.flatnonzero(np.diff(times) > most_s):
            good &= (grid <= times[k]) | (grid >= times[k + 1])
    places = np.flatnonzero(good)
    if not len(places):
        return places
    parts = np.split(places, np.flatnonzero(np.diff(grid[places]) > _LONG_STALL_S) + 1)
    return max(parts, key=len)


def judge_record(section: Section, joint: JointFile, record: Record | None) -> None:
    """Check units and signs of a moving joint by the gate for recordings (eq 5)."""
    if record is None:
        section.say(Severity.INFO, joint.name, "units and signs of torque: not every channel was read")
        return
    model = replace(joint.model(), period_s=record.period_s)
    try:
        check(record, model)
        judgement = judge(record, model)
    except EstimatorError as error:
        section.say(Severity.INFO, joint.name, f"units and signs cannot be checked: {error}", _LONGER)
        return
    section.facts["samples"] = len(record)
    _say_judgement(section, joint, judgement)


def judge_gathered(section: Section, joint: JointFile, gathered: Gathered) -> None:
    """The same for samples from frames on the bus."""
    try:
        _say_judgement(section, joint, gathered.judgement())
    except EstimatorError as error:
        section.say(Severity.INFO, joint.name, str(error))


def _say_judgement(section: Section, joint: JointFile, judgement: Judgement) -> None:
    section.facts["torque_left"] = None if np.isnan(judgement.left) else judgement.left
    if judgement.findings:
        needed = [change for finding in judgement.findings for change in finding.changes]
        first = judgement.findings[0]
        text = ", and ".join(map(str, judgement.findings))
        text += f": the torque balance leaves {first.left_before:.0%}, {first.left_after:.1%} put right"
        fix = "; ".join(map(str, corrections(joint, needed, live=True)))
        section.say(Severity.ERROR, joint.name, text, f"in the joint file: {fix}")
    elif judgement.remark:
        section.say(Severity.INFO, joint.name, judgement.remark, f"{_LONGER}; or drivelink doctor --move")
    else:
        text = (
            f"units and signs of positions and torque agree: the torque balance leaves {judgement.left:.1%}"
        )
        section.ok(joint.name, text)


class _Unwrapped:
    """One object's bytes to SI, rolled-over counters straightened."""

    def __init__(self, candidate: MappedObject) -> None:
        self._candidate = candidate
        self._last: int | None = None
        self._total = 0

    @property
    def address(self) -> tuple[int, int]:
        """Of the object."""
        return self._candidate.address

    def take(self, data: bytes) -> float:
        """The SI value of the bytes."""
        data = data[: max(1, self._candidate.bits // 8)]
        count = int.from_bytes(data, "little", signed=self._candidate.signed)
        if self._candidate.wraps:
            span = self._candidate.modulus or 1 << 8 * max(1, len(data))
            if self._last is None:
                self._total = count
            else:
                self._total += (count - self._last + span // 2) % span - span // 2
            self._last, count = count, self._total
        return count * self._candidate.scale


def slope(x: Sequence[float], y: Sequence[float]) -> float:
    """Least-squares factor k of y = k x."""
    square = sum(a * a for a in x)
    return sum(a * b for a, b in zip(x, y, strict=True)) / square if square else 0.0


def judge_motion(section: Section, survey: NodeSurvey, samples: Sequence[MotionSample]) -> bool:
    """Compare the channels of the samples; return whether the motor moved."""
    subject, key = survey.role.subject, survey.role.key
    position = next(iter(survey.available.get(Signal.MOTOR_POSITION, ())), None)
    if position is None or len(samples) < 3 or Signal.MOTOR_POSITION not in samples[0].values:
        return False
    times = [sample.time_s for sample in samples]
    motor = [sample.values[Signal.MOTOR_POSITION] for sample in samples]
    section.facts[f"{subject} travel_rad"] = max(motor) - min(motor)
    if max(motor) - min(motor) < _LEAST_COUNTS * abs(position.scale):
        section.say(
            Severity.INFO,
            subject,
            "stands still: signs and units could not be checked against each other",
            "turn the joint by hand during the check (--seconds 10: more time), or drivelink doctor --move",
        )
        return False
    if Signal.MOTOR_VELOCITY in samples[0].values:
        velocity = [sample.values[Signal.MOTOR_VELOCITY] for sample in samples]
        _judge_velocity(section, subject, key, *_differences(times, motor, velocity))
    if Signal.LINK_POSITION in samples[0].values:
        link = [sample.values[Signal.LINK_POSITION] for sample in samples]
        moved, followed = _steps(times, motor), _steps(times, link)
        _judge_link(section, subject, slope(moved, followed))
    return True


def _steps(times: Sequence[float], values: Sequence[float]) -> list[float]:
    """Differences over at least the window."""
    steps = []
    start = 0
    for k in range(1, len(times)):
        if times[k] - times[start] >= _WINDOW_S:
            steps.append(values[k] - values[start])
            start = k
    return steps


def _differences(
    times: Sequence[float], position: Sequence[float], velocity: Sequence[float]
) -> tuple[list[float], list[float]]:
    """Mean velocity of each window: as reported, and from the positions."""
    reported, differenced = [], []
    start = 0
    for k in range(1, len(times)):
        span_s = times[k] - times[start]
        if span_s >= _WINDOW_S:
            differenced.append((position[k] - position[start]) / span_s)
            reported.append(sum(velocity[start : k + 1]) / (k + 1 - start))
            start = k
    return reported, differenced


def _judge_velocity(
    section: Section, subject: str, key: str, reported: list[float], differenced: list[float]
) -> None:
    ratio = slope(reported, differenced)
    section.facts[f"{subject} velocity_ratio"] = ratio
    text = f"positions change {ratio:.3g} times as fast as the reported velocity 0x606C"
    if abs(ratio - 1) <= _TOLERANCE:
        section.ok(subject, f"velocity agrees with the differences of positions (ratio {ratio:.3f})")
    elif ratio < 0:
        section.say(
            Severity.WARNING,
            subject,
            f"{text}: they have opposite signs",
            "bits 7 and 6 of the polarity 0x607E, with the maker's tool",
        )
    else:
        section.say(
            Severity.WARNING,
            subject,
            f"{text}: counts_per_rev or the velocity unit is wrong",
            f"correct {key}: counts_per_rev, or velocity_rad_s_per_count",
        )


def _judge_link(section: Section, subject: str, ratio: float) -> None:
    section.facts[f"{subject} link_ratio"] = ratio
    if abs(ratio - 1) <= _LINK_TOLERANCE:
        section.ok(subject, f"the link follows the motor (ratio {ratio:.3f})")
        return
    text = f"the link moves {ratio:.3g} times as far as the motor, both at the joint side"
    if ratio < 0:
        section.say(
            Severity.WARNING, subject, text, "reverse the sign of link.encoder.direction, or the drive's"
        )
    else:
        section.say(
            Severity.WARNING,
            subject,
            text,
            "correct gear_ratio, counts_per_rev or link.encoder.counts_per_rev",
        )
