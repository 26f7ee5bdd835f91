"""A run over a fleet: whatever is killed, nothing is lost or doubled, and nobody else gets in."""

import asyncio
import contextlib
import json
import logging
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from unittest.mock import MagicMock
from urllib.error import HTTPError
from urllib.request import urlopen

import fleetkit
import psutil
import pytest

pytest.importorskip("distributed", reason="the extra [fleet] is not installed")

import dask
from distributed import Client, LocalCluster, Security

from drivelink import jointfile
from drivelink.cli import main
from drivelink.fleet import runner, storage, task
from drivelink.fleet.joints import Joints
from drivelink.fleet.storage import FleetError, Store
from drivelink.fleet.table import read_rows
from drivelink.fleet.task import HELD_OUT

# Dask's own: a process that was ended on purpose leaves sockets behind.
pytestmark = pytest.mark.filterwarnings(
    "ignore::ResourceWarning", "ignore::pytest.PytestUnraisableExceptionWarning"
)


def run_fleet(fleet: Path, out: Path, *more: str, recordings: Path | None = None) -> int:
    joints = str(fleet / "joints")
    return main(
        ["fleet", str(recordings or fleet / "recordings"), "--joints", joints, "--out", str(out), *more]
    )


@pytest.mark.timeout(300)  # starts a cluster of its own
@pytest.mark.slow
def test_from_recordings_to_a_page(fleet, tmp_path, capsys):
    recordings = shutil.copytree(fleet / "recordings", tmp_path / "recordings")
    for path in recordings.glob("wrist-*"):
        path.unlink()
    shutil.copy(recordings / "elbow-2026-01-05.csv", recordings / "elbow-2026-01-05-copy.csv")
    (recordings / "elbow-2026-01-07.csv").write_text("nothing")
    out = tmp_path / "out"
    assert run_fleet(fleet, out, "--workers", "1", "--validate", "previous", recordings=recordings) == 0
    said = capsys.readouterr()
    assert "4 recordings: 2 done, 1 there already, 1 broken" in said.out
    assert "elbow-2026-01-07.csv" in said.err
    rows = read_rows(Store(str(out)))
    assert sorted(r["status"] for r in rows) == ["done", "done", "error"]
    document = json.loads((out / "fleet.json").read_text())
    assert document["schema"] == "drivelink.fleet/1"
    assert {one["joint"]: one["recordings"] for one in document["joints"]} == {"elbow": 3}
    page = (out / "fleet.html").read_text()
    # Self-contained.
    assert not re.search(r"""(?:src|href)=["']?(?:\w+:)?//|url\(|@import|<script|<link""", page)
    validated = {r["validated_on"].rpartition("/")[2] for r in rows if r["status"] == "done"}
    assert len(validated) == 2 and validated < {HELD_OUT, "elbow-2026-01-05.csv", "elbow-2026-01-05-copy.csv"}
    for r in rows:
        assert r["status"] == "error" or (out / r["report"]).exists()
        assert r["report"] is None or r["report"] in page
    assert run_fleet(fleet, tmp_path / "none", "--since", "2027-01-01", recordings=recordings) == 0
    assert capsys.readouterr().out == "4 recordings: 0 done, 4 too early\n"
    # earlier ones are left out; once more nothing is done, nothing is lost
    assert run_fleet(fleet, out, "--since", "2026-01-06", recordings=recordings) == 0
    assert "too early" in capsys.readouterr().out
    before = fleetkit.ids(out)
    assert run_fleet(fleet, out, recordings=recordings) == 0
    assert "0 done, 4 there already" in capsys.readouterr().out
    assert fleetkit.ids(out) == before
    assert main(["fleet", "report", str(out), "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == json.loads((out / "fleet.json").read_text())


@pytest.mark.slow
def test_a_killed_worker_loses_nothing_and_doubles_nothing(fleet, tmp_path):
    secret, files = Security.temporary(), {}
    for name in ("ca-file", "client.cert", "client.key"):
        path = tmp_path / name
        path.write_text(getattr(secret, f"tls_{name.replace('-', '_').replace('.', '_')}"))
        files[f"distributed.comm.tls.{name}"] = str(path)
    recordings = tmp_path / "recordings"
    recordings.mkdir()
    shutil.copy(fleet / "recordings" / "elbow-2026-01-05.csv", recordings)
    for k in range(8):  # read in no time, to a row with an error
        (recordings / f"elbow-{k}.csv").write_text(f"nothing {k}")
    sources, _ = storage.find([str(recordings)])
    with (
        LocalCluster(
            n_workers=2, threads_per_worker=1, dashboard_address="127.0.0.1:0", security=secret
        ) as cluster,
        dask.config.set(files),
    ):
        address, killed = cluster.scheduler_address, []

        def kill_one(counts: runner.Counts) -> None:
            if not killed:
                with Client(address, set_as_default=False) as client:
                    killed.append(client.run(os.getpid).popitem()[1])
                os.kill(killed[0], signal.SIGKILL)

        settings = runner.Settings(scheduler=address)
        counts = runner.run(sources, Joints.load(fleet / "joints"), Store(str(tmp_path)), settings, kill_one)
    assert killed
    assert (counts.done, counts.broken) == (1, 8)
    assert sorted(r["recording"] for r in read_rows(Store(str(tmp_path)))) == [one.url for one in sources]


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_ctrl_c_leaves_what_is_finished(fleet, tmp_path):
    recordings = tmp_path / "recordings"
    recordings.mkdir()
    lines = (fleet / "recordings" / "elbow-2026-01-05.csv").read_text().splitlines(keepends=True)
    for k in range(6):  # each is a content of its own
        (recordings / f"elbow-{k}.csv").write_text("".join(lines[: len(lines) - k]))
    out = tmp_path / "out"
    command = [sys.executable, "-m", "drivelink", "fleet", str(recordings), "--joints", str(fleet / "joints")]
    command += ["--out", str(out), "--workers", "1"]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True, start_new_session=True)
    # However long that takes: on a busy machine none was finished in 90 s.
    while len(list(out.glob("diagnoses/*/*/report.html"))) < 2 and process.poll() is None:
        time.sleep(0.1)  # the only worker begins the second when the first is told
    os.killpg(process.pid, signal.SIGINT)  # as a terminal does: the workers get it too
    _, error = process.communicate(timeout=60)
    assert process.returncode == 130
    assert "Traceback" not in error
    assert 1 <= len(read_rows(Store(str(out)))) < 6


@pytest.mark.slow
def test_ctrl_c_while_the_workers_start_is_one_line(fleet, tmp_path):
    command = [sys.executable, "-m", "drivelink", "fleet", str(fleet / "recordings")]
    command += ["--joints", str(fleet / "joints"), "--out", str(tmp_path / "out")]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True, start_new_session=True)
    end = time.monotonic() + 60
    while time.monotonic() < end and len(psutil.Process(process.pid).children()) < 2:  # beside the tracker
        time.sleep(0.01)
    time.sleep(0.3)  # it imports what it needs
    os.killpg(process.pid, signal.SIGINT)  # as a terminal does: the workers get it too
    _, error = process.communicate(timeout=60)
    assert process.returncode == 130
    assert error.splitlines()[-1].startswith("interrupted") and "Traceback" not in error, error


def test_a_process_that_is_killed_as_it_starts_is_one_line(monkeypatch):
    """By the kernel, for want of memory: it was a traceback of Dask's."""
    monkeypatch.setattr(runner, "LocalCluster", MagicMock(side_effect=RuntimeError("Nanny failed\nto start")))
    with pytest.raises(FleetError, match=r"^its processes do not start: Nanny failed to start$"):
        runner._started()


def test_a_worker_does_not_repeat_what_is_said_of_an_edited_joint_file(fleet, caplog, monkeypatch):
    text = (fleet / "joints" / "elbow.toml").read_text()
    edited = f"# drivelink wrote this file, and ends it with a check line\n{text}\n# drivelink check: sha256 {0:016x}\n"
    monkeypatch.setattr(task.signal, "signal", lambda *_: None)
    jointfile.parse(edited, "elbow.toml")
    assert "edited since drivelink wrote it" in caplog.text
    caplog.clear()
    log = logging.getLogger("drivelink.jointfile")
    try:
        task.dask_setup(None)
        jointfile.parse(edited, "elbow.toml")
    finally:
        log.setLevel(logging.NOTSET)
    assert not caplog.text


def test_a_ctrl_c_that_a_finaliser_discards_ends_the_run_all_the_same():
    with pytest.raises(KeyboardInterrupt), runner._interruptible() as go_on:
        with contextlib.suppress(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
        go_on()


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ("{recordings}", "--joints: expected the folder of the joint files"),
        ("{recordings} --joints nowhere", "there is no nowhere"),
        ("nothing/*.csv --joints {joints}", "expected at least one recording"),
        ("{recordings} --joints {recordings}", "expected joint files (*.toml)"),
        ("{recordings} --joints {joints} --workers 0", "--workers: expected a whole number above 0"),
        ("{recordings} --joints {joints} --memory much", "--memory: expected a size"),
        ("{recordings} --joints {joints} --memory 0", "--memory: expected a size"),
        ("{recordings} --joints {joints} --memory=-1GiB", "--memory: expected a size"),
        ("{recordings} --joints {joints} --since soon", "--since: expected a date"),
        ("nosuch://x/*.csv --joints {joints}", "nosuch://x/*.csv: cannot be reached"),
        ("report", "drivelink fleet: report: expected one folder"),
        ("report nowhere", "expected a table of `drivelink fleet`"),
        ("{recordings} --joints {joints} --scheduler tcp://127.0.0.1:1", "expected tls://HOST:PORT: without TLS anybody who reaches"),
        ("{recordings} --joints {joints} --scheduler 127.0.0.1:1", "expected tls://HOST:PORT"),
        ("{recordings} --joints {joints} --scheduler tls://127.0.0.1:1", "expected certificates in Dask's configuration"),
        ("{recordings} --joints {joints} --scheduler bogus --insecure", "cannot be reached: missing port number"),
        ("{recordings} --joints {joints} --scheduler tcp://127.0.0.1:1 --insecure", "--scheduler tcp://127.0.0.1:1: cannot be reached"),
    ],
)  # fmt: skip
def test_what_a_user_gets_wrong_also_of_certificates_is_one_line(
    fleet, tmp_path, monkeypatch, capsys,
    arguments, said,
):  # fmt: skip
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(runner, "_CONNECT_S", 0.5)
    places = {"recordings": fleet / "recordings", "joints": fleet / "joints"}
    assert main(["fleet", *arguments.format(**places).split()]) != 0
    error = capsys.readouterr().err.splitlines()
    assert said in error[-1]
    assert len(error) <= 2
    assert ("anybody who reaches it runs code" in error[0]) == ("--insecure" in arguments)


def test_a_certificate_that_is_not_there_is_named(tmp_path):
    files = {f"distributed.comm.tls.{name}": str(tmp_path / name) for name in ("ca-file", "client.cert")}
    with dask.config.set(files), pytest.raises(FleetError, match=r"ca-file of Dask's .*: cannot be read"):
        runner._remote("tls://127.0.0.1:1", False)


def test_a_scheduler_without_workers_is_said_to_have_none(tmp_path):
    """It waited in silence."""
    secret, said, lines = Security.temporary(), [], []
    (tmp_path / "r.csv").write_text("nothing")
    sources, _ = storage.find([str(tmp_path / "r.csv")])
    keys = {
        "ca-file": secret.tls_ca_file,
        "client.cert": secret.tls_client_cert,
        "client.key": secret.tls_client_key,
    }
    settings = {f"distributed.comm.tls.{name}": value for name, value in keys.items()}
    none = LocalCluster(n_workers=0, dashboard_address="127.0.0.1:0", security=secret)
    with none as cluster, dask.config.set(settings):
        address = cluster.scheduler_address

        def say(line):
            said.append(line)
            cluster.scale(1)

        joints = Joints.load(Path(runner.__file__).parents[1] / "joints")
        runner.run(
            sources, joints, Store(str(tmp_path)), runner.Settings(scheduler=address), lines.append, say
        )
    assert said[0] == f"--scheduler {address}: no worker has connected to it yet: waits for one"
    assert len(lines) == 1


def test_nobody_without_the_certificate_of_the_run_gets_into_the_local_cluster():
    from distributed.core import rpc

    async def called(address: str, security: Security | None) -> str:
        arguments = security.get_connection_args("client") if security else {}
        try:
            async with rpc(address, connection_args=arguments, timeout=3) as peer:
                return str((await peer.identity())["type"])
        except OSError:
            return "refused"

    with runner._client(runner.Settings(workers=1), 1) as client:
        workers = client.scheduler_info(n_workers=-1)["workers"]
        doors = [client.scheduler.address, *workers, *(one["nanny"] for one in workers.values())]
        assert len(doors) == 3
        for address in doors:
            plain = address.replace("tls://", "tcp://")
            assert asyncio.run(called(address, client.security)) != "refused"
            assert asyncio.run(called(address, Security.temporary())) == "refused"
            assert asyncio.run(called(plain, None)) == "refused"
        (worker,) = workers.values()
        for port in (worker["services"]["dashboard"], client.scheduler_info()["services"].get("dashboard")):
            if port is not None:
                with pytest.raises(HTTPError, match="404"):
                    urlopen(f"http://127.0.0.1:{port}/info/main/workers.html", timeout=5)
        assert Path(worker["local_directory"]).parents[1].stat().st_mode & 0o077 == 0
