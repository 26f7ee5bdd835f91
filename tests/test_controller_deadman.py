"""The dead-man of the controller's process, by its own clock, which stands still unless the process waits."""

import io
import math
from types import SimpleNamespace

import controllerkit as kit
import pytest
import vsacontrol.process
from vsacontrol.phases import Phase
from vsacontrol.process import Process

from drivelink._core import encode_sample
from drivelink.pubsub.wire import EstimateMessage
from estimator.sample import Sample, TransmissionEstimate

SAFE = (0.0, 0.0)
PERIOD_S = 0.001
DEADLINE_S = 0.010  # of the example
LOOK_S = 0.002  # how long it waits for an estimate before it looks at the clock again


class Daemon:
    """Clock, subscription and zenoh session in one: an estimate and its sample a period, until it is silent."""

    def __init__(self) -> None:
        self.now_s = 100.0
        self.silent_from_s = math.inf
        self.last_s = -math.inf
        self.status = self.external = None
        self._sequence = 0
        self._sample: bytes | None = None

    def monotonic(self) -> float:
        return self.now_s

    def sleep(self, seconds: float) -> None:
        self.now_s += seconds

    @property
    def age_s(self) -> float:
        return self.now_s - self.last_s

    def wait(self, timeout_s: float) -> EstimateMessage | None:
        if self.now_s + PERIOD_S > self.silent_from_s:
            self.now_s += timeout_s
            return None
        self.now_s += PERIOD_S
        return self.estimate()

    def estimate(self) -> EstimateMessage:
        self.last_s = self.now_s
        self._sequence += 1
        sample = Sample(self._sequence, (0.0, 0.0), (math.nan,) * 2, (0.0, 0.0), 0.0)
        self._sample = encode_sample(sample, 0)
        each = TransmissionEstimate(0.0, 0.3, 0.001, 0.0)
        return EstimateMessage(self._sequence, 0, 0, 0.0, 0.6, 0.001, (each, each))

    def try_recv(self) -> SimpleNamespace | None:
        data, self._sample = self._sample, None
        return None if data is None else SimpleNamespace(payload=SimpleNamespace(to_bytes=lambda: data))

    def declare_subscriber(self, *_: object) -> "Daemon":
        return self

    def close(self) -> None:
        pass


class Drives:
    """A master whose drives are enabled, and what torques they were commanded."""

    enabled, faulted, status_ids = True, False, ()

    def __init__(self) -> None:
        self.commanded: list[tuple[float, tuple[float, float]]] = []

    def command(self, torques: tuple[float, float], now_s: float) -> None:
        self.commanded.append((now_s, torques))

    def poll(self, *_: object, **__: object) -> None:
        pass

    release = poll


@pytest.fixture
def running(monkeypatch):
    """A process that has moved the joint for a second."""
    daemon, drives = Daemon(), Drives()
    bus = SimpleNamespace(recv=lambda _: None, send=print, shutdown=daemon.close)
    fakes = {
        "time": daemon,
        "open_bus": lambda _: bus,
        "open_client": lambda *_: daemon,
        "close_session": lambda _: None,
        "subscribe": lambda *_, **__: daemon,
    }
    for name, fake in fakes.items():
        monkeypatch.setattr(vsacontrol.process, name, fake)
    settings = kit.Settings(deadline_s=DEADLINE_S)
    law = kit.Decoupler(joint=kit.VSA)
    controller = kit.Controller(kit.VSA, law, kit.Reference(kit.WAYPOINTS["decoupling"]), PERIOD_S)
    with io.StringIO() as report:
        process = Process(kit.declared(), kit.EXAMPLE, controller, settings=settings, report=report)
        process._master = drives
        begin_s = daemon.now_s
        while daemon.now_s < begin_s + 1.0:
            process._once()
        assert controller.phase is Phase.IDENTIFY
        assert drives.commanded[-1][1] != SAFE
        yield process, daemon, drives, controller


def test_no_torque_a_deadline_and_a_look_after_the_last_estimate_and_never_before(running):
    process, daemon, drives, controller = running
    daemon.silent_from_s = daemon.now_s
    last_s = daemon.last_s
    before = len(drives.commanded)
    process.run(lambda: daemon.now_s > last_s + 0.1)
    ended = drives.commanded[before:]
    assert all(torques == SAFE for _, torques in ended)
    assert DEADLINE_S < ended[0][0] - last_s <= DEADLINE_S + LOOK_S + 1e-9
    assert len(ended) > 0.1 / DEADLINE_S - 2  # and said again: the frame may have been lost
    assert controller.events[-1].reason == "estimates are stale"
    assert controller.events[-1].age_s == pytest.approx(ended[0][0] - last_s)


def test_an_estimate_that_comes_in_time_keeps_it_moving(running):
    process, daemon, drives, _ = running
    daemon.sleep(DEADLINE_S - 2 * PERIOD_S)  # a stall shorter than the deadline
    process._once()
    assert drives.commanded[-1][1] != SAFE


def test_what_waited_while_the_process_was_stopped_moves_nothing(running, monkeypatch):
    process, daemon, drives, controller = running
    old = daemon.estimate()
    daemon.sleep(0.03)
    monkeypatch.setattr(daemon, "wait", lambda _: old)
    process._once()
    assert drives.commanded[-1][1] == SAFE
    assert controller.events[-1].reason == "estimates are stale"
    assert controller.events[-1].age_s == pytest.approx(0.03)
