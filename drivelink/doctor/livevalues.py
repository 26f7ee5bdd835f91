"""Reads a joint's channels now: by SDO, or from the traffic of another master."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path

import can
import numpy as np

from drivelink.canopen.blocking import run_program
from drivelink.canopen.bus import open_bus
from drivelink.canopen.guard import SilentBus
from drivelink.canopen.layout import Signal
from drivelink.canopen.node import NodeSurvey, survey_node
from drivelink.canopen.passive import PassiveConfigurator
from drivelink.canopen.roles import roles
from drivelink.canopen.scan import listen
from drivelink.doctor.byhand import Value, Values
from drivelink.doctor.motion import MotionReader
from drivelink.doctor.sampletap import SampleTap
from drivelink.errors import DriveError
from drivelink.jointfile import BusSection, JointFile
from estimator.sample import Sample

_PATIENCE_S = 5.0  # timeout for a sample from the frames of a passive bus
_CHANNELS = {Signal.MOTOR_POSITION: "position", Signal.MOTOR_TORQUE: "torque"}


class AskedValues:
    """Reads the nodes by SDO; writes nothing.

    Args:
        bus: where they are.
        section: of the joint file.
        surveys: of the nodes.
    """

    def __init__(self, bus: can.BusABC, section: BusSection, surveys: Sequence[NodeSurvey]) -> None:
        self._bus, self._section, self._surveys = bus, section, surveys
        self._reader = MotionReader(surveys)

    def read(self, seconds: float) -> Mapping[str, Value]:
        """The channels of the next seconds.

        Raises:
            DriveError: a node does not answer.
        """
        samples = run_program(self._reader.program(seconds), self._bus, self._section)
        found = {}
        for survey in self._surveys:
            mine = samples[survey.role.node_id]
            for signal in mine[0].values if mine else ():
                name = _channel(signal, survey.role.motor)
                if name:
                    found[name] = _value([sample.values[signal] for sample in mine])
        return found


class HeardValues:
    """Listens to the frames of a bus; sends nothing.

    Args:
        bus: listened to only.
        tap: makes samples from its frames.
    """

    def __init__(self, bus: SilentBus, tap: SampleTap) -> None:
        self._bus, self._tap = bus, tap

    def read(self, seconds: float) -> Mapping[str, Value]:
        """The channels of the next seconds."""
        heard: list[Sample] = []

        def take(message: can.Message) -> None:
            before = self._tap.samples
            self._tap.take(message)
            if self._tap.samples != before and self._tap.latest is not None:
                heard.append(self._tap.latest)

        listen(self._bus, seconds, take)
        if not heard:
            return {}
        motors = range(len(heard[0].motor_position_rad))
        found = {f"motor{i + 1}_position": _value([s.motor_position_rad[i] for s in heard]) for i in motors}
        found |= {f"motor{i + 1}_torque": _value([s.motor_torque_nm[i] for s in heard]) for i in motors}
        found["link_position"] = _value([s.link_position_rad for s in heard])
        return {name: value for name, value in found.items() if np.isfinite(value.mean)}


@contextmanager
def live_values(joint: JointFile, base_dir: Path) -> Iterator[Values]:
    """The channels of a joint on its bus.

    Raises:
        BusError: the bus cannot be opened.
        DriveError: a node does not answer, or its frames give no samples.
    """
    bus = open_bus(joint.bus)
    try:
        if joint.bus.configure:
            surveys = [run_program(survey_node(role), bus, joint.bus) for role in roles(joint, base_dir)]
            yield AskedValues(bus, joint.bus, surveys)
        else:
            silent, configurator = SilentBus(bus), PassiveConfigurator([joint], [base_dir])
            tap = SampleTap(joint, configurator)
            listen(silent, _PATIENCE_S, tap.take)
            if tap.latest is None:
                raise DriveError(f"{joint.name}: no sample in {_PATIENCE_S:g} s: {tap.missing}")
            yield HeardValues(silent, tap)
    finally:
        bus.shutdown()


def _channel(signal: Signal, motor: int | None) -> str:
    if signal is Signal.LINK_POSITION:
        return "link_position"
    return f"motor{motor + 1}_{_CHANNELS[signal]}" if motor is not None and signal in _CHANNELS else ""


def _value(values: Sequence[float]) -> Value:
    return Value(float(np.mean(values)), float(np.std(values)))
