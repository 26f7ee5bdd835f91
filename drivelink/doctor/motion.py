"""Units and signs, checked against each other: what positions say of the velocity, and the link of the motor.

The drive is only read; whoever wants to know more turns the shaft by hand meanwhile.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from drivelink.canopen.candidates import Candidate
from drivelink.canopen.layout import Signal
from drivelink.canopen.node import NodeSurvey
from drivelink.canopen.sdo import Program, Read, SdoAbort
from drivelink.doctor.report import Section
from drivelink.finding import Severity

__all__ = ["MotionSample", "judge_motion", "sample_motion", "slope"]

_READ = (Signal.MOTOR_POSITION, Signal.MOTOR_VELOCITY, Signal.LINK_POSITION)
_WINDOW_S = 0.02  # differences over less are mostly quantisation
_LEAST_COUNTS = 50  # that have to pass for a judgement
_TOLERANCE = 0.15  # relative; velocities are filtered in the drive
_LINK_TOLERANCE = 0.35  # the transmission bends


@dataclass(frozen=True, slots=True)
class MotionSample:
    """What one node said at one time.

    Attributes:
        time_s: monotonic, of its position.
        values: SI at the joint side, by signal.
    """

    time_s: float
    values: dict[Signal, float]


def sample_motion(
    survey: NodeSurvey, seconds: float, clock: Callable[[], float] = time.monotonic
) -> Program[list[MotionSample]]:
    """Read positions and velocity of one node as fast as it answers; writes nothing."""
    chosen = {signal: survey.available[signal][0] for signal in _READ if survey.available.get(signal)}
    counters = {signal: _Unwrapped(candidate) for signal, candidate in chosen.items()}
    samples: list[MotionSample] = []
    end_s = clock() + seconds
    while clock() < end_s and chosen:
        values = {}
        stamp_s = clock()
        for signal, candidate in chosen.items():
            before_s = clock()
            try:
                data = yield Read(survey.role.node_id, *candidate.address)
            except SdoAbort:  # some have no value before the drive runs
                continue
            values[signal] = counters[signal].take(data)
            if signal is Signal.MOTOR_POSITION:
                stamp_s = (before_s + clock()) / 2
        samples.append(MotionSample(stamp_s, values))
    everywhere = set(chosen).intersection(*(sample.values for sample in samples))
    return [
        MotionSample(sample.time_s, {signal: sample.values[signal] for signal in everywhere})
        for sample in samples
        if everywhere
    ]


class _Unwrapped:
    """One object's bytes to SI, rolled-over counters straightened."""

    def __init__(self, candidate: Candidate) -> None:
        self._candidate = candidate
        self._last: int | None = None
        self._total = 0

    def take(self, data: bytes) -> float:
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


def judge_motion(section: Section, survey: NodeSurvey, samples: Sequence[MotionSample]) -> None:
    """Compare what the samples say of each other."""
    subject, key = survey.role.subject, survey.role.key
    position = next(iter(survey.available.get(Signal.MOTOR_POSITION, ())), None)
    if position is None or len(samples) < 3 or Signal.MOTOR_POSITION not in samples[0].values:
        return
    times = [sample.time_s for sample in samples]
    motor = [sample.values[Signal.MOTOR_POSITION] for sample in samples]
    section.facts[f"{subject} travel_rad"] = max(motor) - min(motor)
    if max(motor) - min(motor) < _LEAST_COUNTS * abs(position.scale):
        section.say(
            Severity.INFO,
            subject,
            "stands still: signs and units could not be checked against each other",
            "turn the joint by hand during the check (--seconds 10 gives more time)",
        )
        return
    if Signal.MOTOR_VELOCITY in samples[0].values:
        velocity = [sample.values[Signal.MOTOR_VELOCITY] for sample in samples]
        _judge_velocity(section, subject, key, *_differences(times, motor, velocity))
    if Signal.LINK_POSITION in samples[0].values:
        link = [sample.values[Signal.LINK_POSITION] for sample in samples]
        moved, followed = _steps(times, motor), _steps(times, link)
        _judge_link(section, subject, slope(moved, followed))


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
            Severity.WARNING, subject, text, "turn the sign of link.encoder.direction, or the drive's"
        )
    else:
        section.say(
            Severity.WARNING,
            subject,
            text,
            "correct gear_ratio, counts_per_rev or link.encoder.counts_per_rev",
        )
