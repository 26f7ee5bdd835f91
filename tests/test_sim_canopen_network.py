"""The network of devices: lockstep, served by a thread, over TCP."""

import itertools
import math
import socket
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from types import SimpleNamespace

import can
import numpy as np
import pytest
from simkit import StubRig

from drivelink.demo.simbus import SocketcandServer
from sim.canopen.drive import Cia402Drive
from sim.network import Network

PATIENCE_S = 60.0  # only ever waited for when something is broken


def sync(stamp_s=0.0):
    return can.Message(arbitration_id=0x80, is_extended_id=False, timestamp=stamp_s)


FOREIGN = (
    can.Message(arbitration_id=0x12345678, data=b"\1", is_extended_id=True),
    can.Message(arbitration_id=0x181, is_remote_frame=True, is_extended_id=False),
    can.Message(arbitration_id=0x80, is_error_frame=True),
    can.Message(arbitration_id=0x601, data=bytes(3), is_extended_id=False),
    can.Message(arbitration_id=0x601, data=bytes(64), is_fd=True, is_extended_id=False),
    can.Message(arbitration_id=0x7E5, data=bytes(8), is_extended_id=False),
    can.Message(arbitration_id=0, is_extended_id=False),
)


def test_in_lockstep_a_sync_is_one_period_however_long_the_caller_takes_and_foreign_frames_disturb_nobody():
    rig, now, ends = StubRig(), 0.0, {"interface": "virtual", "channel": "net-1"}
    with can.Bus(**ends) as device_end, can.Bus(**ends) as master_end:
        network = Network(device_end, [Cia402Drive(1, rig, 0)], rig, clock=lambda: now)
        network.poll()
        for message in FOREIGN:
            master_end.send(message)
        network.poll()
        (boot,) = iter(lambda: master_end.recv(0), None)
        assert (boot.arbitration_id, rig.tick) == (0x701, 0)
        for pause_s in (0.0, 0.001, 0.3, 10.0):
            now += pause_s
            master_end.send(sync())
            network.poll()
        assert rig.tick == 4
        for _ in range(3):
            master_end.send(sync())
        assert (network.poll(), rig.tick) == (3, 7)


class ScriptedBus(can.BusABC):
    """Hands out given frames, then fails, then ends its reader."""

    def __init__(self, frames, stop):
        super().__init__(channel="script")
        self.frames = frames
        self.stop = stop
        self.sent: list[can.Message] = []

    def _recv_internal(self, timeout):
        if not self.frames:
            self.stop.set()
            return None, False
        frame = self.frames.pop(0)
        if isinstance(frame, Exception):
            raise frame
        return frame, False

    def send(self, msg, timeout=None):
        self.sent.append(msg)


def served_ticks(stamps_s, clock=time.monotonic):
    """Ticks of the world after each SYNC that arrives at these times (relative to now)."""
    rig = StubRig()
    stop = threading.Event()
    ticks: list[int] = []
    origin_s = time.time()
    frames: list[can.Message | Exception] = [sync(origin_s + stamp_s) for stamp_s in stamps_s]
    bus = ScriptedBus(frames, stop)
    network = Network(bus, [Cia402Drive(1, rig, 0)], rig, clock=clock)
    network.sync_filter = lambda _data: ticks.append(rig.tick) is None
    network.serve(stop)
    bus.shutdown()
    return [*ticks[1:], rig.tick]


@pytest.mark.parametrize(
    ("stamps", "expected"),
    [
        ([0.001 * k + 0.0003 * (-1) ** k for k in range(1, 400)], {1}),  # jitter: none lost and none invented
        ([0.001 * k for k in range(1, 200) if k != 100], {1, 2}),
        ([0.001 * k + (3600.0 if k >= 100 else 0.0) for k in range(1, 200)], {1}),
        ([0.001 * k + (0.0007 if k % 10 == 0 else 0.0) for k in range(1, 200)], {1}),
        ([0.0011 * k - 0.01 if 100 <= k < 107 else 0.001 * k for k in range(1, 200)], {1}),
        ([0.00098 * k for k in range(1, 400)], {1}),
        ([0.00102 * k for k in range(1, 400)], {1}),
    ],
    ids=["jitter", "one is lost", "the clock is set", "some are late", "read in one go", "faster", "slower"],
)
def test_served_the_world_keeps_pace_with_sync(stamps, expected):
    """Each SYNC is a period of the plant, however late it comes; where one is lost, two pass."""
    steps = [b - a for a, b in itertools.pairwise(served_ticks(stamps)[25:])]  # from when it is locked
    assert set(steps) == expected and steps.count(2) <= 1


def test_the_world_does_not_run_on_while_syncs_wait():
    """A loaded machine reads SYNCs a tenth of a second late: each is one period all the same."""
    reads = itertools.count()
    ticks = served_ticks([-0.15 + 0.001 * k for k in range(50)], clock=lambda: 0.1 * next(reads))[:-1]
    assert {b - a for a, b in itertools.pairwise(ticks)} == {1}


def test_a_sync_is_answered_in_time_or_not_at_all(monkeypatch):
    """A late answer would be taken for that of a later SYNC: a reading some periods old, and a false contact."""
    answered, clock = [], SimpleNamespace(time=lambda: now_s, monotonic=time.monotonic)
    monkeypatch.setattr("sim.network.time", clock)
    monkeypatch.setattr(Cia402Drive, "latch", lambda *_: True)
    monkeypatch.setattr(Cia402Drive, "transmit", lambda _: answered.append(stamp_s))
    rig, now_s = StubRig(), 100.0
    with ScriptedBus([], threading.Event()) as bus:
        network = Network(bus, [Cia402Drive(1, rig, 0)], rig)
        network.power_on()
        network._lockstep = False
        for ahead_s in (0.0, -3600.0):  # also where the stamps are of another clock
            answered.clear()
            stamps = [100.0 + ahead_s + 0.001 * k for k in range(1, 60)]
            for k, stamp_s in enumerate(stamps):
                now_s = max(stamp_s - ahead_s + 0.0001, stamps[25] - ahead_s if 20 <= k < 25 else 0.0)
                network._receive(sync(stamp_s))
            assert answered == [*stamps[:20], *stamps[24:]]


def clients(server, count):
    """Connected clients; the server is served meanwhile."""
    with ThreadPoolExecutor(1) as pool:
        how = {"interface": "socketcand", "channel": "vcan0", "host": "127.0.0.1", "port": server.port}
        made = pool.submit(lambda: [can.Bus(**how) for _ in range(count)])
        while not made.done():
            assert server.recv(0.01) is None
        return made.result()


def exchange(server, client):
    """What the client receives, with the server served meanwhile."""
    deadline = time.monotonic() + PATIENCE_S
    while time.monotonic() < deadline:
        server.recv(0.005)
        message = client.recv(0.005)
        if message is not None:
            return message.arbitration_id, bytes(message.data)
    return None


@pytest.mark.skipif(sys.platform != "linux", reason="the kernel's stamps")
def test_a_frame_has_the_time_of_its_arrival_however_late_it_is_read():
    """The drives of a loaded machine answer late, but for the moment of the SYNC: the world is not a period ahead."""
    with SocketcandServer("vcan0", port=0) as server:
        (client,) = clients(server, 1)
        deadline = time.monotonic() + PATIENCE_S
        late = math.inf
        while late > 0.0 and time.monotonic() < deadline:  # the kernel begins to stamp in its own time
            client.send(sync())
            sent_s = time.time()
            time.sleep(0.02)
            late = server.recv(PATIENCE_S).timestamp - sent_s
        assert late <= 0.0
        for _ in range(15):
            time.sleep(0.02)
            client.send(sync())
            server.recv(PATIENCE_S)
        time.sleep(0.5)  # neither end has time
        for _ in range(4):  # one read, and one stamp: the others came before it, as far apart as usual
            client.send(sync())
            time.sleep(0.02)
        stamps = [server.recv(PATIENCE_S).timestamp for _ in range(4)]
        assert np.diff(stamps) == pytest.approx([0.02] * 3, abs=0.01)
        client.shutdown()


@pytest.mark.parametrize(
    ("said", "answered"),
    [
        (b"< open can7 >", b"< error could not open bus >"),
        (b"< rawmode >", b"< error unknown command >"),
        (b"< open vcan0 >< send 123 9 1 2 3 >", b"< ok >< error could not parse frame >"),
        (b"< open vcan0 >< send 123 1 fff >", b"< ok >< error could not parse frame >"),
        (b"< open vcan0 >< send >", b"< ok >< error could not parse frame >"),
        (b"\xff\xfe >", b"< error unknown command >"),
        (b"< echo >", b"< echo >"),
    ],
)
def test_what_a_client_says_wrong_is_answered_and_ends_nothing(said, answered):
    with SocketcandServer("vcan0", port=0) as server:
        with socket.create_connection(("127.0.0.1", server.port)) as client:
            client.settimeout(PATIENCE_S)
            server.recv(0.02)
            assert client.recv(6) == b"< hi >"
            client.sendall(said)
            server.recv(0.05)
            assert client.recv(100) == answered
        assert server.recv(0.02) is None  # the client's end is no end of the server
