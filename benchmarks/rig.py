"""What the benchmarks of the service share: the joint, its simulated devices, a subscriber."""

import re
import socket
import subprocess
import sys
import time
from pathlib import Path

import can
from can.interfaces.virtual import VirtualBus

import drivelink
from drivelink.demo.simbus import open_sim_bus
from drivelink.demo.simulate import bench_from_joints
from drivelink.jointfile import JointFile, parse

PERIOD_S = 0.001
VSA = (Path(drivelink.__file__).parent / "joints" / "vsa-ii.toml").read_text(encoding="utf-8")
NODES = {"1": 1, "2": 2, "10": 3}  # of that file, and those of the first joint here
SUBSCRIBER = """
import sys, time
from drivelink.pubsub.session import open_client
import zenoh
session = open_client(sys.argv[1])
ring = zenoh.handlers.RingChannel
kept = [session.declare_subscriber(key, ring(10)) for key in ("bench/**", "drivelink/**")]
print("ready", flush=True)
sys.stdin.read()
session.close()
"""


def joint_text(mode: str, endpoint: str, index: int = 0) -> str:
    """The joint file of the paper's VSA-II, without link dynamics.

    Args:
        mode: of the estimator.
        endpoint: zenoh's.
        index: of several on one bus, which is virtual and carries more of them than a real one.
    """
    text = re.sub(r"\[link\.dynamics\][^\[]*", "", VSA)
    text = re.sub(r"node_id = (\d+)", lambda found: f"node_id = {3 * index + NODES[found[1]]}", text)
    text = text.replace('name = "vsa-ii"', f'name = "bench{index or ""}"')
    text = text.replace("[bus]", "[bus]\nbitrate = 8_000_000")
    return f'{text}\n[estimator]\nmode = "{mode}"\n[zenoh]\nendpoint = "{endpoint}"\n'


def joint(mode: str, endpoint: str, index: int = 0) -> JointFile:
    """The same, read."""
    return parse(joint_text(mode, endpoint, index))


def free_endpoint() -> str:
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{listener.getsockname()[1]}"


def subscriber(endpoint: str) -> subprocess.Popen[bytes]:
    """A process that receives everything; ends with its stdin."""
    process = subprocess.Popen(
        [sys.executable, "-c", SUBSCRIBER, endpoint], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    )
    process.stdout.readline()
    return process


class Devices:
    """Simulated devices that answer in the sender's thread; their CPU time is counted apart.

    A thread of their own would fight for Python's lock with what is measured, which no real drive does.
    """

    def __init__(self, *joints: JointFile) -> None:
        self._bus = open_sim_bus(joints[0].bus)
        self.network = bench_from_joints(joints).network(self._bus)
        self.cpu_s = 0.0
        self._begin: tuple[int, float] | None = None

    def poll(self) -> None:
        start = time.thread_time()
        self.network.poll()
        if self._begin is None and self.network.syncs:
            self._begin = (self.network.syncs, time.process_time() - self.cpu_s)
        self.cpu_s += time.thread_time() - start

    def begin(self) -> None:
        """What is counted begins with the next SYNC: a start is none of the cycle's business."""
        self._begin = None

    def counted(self) -> tuple[int, float]:
        """SYNCs, and CPU time of the process without that of the devices, s, since then."""
        if self._begin is None:
            return 0, 0.0
        syncs, cpu_s = self._begin
        return self.network.syncs - syncs, time.process_time() - self.cpu_s - cpu_s

    def close(self) -> None:
        """Take them off the bus."""
        self._bus.shutdown()


class AnsweringBus(VirtualBus):
    """The virtual bus, with devices that answer before `send` returns."""

    def __init__(self, channel: str | None, devices: Devices) -> None:
        super().__init__(channel)
        self._devices = devices

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        super().send(msg, timeout)
        self._devices.poll()
