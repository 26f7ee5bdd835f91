"""`drivelink run` as a process: ready, published, ended; and every bad start in one line."""

import json
import re
import signal
import socket
from pathlib import Path
from types import SimpleNamespace

import pytest
from daemonkit import served, vsa_text
from zenohkit import free_endpoint, free_port, process, until

from drivelink.cli import main
from drivelink.daemon.service import Daemon
from drivelink.jointfile import load
from drivelink.plaintext import stamped
from drivelink.pubsub.client import subscribe
from estimator.sample import Status


@pytest.fixture
def joint(tmp_path: Path) -> Path:
    """A joint on a bus that processes share without SocketCAN: socketcand over the loopback."""
    path = tmp_path / "elbow.toml"
    bus = f'interface = "socketcand"\noptions = {{ host = "127.0.0.1", port = {free_port()} }}\nperiod_s = 0.005'
    path.write_text(vsa_text(channel="can0", endpoint=free_endpoint(), bus=bus), encoding="utf-8")
    return path


def endpoint_of(path: Path) -> str:
    return re.search(r'endpoint = "([^"]+)"', path.read_text(encoding="utf-8"))[1]


def test_simulated_drives_daemon_and_subscriber_are_three_processes(joint, tmp_path):
    address = str(tmp_path / "notify")
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager, process("sim", str(joint)) as drives:
        manager.bind(address)
        manager.settimeout(30.0)
        assert "ready" in drives.stdout.readline()
        with process("run", str(joint), "--no-realtime", NOTIFY_SOCKET=address) as daemon:
            line = daemon.stdout.readline()
            assert line[9:].startswith("drivelink run: elbow on socketcand can0, 200 Hz, ready"), (
                daemon.stderr.read()
            )
            assert manager.recv(100).startswith(b"READY=1")
            with subscribe("elbow", endpoint=endpoint_of(joint)) as client:
                until(lambda: (e := client.wait(timeout_s=1.0)) and not e.status & Status.STALE)
                daemon.send_signal(signal.SIGHUP)  # reloads, and does not end it
                last = client.wait(timeout_s=5.0)
                assert until(lambda: client.wait(timeout_s=1.0)).sequence > last.sequence
                daemon.send_signal(signal.SIGTERM)
                out, err = daemon.communicate(timeout=60)
            assert daemon.returncode == 0, err
            assert re.match(r"\d\d:\d\d:\d\d elbow: \d+ cycles, \d+ missed", out.splitlines()[-1])
            assert "Traceback" not in err
        with process("run", str(joint), "--no-realtime") as again:  # the drives were left as they were
            assert "ready" in again.stdout.readline()
            again.send_signal(signal.SIGHUP)  # its terminal is closed: no orphan stays on the bus
            assert again.wait(timeout=60) == 0


def test_run_ends_after_its_seconds_and_prints_two_objects_of_json(tmp_path, capsys):
    path = tmp_path / "elbow.toml"
    path.write_text(vsa_text(endpoint=free_endpoint(), bus="period_s = 0.02"), encoding="utf-8")
    with served(load(path)):
        assert main(["run", str(path), "--no-realtime", "--seconds", "0.4", "--json"]) == 0
    ready, end = map(json.loads, capsys.readouterr().out.splitlines())  # and nothing else
    assert (ready["event"], ready["joints"], ready["rate_hz"]) == ("ready", ["elbow"], 50.0)
    (status,) = end["joints"]
    assert (end["event"], status["joint"]) == ("end", "elbow")


def test_a_full_disk_under_what_is_printed_ends_no_daemon(tmp_path, capsys, monkeypatch):
    path, ran = tmp_path / "elbow.toml", []
    path.write_text(vsa_text(endpoint=free_endpoint(), bus="period_s = 0.02"), encoding="utf-8")
    monkeypatch.setattr(Daemon, "run", lambda _, seconds: ran.append(seconds))
    with served(load(path)), Path("/dev/full").open("w") as full:
        monkeypatch.setattr("sys.stdout", full)
        assert main(["run", str(path), "--no-realtime", "--seconds", "0.4"]) == 1
    assert ran == [0.4]
    assert (
        capsys.readouterr().err.splitlines()[-1] == "drivelink run: standard output: No space left on device"
    )


def test_a_drive_that_does_not_answer_is_one_line(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("drivelink.canopen.node.BOOT_S", 0.1)
    path = tmp_path / "elbow.toml"
    path.write_text(vsa_text(endpoint=free_endpoint()), encoding="utf-8")
    assert main(["run", str(path)]) == 5
    (line,) = [x for x in capsys.readouterr().err.splitlines() if not re.match(r"\d\d:\d\d:\d\d [DIW] ", x)]
    assert "node 1 does not answer" in line


def test_a_long_line_is_stamped_and_folded_on_a_terminal_only(monkeypatch):
    monkeypatch.delenv("JOURNAL_STREAM", raising=False)
    text = "W " + "this machine is too slow for the cycle; " * 6
    for terminal in (True, False):
        folded = stamped(text, SimpleNamespace(isatty=lambda terminal=terminal: terminal), 11)
        assert re.match(r"\d\d:\d\d:\d\d W this", folded)
        assert (max(map(len, folded.splitlines())) <= 100) is terminal
        assert " ".join(folded.split())[9:] == text.strip()
    console = SimpleNamespace(isatty=lambda: True, encoding="ascii")  # which needs three columns for a ±
    assert max(map(len, stamped("0.3 ± 0.1, " * 30, console).splitlines())) <= 100
    assert "±" not in stamped("0.3 ± 0.1", console)
