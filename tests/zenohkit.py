"""What the zenoh tests share: free ports, joints, and daemons in processes of their own that can be killed."""

import os
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

from drivelink._core import encode_estimate, encode_external, encode_sample
from drivelink.jointfile import JointFile, parse
from estimator.sample import Estimate, External, Sample, Status, TransmissionEstimate

HERE = Path(__file__).parent
LIMIT_S = 60.0  # patience with a loaded machine; nothing is asserted about time itself


def free_port() -> int:
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        return int(listener.getsockname()[1])


def free_endpoint() -> str:
    return f"tcp/127.0.0.1:{free_port()}"


def joint_text(name: str, endpoint: str, more: str = "") -> str:
    return (
        f'name = "{name}"\n[[motor]]\ninertia_kg_m2 = 0.125\n[motor.transmission]\nmodel = "linear"\n'
        f'parameters = {{ k_nm_rad = 700.0 }}\n[zenoh]\nendpoint = "{endpoint}"\n{more}'
    )


def make_joint(name: str, endpoint: str, more: str = "") -> JointFile:
    return parse(joint_text(name, endpoint, more))


def make_estimate(sequence: int, status: int = Status.VALID | Status.OBSERVABLE, motors: int = 1) -> Estimate:
    each = (TransmissionEstimate(sequence * 0.5, 700.0, 3.0, sequence * 0.001),) * motors
    return Estimate(sequence, int(status), sequence * 0.5, 700.0, 3.0, each)


def make_external(sequence: int, status: int = 1) -> External:
    return External(sequence, status, 0.01 * sequence, 0.25, 1.0, 2.0)


def make_sample(sequence: int) -> Sample:
    return Sample(sequence, (0.5,), (0.0,), (1.5,), 0.25)


@dataclass(frozen=True)
class Cycle:
    """A tick made by hand, with more transmissions than a joint has if need be."""

    estimate: Estimate
    sample: Sample | None = None
    external: External | None = None
    stamp_ns: int = 0

    def flagged(self, status: int) -> "Cycle":
        return replace(self, estimate=self.estimate._replace(status=self.estimate.status | status))

    @property
    def estimate_payload(self) -> bytes:
        return encode_estimate(self.estimate, self.stamp_ns)

    @property
    def sample_payload(self) -> bytes | None:
        return self.sample and encode_sample(self.sample, self.stamp_ns)

    @property
    def external_payload(self) -> bytes | None:
        return self.external and encode_external(self.external, self.stamp_ns)


def put_estimate(publisher, estimate: Estimate, stamp_ns: int) -> None:
    publisher.put(Cycle(estimate, stamp_ns=stamp_ns))


def put_external(publisher, external: External, stamp_ns: int) -> None:
    publisher._external.put(encode_external(external, stamp_ns))


def put_sample(publisher, sample: Sample, stamp_ns: int) -> None:
    publisher._sample.put(encode_sample(sample, stamp_ns))


def until(condition, limit_s: float = LIMIT_S):
    """Wait until the condition holds and return what it gave; fail after a generous limit."""
    deadline = time.monotonic() + limit_s
    while not (result := condition()):
        assert time.monotonic() < deadline, "did not come about"
        time.sleep(0.01)
    return result


@contextmanager
def process(*arguments: str | Path, **environment: str) -> Iterator[subprocess.Popen[str]]:
    with python("-m", "drivelink", *arguments, **environment) as running:
        yield running


@contextmanager
def python(*arguments: str | Path, **environment: str) -> Iterator[subprocess.Popen[str]]:
    environment = os.environ | {"PYTHONPATH": str(HERE.parent), "PYTHONUNBUFFERED": "1"} | environment
    command = [sys.executable, *map(str, arguments)]
    pipe = subprocess.PIPE
    running = subprocess.Popen(command, stdout=pipe, stderr=pipe, text=True, env=environment)
    try:
        yield running
    finally:
        running.kill()
        running.communicate()


def script(*arguments: str, name: str = "zenoh_daemon.py") -> AbstractContextManager[subprocess.Popen[str]]:
    return python(HERE / name, *arguments)


@contextmanager
def repeated(call: Callable[[], object], every_s: float) -> Iterator[None]:
    """Something is called all the time in a thread, as a loop's slack would."""
    over = threading.Event()

    def repeat() -> None:
        while not over.wait(every_s):
            call()

    thread = threading.Thread(target=repeat)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()


def connected(publisher, joint) -> None:
    """Wait until a joint's publisher knows of this subscription: from then on nothing is lost."""
    until(lambda: joint.model is not None)
    until(lambda: publisher.subscribed)


def ready(process: subprocess.Popen) -> None:
    line = process.stdout.readline()
    assert line == "ready\n", (line, process.stderr.read() if process.poll() is not None else "")
