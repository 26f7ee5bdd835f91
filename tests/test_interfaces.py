"""The daemon on the interfaces that need no kernel: a serial adapter (slcan), socketcand over TCP; lost and back."""

import os
import pty
import socket
import threading
import time
import tty
from contextlib import ExitStack, closing, suppress
from pathlib import Path
from types import SimpleNamespace

import can
import pytest
from daemonkit import quiet_daemon, running, served, vsa
from zenohkit import free_port, until

from drivelink._core import JointPipeline
from drivelink.canopen.bus import open_bus
from drivelink.cycle.sources import MOST_FRAMES, BusLostError, BusSource, open_source
from drivelink.daemon.service import Daemon
from drivelink.errors import BusError
from drivelink.jointfile import BusSection, JointFile
from drivelink.recording.formats import open_sink
from drivelink.recording.recorder import BusTap
from estimator.sample import Status

PERIOD_S = 0.01


class SerialAdapter:
    """An slcan adapter on a pseudo terminal; its CAN side is a python-can virtual channel."""

    def __init__(self, link: Path, channel: str) -> None:
        self._link = link
        self._bus = can.Bus(interface="virtual", channel=channel)
        self.commands: list[str] = []
        self.put_in()

    def put_in(self) -> None:
        self._master, self._follower = pty.openpty()
        tty.setraw(self._master)
        self._link.unlink(missing_ok=True)
        self._link.symlink_to(os.ttyname(self._follower))
        self._stop = threading.Event()
        self._threads = [threading.Thread(target=work) for work in (self._to_can, self._from_can)]
        for thread in self._threads:
            thread.start()

    def pull_out(self) -> None:
        self._stop.set()
        self._link.unlink()
        self._threads[1].join()
        os.close(self._follower)
        os.close(self._master)
        self._threads[0].join()

    def close(self) -> None:
        self.pull_out()
        self._bus.shutdown()

    def _to_can(self) -> None:
        buffer = b""
        os.set_blocking(self._master, False)
        while not self._stop.wait(0.0005):
            with suppress(BlockingIOError, OSError):
                buffer += os.read(self._master, 4096)
            *lines, buffer = buffer.split(b"\r")
            for line in lines:
                self._line(line.decode("ascii"))

    def _line(self, line: str) -> None:
        if line[:1] != "t":
            self.commands.append(line)
            return
        data = bytes.fromhex(line[5:])
        assert len(data) == int(line[4])
        self._bus.send(can.Message(arbitration_id=int(line[1:4], 16), data=data, is_extended_id=False))

    def _from_can(self) -> None:
        while not self._stop.is_set():
            message = self._bus.recv(0.01)
            if message is not None:
                text = f"t{message.arbitration_id:03X}{message.dlc}{bytes(message.data).hex().upper()}\r"
                with suppress(BlockingIOError):
                    os.write(self._master, text.encode("ascii"))


def joint_on(interface: str, channel: str, options: str, more: str = "") -> JointFile:
    bus = f'interface = "{interface}"\noptions = {{ {options} }}\nperiod_s = {PERIOD_S}\n{more}'
    return vsa(channel=channel, bus=bus)


def is_fresh(pipeline: JointPipeline) -> bool:
    """Whether the last estimate is of frames that came in its cycle; valid it is only on a machine that keeps time."""
    return pipeline.estimate is not None and not pipeline.estimate.status & Status.STALE


def lost(daemon: Daemon) -> bool:
    return "bus" in daemon.events.active


def test_a_joint_behind_a_serial_adapter_that_is_pulled_out_and_put_in(tmp_path):
    behind = vsa(bus=f"period_s = {PERIOD_S}")
    joint = joint_on("slcan", str(tmp_path / "ttyCAN"), "sleep_after_open = 0.0")
    with closing(SerialAdapter(tmp_path / "ttyCAN", behind.bus.channel)) as adapter, served(behind):
        daemon = quiet_daemon(joint)
        pipeline = daemon.pipelines[0]
        with running(daemon):
            until(lambda: is_fresh(pipeline))
            adapter.pull_out()
            until(lambda: lost(daemon))
            until(lambda: not is_fresh(pipeline))
            adapter.put_in()
            until(lambda: is_fresh(pipeline))
            assert not lost(daemon)
        assert {"S8", "O"} <= set(adapter.commands)


def test_a_passive_serial_adapter_is_opened_listen_only_at_its_bit_rate(tmp_path):
    adapter = SerialAdapter(tmp_path / "ttyCAN", "passive")
    more = 'bitrate = 500_000\nconfigure = false\nsync = "follow"'
    open_bus(joint_on("slcan", str(tmp_path / "ttyCAN"), "sleep_after_open = 0.0", more).bus).shutdown()
    until(lambda: {"S6", "L"} <= set(adapter.commands))
    adapter.close()


def test_a_socketcand_server_that_goes_and_comes_back_and_a_second_daemon_that_is_refused(tmp_path):
    joint = joint_on("socketcand", "can0", f'host = "127.0.0.1", port = {free_port()}')
    sink = open_sink(tmp_path / "x.log", joint)

    def recorded() -> int:
        before = sink.counts["frame"]
        tap.poll()
        return sink.counts["frame"] - before

    with ExitStack() as stack:
        with served(joint):
            bus = open_bus(joint.bus)  # a listener
            stack.callback(bus.shutdown)
            source = open_source(bus)
            source.wait(0.01)
            tap = BusTap(open_bus(joint.bus), joint, sink, None)
            stack.callback(tap.close)
            daemon = quiet_daemon(joint)
            pipeline = daemon.pipelines[0]
            stack.enter_context(running(daemon))
            until(lambda: is_fresh(pipeline))
            until(recorded)
            reboots = [c.reboots for c in pipeline.assembler.counters.values()]
            with pytest.raises(BusError, match="another master already produces SYNC"):
                other = joint.model_copy(update={"name": "other"})
                quiet_daemon(other)
            assert [c.reboots for c in pipeline.assembler.counters.values()] == reboots
            assert not any("configured again" in e["text"] for e in daemon.events.recent())
        until(lambda: lost(daemon))
        until(lambda: not is_fresh(pipeline))
        until(lambda: not recorded())
        with pytest.raises(BusLostError, match="closed"):
            while True:  # python-can itself would say for ever that there is nothing
                source.wait(0.01)
                source.receive()
        with served(joint):
            until(lambda: is_fresh(pipeline))
            assert not lost(daemon)
            until(recorded)
    sink.abandon()


@pytest.mark.parametrize("stamp_s", [float("nan"), float("inf"), 1e300, 9.3e9, 0.0, -1.0])
def test_a_time_that_no_interface_can_mean_is_that_of_the_reading(stamp_s):
    """A frame that a socketcand server stamped "nan" ended the daemon and its black box."""
    waiting = [can.Message(timestamp=stamp_s, arbitration_id=0x181, is_extended_id=False)]
    bus = SimpleNamespace(recv=lambda _timeout: waiting.pop() if waiting else None)
    before_ns = time.time_ns()
    ((_, _, stamp_ns),) = BusSource(bus).receive()
    assert before_ns <= stamp_ns <= time.time_ns()


def test_of_any_interface_data_frames_of_11_bits_are_taken_and_so_many_at_once():
    def frame(**kind):
        return can.Message(**{"arbitration_id": 0x181, "is_extended_id": False, **kind})

    strange = [frame(is_extended_id=True), frame(is_remote_frame=True, dlc=8)]
    bus = SimpleNamespace(recv=lambda _timeout: strange.pop() if strange else frame())
    assert len(BusSource(bus).receive()) == MOST_FRAMES - 2
    bus.recv = lambda _timeout: int("xyz", 16)  # what python-can makes of a server's nonsense
    with pytest.raises(BusLostError, match="xyz"):
        BusSource(bus).receive()


def test_error_frames_of_any_interface_are_counted_by_kind():
    section = BusSection(channel="error-frames")
    with can.Bus(interface="virtual", channel="error-frames") as other, open_bus(section) as bus:
        source, frame = open_source(bus), {"data": b"\0\1", "is_error_frame": True, "is_extended_id": False}
        for kind in (0x040, 0x100, 0x004):
            other.send(can.Message(arbitration_id=kind, **frame))
        assert source.receive() == []
        assert source.errors == {"bus-off": 1, "restarted": 1, "controller": 1, "receive overflow": 1}
    # A lost bus is one line, whatever python-can puts into its message.
    said = "Failed to receive: [Errno 104] Connection reset by peer  Traceback (most recent call last):\n  File ...\n"
    assert str(BusLostError(said)) == "Failed to receive: [Errno 104] Connection reset by peer"


def test_a_socketcand_server_that_says_nothing_is_one_line(monkeypatch):
    monkeypatch.setattr("drivelink.canopen.bus._CONNECT_S", 0.2)
    with socket.create_server(("127.0.0.1", 0)) as server:
        section = BusSection(
            interface="socketcand",
            channel="can0",
            options={"host": "127.0.0.1", "port": server.getsockname()[1]},
        )
        with pytest.raises(BusError, match=r"no greeting for 0.2 s"):
            open_bus(section)
    assert socket.getdefaulttimeout() is None
