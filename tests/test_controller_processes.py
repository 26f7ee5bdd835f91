"""Drives, daemon and controller in three processes: CAN over TCP between them, zenoh through a relay.

What is asserted is that each fault ends in safe torque and that the controller moves the joint again. How fast is
asserted in bus time by the tests in lockstep and of the process's own clock by `test_controller_faults.py`, and
here only reported. What the controller does once the springs are identified is asserted in lockstep too: a machine
that others use may lose so many cycles that they never are.
"""

import json
import signal
import socket
import subprocess
import sys
import threading
import time
from collections import deque
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import can
import controllerkit as kit
import pytest
from zenohkit import LIMIT_S, free_endpoint, until

from drivelink import jointfile
from drivelink.cycle import realtime
from drivelink.demo.simbus import open_sim_bus
from drivelink.demo.simulate import nodes_from_joint, world_from_joint
from sim.canopen.statemachine import PowerState
from sim.faults import Faults
from sim.network import Network

RPDO3 = 0x400
SLOW_S = 120.0  # for what takes seconds even on an idle machine


class Cut:
    """A TCP relay in front of the daemon's zenoh endpoint; while `cut`, it passes nothing on and says nothing."""

    def __init__(self, endpoint: str) -> None:
        self._target = int(endpoint.rpartition(":")[2])
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.endpoint = f"tcp/127.0.0.1:{self._listener.getsockname()[1]}"
        self.open = threading.Event()
        self.open.set()
        self._sockets: list[socket.socket] = []
        threading.Thread(target=self._accept, daemon=True).start()

    def _accept(self) -> None:
        while True:
            try:
                client, _ = self._listener.accept()
                server = socket.create_connection(("127.0.0.1", self._target), timeout=None)
            except OSError:
                if self._listener.fileno() < 0:
                    return
                client.close()
                time.sleep(0.05)
                continue
            self._sockets += [client, server]
            for source, sink in ((client, server), (server, client)):
                source.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                threading.Thread(target=self._pass_on, args=(source, sink), daemon=True).start()

    def _pass_on(self, source: socket.socket, sink: socket.socket) -> None:
        try:
            while data := source.recv(65536):
                self.open.wait()
                sink.sendall(data)
        except OSError:
            pass
        for end in (source, sink):
            end.close()

    def close(self) -> None:
        self.open.set()
        for end in (self._listener, *self._sockets):
            end.close()


class Observed:
    """The drives' end of the bus, with a note of the torque commands.

    Attributes:
        torques: (monotonic time, identifier, per mille) of each.
    """

    def __init__(self, bus: can.BusABC) -> None:
        self._bus = bus
        self.torques: deque[tuple[float, int, int]] = deque(maxlen=100_000)

    def recv(self, timeout: float | None = None) -> can.Message | None:
        message = self._bus.recv(timeout)
        if message is not None:
            cob_id = message.arbitration_id
            if cob_id & 0x780 == RPDO3:
                per_mille = int.from_bytes(message.data[2:4], "little", signed=True)
                self.torques.append((time.monotonic(), cob_id, per_mille))
        return message

    def __getattr__(self, name: str) -> Any:
        return getattr(self._bus, name)

    def ended(self, since_s: float) -> bool:
        """Whether, after that time, both drives were commanded to give no torque."""
        zero = {
            cob_id for time_s, cob_id, per_mille in list(self.torques) if time_s >= since_s and not per_mille
        }
        return len(zero) == 2


class Plant:
    """Drives on a bus, a daemon and a controller, each in a process of its own; the drives in this one.

    Args:
        folder: for the joint files.
        bus: the bus section's lines, without its head.
        options: of the controller.
    """

    def __init__(self, folder: Path, bus: str, *options: str) -> None:
        self._closing = ExitStack()
        self.endpoint = free_endpoint()
        self.relay = Cut(self.endpoint)
        self._closing.callback(self.relay.close)
        self.daemon_file = self._write(folder / "daemon.toml", bus, self.endpoint)
        self.controller_file = self._write(folder / "controller.toml", bus, self.relay.endpoint)
        joint = jointfile.load(self.daemon_file)
        self.world = world_from_joint(joint)
        sim_bus = open_sim_bus(joint.bus)
        self._closing.callback(sim_bus.shutdown)
        self.observed = Observed(sim_bus)
        self.network = Network(self.observed, nodes_from_joint(joint, self.world), self.world)
        self.faults = Faults(self.network)
        stop = threading.Event()
        drives = threading.Thread(target=self._serve, args=(stop,))
        drives.start()
        self._closing.callback(drives.join)
        self._closing.callback(stop.set)
        self.daemon = self.start_daemon()
        self.events: list[dict] = []
        script = [str(kit.EXAMPLE / "run.py"), str(self.controller_file)]
        self._controller = self._start([*script, "--identify", "1", *options])
        threading.Thread(target=self._read, daemon=True).start()

    @staticmethod
    def _write(path: Path, bus: str, endpoint: str) -> Path:
        text = kit.declared_text()
        head, _, rest = text.partition("[bus]")
        _, _, tail = rest.partition("[estimator]")
        path.write_text(
            f'{head}[bus]\n{bus}\n[zenoh]\nendpoint = "{endpoint}"\n[estimator]{tail}',
            encoding="utf-8",
        )
        return path

    def _serve(self, stop: threading.Event) -> None:
        """As urgent as the other processes: a real drive is not late because a PC is busy."""
        obtained = realtime.acquire()
        try:
            self.network.serve(stop)
        finally:
            realtime.release(obtained)

    def _start(self, command: list[str]) -> subprocess.Popen:
        process = subprocess.Popen(
            [sys.executable, *command], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
        )
        self._closing.callback(self._end, process)
        return process

    @staticmethod
    def _end(process: subprocess.Popen) -> None:
        process.kill()
        process.communicate()

    def start_daemon(self) -> subprocess.Popen:
        self.daemon = self._start(["-m", "drivelink", "run", str(self.daemon_file)])
        return self.daemon

    def _read(self) -> None:
        for line in self._controller.stdout:
            self.events.append(json.loads(line))

    def reaches(self, phase: str, after: int = 0, limit_s: float = SLOW_S) -> dict:
        """Wait for the first event of that phase after so many events."""
        deadline_s = time.monotonic() + limit_s
        while not (found := [event for event in self.events[after:] if event["phase"] == phase]):
            assert time.monotonic() < deadline_s, f"{phase} did not come about: {self.events[after:][-12:]}"
            time.sleep(0.01)
        return found[0]

    def enabled(self) -> bool:
        """Whether any drive's power stage is on."""
        return any(node.machine.state is PowerState.OPERATION_ENABLED for node in self.network.nodes[:2])

    def end_controller(self) -> int:
        self._controller.send_signal(signal.SIGTERM)
        return self._controller.wait(LIMIT_S)

    def close(self) -> None:
        self._closing.close()


def go_through_faults(plant: Plant) -> list[dict]:
    """Each fault on the moving joint, and back to moving; the events of safe torque, in order."""
    outcomes = []
    acts = {
        "a drive in fault": (lambda: plant.faults.emergency(plant.network.nodes[0], 0x2310), lambda: None),
        "zenoh cut": (plant.relay.open.clear, plant.relay.open.set),
        "daemon killed": (plant.daemon.kill, plant.start_daemon),
    }
    plant.reaches("identify")
    for why, (begin, end) in acts.items():
        before = len(plant.events)
        begin()
        event = plant.reaches("safe", before)
        until(lambda since_s=event["time_s"]: plant.observed.ended(since_s))
        outcomes.append({"fault": why, **event})
        end()
        plant.reaches("identify", before)
    return outcomes


def start(folder):
    """The three processes, the drives being in this one."""
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    where = f'{{ host = "127.0.0.1", port = {port}, tcp_tune = true }}'
    bus = f'interface = "socketcand"\nchannel = "vsa"\noptions = {where}\nperiod_s = 0.002'
    # The example's own 10 ms belong to a machine of its own: here others may hold a core for longer.
    return Plant(folder, bus, "--deadline", "0.08")


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_each_fault_and_the_way_back_in_three_processes(tmp_path, capsys):
    plant = start(tmp_path)
    try:
        outcomes = go_through_faults(plant)
        assert plant.end_controller() == 0
        until(lambda: not plant.enabled())
    finally:
        plant.close()
    with capsys.disabled():
        for event in outcomes:
            print(
                f"\n{event['fault']}: {event['reason']}, {1e3 * event['age_s']:.1f} ms after the last estimate",
                end="",
            )
