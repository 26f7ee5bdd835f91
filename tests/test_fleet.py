"""`drivelink fleet`: every recording once, whatever breaks; what the table holds is what fit and diagnose say."""

import importlib.util
import json
import os
import sys
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import diagnosiskit as kit
import fleetkit
import numpy as np
import pytest
from daemonkit import vsa_text
from joints import write_csv

pytest.importorskip("distributed", reason="the extra [fleet] is not installed")

from drivelink import __version__, recording
from drivelink.cli import main
from drivelink.errors import DrivelinkError, RecordingError
from drivelink.fleet import analysis, storage, task
from drivelink.fleet.joints import Joints
from drivelink.fleet.storage import FleetError, Source, Store
from drivelink.fleet.table import FleetTable, read_rows
from estimator.identify import identify


@pytest.fixture
def joints(fleet: Path) -> Joints:
    return Joints.load(fleet / "joints")


def source(path: Path) -> Source:
    ((found,), _) = storage.find([str(path)])
    return found


def test_a_data_sheet_that_is_no_file_or_has_no_end_is_one_line(tmp_path):
    (tmp_path / "elbow.toml").write_text(vsa_text().replace("node_id = 1", 'node_id = 1\neds = "drive.eds"'))
    os.mkfifo(tmp_path / "pipe")
    for place in (tmp_path / "pipe", Path("/dev/zero")):
        (tmp_path / "drive.eds").symlink_to(place)
        with pytest.raises(DrivelinkError, match=r"drive\.eds: cannot be read: expected a regular file"):
            Joints.load(tmp_path)
        (tmp_path / "drive.eds").unlink()


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
    k, written = fitted["parameters"]["k_nm_rad"], 1e-3 * fitted["std"]["k_nm_rad"]  # digits of a file
    assert json.loads(row["parameters"]) == {"k_nm_rad": pytest.approx(k, abs=written)}
    assert row["stiffness_middle_nm_rad"] == pytest.approx(k, abs=written)
    assert row["stiffness_std_middle_nm_rad"] == pytest.approx(fitted["std"]["k_nm_rad"], rel=1e-3)
    assert (row["joint"], row["time"]) == ("wrist", datetime(2026, 1, 6, tzinfo=UTC))
    assert (row["status"], row["verdict"], row["effects"]) == ("done", "effect", ["coulomb_friction@motor"])
    assert row["error_after_relative"] == report["error"]["validation"]["after_relative"]
    assert json.loads(dict(outcome.reports)[row["report"].replace(".html", ".json")]) == report


@pytest.mark.parametrize(
    ("name", "text", "said"),
    [
        ("elbow-a.csv", "time_s,motor1_position_rad\n0,zero\n", "expected"),
        ("elbow-a.csv", "time_s,motor1_position_rad\n", "expected samples below the header"),
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


def test_damping_is_as_uncertain_as_a_late_link_encoder_would_look_like(fleet, joints):
    record = recording.read(fleet / "recordings" / "elbow-2026-01-05.csv")
    (fitted,) = identify(record, joints.by_name["elbow"].file.model()).fits
    on_time, late = (analysis._row(1, replace(fitted, link_delay_s=delay)) for delay in (0.0, 4e-3))
    assert on_time["viscous_damping_std_nm_s_rad"] == pytest.approx(fitted.nuisance_std["damping"])
    assert late["viscous_damping_std_nm_s_rad"] > 4e-3 * late["stiffness_middle_nm_rad"]


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


# Storage


def test_a_remote_storage_holds_recordings_what_lies_beside_them_and_results(fleet, monkeypatch):
    """fsspec's own in-memory file system stands for the protocols."""
    import fsspec

    fs, local = fsspec.filesystem("memory"), fleet / "recordings" / "elbow-2026-01-05.csv"
    fs.pipe_file("/plant/night/elbow-2026-01-05.csv", local.read_bytes())
    fs.pipe_file("/plant/night/readme.txt", b"no recording")
    for pattern in ("night", "*/*.csv", "night/elbow-2026-01-05.csv"):
        (found,), empty = storage.find([f"memory://plant/{pattern}"])
        assert found.size == local.stat().st_size and not empty
    with storage.fetched(found) as (_, digest), storage.fetched(source(local)) as (path, same):
        assert digest == same and path == local
    with FleetTable(Store("memory://plant/out")) as one:
        one.append([fleetkit.row()])
    assert [r["id"] for r in read_rows(Store("memory://plant/out"))] == [fleetkit.row()["id"]]
    fs.pipe_file("/logs/r.log", b"(1.0) can0 080#\n")
    fs.pipe_file("/logs/r.log.mapping.json", b"{}")
    ((log,), _) = storage.find(["memory://logs/r.log"])
    with storage.fetched(log) as (path, _):
        assert (path.parent / "r.log.mapping.json").read_bytes() == b"{}"
    monkeypatch.setitem(sys.modules, "s3fs", None)
    with pytest.raises(FleetError, match="s3://a/b: Install s3fs"):
        storage.find(["s3://a/b"])


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


def test_nights_that_failed_alike_are_each_a_recording(joints, tmp_path):
    for day in (7, 8):
        (tmp_path / f"elbow-2026-01-0{day}.csv").write_text("nothing")
    found, _ = storage.find([str(tmp_path)])
    with FleetTable(Store(str(tmp_path / "out"))) as kept:
        for one in found:
            (row,) = task.process(task.Task(source=one, version=__version__), joints).rows
            assert not kept.has_now(row["digest"], row["joint"])
            kept.append([row])
    assert [row["time"].day for row in read_rows(Store(str(tmp_path / "out")))] == [7, 8]


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


def test_what_the_extra_would_have_brought_is_named(monkeypatch, capsys):
    find = importlib.util.find_spec
    monkeypatch.setattr(
        importlib.util, "find_spec", lambda name: None if name == "cryptography" else find(name)
    )
    assert main(["fleet", "recordings", "--joints", "joints"]) == 2
    assert "drivelink fleet: needs cryptography: install the extra" in capsys.readouterr().err
