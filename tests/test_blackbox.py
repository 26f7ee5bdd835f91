"""The black box: what led to an event becomes a recording, without the daemon's help."""

import gc
import json
import math
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
import tracemalloc
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from types import SimpleNamespace

import pytest
import zenohkit
from daemonkit import served, vsa_text
from mcap.reader import make_reader
from test_recording_recorder import joint_file

from drivelink import cli, jointfile
from drivelink._core import Assembler, JointPipeline
from drivelink.cli import keep
from drivelink.cycle.pipeline import build
from drivelink.demo.simbus import SocketcandServer
from drivelink.loop import blackbox
from drivelink.loop.blackbox import AFTER_S, BlackBox
from drivelink.loop.finding import drop_oldest, event_of, kept, taken, wish_of
from drivelink.loop.queue import next_due
from drivelink.pubsub import wire
from drivelink.pubsub.feed import DECODERS
from drivelink.pubsub.wire import EstimateMessage, ExternalMessage
from drivelink.recording.mapping import joint_of
from drivelink.recording.mcapfile import SNAPSHOT, read_attachment, read_messages, recorded_cycles
from drivelink.recording.messages import Encoders
from drivelink.recording.playback import open_playback
from estimator.sample import Sample, Status, TransmissionEstimate

PERIOD_S = 0.125  # exact in binary


class Scene:
    """A black box whose clock goes with its samples, eight a second."""

    def __init__(self, folder: Path, more: str = "", keep_s: float = 10.0) -> None:
        path = folder / "elbow.toml"
        path.write_text(
            'name = "elbow"\n[[motor]]\ninertia_kg_m2 = 0.125\n[motor.transmission]\nmodel = "linear"\n'
            f'[bus]\nperiod_s = {PERIOD_S}\n[recording]\nfolder = "kept"\nkeep_s = {keep_s}\n{more}'
        )
        self.cycle = 0
        self.path = path
        self.box = BlackBox(jointfile.load_text(path), lambda: self.cycle * PERIOD_S)

    def sample(self, number: int) -> Sample:
        return Sample(number, (0.1 * number / 3.0,), (number / 7.0,), (1.0 / (number + 1),), number / 9.0)

    def run(self, cycles: int, flags: int = 0) -> None:
        for _ in range(cycles):
            self.cycle += 1
            stamp_ns = self.cycle * 125_000_000
            self.box.frame(stamp_ns, 0x181, self.cycle.to_bytes(8, "little"))
            self.box.sample(self.sample(self.cycle), stamp_ns)
            one = TransmissionEstimate(1.0 / self.cycle, 700.0, 3.0, 0.001)
            self.box.estimate(
                EstimateMessage(self.cycle, stamp_ns, 3 | flags, 1.0 / self.cycle, 700.0, 3.0, (one,))
            )
            self.box.flush()

    def finish(self) -> list[tuple[Path, str]]:
        self.box.close()
        return [(path, event_of(path).cause) for path in kept(self.path.parent / "kept", "elbow")]


def test_what_becomes_of_joint_file_and_bus_is_the_daemons_to_say(tmp_path):
    path = tmp_path / "elbow.toml"
    text = (Path(__file__).parent.parent / "examples" / "elbow.toml").read_text(encoding="utf-8")
    with SocketcandServer(port=0) as server:
        text = text.replace(
            'interface = "virtual"', f'interface = "socketcand"\noptions.port = {server.port}'
        )
        path.write_text(text.replace('folder = "kept"', 'folder = "here"'))
        command = [sys.executable, "-m", "drivelink.cli.blackbox", str(path)]
        box = subprocess.Popen(command, stdin=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        ready = [time.monotonic() + 30.0]
        while time.monotonic() < ready[-1]:
            server.recv(0.05)
            if len(ready) == 1 and any(client.raw for client in server._clients):
                ready.append(time.monotonic() + 1.0)
    time.sleep(1.0)
    _, said = box.communicate(timeout=60)
    assert box.returncode == 0 and "edited" not in said and "lost" not in said, said


def test_an_alarm_keeps_the_time_before_and_after_it_bit_for_bit(tmp_path, caplog):
    scene = Scene(tmp_path)
    scene.run(500)
    scene.box.snapshot(b"garbage")
    scene.run(300, Status.MODEL_ALARM)
    ((path, cause),) = scene.finish()
    assert cause == "model alarm" and path.name.endswith("-model-alarm.mcap")
    numbers = list(range(501 - 80, 501 + 120 + 1))  # 10 s before the alarm, 15 s after it
    kept = list(recorded_cycles(path, 1))
    assert [one.sequence for one in kept] == numbers
    assert [repr(one.sample) for one in kept] == [repr(scene.sample(number)) for number in numbers]
    frames = [json.loads(m.data) for m in read_messages(path) if m.topic == "/elbow/can"]
    assert [int.from_bytes(bytes.fromhex(one["data"]), "little") for one in frames] == numbers
    assert joint_of(path, None).text == (tmp_path / "elbow.toml").read_text()
    with path.open("rb") as file:
        notes = {one.name: one.metadata for one in make_reader(file).iter_metadata()}
    assert notes["black box"]["cause"] == "model alarm" and notes["black box"]["joint_file"].endswith(
        "elbow.toml"
    )
    assert notes["black box"]["time"].endswith("+00:00")
    assert read_attachment(path, SNAPSHOT) == b"garbage"
    assert len(list(open_playback(path, scene.box._text.joint, tmp_path))) == len(numbers)
    assert "the estimator begins anew: snapshot: expected one of version" in caplog.text


def test_the_state_of_another_model_or_of_other_settings_is_not_used(tmp_path, caplog):
    """A replay with a joint file is one of that file's model, whatever the recording began with."""
    scene = Scene(tmp_path)
    own = scene.box._text.joint
    pipeline = JointPipeline(Assembler((), 0), *build(own))
    for k in range(500):
        pipeline.step(scene.sample(k))
    scene.run(500)
    scene.box.snapshot(pipeline.snapshot()[1])
    scene.run(300, Status.MODEL_ALARM)
    ((path, _),) = scene.finish()
    heavier = own.motor[0].model_copy(update={"inertia_kg_m2": 2.0 * own.motor[0].inertia_kg_m2})
    slower = replace(own.estimator, bandwidth_rad_s=10.0)
    for changes, numbers in (({}, 122), ({"motor": (heavier,)}, 201), ({"estimator": slower}, 201)):
        caplog.clear()
        played = list(open_playback(path, own.model_copy(update=changes), tmp_path))
        assert len(played) == numbers
        assert ("another model or other settings" in caplog.text) == bool(changes)


def test_a_joint_file_that_changes_after_an_event_is_not_that_of_its_recording(tmp_path):
    scene = Scene(tmp_path)
    scene.box.document("model", b'{"joint": "elbow", "n": 1}', 1)
    before = scene.path.read_text()
    scene.run(20)
    scene.box.keep("asked")
    scene.run(20)
    scene.path.write_text(before + "# another\n")
    scene.box.document("model", b'{"joint": "elbow", "n": 2}', 2)
    scene.run(200)
    ((path, _),) = scene.finish()
    assert joint_of(path, None).text == before
    assert json.loads(next(read_messages(path, frozenset({"model"}))).data)["n"] == 1


def test_a_state_that_is_read_before_the_first_model_is_of_it_and_not_of_the_next_one(tmp_path):
    scene = Scene(tmp_path)
    scene.box.snapshot(b"first")
    scene.run(1)
    scene.box.document("model", b"{}", 1)
    scene.run(20)
    scene.box.keep("asked")
    scene.run(200)
    scene.box.document("model", b'{"joint": "elbow"}', 2)
    scene.run(20)
    scene.box.keep("asked", asked=True)
    states = {read_attachment(path, SNAPSHOT) for path, _ in scene.finish()}
    assert states == {b"first", None}


def test_memory_holds_no_more_than_is_kept_and_ten_alarms_a_minute_make_one_recording(tmp_path, monkeypatch):
    scene = Scene(tmp_path)
    scene.run(2000)
    reach_s = 10.0 + 12.0 + 2 * AFTER_S  # before, a state before that, after, and until it is written
    held = list(scene.box._ring.between(-math.inf, math.inf))
    assert len(held) <= 3 * ((reach_s + 2.0) / PERIOD_S + 1)  # in whole seconds
    for _ in range(10):  # the last one within a minute of the first
        scene.run(24, Status.MODEL_ALARM)
        scene.run(24)
    assert len(scene.finish()) == 1
    # Of a bus that is flooded: ten seconds in eleven blocks.
    monkeypatch.setattr(blackbox, "_BLOCK_ITEMS", 10)
    ring = blackbox.Ring(10.0)
    for number in range(500):
        ring.take((0.0, "frame", (number,)))
    assert len(list(ring.between(-math.inf, math.inf))) <= 12 * 10


def test_a_cycle_takes_no_more_memory_than_its_messages_take_on_the_wire(tmp_path):
    scene = Scene(tmp_path)
    scene.box._clock = lambda: scene.cycle * 1e-3
    scene.run(10)
    gc.collect()
    tracemalloc.start()
    scene.run(cycles := 3001)
    gc.collect()
    held, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    frame = 8 + 4 + 8  # its stamp, its identifier, its data
    assert held < cycles * (frame + wire.SAMPLE.size(1) + wire.ESTIMATE.size(1))


@pytest.mark.parametrize(
    ("status", "cause"),
    [
        ({"suspected": {"reason": "frozen", "text": "link"}}, "suspected signal"),
        ({"drive_faults": ["node 1: fault"]}, "drive fault"),
        ({"state": "bus lost"}, "bus lost"),
        # A reading whose frames come late is no event.
        ({"suspected": {"reason": "late", "text": "link"}}, ""),
    ],
)
def test_events_of_the_status_are_kept(status, cause, tmp_path):
    scene = Scene(tmp_path)
    scene.run(20)
    for _ in range(3):
        scene.box.document("status", json.dumps(status).encode(), 1)
    scene.run(20)
    assert [made[1] for made in scene.finish()] == ([cause] if cause else [])


@pytest.mark.parametrize("asked", [False, True])
def test_a_contact_is_kept_where_that_is_asked_for(asked, tmp_path):
    scene = Scene(tmp_path, "keep_contacts = true\n" if asked else "")
    scene.run(20)
    for _ in range(3):
        scene.box.external(ExternalMessage(1, 1, 3, 2.0, 0.1))
    scene.run(20)
    assert [cause for _, cause in scene.finish()] == ["contact"] * asked


def full(*_: object) -> int:
    raise OSError(28, "No space left on device")


def test_what_a_kill_leaves_is_removed_at_the_next_start(tmp_path, monkeypatch):
    scene, left = Scene(tmp_path), tmp_path / "left"
    scene.run(20)
    scene.box.keep("asked")
    monkeypatch.setattr(blackbox.McapSink, "note", lambda *_: shutil.copytree(tmp_path / "kept", left))
    scene.finish()
    names = [path.name for path in left.iterdir() if path.suffix != ".csv"]
    assert len(names) == 1 and names[0].endswith("-asked.part")
    (tmp_path / "kept" / names[0]).touch()
    Scene(tmp_path)
    assert not (tmp_path / "kept" / names[0]).exists()


@pytest.mark.parametrize("is_full", [False, True])
def test_keep_says_what_became_of_it(is_full, tmp_path, monkeypatch, capsys):
    scene, status = Scene(tmp_path), []
    if is_full:
        monkeypatch.setattr("drivelink.recording.sinks.os.write", full)
    asking = threading.Thread(target=lambda: status.append(cli.main(["keep", str(scene.path)])))
    asking.start()
    while asking.is_alive():
        scene.run(8)
        time.sleep(0.01)
    out, err = capsys.readouterr()
    made = [path for path, _ in scene.finish()]
    if is_full:
        assert (
            status == [3]
            and not made
            and err.strip().endswith("mcap: nothing is kept: No space left on device")
        )
    else:
        assert status == [0] and out.splitlines()[-1] == f"{made[0]}: kept"


def test_the_oldest_is_dropped_beyond_the_budget_and_nothing_else(tmp_path):
    (tmp_path / "own").mkdir()
    scene = Scene(tmp_path / "own", "keep_mib = 0.001\n")
    for _ in range(2):
        scene.box.keep("asked", asked=True)
        scene.run(130)
    assert len(scene.finish()) == 1
    shutil.rmtree(tmp_path / "own")
    names = [f"elbow-2026010{day}T000000Z-model-alarm.mcap" for day in (1, 2, 3)]
    others = ["elbow-2-20250101T000000Z-change.mcap", "elbow-best.mcap", "notes.txt"]
    for name in (*names, *others):
        (tmp_path / name).write_bytes(bytes(2**20))
    drop_oldest(tmp_path, "elbow", 2.0)
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted([*names[1:], *others])
    drop_oldest(tmp_path, "elbow", 0.5)  # the newest stays
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted([names[2], *others])


def test_keep_without_a_black_box_says_what_it_expects(tmp_path, capsys):
    path = joint_file(tmp_path, zenohkit.free_endpoint())
    for verb in ("keep", "accept"):
        assert cli.main([verb, str(path)]) == 2
        assert "recording.folder: expected the folder of the black box" in capsys.readouterr().err
    path.write_text(path.read_text() + '[recording]\nfolder = "kept"\n')
    assert cli.main(["keep", str(path)]) == 3
    (tmp_path / "kept").mkdir()
    os.mkfifo(wish := wish_of(jointfile.load_text(path)))  # which nobody reads
    assert cli.main(["keep", str(path)]) == 3
    taken(wish).write_bytes(b"\xff.mcap")
    assert keep._answer(wish) == "\ufffd.mcap"
    assert "no black box writes there: expected a daemon that was started since" in capsys.readouterr().err


@pytest.mark.slow
def test_the_box_of_a_daemon_has_frames_and_replays_bit_for_bit(tmp_path, capsys):
    bus = f'interface = "socketcand"\noptions = {{ host = "127.0.0.1", port = {zenohkit.free_port()} }}\nperiod_s = 0.005'
    path = tmp_path / "elbow.toml"
    text = vsa_text(channel="can0", endpoint=zenohkit.free_endpoint(), bus=bus)
    path.write_text(text + '[recording]\nfolder = "kept"\n')
    day, status = tmp_path / "kept" / "elbow.day.csv", []
    asking = threading.Thread(target=lambda: status.append(cli.main(["keep", str(path), "--json"])))
    with served(jointfile.load(path)), zenohkit.process("run", path, "--no-realtime", "--json") as daemon:
        assert "ready" in daemon.stdout.readline()
        # A row a second of the estimates: the box has had a state of the estimator by then.
        zenohkit.until(lambda: day.exists() and day.read_text().count("\n") > 2)
        asking.start()
        zenohkit.until((tmp_path / "kept" / "elbow.keeping").exists)
        assert not kept(tmp_path / "kept", "elbow")  # 15 s more are to come, but the daemon ends
        daemon.send_signal(signal.SIGTERM)
        _, err = daemon.communicate(timeout=60)
        asking.join(60.0)
    assert daemon.returncode == 0 and "Traceback" not in err, err
    made = [one for one in (tmp_path / "kept").iterdir() if one.name.endswith("-asked.mcap")]
    assert status == [0] and json.loads(capsys.readouterr().out)["recording"] == str(made[0])
    cycles = list(recorded_cycles(made[0], 2))
    assert len(cycles) > 100
    assert any(m.topic == "/elbow/can" for m in read_messages(made[0]))
    joint = jointfile.parse(text)
    encode = Encoders(2, joint.bus.period_s).estimate
    ticks = [played.tick for played in open_playback(made[0], joint, tmp_path)]
    again = [encode(DECODERS["estimate"](tick.estimate_payload)) for tick in ticks]
    recorded = [m.data for m in read_messages(made[0], frozenset({"estimate"}))]
    assert len(again) > 100 and again == recorded[-len(again) :]  # bit for bit
    assert ticks[0].sequence > cycles[0].sequence  # from a state in the middle of the run


def test_with_the_same_wall_time_at_each_start_no_recording_takes_the_place_of_another(tmp_path, monkeypatch):
    wall = SimpleNamespace(now=lambda _: datetime(1970, 1, 1, tzinfo=UTC))
    monkeypatch.setattr(blackbox, "datetime", wall)
    for count in (1, 2):
        scene = Scene(tmp_path)
        scene.run(100)
        scene.run(200, Status.MODEL_ALARM)
        assert len(scene.finish()) == count


def test_what_others_put_into_the_folder_stops_no_box_and_is_not_written_through(tmp_path, caplog):
    """Names of no time, folders in the places of files, links, pipes; and a status of anybody's."""
    (folder := tmp_path / "kept").mkdir()
    (victim := tmp_path / "victim").write_text("untouched")
    (folder / "elbow-20261399T000000Z-asked.mcap").touch()
    (folder / "elbow-20260101T000000Z-asked.mcap").mkdir()
    (folder / "elbow-20260101T000000Z-asked.part").mkdir()
    (folder / "elbow.day.csv").symlink_to(victim)
    scene = Scene(tmp_path)
    assert next_due(folder, "elbow") is None
    (folder / "elbow.keep").symlink_to(victim)
    scene.box.document("status", b'{"friction": [{}]}', 0)
    scene.run(20)
    (folder / "elbow.day.csv").unlink()
    os.mkfifo(folder / "elbow.day.csv")  # which nobody reads
    scene.run(200)
    ((made, cause),) = scene.finish()
    assert cause == "asked" and made.stat().st_size > 1000
    assert victim.read_text() == "untouched" and "rows of the day are not kept" in caplog.text


def test_a_box_that_begins_leaves_the_recording_that_another_one_still_writes(tmp_path, monkeypatch):
    """Of a daemon that was killed, while the next one begins."""
    first, others, wrote = Scene(tmp_path), [], blackbox.McapSink.mapping
    first.box.mapping({"joint": "elbow", "nodes": []}, 1)
    # Begins meanwhile.
    monkeypatch.setattr(blackbox.McapSink, "mapping", lambda *a: others.append(Scene(tmp_path)) or wrote(*a))
    first.run(100)
    first.run(200, Status.MODEL_ALARM)
    assert len(first.finish()) == len(others) == 1
    (left := tmp_path / "kept" / "elbow-20260105T081500Z-asked.part").touch()
    Scene(tmp_path)
    assert not left.exists()


def test_a_full_disk_is_one_line_and_leaves_no_half_file(tmp_path, monkeypatch, caplog):
    scene = Scene(tmp_path)
    scene.run(20)
    scene.box.keep("asked")
    monkeypatch.setattr("drivelink.recording.sinks.os.write", full)
    assert not scene.finish()
    assert [record.getMessage().count("No space left on device") for record in caplog.records] == [1]
    assert [path.name for path in (tmp_path / "kept").iterdir()] == ["elbow.day.csv"]
