"""A joint's channels as they are now: asked by SDO, or heard in the frames of a bus that may not be asked."""

import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import can
import numpy as np
from numpy.typing import NDArray

from drivelink.canopen.bus import open_bus, received_ns, run_program
from drivelink.canopen.guard import SilentBus
from drivelink.canopen.layout import MappedObject, Signal, roles
from drivelink.canopen.node import NodeSurvey, survey_node
from drivelink.canopen.passive import PassiveConfigurator
from drivelink.canopen.scan import listen, shares
from drivelink.canopen.sdo import Program, Read, SdoAbort
from drivelink.doctor.machine import daemon_mapping
from drivelink.doctor.manualcheck import Reader, Value
from drivelink.errors import DriveError
from drivelink.jointfile import JointFile
from drivelink.recording.canlog import LoggedFrame
from drivelink.recording.cycles import FrameSamples
from estimator.sample import FloatArray, Record, Sample

_READ = (Signal.MOTOR_POSITION, Signal.MOTOR_VELOCITY, Signal.MOTOR_TORQUE, Signal.LINK_POSITION)
_NAMES = {Signal.MOTOR_POSITION: "position", Signal.MOTOR_TORQUE: "torque"}
_STALL = 4.0  # turns without an answer that make a gap,
_STALL_S = 0.01  # and their duration: at 10 Hz linear interpolation over it is off by (2 pi f t)²/8 = 5 %
_LONG_STALL_S = 0.25  # stall that ends the recording; a shorter one is a gap
_LEAST_PERIOD_S = 0.001  # of the recording made from the answers, enough for a joint's motion
_PROMPT = 1.5  # times the usual answer time; later answers have an uncertain time and are omitted
_MOST_SAMPLES = 60_000  # that are kept of what is heard; more add no information
_PATIENCE_S = 5.0  # timeout for a sample from the frames of a passive bus

Channel = tuple[Signal, int | None]
"""A signal of a motor, or of the link (None)."""


@dataclass(slots=True)
class Series:
    """The values of one channel."""

    # of each value; for an answer, halfway between it and its request
    times_s: list[float] = field(default_factory=list)
    values: list[float] = field(default_factory=list)  # SI at the joint side
    waits_s: list[float] = field(default_factory=list)  # from request to answer; 0: heard
    step: float = 0.0  # of the values, as the device counts them


Readings = Mapping[Channel, Series]


class Asked:
    """Reads positions, velocity and torque of the nodes in turn, as fast as they answer; writes nothing."""

    def __init__(self, surveys: Sequence[NodeSurvey], clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._counters: dict[Channel, tuple[int, _Unwrapped]] = {
            (signal, None if signal is Signal.LINK_POSITION else survey.role.motor): (
                survey.role.node_id,
                _Unwrapped(survey.available[signal][0]),
            )
            for survey in surveys
            for signal in _READ
            if survey.available.get(signal)
        }

    def program(self, seconds: float) -> Program[Readings]:
        """Return the readings of so many seconds, of the channels that have a value in every turn."""
        clock, turns = self._clock, 0
        found: dict[Channel, Series] = {
            channel: Series(step=counter.step) for channel, (_, counter) in self._counters.items()
        }
        end_s = clock() + seconds
        while clock() < end_s and self._counters:
            turns += 1
            for channel, (node, counter) in self._counters.items():
                before_s, series = clock(), found[channel]
                try:
                    data = yield Read(node, *counter.address)
                except SdoAbort:  # some have no value before the drive runs
                    continue
                series.values.append(counter.decode(data))
                series.waits_s.append(clock() - before_s)
                series.times_s.append(before_s + series.waits_s[-1] / 2)
        return {channel: series for channel, series in found.items() if 0 < len(series.values) == turns}


class _Unwrapped:
    """One object's bytes to SI, rolled-over counters straightened."""

    def __init__(self, candidate: MappedObject) -> None:
        self._candidate = candidate
        self.address, self.step = candidate.address, abs(candidate.scale)
        self._last: int | None = None
        self._total = 0

    def decode(self, data: bytes) -> float:
        """Return the SI value of the bytes."""
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


class Heard:
    """Makes samples from the frames of a passive bus, as the daemon would; sends nothing.

    Args:
        configurator: knows the mapping of its nodes, or takes it from the frames.
    """

    def __init__(self, joint: JointFile, configurator: PassiveConfigurator) -> None:
        self._frames, self._configurator = FrameSamples(joint, configurator), configurator
        self._samples: list[Sample] = []

    @property
    def joint(self) -> JointFile:
        """The joint, with the measured period of SYNC."""
        return self._frames.joint

    @property
    def missing(self) -> str:
        """Why there are no samples."""
        return self._frames.missing or "no SYNC, or not all of its frames"

    def feed(self, message: can.Message) -> None:
        """Process a frame, in bus order."""
        if not (message.is_extended_id or message.is_remote_frame or message.is_error_frame):
            frame = LoggedFrame(received_ns(message), message.arbitration_id, bytes(message.data), "")
            self._keep(self._frames.feed(frame))

    def _keep(self, made: list[tuple[Sample, int]]) -> None:
        if len(self._samples) < _MOST_SAMPLES:
            self._samples += [sample for sample, _ in made]

    def readings(self) -> Readings:
        """Return what was heard since the last call, of the channels that have every value."""
        self._keep(self._frames.rest())
        samples, self._samples = self._samples, []
        values: dict[Channel, list[float]] = {}
        for i in range(len(samples[0].motor_position_rad) if samples else 0):
            values[Signal.MOTOR_POSITION, i] = [sample.motor_position_rad[i] for sample in samples]
            values[Signal.MOTOR_TORQUE, i] = [sample.motor_torque_nm[i] for sample in samples]
        values[Signal.LINK_POSITION, None] = [sample.link_position_rad for sample in samples]
        times = [sample.sequence * self.joint.bus.period_s for sample in samples]
        heard = {channel: each for channel, each in values.items() if each and np.all(np.isfinite(each))}
        steps: dict[Channel, float] = {
            (one.signal, None if one.signal is Signal.LINK_POSITION else layout.motor): abs(one.scale)
            for layout in self._configurator.layouts.values()
            for tpdo in layout.tpdos
            for one in tpdo.objects
        }
        return {
            channel: Series(times, each, [0.0] * len(each), steps.get(channel, 0.0))
            for channel, each in heard.items()
        }

    def listen(self, bus: SilentBus, seconds: float) -> Readings:
        """Return what is heard in the next seconds."""
        self.readings()
        listen(bus, seconds, self.feed)
        return self.readings()


def record_of(readings: Readings, motors: int, linked: bool) -> Record | None:
    """Return the channels, each read at its own times, as a recording with one period.

    Slow answers are omitted because their time is uncertain. Several turns without an answer make a gap, a
    long stall ends the recording.

    Args:
        linked: whether the link position is needed.

    Returns:
        The recording; None if a channel is missing or there are fewer than three turns.
    """
    needed = [(signal, i) for signal in (Signal.MOTOR_POSITION, Signal.MOTOR_TORQUE) for i in range(motors)]
    wanted: list[Channel] = [*needed, *([(Signal.LINK_POSITION, None)] if linked else [])]
    series = {channel: _prompt(readings[channel]) for channel in wanted if channel in readings}
    if any(channel not in series or len(series[channel][0]) < 3 for channel in wanted):
        return None
    begin = max(float(times[0]) for times, _ in series.values())
    end = min(float(times[-1]) for times, _ in series.values())
    period_s = max(float(np.median(np.diff(series[wanted[0]][0]))), _LEAST_PERIOD_S)
    if not (end - begin > 2.0 * period_s > 0.0):
        return None
    turns = np.asarray(begin + period_s * np.arange(int((end - begin) / period_s) + 1), dtype=np.float64)
    sequence = _known(turns, [times for times, _ in series.values()], max(_STALL * period_s, _STALL_S))
    column = {channel: np.asarray(np.interp(turns[sequence], *each)) for channel, each in series.items()}
    return Record(
        period_s=period_s,
        sequence=sequence,
        motor_position_rad=np.stack([column[Signal.MOTOR_POSITION, i] for i in range(motors)], axis=1),
        motor_torque_nm=np.stack([column[Signal.MOTOR_TORQUE, i] for i in range(motors)], axis=1),
        link_position_rad=column[Signal.LINK_POSITION, None] if linked else None,
    )


def _prompt(series: Series) -> tuple[FloatArray, FloatArray]:
    """Times and values of the prompt answers."""
    prompt = np.asarray(series.waits_s) <= _PROMPT * np.median(series.waits_s)
    return np.asarray(series.times_s)[prompt], np.asarray(series.values)[prompt]


def _known(grid: FloatArray, channels: Sequence[FloatArray], most_s: float) -> NDArray[np.int64]:
    """Places of the grid near readings of every channel, in the longest part without a long stall."""
    good = np.ones(len(grid), dtype=bool)
    for times in channels:
        for k in np.flatnonzero(np.diff(times) > most_s):
            good &= (grid <= times[k]) | (grid >= times[k + 1])
    places = np.flatnonzero(good)
    if not len(places):
        return places
    parts = np.split(places, np.flatnonzero(np.diff(grid[places]) > _LONG_STALL_S) + 1)
    return max(parts, key=len)


def values_of(readings: Readings) -> Mapping[str, Value]:
    """Return mean and standard deviation of "motor1_position", …, "link_position", for the checks by hand."""
    found = {}
    for (signal, motor), series in readings.items():
        name = "link_position" if motor is None else f"motor{motor + 1}_{_NAMES.get(signal, '')}"
        if motor is None or signal in _NAMES:
            std = math.hypot(float(np.std(series.values)), series.step / math.sqrt(12.0))
            found[name] = Value(float(np.mean(series.values)), std)
    return found


@contextmanager
def live_values(joint: JointFile, base_dir: Path) -> Iterator[Reader]:
    """Yield what reads the channels of a joint on its bus.

    Raises:
        BusError: the bus cannot be opened.
        DriveError: a node does not answer, or its frames give no samples.
    """
    with open_bus(joint.bus) as bus:
        if joint.bus.configure:
            mine = roles(joint, base_dir)
            ends = zip(mine, shares(len(mine)), strict=True)
            asked = Asked([run_program(survey_node(one), bus, joint.bus, end_s=end_s) for one, end_s in ends])
            yield lambda seconds: values_of(run_program(asked.program(seconds), bus, joint.bus))
        else:
            silent = SilentBus(bus)
            known = PassiveConfigurator([joint], [base_dir])
            known.adopt(daemon_mapping(joint, base_dir))
            heard = Heard(joint, known)
            if not heard.listen(silent, _PATIENCE_S):
                raise DriveError(f"{joint.name}: no sample in {_PATIENCE_S:g} s: {heard.missing}")
            yield lambda seconds: values_of(heard.listen(silent, seconds))
