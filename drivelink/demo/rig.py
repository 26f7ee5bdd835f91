"""The demo's other process: the simulated joint and the daemon that serves it, on one virtual bus.

python-can's virtual bus exists inside one process. Both share one thread, because two would wait for each
other's hold on the interpreter, which no real drive does; for the same reason the subscriber is another
process. The truth goes to it through a pipe, with the sequence numbers of the estimates.
"""

import logging
import signal
from collections.abc import Mapping
from contextlib import suppress
from multiprocessing.connection import Connection
from pathlib import Path
from types import MappingProxyType
from typing import NamedTuple

from drivelink import jointfile
from drivelink._core import Tick
from drivelink.cycle.loop import CycleSink
from drivelink.daemon.service import Daemon, ServedJoint
from drivelink.demo.simbus import open_sim_bus
from drivelink.demo.simulate import World, alter, network_from_joint, world_from_joint
from drivelink.errors import DrivelinkError
from drivelink.monitor.history import TruePoint

_BATCH = 50  # cycles per message to the watcher


class RunSummary(NamedTuple):
    """The daemon's summary of the run."""

    cycles: int
    estimates: int
    missed_cycles: int
    work_p99_us: float
    lateness_p99_us: float
    torque_std_nm: float  # of the flexibility torque of the last cycle
    text: str


class Change(NamedTuple):
    """What becomes of the simulated joint in the middle of the run, undeclared."""

    after_s: float  # of the run
    effects: tuple[str, ...] = ()  # that it then has, as `sim --effect` takes them
    parameters: Mapping[str, float] = MappingProxyType({})  # that it then has, as `[sim] parameters`


class Changed(NamedTuple):
    """The joint is another one since this SYNC."""

    stamp_ns: int


class Failure(NamedTuple):
    """Why the run failed, in one line."""

    text: str
    exit_status: int


class TruthTap:
    """Publishes like the daemon's publisher, and notes the truth at the same SYNC."""

    def __init__(
        self, sink: CycleSink | None, world: World, connection: Connection, change: Change | None
    ) -> None:
        self._sink = sink
        self._world = world
        self._connection = connection
        self._change = change
        self._points: list[TruePoint] = []

    def put(self, tick: Tick) -> None:
        """Publish, then note the truth: the world stands still until the next SYNC."""
        if self._sink is not None:
            self._sink.put(tick)
        change = self._change
        if change is not None and self._world.time_s >= change.after_s:
            self._change = None
            alter(self._world, change.effects, change.parameters)
            self.flush()
            self._send(Changed(tick.stamp_ns))
        truth = self._world.truth()
        self._points.append(TruePoint(tick.sequence, truth.flexibility_torque_nm, truth.stiffness_nm_rad))
        if len(self._points) >= _BATCH:
            self.flush()

    def flush(self) -> None:
        """Send the noted truth."""
        points, self._points = self._points, []
        self._send(points)

    def _send(self, message: list[TruePoint] | Changed) -> None:
        with suppress(OSError):  # the watcher has gone; end cleanly
            self._connection.send(message)


def serve(path: Path, seconds: float | None, connection: Connection, change: Change | None = None) -> None:
    """Run simulation and daemon, and send the watcher `TruePoint` batches, then a `RunSummary` or `Failure`.

    Args:
        path: joint file with a `[sim]` section, on the virtual bus.
        seconds: of the run; None: until SIGTERM.
        change: of the joint in the middle of the run.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches both processes; the watcher decides
    logging.getLogger("drivelink").propagate = False  # the watcher's view shows the daemon's events
    logging.getLogger("drivelink").addHandler(logging.NullHandler())
    try:
        summary: RunSummary | Failure = _run(path, seconds, connection, change)
    except DrivelinkError as error:
        summary = Failure(str(error), error.exit_status)
    with suppress(OSError):
        connection.send(summary)
        connection.close()


def _run(path: Path, seconds: float | None, connection: Connection, change: Change | None) -> RunSummary:
    source = jointfile.load_text(path)
    joint = source.joint
    world = world_from_joint(joint)
    bus = open_sim_bus(joint.bus)
    network = network_from_joint(joint, bus, world=world)
    try:
        served = ServedJoint(joint=joint, path=path, fingerprint=jointfile.fingerprint(source.text))
        with Daemon([served], devices=network.poll) as daemon:
            signal.signal(signal.SIGTERM, lambda *_: daemon.stop())
            (loop_joint,) = daemon.loop.loop_joints
            tap = TruthTap(loop_joint.sink, world, connection, change)
            loop_joint.sink = tap
            daemon.run(seconds)
            tap.flush()
            loop = daemon.loop
            return RunSummary(
                cycles=loop.cycles,
                estimates=loop_joint.estimates,
                missed_cycles=loop_joint.pipeline.missed + loop.overruns,
                work_p99_us=loop_joint.work.total().get("p99_us", 0.0),
                lateness_p99_us=loop.lateness.total().get("p99_us", 0.0),
                torque_std_nm=loop_joint.pipeline.estimator.flexibility_torque_std_nm,
                text=daemon.summary(),
            )
    finally:
        bus.shutdown()
