"""`drivelink sim` as a process."""

from __future__ import annotations

import signal
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import can
import pytest
from zenohkit import free_port, process

from drivelink.cli import main

PATIENCE_S = 60.0  # only ever waited for when something is broken

JOINT = """
name = "wrist"
arrangement = "antagonistic"
[[motor]]
inertia_kg_m2 = 0.0005
[motor.drive]
node_id = 1
[[motor]]
inertia_kg_m2 = 0.0005
[motor.drive]
node_id = 2
[link.encoder]
[bus]
interface = "socketcand"
channel = "vcan0"
options = {{ host = "127.0.0.1", port = {port} }}
[sim]
case = "vsa-ii"
"""


@pytest.fixture
def port() -> int:
    return free_port()


@pytest.fixture
def file(tmp_path: Path, port: int) -> Path:
    path = tmp_path / "wrist.toml"
    path.write_text(JOINT.format(port=port), encoding="utf-8")
    return path


@contextmanager
def simulation(path: Path) -> Iterator[tuple[subprocess.Popen[str], str]]:
    """The process, and the line that it prints when it is ready."""
    with process("sim", path) as running:
        yield running, running.stdout.readline().strip()


def test_two_processes_share_the_bus_over_tcp_and_sigterm_ends_cleanly(file, port, capsys):
    with simulation(file) as (drives, ready):
        assert ready == ("drivelink sim: ready on socketcand vcan0: wrist (drive 1, drive 2); Ctrl-C ends it")
        with can.Bus(interface="socketcand", channel="vcan0", host="127.0.0.1", port=port) as bus:
            bus.send(can.Message(arbitration_id=0, data=[1, 0], is_extended_id=False))
            seen: set[int] = set()
            for _ in range(1000):
                if {0x281, 0x282} <= seen:
                    break
                bus.send(can.Message(arbitration_id=0x80, is_extended_id=False))
                message = bus.recv(0.05)
                seen |= {message.arbitration_id} if message else set()
            assert {0x281, 0x282} <= seen
        assert main(["sim", str(file), "--seconds", "1"]) == 4  # the same nodes a second time
        said = capsys.readouterr().err.splitlines()
        assert "joined" in said[0]
        assert "node 1, node 2: on the bus already: another `drivelink sim`" in said[1]
        drives.send_signal(signal.SIGTERM)
        assert drives.wait(PATIENCE_S) == 0 and drives.stderr.read() == ""


def test_it_ends_by_itself_and_leaves_the_data_sheets(file, tmp_path, capsys):
    before = signal.getsignal(signal.SIGTERM)
    arguments = [str(file), "--interface", "virtual", "--seconds", "0.1", "--write-eds", str(tmp_path)]
    assert main(["sim", *arguments]) == 0
    assert "ready on virtual vcan0" in capsys.readouterr().out
    assert (tmp_path / "wrist-node1.eds").is_file()
    assert signal.getsignal(signal.SIGTERM) is before


def test_other_simulations_join_the_first_as_clients(file, tmp_path):
    def others(name: str, tens: int) -> Path:
        path, text = tmp_path / f"{name}.toml", file.read_text(encoding="utf-8")
        path.write_text(text.replace("wrist", name).replace("node_id = ", f"node_id = {tens}"))
        return path

    with (
        simulation(file) as (server, first),
        simulation(others("elbow", 1)) as (joined, second),
        simulation(others("knee", 2)) as (other, _),
    ):
        assert "wrist (drive 1, drive 2)" in first and "elbow (drive 11, drive 12)" in second
        other.send_signal(signal.SIGINT)
        assert other.wait(PATIENCE_S) == 0
        server.kill()
        assert joined.wait(PATIENCE_S) == 4
        assert "the process that served it has ended" in joined.stderr.read()
