"""`drivelink sim` as a process."""

import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import can
import pytest
from daemonkit import vsa_text
from zenohkit import free_port, process, until

from drivelink.cli import main

PATIENCE_S = 60.0  # only ever waited for when something is broken


@pytest.fixture
def port() -> int:
    return free_port()


@pytest.fixture
def file(tmp_path: Path, port: int) -> Path:
    path = tmp_path / "wrist.toml"
    bus = f'interface = "socketcand"\noptions = {{ host = "127.0.0.1", port = {port} }}'
    path.write_text(vsa_text(name="wrist", channel="vcan0", bus=bus), encoding="utf-8")
    return path


@contextmanager
def simulation(path: Path) -> Iterator[tuple[subprocess.Popen[str], str]]:
    """The process, and the line that it prints when it is ready."""
    with process("sim", path) as running:
        yield running, running.stdout.readline().strip()


def test_simulations_and_masters_share_the_bus_over_tcp_and_sigterm_ends_the_first_cleanly(
    file, port, tmp_path, capsys
):
    path = tmp_path / "elbow.toml"
    path.write_text(file.read_text().replace("wrist", "elbow").replace("node_id = ", "node_id = 1"))
    with simulation(file) as (drives, ready), simulation(path) as (joined, second):
        assert "elbow (drive 11, drive 12, encoder 13)" in second
        assert ready.startswith(
            "drivelink sim: ready on socketcand vcan0: wrist (drive 1, drive 2, encoder 3); Ctrl-C"
        )
        with can.Bus(interface="socketcand", channel="vcan0", host="127.0.0.1", port=port) as bus:
            bus.send(can.Message(arbitration_id=0, data=[1, 0], is_extended_id=False))
            seen: set[int] = set()

            def answered() -> bool:
                bus.send(can.Message(arbitration_id=0x80, is_extended_id=False))
                message = bus.recv(0.05)
                seen.update([message.arbitration_id] if message else [])
                return {0x281, 0x282, 0x28B, 0x28C} <= seen

            until(answered)
        assert main(["sim", str(file), "--seconds", "1"]) == 4  # the same nodes a second time
        said = capsys.readouterr().err.splitlines()
        assert "joined" in said[0]
        assert "node 1, node 2, node 3: on the bus already: another `drivelink sim`" in said[1]
        with process("sim", file, "--channel", "vcan1") as elsewhere:
            said = elsewhere.communicate(timeout=PATIENCE_S)[1]
            assert (
                "vcan1 cannot be opened: its server has no bus of this name; give this bus a server" in said
            )
        drives.send_signal(signal.SIGTERM)
        assert drives.wait(PATIENCE_S) == 0 and drives.stderr.read() == ""
        assert joined.wait(PATIENCE_S) == 4
        assert "the process that served it has ended" in joined.stderr.read()


def test_it_ends_by_itself_and_leaves_the_data_sheets(file, tmp_path, capsys):
    before = signal.getsignal(signal.SIGTERM)
    arguments = [str(file), "--interface", "virtual", "--seconds", "0.1", "--write-eds", str(tmp_path)]
    assert main(["sim", *arguments]) == 0
    assert "ready on virtual vcan0" in capsys.readouterr().out
    assert (tmp_path / "wrist-node1.eds").is_file()
    full = 'ulimit -f 0; exec "$0" -m drivelink sim "$@"'
    done = subprocess.run(
        ["sh", "-c", full, sys.executable, *arguments], capture_output=True, text=True, timeout=60
    )
    assert done.returncode == 1 and f"{tmp_path}/wrist-node" in done.stderr, done
    assert signal.getsignal(signal.SIGTERM) is before
