"""MCAP recordings: bit for bit, by an independent reader, and after everything that may go wrong."""

import errno
import json
import math
import os
import random
import struct
from collections import Counter
from xml.etree import ElementTree

import numpy as np
import pytest
from mcap.reader import NonSeekingReader, make_reader

from drivelink.errors import RecordingError
from drivelink.jointfile import parse
from drivelink.pubsub.wire import EstimateMessage, ExternalMessage
from drivelink.recording import read
from drivelink.recording.canlog import read_frames
from drivelink.recording.columns import record_from_columns
from drivelink.recording.formats import open_sink
from drivelink.recording.foxglove import write_layouts
from drivelink.recording.mapping import joint_of
from drivelink.recording.mcapfile import read_messages, recorded_cycles
from drivelink.recording.messages import message_schema
from drivelink.recording.playback import open_playback
from estimator.sample import SIGMA_95, Sample, Status, TransmissionEstimate

TEXT = 'name = "elbow"\n[[motor]]\ninertia_kg_m2 = 0.1\n'
JOINT = parse(TEXT)
BEGIN_NS = 1_700_000_000_000_000_000


def sample(k):
    rng = random.Random(k)
    velocity = math.nan if k % 3 else rng.gauss(0, 1)
    return Sample(k, (rng.gauss(0, 1),), (velocity,), (rng.gauss(0, 1e6),), rng.gauss(0, 1e-9))


def estimate(k, status=3):
    one = TransmissionEstimate(k / 3, 700.0 + k, math.inf if k < 5 else 3.0, k * 1e-3)
    return EstimateMessage(k, BEGIN_NS + k * 1_000_000, status, k / 3, 700.0 + k, 3.0, (one,))


def external(k):
    status = (1 if k >= 5 else 0) | (2 if k >= 400 else 0)
    return ExternalMessage(k, BEGIN_NS + k * 1_000_000, status, k / 7 if k >= 5 else math.nan, 0.5)


def record(path, n=500, close=True):
    sink = open_sink(path, JOINT, TEXT)
    for k in range(n):
        stamp_ns = BEGIN_NS + k * 1_000_000
        sink.sample(sample(k), stamp_ns)
        sink.estimate(estimate(k))
        sink.external(external(k))
        sink.frame(stamp_ns, 0x181, struct.pack("<iH", k, 7))
        if k % 100 == 99:
            events = [{"time": 1.5e9 + j, "text": f"event {j}", "count": 1} for j in range(k // 250 + 1)]
            sink.document("status", json.dumps({"state": "running", "events": events}).encode(), stamp_ns)
            sink.flush()
    if close:
        sink.close()
    return sink


def bits(one):
    values = (*one.motor_position_rad, *one.motor_velocity_rad_s, *one.motor_torque_nm, *one[4:])
    return struct.pack(f"<q{len(values)}d", one.sequence, *values)


@pytest.fixture
def path(tmp_path):
    record(tmp_path / "r.mcap")
    return tmp_path / "r.mcap"


def test_samples_come_back_bit_for_bit(path, tmp_path, caplog):
    back = [cycle.sample for cycle in recorded_cycles(path, 1)]
    assert [bits(one) for one in back if one] == [bits(sample(k)) for k in range(500)]
    carried, whole = joint_of(path, None), read(path, JOINT)
    assert (carried.text, carried.folder) == (TEXT, tmp_path)
    assert whole.period_s == JOINT.bus.period_s and len(whole) == 500
    assert np.array_equal(whole.motor_torque_nm[:, 0], [sample(k).motor_torque_nm[0] for k in range(500)])
    with pytest.raises(RecordingError, match="has more motors than the joint file"):
        list(recorded_cycles(path, 0))
    columns = {name: np.sin(0.1 * np.arange(200.0)) for name in TWO} | {"time_s": 1e-3 * np.arange(200.0)}
    record_from_columns(columns, "two.csv", JOINT)
    assert "two.csv: has a second motor" in caplog.text


TWO = ("motor1_position_rad", "motor1_torque_nm", "motor2_position_rad", "link_position_rad")


TYPES = {
    "object": dict, "integer": int, "string": str, "boolean": bool, "number": (int, float), "null": type(None),
}  # fmt: skip


def check(value, schema, where):
    """What our schemas use of JSON schema: type, properties, required."""
    wanted = schema["type"] if isinstance(schema["type"], list) else [schema["type"]]
    assert any(isinstance(value, TYPES[name]) for name in wanted), where
    if isinstance(value, dict):
        assert set(schema.get("required", ())) <= set(value), where
        for name, inner in schema.get("properties", {}).items():
            check(value[name], inner, f"{where}.{name}")


def test_a_recording_of_another_joint_is_said_to_be_one_once(path, caplog):
    arm = parse(TEXT.replace("elbow", "arm"))
    for joint in (JOINT, arm):
        read(path, joint)
        open_playback(path, joint, path.parent)
    assert caplog.messages == [f'{path}: recorded of "elbow", while the joint file is of "arm"']


def test_an_independent_reader_finds_channels_schemas_and_messages_that_obey_them(path):
    counts, refuse = Counter(), lambda name: pytest.fail(f"{name} is no JSON")
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        assert reader.get_summary().statistics.message_start_time == BEGIN_NS
        for schema, channel, message in reader.iter_messages():
            assert (schema.encoding, channel.message_encoding) == ("jsonschema", "json")
            value = json.loads(message.data, parse_constant=refuse)  # as other languages read it
            check(value, json.loads(schema.data), channel.topic)
            counts[channel.topic] += 1
    topics = {"sample": 500, "estimate": 500, "external": 500, "can": 500, "status": 5, "joint": 1, "log": 2}
    assert counts == {f"/elbow/{topic}": count for topic, count in topics.items()}
    described = json.loads(message_schema("estimate", 1))["properties"]
    assert (
        described["motor1_stiffness_nm_rad"]["unit"] == "N·m/rad" and described["valid"]["type"] == "boolean"
    )
    assert json.loads(message_schema("log", 1))["title"] == "foxglove.Log"
    drawn = [json.loads(m.data) for m in read_messages(path, frozenset({"estimate"}))][:6]
    assert drawn[0]["motor1_stiffness_low_nm_rad"] is None  # without a standard deviation
    for part in ("", "motor1_"):
        value, std = drawn[5][f"{part}stiffness_nm_rad"], drawn[5][f"{part}stiffness_std_nm_rad"]
        assert drawn[5][f"{part}stiffness_low_nm_rad"] == pytest.approx(value - SIGMA_95 * std)
        assert drawn[5][f"{part}stiffness_high_nm_rad"] == pytest.approx(value + SIGMA_95 * std)


def test_without_its_end_everything_flushed_is_there_for_both_readers_and_that_is_said_once(tmp_path, caplog):
    path, found = tmp_path / "r.mcap", 0
    sink = record(path, close=False)  # as after a kill
    for _ in range(3):
        assert sum(m.topic == "/elbow/sample" for m in read_messages(path)) == 500
    assert caplog.messages.count(f"{path}: truncated or damaged: read up to the damage") == 1
    with path.open("rb") as file, pytest.raises(Exception):  # noqa: B017  (the end is missing, and it says so)
        for _ in NonSeekingReader(file).iter_messages(log_time_order=False):
            found += 1
    assert found == 2008
    sink.abandon()


def test_cut_off_anywhere_it_gives_what_is_whole(path):
    whole, rng, before = path.read_bytes(), random.Random(3), 0
    for size in sorted(rng.randrange(3000, len(whole)) for _ in range(25)):
        path.write_bytes(whole[:size])
        found = [m for m in read_messages(path) if m.topic == "/elbow/sample"]
        assert before <= len(found) <= 500 and len(found) % 100 == 0
        before = len(found)
    assert before >= 400


def test_a_cycle_that_was_carried_on_is_a_cycle_without_sample(tmp_path):
    path = tmp_path / "r.mcap"
    sink = open_sink(path, JOINT)
    stale = int(Status.STALE | Status.BUS_FAULT)
    for k in range(300):
        if k != 120:
            sink.sample(sample(k), BEGIN_NS + k)
        sink.estimate(estimate(k, stale if k == 120 else 3 | int(Status.DRIVE_FAULT) * (k == 200)))
    sink.close()
    cycles = list(recorded_cycles(path, 1))
    assert [c.sequence for c in cycles] == list(range(300))
    assert [c.sequence for c in cycles if c.sample is None] == [120]
    assert cycles[120].flags == Status.BUS_FAULT and cycles[200].flags == Status.DRIVE_FAULT


@pytest.mark.parametrize("batch", [1, 50, 1000])
def test_batches_of_any_length_and_another_run_of_the_daemon_are_cycles_with_their_flags(batch, tmp_path):
    path = tmp_path / "r.mcap"
    sink = open_sink(path, JOINT)
    runs = (2500, 1200)
    # All samples that wait, then all estimates, as a recorder takes them.
    for begin in range(0, sum(runs), batch):
        waiting = [
            (k if k < runs[0] else k - runs[0], k) for k in range(begin, min(begin + batch, sum(runs)))
        ]
        for sequence, k in waiting:
            sink.sample(sample(sequence), BEGIN_NS + k)
        for sequence, k in waiting:
            sink.estimate(estimate(sequence, 3 | int(Status.DRIVE_FAULT) * (k % 70 == 0)))
    sink.close()
    cycles = list(recorded_cycles(path, 1))
    assert [c.sequence for c in cycles] == [*range(runs[0]), *range(runs[1])]
    assert [k for k, c in enumerate(cycles) if c.flags] == list(range(0, sum(runs), 70))


def test_time_goes_on_where_the_daemon_began_again(tmp_path):
    path, began = tmp_path / "r.mcap", (300, 0)
    sink = open_sink(path, JOINT)
    for at, begin in zip((0.0, 0.4321), began, strict=True):
        for k in range(100):
            sink.sample(sample(begin + k), BEGIN_NS + round(1e9 * at) + k * 1_000_000)
    sink.close()
    time_s = read(path, JOINT).time_s
    assert np.diff(time_s)[99] == pytest.approx(0.333) and np.diff(time_s).min() == pytest.approx(1e-3)
    played = [one.time_s for one in open_playback(path, JOINT, tmp_path)]
    assert played[-1] - played[0] == pytest.approx(0.4321 + 0.099) and min(np.diff(played)) > 0.0


def count(path):
    if path.suffix == ".mcap":
        return sum(m.topic == "/elbow/sample" for m in read_messages(path))
    if path.suffix == ".csv":
        return len(read(path, parse(TEXT + '[motor.transmission]\nmodel = "none"\n')))
    return sum(1 for _ in read_frames(path))


@pytest.mark.parametrize("suffix", [".mcap", ".csv", ".blf"])
def test_a_full_disk_is_one_line_and_a_file_that_is_whole(suffix, tmp_path, monkeypatch):
    path, room, write, flushed = tmp_path / f"r{suffix}", [40_000], os.write, 0

    def full(fd, data):
        """Of the write that goes beyond its room the disk takes a part."""
        if not room[0]:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        done = write(fd, data[: room[0]])
        room[0] -= done
        return done

    monkeypatch.setattr("drivelink.recording.sinks.os.write", full)
    sink = open_sink(path, JOINT, TEXT)
    with pytest.raises(RecordingError, match="cannot be written any further: No space left") as error:
        while True:
            for k in range(flushed, flushed + 100):
                sink.sample(sample(k), BEGIN_NS + k * 1_000_000)
                sink.frame(BEGIN_NS + k * 1_000_000, 0x181, bytes(8))
            sink.flush()
            flushed += 100
    sink.abandon()
    assert "\n" not in str(error.value)
    assert count(path) == flushed > 0


@pytest.mark.parametrize("motors", [1, 2])
def test_the_layouts_for_foxglove_and_plotjuggler_plot_what_is_recorded(motors, tmp_path):
    two = 'name = "elbow"\narrangement = "antagonistic"\n' + "[[motor]]\ninertia_kg_m2 = 0.1\n" * 2
    fox, jug = write_layouts(JOINT if motors == 1 else parse(two), tmp_path / "views")
    fields = {
        f"/elbow/{topic}/{name}"
        for topic in ("sample", "estimate")
        for name in json.loads(message_schema(topic, motors))["properties"]
    }
    layout = json.loads(fox.read_text())
    paths = [p["value"] for panel in layout["configById"].values() for p in panel["paths"]]
    assert {path.replace(".", "/") for path in paths} <= fields and len(paths) > 6
    curves = [curve.attrib["name"] for curve in ElementTree.parse(jug).iter("curve")]
    assert set(curves) <= fields and len(curves) == len(paths)
    placed, rest = [], layout["layout"]
    while isinstance(rest, dict):
        placed.append(rest["first"])
        rest = rest["second"]
    assert [*placed, rest] == list(layout["configById"])
