"""What the daemon's tests share: joints on a virtual bus of their own, the simulated devices, the daemon."""

import itertools
import threading
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

import can
from can.interfaces import virtual
from zenohkit import LIMIT_S, until

from drivelink._core import Tick
from drivelink.daemon.service import Daemon, ServedJoint
from drivelink.demo.simbus import open_sim_bus
from drivelink.demo.simulate import network_from_joint
from drivelink.jointfile import JointFile, fingerprint, parse, read_text
from estimator.sample import Estimate, Sample
from sim.faults import Faults
from sim.network import Network

_channels = itertools.count()

MOTOR = """
[[motor]]
inertia_kg_m2 = 0.0005
viscous_damping_nm_s_rad = 0.005
[motor.transmission]
model = "vsa-ii"
parameters = {{ k_nm_rad = 0.5, c = 1.75 }}
[motor.drive]
node_id = NODE
gear_ratio = 20.0
torque_constant_nm_a = 0.02
"""
VSA = f"""
name = "{{name}}"
arrangement = "antagonistic"
{MOTOR.replace("NODE", "1")}{MOTOR.replace("NODE", "2")}
[link.encoder]
source = "cia406"
node_id = 3
[bus]
channel = "{{channel}}"
sdo_timeout_s = 0.1
{{bus}}
[estimator]
mode = "{{mode}}"
[zenoh]
endpoint = "{{endpoint}}"
[sim]
case = "vsa-ii"
"""


def vsa_text(
    name: str = "elbow",
    channel: str = "",
    endpoint: str = "tcp/127.0.0.1:1",
    bus: str = "",
    mode: str = "robust",
) -> str:
    channel = channel or f"daemon-test-{next(_channels)}"
    return VSA.format(name=name, channel=channel, endpoint=endpoint, bus=bus, mode=mode)


def vsa(**options: str) -> JointFile:
    return parse(vsa_text(**options))


class Collector:
    """A sink that keeps everything."""

    def __init__(self) -> None:
        self.estimates: list[tuple[Estimate, int]] = []
        self.samples: list[tuple[Sample, int]] = []
        self.payloads: list[tuple[bytes, bytes | None]] = []

    def put(self, tick: Tick) -> None:
        self.payloads.append((tick.estimate_payload, tick.sample_payload))
        self.estimates.append((tick.estimate, tick.stamp_ns))
        if tick.sample is not None:
            self.samples.append((tick.sample, tick.stamp_ns))


class DaemonRig:
    """Simulated devices and a daemon in one thread; nothing is published."""

    def __init__(self, joint: JointFile, path: Path | None = None, **options: Any) -> None:
        self.joint = joint
        self.bus = open_sim_bus(joint.bus)
        self.network: Network = network_from_joint(joint, self.bus)
        self.faults = Faults(self.network)
        known = fingerprint(read_text(path)) if path else ""
        self.daemon = Daemon(
            [ServedJoint(joint=joint, path=path, fingerprint=known, **options)],
            publish=False,
            real_time=False,
            devices=self.network.poll,
        )
        self.collector = Collector()
        (self.loop_joint,) = self.daemon.loop.loop_joints
        self.loop_joint.sink = self.collector

    @property
    def status(self) -> dict:
        return self.daemon.documents()[0]

    @property
    def events(self) -> list[str]:
        return [event["text"] for event in self.daemon.events.recent()]

    def forget(self) -> None:
        """What was said until now is of no more interest, and may be said again."""
        self.daemon.events._said.clear()
        self.daemon.events._recent.clear()

    def run(self, cycles: int) -> list[Estimate]:
        before = len(self.collector.estimates)
        self.daemon.run_lockstep(cycles)
        return [estimate for estimate, _ in self.collector.estimates[before:]]

    def node(self, node_id: int):
        return next(node for node in self.network.nodes if node.node_id == node_id)

    def tpdo(self, node_id: int) -> tuple[int, int]:
        """Number and identifier of the TPDO that carries the position of a node."""
        layout = self.daemon.layouts[node_id]
        return layout.tpdos[0].number, layout.tpdos[0].cob_id

    def close(self) -> None:
        self.daemon.close()
        self.bus.shutdown()


@contextmanager
def rig(joint: JointFile | None = None, path: Path | None = None, **options: Any) -> Iterator[DaemonRig]:
    with closing(DaemonRig(joint or vsa(), path, **options)) as made:
        yield made


@contextmanager
def served(joint: JointFile) -> Iterator[Network]:
    """Simulated devices with a thread of their own."""
    bus = open_sim_bus(joint.bus)
    network = network_from_joint(joint, bus)
    network.start()
    try:
        yield network
    finally:
        network.stop()
        bus.shutdown()


def quiet_daemon(*joints: JointFile, **options: Any) -> Daemon:
    """A daemon that publishes nothing and asks the system for nothing."""
    return Daemon([ServedJoint(joint=joint) for joint in joints], publish=False, real_time=False, **options)


def listens(joint: JointFile, devices: int) -> None:
    """Wait until one more than the simulated devices is on a virtual bus: from then on it misses no frame."""
    until(lambda: len(virtual.channels.get(joint.bus.channel, ())) > devices)


@contextmanager
def running(daemon: Daemon) -> Iterator[threading.Thread]:
    """The daemon's loop in a thread, ended and closed afterwards."""
    thread = threading.Thread(target=daemon.run)
    thread.start()
    try:
        yield thread
    finally:
        daemon.stop()
        thread.join(LIMIT_S)
        daemon.close()
        assert not thread.is_alive()


class Listener:
    """Everything that is on a virtual bus, in order."""

    def __init__(self, joint: JointFile) -> None:
        self._bus = can.Bus(interface="virtual", channel=joint.bus.channel, preserve_timestamps=True)

    def frames(self) -> list[tuple[int, bytes]]:
        found = []
        while (message := self._bus.recv(0)) is not None:
            found.append((message.arbitration_id, bytes(message.data)))
        return found

    def send(self, cob_id: int, data: bytes = b"") -> None:
        self._bus.send(can.Message(arbitration_id=cob_id, data=data, is_extended_id=False))

    def close(self) -> None:
        self._bus.shutdown()
