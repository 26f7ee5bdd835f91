"""`drivelink fleet`: every recording once, whatever breaks; what the table holds is what fit and diagnose say."""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any
from urllib.error import HTTPError
from urllib.request import urlopen

import diagnosiskit as kit
import fleetkit
import numpy as np
import pytest
from joints import write_csv

REASON = "the extra [fleet] is not installed"
pytest.importorskip("distributed", reason=REASON)
pq = pytest.importorskip("pyarrow.parquet", reason=REASON)

from drivelink import __version__, recording  # noqa: E402
from drivelink.cli import main  # noqa: E402
from drivelink.errors import RecordingError  # noqa: E402
from drivelink.fleet import runner, storage, table, task  # noqa: E402
from drivelink.fleet.joints import Joints  # noqa: E402
from drivelink.fleet.page import page  # noqa: E402
from drivelink.fleet.storage import FleetError, Source, Store  # noqa: E402
from drivelink.fleet.summary import COLUMNS, summarise  # noqa: E402
from drivelink.fleet.table import FleetTable, read_rows  # noqa: E402

# Dask's own: a process that was ended on purpose leaves sockets behind.
pytestmark = pytest.mark.filterwarnings(
    "ignore::ResourceWarning", "ignore::pytest.PytestUnraisableExceptionWarning"
)


@pytest.fixture(scope="module")
def fleet(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return fleetkit.make_fleet(tmp_path_factory.mktemp("fleet"))


@pytest.fixture
def joints(fleet: Path) -> Joints:
    return Joints.load(fleet / "joints")


def source(path: Path) -> Source:
    ((found,), _) = storage.find([str(path)])
    return found


def done(path: Path, joints: Joints, **more: Any) -> task.Outcome:
    return task.process(task.Task(source=source(path), version=__version__, **more), joints)


# One recording


@pytest.mark.slow
def test_a_row_says_what_fit_and_diagnose_say(fleet, joints, tmp_path):
    path, joint = fleet / "recordings" / "wrist-2026-01-06.csv", str(fleet / "joints" / "wrist.toml")
    outcome = done(path, joints)
    (row,) = outcome.rows
    assert main(["fit", str(path), "--joint", joint, "--out", str(tmp_path)]) == 0
    assert main(["diagnose", str(path), "--joint", joint, "--out", str(tmp_path)]) == 0
    (fitted,) = json.loads((tmp_path / "fit.json").read_text())["transmissions"]
    report = json.loads((tmp_path / "report.json").read_text())
    assert json.loads(row["parameters"]) == fitted["parameters"]
    assert row["stiffness_middle_nm_rad"] == pytest.approx(fitted["parameters"]["k_nm_rad"])
    assert row["stiffness_std_middle_nm_rad"] == pytest.approx(fitted["std"]["k_nm_rad"])
    assert (row["joint"], row["time"]) == ("wrist", datetime(2026, 1, 6, tzinfo=UTC))
    assert (row["status"], row["verdict"], row["effects"]) == ("done", "effect", ["coulomb_friction@motor"])
    assert row["error_after_relative"] == report["error"]["validation"]["after_relative"]
    assert json.loads(dict(outcome.reports)[row["report"].replace(".html", ".json")]) == report


@pytest.mark.parametrize(
    ("name", "text", "said"),
    [
        ("elbow-a.csv", "time_s,motor1_position_rad\n0,zero\n", "expected"),
        ("elbow-b.mcap", "no MCAP", "expected an MCAP file"),
        ("knee.csv", "time_s\n", "expected the name of a joint in the file's name or folder (elbow, wrist)"),
        ("elbow-wrist.csv", "time_s\n", "its name fits several joints: elbow, wrist"),
        ("elbow-c.log", "(1.0) can0 123#00\n", "expected SYNC frames"),
    ],
)
def test_a_broken_recording_is_a_row_with_one_line(joints, tmp_path, name, text, said):
    path = tmp_path / name
    path.write_text(text)
    outcome = done(path, joints)
    (row,) = outcome.rows
    assert outcome.kind == row["status"] == "error"
    assert "\n" not in row["error"]
    if name != "elbow-c.log":
        assert said in row["error"]


def test_units_and_signs_are_checked_before_anything_else(fleet, joints, tmp_path):
    record = recording.read(fleet / "recordings" / "elbow-2026-01-05.csv")
    degrees = np.rad2deg(record.link_position_rad)  # type: ignore[arg-type]
    wrong = write_csv(replace(record, link_position_rad=degrees), tmp_path / "elbow.csv")
    (row,) = done(wrong, joints).rows
    assert row["status"] == "error" and "degree" in row["error"]
    assert "recording.scale = { link_position" in row["error"]  # the line to paste, as `diagnose` says it
    outcome = done(fleet / "recordings" / "elbow-2026-01-06.csv", joints, previous=source(wrong))
    assert (outcome.kind, outcome.rows[0]["validated_on"]) == ("done", task.HELD_OUT)
    asked = task.Task(source=source(fleet / "recordings" / "elbow-2026-01-05.csv"), version="0.0.0")
    assert "expected drivelink 0.0.0 on worker" in task.process(asked, joints).rows[0]["error"]


@pytest.mark.slow
def test_a_recording_larger_than_the_memory_is_cut_into_parts(joints, tmp_path, monkeypatch):
    (record,) = kit.World([{}], seconds=12.0).run()
    path = write_csv(record, tmp_path / "elbow.csv")
    monkeypatch.setattr(task, "_BASE_BYTES", 0)
    monkeypatch.setattr(task, "_LEAST_BYTES", 0)
    outcome = done(path, joints, limit_bytes=30.0 * path.stat().st_size)
    assert [(row["part"], row["parts"]) for row in outcome.rows] == [(1, 2), (2, 2)]
    assert sum(row["samples"] for row in outcome.rows) == len(record)
    assert outcome.rows[1]["time"] - outcome.rows[0]["time"] > timedelta(seconds=1)
    assert len({row["id"] for row in outcome.rows}) == 2
    assert any("cut into 2 parts" in note for note in outcome.notes)


@pytest.mark.slow
def test_the_recording_before_validates(fleet, joints):
    before = source(fleet / "recordings" / "wrist-2026-01-05.csv")
    (row,) = done(fleet / "recordings" / "wrist-2026-01-06.csv", joints, previous=before).rows
    assert row["validated_on"] == before.url
    gone = before._replace(url=before.url + ".gone")
    outcome = done(fleet / "recordings" / "wrist-2026-01-06.csv", joints, previous=gone)
    assert outcome.rows[0]["validated_on"] == task.HELD_OUT
    assert "validated on held-out blocks" in outcome.notes[0]


# Storage


@pytest.mark.slow
def test_a_remote_storage_holds_recordings_and_results(fleet, joints):
    """fsspec's own in-memory file system stands for the protocols."""
    import fsspec

    fs, local = fsspec.filesystem("memory"), fleet / "recordings" / "elbow-2026-01-05.csv"
    fs.pipe_file("/plant/night/elbow-2026-01-05.csv", local.read_bytes())
    fs.pipe_file("/plant/night/readme.txt", b"no recording")
    for pattern in (
        "memory://plant/night",
        "memory://plant/*/*.csv",
        "memory://plant/night/elbow-2026-01-05.csv",
    ):
        (found,), empty = storage.find([pattern])
        assert found.size == local.stat().st_size
        assert not empty
    outcome = task.process(task.Task(source=found, version=__version__), joints)
    (row,), (here,) = outcome.rows, done(local, joints).rows
    assert row["parameters"] == here["parameters"]
    assert row["id"] == here["id"]
    with FleetTable(Store("memory://plant/out")) as one:
        one.append([row])
    assert [r["id"] for r in read_rows(Store("memory://plant/out"))] == [row["id"]]


@pytest.mark.slow
def test_recordings_come_over_http_and_an_mcap_brings_its_joint(fleet, joints, tmp_path):
    record = recording.read(fleet / "recordings" / "elbow-2026-01-05.csv")
    (tmp_path / "night").mkdir()
    begin = datetime(2026, 1, 7, 3, tzinfo=UTC)
    fleetkit.write_mcap(record, "elbow", tmp_path / "night" / "one.mcap", int(begin.timestamp()))
    (tmp_path / "night" / "knee.csv").write_text("time_s\n")
    with fleetkit.served(tmp_path) as address:
        for pattern in (f"{address}/night/", f"{address}/night/*"):
            found, _ = storage.find([pattern])
            assert sorted(one.name for one in found) == ["knee.csv", "one.mcap"]
        made = [task.process(task.Task(source=one, version=__version__), joints) for one in found]
        gone, _ = storage.find([f"{address}/night/one.mcap"])
    (row,), (broken,) = sorted((outcome.rows for outcome in made), key=lambda rows: rows[0]["status"])
    assert (row["status"], row["joint"], row["time"]) == ("done", "elbow", begin)
    assert row["accepted_model"] == joints.by_name["elbow"].digest  # the fleet's, not the one that is carried
    assert broken["error"].startswith("expected the name of a joint")
    (here,) = done(fleet / "recordings" / "elbow-2026-01-05.csv", joints).rows
    (k,), (there,) = json.loads(row["parameters"]).values(), json.loads(here["parameters"]).values()
    assert k == pytest.approx(there, rel=1e-6)  # the CSV has nine digits
    (lost,) = task.process(
        task.Task(source=gone[0], version=__version__), joints
    ).rows  # the server has ended
    assert (lost["status"], "\n" in lost["error"]) == ("error", False)
    assert "127.0.0.1" in lost["error"]


def test_a_frame_log_brings_the_file_beside_it_along_and_a_storage_without_its_client_is_one_line(
    monkeypatch,
):
    import fsspec

    fs = fsspec.filesystem("memory")
    fs.pipe_file("/logs/r.log", b"(1.0) can0 080#\n")
    fs.pipe_file("/logs/r.log.mapping.json", b"{}")
    ((found,), _) = storage.find(["memory://logs/r.log"])
    with storage.fetched(found) as (path, _):
        assert (path.parent / "r.log.mapping.json").read_bytes() == b"{}"
    monkeypatch.setitem(sys.modules, "s3fs", None)
    with pytest.raises(FleetError, match="s3://a/b: Install s3fs"):
        storage.find(["s3://a/b"])


# Joints and times


def test_the_joint_is_the_name_in_the_nearest_part_of_the_path_and_of_its_files_the_last_accepted_counts(
    tmp_path,
):
    for name in ("arm", "arm-left", "elbow"):
        (tmp_path / f"{name}.toml").write_text(fleetkit.JOINT.format(name=name))
    joints = Joints.load(tmp_path)
    for url, name in {
        "/data/elbow/arm-2026.csv": "arm", "s3://plant/arm-left/0001.mcap": "arm-left",
        "/data/2026-11-22_elbow.csv": "elbow",
    }.items():  # fmt: skip
        assert joints.named(url).name == name
    with pytest.raises(RecordingError, match="expected the name of a joint"):
        joints.named("/data/alarm/elbows.csv")
    text = fleetkit.JOINT.format(name="elbow")
    for day in ("2026-01-07", "2026-01-06"):
        (tmp_path / f"{day}.toml").write_text(f'{text}[provenance.fit]\nwritten = "{day}T00:00:00+00:00"\n')
    assert Joints.load(tmp_path).by_name["elbow"].where.endswith("2026-01-07.toml")
    (tmp_path / "again.toml").write_text((tmp_path / "2026-01-07.toml").read_text())
    with pytest.raises(FleetError, match="joint elbow is in"):
        Joints.load(tmp_path)


@pytest.mark.parametrize(
    ("name", "moment"),
    [
        ("elbow-2026-11-22.csv", (2026, 11, 22)),
        ("elbow_20261122T2315.csv", (2026, 11, 22, 23, 15)),
        ("2026-11-22/elbow.csv", (2026, 11, 22)),
        ("elbow-2026-11-22T23-15-07.mcap", (2026, 11, 22, 23, 15, 7)),
        ("elbow-2026-02-31.csv", None),
        ("elbow-120261122.csv", None),
    ],
)
def test_the_time_is_in_the_name_or_in_the_unix_stamps(name, moment, tmp_path):
    expected = moment and datetime(*moment, tzinfo=UTC)  # type: ignore[misc]
    assert task.named_time(Source(f"/data/{name}", 1, "", None)) == expected
    path = tmp_path / "elbow-2020-01-01.csv"
    path.write_text("# a comment\ntime_s;motor1_position_rad\n1780000000,5;1\n")
    assert task.recorded_time(path, source(path)) == datetime.fromtimestamp(1780000000.5, UTC)


# The table


def row(digest: str = "a", joint: str | None = "elbow", **more: Any) -> dict[str, Any]:
    return {
        "id": f"{digest}-{joint}", "joint": joint, "digest": digest, "recording": f"{digest}.csv", "size_bytes": 1,
        "stamp": "s", "status": "done", "version": "1", "accepted_model": "m", "transmission": 1,
        "time": datetime(2026, 1, 1, tzinfo=UTC),
    } | more  # fmt: skip


def ids(folder: Path) -> list[str]:
    """As DuckDB or pandas would see them."""
    parts = sorted(folder.glob("table/*.parquet"))
    return sorted(name for part in parts for name in pq.read_table(part)["id"].to_pylist())


def append(folder: Path, *rows: dict[str, Any]) -> None:
    """As a run does it."""
    with FleetTable(Store(str(folder))) as one:
        one.append([*rows])


def test_rows_of_runs_one_after_the_other_and_at_once_stand_in_one_part(tmp_path):
    append(tmp_path, row("a"))
    append(tmp_path, row("b"))
    assert len(list(tmp_path.glob("table/*.parquet"))) == 1
    assert not list(tmp_path.glob("table/*.tmp"))
    store = Store(str(tmp_path))
    with FleetTable(store) as first, FleetTable(store) as second:
        first.append([row("c")])
        second.append([row("d")])
    assert ids(tmp_path) == [f"{digest}-elbow" for digest in "abcd"]


def test_full_parts_follow_each_other_and_a_newer_row_takes_the_place_of_an_old_one(tmp_path, monkeypatch):
    monkeypatch.setattr(table, "_PART_ROWS", 2)
    for digest in "abcde":
        append(tmp_path, row(digest))
    assert len(list(tmp_path.glob("table/*.parquet"))) == 3
    append(tmp_path, row("a", version="2"))
    assert ids(tmp_path) == [f"{digest}-elbow" for digest in "abcde"]
    assert {r["id"]: r["version"] for r in read_rows(Store(str(tmp_path)))}["a-elbow"] == "2"


def test_what_a_kill_between_two_writes_leaves_double_is_read_once_and_mended(tmp_path):
    append(tmp_path, row("a"))
    (part,) = tmp_path.glob("table/*.parquet")
    shutil.copy(part, part.with_name("part-0.parquet"))
    assert len(read_rows(Store(str(tmp_path)))) == 1
    append(tmp_path, row("b"))
    assert ids(tmp_path) == ["a-elbow", "b-elbow"]


def test_an_error_gives_way_to_the_result_of_the_same_recording(tmp_path):
    append(tmp_path, row("unread-1", None, recording="a.csv", status="error", error="no such host"))
    with FleetTable(Store(str(tmp_path))) as one:
        assert one.at(Source("a.csv", 1, "s", None)).failed  # type: ignore[union-attr]
        one.append([row("a")])
    assert ids(tmp_path) == ["a-elbow"]


def test_a_part_that_is_no_parquet_file_is_one_line(tmp_path):
    (tmp_path / "table").mkdir()
    (tmp_path / "table" / "part-1.parquet").write_text("garbage")
    with pytest.raises(FleetError, match=r"part-1.parquet: expected a Parquet file"):
        read_rows(Store(str(tmp_path)))


# The whole


def run_fleet(fleet: Path, out: Path, *more: str, recordings: Path | None = None) -> int:
    joints = str(fleet / "joints")
    return main(
        ["fleet", str(recordings or fleet / "recordings"), "--joints", joints, "--out", str(out), *more]
    )


@pytest.mark.timeout(300)  # starts a cluster of its own
@pytest.mark.slow
def test_from_recordings_to_a_page(fleet, tmp_path, capsys):
    recordings = shutil.copytree(fleet / "recordings", tmp_path / "recordings")
    (recordings / "wrist-2026-01-05.csv").unlink()
    shutil.copy(recordings / "elbow-2026-01-05.csv", recordings / "elbow-2026-01-05-copy.csv")
    (recordings / "elbow-2026-01-07.csv").write_text("nothing")
    out = tmp_path / "out"
    assert run_fleet(fleet, out, "--workers", "1", "--validate", "previous", recordings=recordings) == 0
    said = capsys.readouterr()
    assert "5 recordings: 3 done, 1 there already, 1 broken" in said.out
    assert "elbow-2026-01-07.csv" in said.err
    rows = read_rows(Store(str(out)))
    assert sorted((r["joint"], r["status"]) for r in rows) == [("elbow", "done")] * 2 + [
        ("elbow", "error"), ("wrist", "done"),
    ]  # fmt: skip
    document = json.loads((out / "fleet.json").read_text())
    assert document["schema"] == "drivelink.fleet/1"
    assert {one["joint"]: one["recordings"] for one in document["joints"]} == {"elbow": 3, "wrist": 1}
    page = (out / "fleet.html").read_text()
    assert not re.search(
        r"""(?:src|href)=["']?(?:\w+:)?//|url\(|@import|<script|<link""", page
    )  # self-contained
    for r in rows:
        assert r["status"] == "error" or (out / r["report"]).exists()
        assert r["report"] is None or r["report"] in page
    # earlier ones are left out; once more nothing is done, nothing is lost
    assert run_fleet(fleet, out, "--since", "2026-01-06", recordings=recordings) == 0
    assert "too early" in capsys.readouterr().out
    before = ids(out)
    assert run_fleet(fleet, out, recordings=recordings) == 0
    assert "0 done, 5 there already" in capsys.readouterr().out
    assert ids(out) == before
    assert main(["fleet", "report", str(out), "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == json.loads((out / "fleet.json").read_text())


@pytest.mark.slow
def test_a_killed_worker_loses_nothing_and_doubles_nothing(fleet, tmp_path):
    import dask
    from distributed import Client, LocalCluster, Security

    secret, files = Security.temporary(), {}
    for name in ("ca-file", "client.cert", "client.key"):
        path = tmp_path / name
        path.write_text(getattr(secret, f"tls_{name.replace('-', '_').replace('.', '_')}"))
        files[f"distributed.comm.tls.{name}"] = str(path)
    sources, _ = storage.find([str(fleet / "recordings")])
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
    assert (counts.done, counts.broken) == (len(sources), 0)
    assert sorted(r["recording"] for r in read_rows(Store(str(tmp_path)))) == [one.url for one in sources]


@pytest.mark.slow
def test_ctrl_c_leaves_what_is_finished(fleet, tmp_path):
    recordings = tmp_path / "recordings"
    recordings.mkdir()
    lines = (fleet / "recordings" / "elbow-2026-01-05.csv").read_text().splitlines(keepends=True)
    for k in range(40):  # each is a content of its own
        (recordings / f"elbow-{k:02d}.csv").write_text("".join(lines[: len(lines) - k]))
    out = tmp_path / "out"
    command = [sys.executable, "-m", "drivelink", "fleet", str(recordings), "--joints", str(fleet / "joints")]
    command += ["--out", str(out), "--workers", "1"]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True, start_new_session=True)
    end = time.monotonic() + 90
    while len(list(out.glob("diagnoses/*/*/report.html"))) < 3 and time.monotonic() < end:
        time.sleep(0.1)
    os.killpg(process.pid, signal.SIGINT)  # as a terminal does: the workers get it too
    _, error = process.communicate(timeout=60)
    assert process.returncode == 130
    assert "Traceback" not in error
    assert 3 <= len(read_rows(Store(str(out)))) < 40


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
        ("report", "fleet report: expected one folder"),
        ("report nowhere", "expected a table of `drivelink fleet`"),
        ("{recordings} --joints {joints} --scheduler tcp://127.0.0.1:1", "expected tls://HOST:PORT: without TLS anybody who reaches"),
        ("{recordings} --joints {joints} --scheduler 127.0.0.1:1", "expected tls://HOST:PORT"),
        ("{recordings} --joints {joints} --scheduler tls://127.0.0.1:1", "expected certificates in Dask's configuration"),
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


def test_nobody_without_the_certificate_of_the_run_gets_into_the_local_cluster():
    from distributed import Security
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


# The summary


def night(joint: str, k: int, stiffness: float, effects: list[str]) -> dict[str, Any]:
    values = dict.fromkeys([*COLUMNS, "recording", "time"])
    return values | {
        "joint": joint, "transmission": 1, "status": "done", "effects": effects, "model": "linear",
        "verdict": "effect" if effects else "sufficient", "sentence": "said", "excited": True,
        "parameters": json.dumps({"k_nm_rad": stiffness}), "covariance": [0.01], "deflection_middle_rad": 0.02,
        "stiffness_middle_nm_rad": stiffness, "stiffness_std_middle_nm_rad": 0.1, "report": f"{joint}{k}.html",
        "error_before_relative": 0.1, "error_after_relative": 0.02, "viscous_damping_nm_s_rad": 0.8, "recording": f"{joint}-{k}.csv",
        "time": datetime(2026, 1, 5, tzinfo=UTC) + timedelta(days=k),
    }  # fmt: skip


def test_joints_come_by_urgency_with_what_changed_since_when():
    rng = np.random.default_rng(8)
    rows = []
    for k in range(20):
        noise = 0.3 * rng.standard_normal(4)
        rows.append(night("steady", k, 150.0 + noise[0], []))
        rows.append(night("drifts", k, 150.0 - 0.5 * k + noise[1], []))
        rows.append(night("steps", k, 150.0 + 4.0 * (k >= 12) + noise[2], []))
        rows.append(night("rubs", k, 150.0 + noise[3], ["coulomb_friction@motor"] if k >= 9 else []))
    document = summarise(rows, 0.05)
    assert json.loads(json.dumps(document)) == document
    joints = {one["joint"]: one for one in document["joints"]}
    assert [one["state"] for one in document["joints"]] == ["changing"] * 3 + ["steady"]
    (drift,) = joints["drifts"]["transmissions"][0]["changes"]
    assert drift["kind"] == "drift"
    assert drift["amount_relative"] == pytest.approx(-9.5 / 150.0, abs=4 * drift["amount_std_relative"])
    (step,) = joints["steps"]["transmissions"][0]["changes"]
    assert (step["kind"], step["since"][:10]) == ("step", "2026-01-17")
    (effect,) = joints["rubs"]["effects"]
    assert (effect["significant"], effect["since"][:10]) == (True, "2026-01-14")
    assert joints["rubs"]["sentence"] == "New at the motor since 2026-01-14: Coulomb friction."


def test_an_unusable_stiffness_is_no_point_of_the_trend_but_a_cross_on_the_chart():
    rows = [night("elbow", k, 150.0 + 0.1 * (k % 3), []) for k in range(10)]
    rows[4] |= {"stiffness_middle_nm_rad": -20.0, "parameters": '{"k_nm_rad": -20.0}'}
    rows[5]["excited"] = False
    document = summarise(rows, 0.05)
    (joint,) = document["joints"]
    assert len(joint["transmissions"][0]["series"]) == 8 and joint["state"] == "steady"
    assert [one["reason"] for one in joint["unusable"]] == [
        "the fitted stiffness is not above zero", "its motion does not reveal the stiffness",
    ]  # fmt: skip
    assert page(document).count('class="cross"') == 4  # on the chart, and in the list


def test_a_joint_that_breaks_is_said_to_be_lost_and_its_findings_stay_on_the_chart():
    rows = [night("elbow", k, 150.0 + 0.1 * (k % 3), []) for k in range(10)]
    for k in (8, 9):
        rows[k] |= {"excited": False, "effects": ["torque_offset@motor"], "error_before_relative": 1.34}
    rows.append(night("elbow", 10, 150.0, []) | {"status": "error", "error": "no frames"})
    document = summarise(rows, 0.05)
    (joint,) = document["joints"]
    assert joint["state"] == "lost"
    assert joint["sentence"] == "The last 3 recordings show no stiffness, from 2026-01-13 on: no frames."
    text = page(document)
    assert "<h1>1 of 1 joint needs a look: 1 lost</h1>" in text
    assert text.count('class="found"') == 2 and "134 → 2.00 % of the torque" in text


# The rest of the service


def test_neither_daemon_nor_command_line_imports_what_the_fleet_needs():
    code = (
        "import sys, drivelink, drivelink.cli, drivelink.cli.run, drivelink.daemon.service, drivelink.cli.fleet;"
        "found = {'dask', 'distributed', 'fsspec', 'pyarrow', 'pandas', 'botocore', 'paramiko'} & set(sys.modules);"
        "sys.exit(', '.join(found) or None)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_the_examples_of_the_documentation_read_the_table(tmp_path, monkeypatch, capsys):
    pytest.importorskip("duckdb")
    text = (Path(__file__).parent.parent / "docs" / "how-to" / "fleet.md").read_text(encoding="utf-8")
    examples = [block.split("```")[0] for block in text.split("```python\n")[1:]]
    assert len(examples) == 1
    with FleetTable(Store(str(tmp_path / "fleet"))) as one:
        for k in range(3):
            one.append([row(str(k), excited=True, stiffness_middle_nm_rad=100.0 + k)])
    monkeypatch.chdir(tmp_path)
    for example in examples:
        exec(compile(example, "docs/how-to/fleet.md", "exec"), {})
    assert "elbow" in capsys.readouterr().out


@pytest.mark.parametrize(
    "report",
    ["javascript:alert(1)", "https://evil.example/report.html", "diagnoses/../../x/report.html", "//x"],
)
def test_the_table_is_data_on_the_page(report):
    rows = [night("elbow", k, 150.0, ["coulomb_friction@motor"]) for k in range(8)]
    good = "diagnoses/elbow/0123456789abcdef01234567-2/report.html"
    for row in rows:
        row |= {"report": report, "sentence": "<script>alert(1)</script>"}
    rows[-1]["report"] = good
    text = page(summarise(rows, 0.05))
    assert report not in text and "<script" not in text
    assert f'href="{good}"' in text
    assert "Content-Security-Policy" in text and "default-src 'none'" in text
