"""Replay: the same pipeline, bit for bit, from every format; and what the command leaves behind."""

import csv
import errno
import itertools
import json
import logging
import math
import signal
import struct
import threading
from types import SimpleNamespace

import can
import daemonkit
import numpy as np
import pytest
import test_column_map as sine
import zenohkit
from test_read_back import forge

from drivelink import cli, jointfile, subscribe
from drivelink.cli import warn
from drivelink.errors import RecordingError
from drivelink.jointfile import JointText, parse
from drivelink.loop.diagnosing import _read
from drivelink.output.progress import Meter
from drivelink.pubsub.publisher import JointPublisher, describe_model, to_json
from drivelink.pubsub.session import close_session, open_client, open_session
from drivelink.pubsub.wire import EstimateMessage
from drivelink.recording import formats, read
from drivelink.recording.canlog import read_frames
from drivelink.recording.formats import open_sink
from drivelink.recording.mapping import mapping_document, recorded_layouts
from drivelink.recording.mcapfile import recorded_cycles
from drivelink.recording.playback import Summary, open_playback
from drivelink.recording.recorder import daemon_layouts
from drivelink.recording.sinks import Sink
from estimator.sample import Estimate, Status

FORMATS = tuple(ending for ending, kind in formats.FORMATS.items() if kind.sink)
BEGIN_NS = 1_700_000_000_000_000_000
CYCLES = 400


def bits(estimate):
    values = [*estimate[2:5], *(value for one in estimate.transmissions for value in one)]
    return struct.pack(f"<qI{len(values)}d", estimate.sequence, int(estimate.status), *values)


class Recorded:
    """A daemon in lockstep with its devices, all its frames and estimates recorded in every format."""

    def __init__(self, folder, text, disturb=None, cycles=CYCLES, formats=FORMATS):
        self.folder = folder
        self.joint = parse(text)
        self.tap = can.Bus(interface="virtual", channel=self.joint.bus.channel)
        self.sinks: list[Sink] = [open_sink(folder / f"r{suffix}", self.joint, text) for suffix in formats]
        self.stamp_ns = BEGIN_NS - 1_000_000_000
        with daemonkit.rig(self.joint) as rig:
            self.drain()
            if disturb:
                disturb(rig)
            for _ in range(cycles):
                rig.run(1)
                self.drain()
            self.events = rig.events
            self.live = [estimate for estimate, _ in rig.collector.estimates]
            samples = {sample.sequence: sample for sample, _ in rig.collector.samples}
            for estimate in self.live:
                stamp_ns = BEGIN_NS + estimate.sequence * 1_000_000
                for sink in self.sinks:
                    sink.estimate(EstimateMessage(estimate[0], stamp_ns, int(estimate[1]), *estimate[2:]))
                    if estimate.sequence in samples:
                        sink.sample(samples[estimate.sequence], stamp_ns)
        for sink in self.sinks:
            sink.close()
        self.tap.shutdown()

    def drain(self):
        """Write what was on the bus, with the stamps that a bus in real time would have given."""
        while (message := self.tap.recv(0)) is not None:
            if message.arbitration_id == 0x080:
                self.stamp_ns = max(self.stamp_ns, BEGIN_NS - 1_000_000) + 1_000_000
            for sink in self.sinks:
                late_ns = 0 if message.arbitration_id == 0x080 else 150_000
                sink.frame(self.stamp_ns + late_ns, message.arbitration_id, bytes(message.data))

    def replayed(self, suffix, frames=None):
        path = self.folder / f"r{suffix}"
        playback = open_playback(path, self.joint, self.folder, frames=frames)
        return [played.tick.estimate for played in playback]


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    return Recorded(tmp_path_factory.mktemp("rec"), daemonkit.vsa_text())


@pytest.mark.parametrize(
    ("suffix", "frames"), [(suffix, None) for suffix in FORMATS] + [(".mcap", True)], ids=str
)
def test_every_format_gives_the_published_estimates_bit_for_bit(recorded, suffix, frames):
    # The mapping of the raw logs is the one the daemon configured by SDO, heard in the log itself.
    assert len(recorded.live) == CYCLES
    assert [bits(e) for e in recorded.replayed(suffix, frames)] == [bits(e) for e in recorded.live]


def disturb(rig):
    at, syncs, node = rig.faults.at, rig.network.syncs, rig.node
    at(syncs + 60, lambda: rig.faults.mute(node(2), rig.tpdo(2)[0]))
    at(syncs + 120, lambda: rig.faults.delay(node(3), rig.tpdo(3)[0], 2))
    at(syncs + 180, lambda: rig.faults.repeat(node(1), rig.tpdo(1)[0], cycles=3))
    at(syncs + 240, lambda: rig.faults.emergency(node(1), 0x2310, 0x02))
    at(syncs + 300, lambda: rig.faults.resize(node(2), rig.tpdo(2)[0], 6, cycles=2))


def upset(rig):
    """A node begins anew, and a SYNC amid a cycle leaves its samples untimed."""
    at, syncs, tap = rig.faults.at, rig.network.syncs, daemonkit.Listener(rig.joint)
    at(syncs + 60, lambda: rig.faults.reboot(rig.node(2)))
    at(syncs + 320, lambda: tap.send(0x080))


@pytest.mark.parametrize(
    ("disturb", "suffixes", "said"),
    [
        (disturb, (".log", ".blf", ".mcap"), (Status.GAP, Status.BUS_FAULT, Status.DRIVE_FAULT)),
        (upset, (".mcap",), (Status.NODE_RESTARTED, Status.UNTIMED)),
    ],
)
def test_a_disturbed_bus_is_judged_as_it_was_live(disturb, suffixes, said, tmp_path):
    recorded = Recorded(tmp_path, daemonkit.vsa_text(), disturb, formats=suffixes)
    for bit in said:
        assert any(e.status & bit for e in recorded.live), bit
    for suffix in suffixes:
        assert [bits(e) for e in recorded.replayed(suffix)] == [bits(e) for e in recorded.live]


def another_object(rig):
    """Node 1's position frames carry something else for a while; one answer for node 2's rated torque is forged."""
    tpdo, other = rig.node(1).tpdos[rig.tpdo(1)[0]], itertools.count(123_456, 7)
    inner, syncs = tpdo.emit, rig.network.syncs

    def lie(can_id, data):
        begun = 2500 <= rig.network.syncs - syncs < 4500
        inner(can_id, struct.pack("<i", next(other)) + data[4:] if begun else data)

    tpdo.emit = lie
    rig.faults.at(syncs + 2500, lambda: forge(rig, 2, (0x6076, 0), 5000, times=1))


def another_mapping(rig):
    """Somebody else exchanges two objects of node 1's frame, which keeps its identifier and length."""
    number, cob_id = rig.tpdo(1)
    other = daemonkit.Listener(rig.joint)
    mapping, entries = 0x19FF + number, rig.daemon.layouts[1].tpdos[0].objects
    steps = [(0x17FF + number, 1, 1 << 31 | cob_id, 4), (mapping, 0, 0, 1)]
    for place, one in enumerate(reversed(entries), start=1):
        steps.append((mapping, place, one.index << 16 | one.subindex << 8 | one.bits, 4))
    steps += [(mapping, 0, len(entries), 1), (0x17FF + number, 1, cob_id, 4)]

    def write():
        for index, subindex, value, size in steps:
            head = bytes([0x23 | (4 - size) << 2]) + index.to_bytes(2, "little") + bytes([subindex])
            other.send(0x601, head + value.to_bytes(size, "little").ljust(4, b"\0"))
        other.close()

    rig.faults.at(rig.network.syncs + 2500, write)


@pytest.mark.parametrize(
    ("lie", "cycles", "event", "suffix"),
    [
        (another_object, 5000, "as 0x6064:00, by SDO it is", ".log"),
        (another_mapping, 3000, "somebody else writes its mapping", ".mcap"),
    ],
)
def test_what_a_daemon_reads_back_and_rejects_is_rejected_in_the_replay_at_the_same_cycle(
    lie, cycles, event, suffix, tmp_path
):
    text = daemonkit.vsa_text(bus="read_back_s = 0.05")
    recorded = Recorded(tmp_path, text, lie, cycles=cycles, formats=(suffix,))
    assert any(event in text for text in recorded.events)
    assert not any("0x6076:00 was" in text for text in recorded.events)  # once is no proof of another unit
    assert sum(not e.status & Status.VALID for e in recorded.live[2500:]) > 100
    assert [bits(e) for e in recorded.replayed(suffix)] == [bits(e) for e in recorded.live]


def test_missing_samples_are_counted_as_those_who_fit_count_them(tmp_path, capsys, caplog):
    recorded = Recorded(tmp_path, daemonkit.vsa_text(), disturb, formats=(".mcap",))
    path = tmp_path / "r.mcap"
    read(path, recorded.joint)
    (said,) = (line for line in caplog.messages if "samples missing" in line)
    assert cli.main(["replay", str(path), "--json"]) == 0
    (out,) = capsys.readouterr().out.splitlines()
    assert f" {json.loads(out)['samples_missing']} of " in said
    assert cli.main(["replay", str(path)]) == 0
    assert said.split(", ")[1] in capsys.readouterr().out


def test_the_length_of_a_replay_has_no_digits_of_rounding():
    summary = Summary(1, None, False)
    summary._first_s, summary._last = 1.2, SimpleNamespace(time_s=7.201, tick=SimpleNamespace(estimate=None))
    assert summary.document()["seconds"] == 6.001 != 7.201 - 1.2


def test_what_is_strange_in_a_log_is_said(recorded, tmp_path, caplog):
    lines = (recorded.folder / "r.log").read_text().splitlines(keepends=True)
    strange = tmp_path / "strange.log"
    strange.write_text("".join([*lines, "no frame\n"]))
    with caplog.at_level(logging.WARNING, "drivelink.recording"):
        played = list(open_playback(strange, recorded.joint, tmp_path))
    assert len(played) == CYCLES and "omitted: 1 line without a CAN frame" in caplog.text
    late = tmp_path / "late.log"  # without its configuration
    late.write_text("".join(lines[len(lines) // 2 :]))
    with pytest.raises(RecordingError, match=r"late\.log.*motor\[1\]\.drive"):
        open_playback(late, recorded.joint, tmp_path)
    slower = recorded.joint.bus.model_copy(update={"period_s": 0.002})
    with caplog.at_level(logging.WARNING, "drivelink.recording"):
        joint = recorded.joint.model_copy(update={"bus": slower})
        playback = open_playback(recorded.folder / "r.log", joint, tmp_path)
    assert playback.period_s == 0.001 and "SYNC comes every 0.001 s" in caplog.text


def test_a_kept_recording_whose_samples_were_dropped_is_diagnosed_by_its_frames(recorded, tmp_path):
    text, kept = daemonkit.vsa_text(), tmp_path / "kept.mcap"
    sink = open_sink(kept, recorded.joint, text)
    for frame in read_frames(recorded.folder / "r.log"):
        sink.frame(frame.stamp_ns, frame.can_id, frame.data)
    for played in recorded_cycles(recorded.folder / "r.mcap", 2):
        if played.sequence % 10 > 2:
            sink.sample(played.sample, BEGIN_NS + played.sequence * 1_000_000)
    sink.close()
    source = JointText(joint=recorded.joint, text=text, folder=recorded.folder, name="vsa.toml")
    whole = read(recorded.folder / "r.csv", recorded.joint)
    assert len(read(kept, recorded.joint).sequence) < 0.75 * len(whole.sequence)
    assert np.array_equal(_read(kept, source).motor_torque_nm, whole.motor_torque_nm)


def asked_over_zenoh(joint, layouts, endpoint, folder):
    """The mapping that `record` takes from a daemon, beside a stranger who publishes another one."""
    serving, ended = open_session(joint.zenoh, folder), threading.Event()
    asking, stranger = open_client(endpoint), open_client(endpoint)
    publisher = JointPublisher(serving, joint)
    publisher.put_joint(joint, layouts)
    lie = to_json(describe_model(joint, layouts[:1]))
    key = f"{publisher.key}/model"
    lying = stranger.declare_queryable(key, lambda query: query.reply(key, lie), complete=True)

    def answer():
        while not ended.wait(0.05):
            publisher.answer()

    answering = threading.Thread(target=answer)
    answering.start()
    try:
        return zenohkit.until(lambda: daemon_layouts(asking, joint, print))
    finally:
        ended.set()
        answering.join()
        lying.undeclare()
        publisher.close()
        for session in (asking, stranger, serving):
            close_session(session)


def test_a_recording_begun_beside_a_running_daemon_replays_by_what_the_daemon_says(tmp_path, capsys):
    """The daemon configured the drives before the recording began: it is asked for the mapping, over zenoh.

    What it configures anew later, when all have rebooted, is followed: nothing before that is left out.
    """
    endpoint = zenohkit.free_endpoint()
    text = daemonkit.vsa_text(endpoint=endpoint)
    joint = parse(text)
    paths = [tmp_path / f"late{suffix}" for suffix in FORMATS if suffix != ".csv"]
    with can.Bus(interface="virtual", channel=joint.bus.channel) as tap, daemonkit.rig(joint) as rig:
        rig.run(20)
        known = asked_over_zenoh(joint, list(rig.daemon.layouts.values()), endpoint, tmp_path)
        sinks = [open_sink(path, joint, text) for path in paths]
        for sink in sinks:
            sink.mapping(mapping_document(joint.name, known, text, daemon=True), BEGIN_NS)
        while tap.recv(0) is not None:
            pass
        skipped, cycle = len(rig.collector.samples), 0
        rig.run(100)
        for node in (1, 2, 3):
            rig.faults.reboot(rig.node(node))
        rig.run(100)
        while (message := tap.recv(0)) is not None:
            cycle += message.arbitration_id == 0x080
            for sink in sinks:
                sink.frame(BEGIN_NS + cycle * 1_000_000, message.arbitration_id, bytes(message.data))
        live = [repr(sample[1:]) for sample, _ in rig.collector.samples[skipped:]]
    assert 150 < len(live) < 200
    for path, sink in zip(paths, sinks, strict=True):
        sink.close()
        played = [one.tick.sample for one in open_playback(path, joint, tmp_path, frames=True)]
        assert [repr(one[1:]) for one in played if one is not None] == live
        # The joint file is kept as well: nothing else is needed to replay it.
        assert cli.main(["replay", str(path), "--json"]) == 0
        document = json.loads(capsys.readouterr().out)
        assert document["joint"] == "elbow" and 198 < document["cycles"] <= 200


def test_what_a_daemon_said_counts_more_than_a_file_beside_the_recording(tmp_path):
    joint = daemonkit.vsa()
    with daemonkit.rig(joint) as rig:
        layouts = list(rig.daemon.layouts.values())
    sink = open_sink(tmp_path / "r.mcap", joint)
    sink.mapping(mapping_document(joint.name, layouts[:1]), 0)
    sink.document("model", to_json(describe_model(joint, layouts)), 1)
    sink.close()
    assert len(recorded_layouts(tmp_path / "r.mcap", joint.name, daemon=False)) == 1
    assert len(recorded_layouts(tmp_path / "r.mcap", joint.name, daemon=True)) == len(layouts)
    with pytest.raises(RecordingError, match="no raw CAN in it"):
        open_playback(tmp_path / "r.mcap", joint, tmp_path, frames=True)
    (tmp_path / "r.log.mapping.json").write_text('{"joint": "elbow", "nodes": 7}')
    with pytest.raises(RecordingError, match="its mapping cannot be read"):
        recorded_layouts(tmp_path / "r.log", joint.name, daemon=False)


# The command

SINE = sine.TEXT + "parameters = { k_nm_rad = 150.0 }\n"


@pytest.fixture
def joint_path(tmp_path):
    path = tmp_path / "sine.toml"
    path.write_text(SINE)
    return path


def rows(path):
    with path.open() as file:
        return list(csv.DictReader(file))


COLUMNS = [
    "time_s", "flexibility_torque_nm", "stiffness_nm_rad", "stiffness_std_nm_rad", "observable",
    "motor1_flexibility_torque_nm", "motor1_stiffness_nm_rad", "motor1_stiffness_std_nm_rad",
]  # fmt: skip
LINK_COLUMNS = [
    "external_torque_nm", "external_torque_std_nm", "external_valid", "contact", "link_flexibility_torque_nm",
    "flexibility_difference_nm",
]  # fmt: skip


def test_estimates_csv_has_the_columns_of_the_contract_and_a_row_for_each_sample(
    tmp_path, joint_path, capsys
):
    joint_path.write_text(f"{SINE}\n[link.dynamics]\ninertia_kg_m2 = 0.4\n")
    recording = sine.ours(tmp_path / "r.csv", 1500, nan_row=700)
    out, plots = tmp_path / "e.csv", tmp_path / "plots"
    arguments = ["--joint", str(joint_path), "--out", str(out), "--plots", str(plots)]
    assert cli.main(["replay", str(recording), *arguments]) == 0
    table = rows(out)
    assert list(table[0])[:8] == COLUMNS and list(table[0])[-6:] == LINK_COLUMNS
    assert [float(row["time_s"]) for row in table] == pytest.approx(np.arange(1500) * 0.002, abs=1e-12)
    assert {row["observable"] for row in table} <= {"0", "1"}
    assert {row["valid"] for row in table} == {row["external_valid"] for row in table} == {"0", "1"}
    assert all(int(row["status"]) & 1 == int(row["valid"]) for row in table)
    sure = [row for row in table if row["torque_valid"] == "1"]
    assert len(sure) > 700 and all(0.0 <= float(row["flexibility_torque_std_nm"]) < math.inf for row in sure)
    # The truth is 150 N·m/rad and noise-free: 1 % after three seconds is a wide bound.
    assert float(table[-1]["stiffness_nm_rad"]) == pytest.approx(150.0, rel=0.01)
    last = [row for row in table if row["external_valid"] == "1"][-1]
    assert float(last["external_torque_std_nm"]) > 0.0 and all(math.isfinite(float(x)) for x in last.values())
    assert all((plots / name).stat().st_size > 5000 for name in ("stiffness.png", "time.png"))
    assert "1500 cycles" in capsys.readouterr().out
    assert cli.main(["replay", str(recording), *arguments[:2], "--out", "/no/such/folder/e.csv"]) == 2
    assert "there is no folder /no/such/folder" in capsys.readouterr().err


def test_the_name_of_a_recording_does_not_reach_the_terminal_as_a_command(tmp_path, joint_path, capsys):
    recording = sine.ours(tmp_path / "\x1b[2J\x9br.csv", 1500)
    assert cli.main(["replay", str(recording), "--joint", str(joint_path)]) == 0
    assert cli.main(["fit", str(recording), "--joint", str(joint_path)]) == 0
    warn(recording, ["said"])
    shown = "".join(capsys.readouterr())
    assert (
        "[2Jr.csv: 1500 cycles" in shown and "[2Jr.csv: warning: said" in shown and "fit of [2Jr.csv" in shown
    )
    assert not set("\x1b\x9b") & set(shown + Meter(f"replay {recording.name}")._title())


def test_ctrl_c_leaves_the_estimates_so_far(tmp_path, joint_path):
    recording, out = sine.ours(tmp_path / "r.csv", 20_000), tmp_path / "e.csv"
    asked = ("replay", recording, "--joint", joint_path, "--out", out, "--speed", "4")
    with zenohkit.process(*asked) as process:
        zenohkit.until(lambda: any(path.stat().st_size for path in tmp_path.glob(f".{out.name}.*")))
        process.send_signal(signal.SIGINT)  # some estimates are written
        text, errors = process.communicate(timeout=90)
    assert process.returncode == 130 and not errors, errors
    assert "up to the interruption" in text
    table = rows(out)
    assert 0 < len(table) < 20_000 and all(row["motor1_deflection_rad"] for row in table)


def test_publish_sends_every_estimate_to_a_subscriber(tmp_path, joint_path):
    endpoint = zenohkit.free_endpoint()
    joint_path.write_text(SINE + f'[zenoh]\nendpoint = "{endpoint}"\n')
    recording, got = sine.ours(tmp_path / "r.csv", 2000), []
    with subscribe("sine", endpoint=endpoint, depth=4096) as subscription:
        assert cli.main(["replay", str(recording), "--joint", str(joint_path), "--publish"]) == 0
        for estimate in subscription.cycles(timeout_s=2.0):
            got.append(estimate)
            if estimate is None or estimate.sequence == 1999:
                break
        zenohkit.until(lambda: subscription.status["state"] == "ended")
    local = [p.tick.estimate for p in open_playback(recording, jointfile.load(joint_path), tmp_path)]
    # The replay begins when the subscriber is there: nothing is missing.
    assert [bits(Estimate(e.sequence, e.status, *e[3:])) for e in got] == [bits(e) for e in local]
    assert len(local) == 2000


def test_samples_that_cannot_be_used_are_named_with_their_reading_and_time(tmp_path, joint_path, capsys):
    path = sine.ours(tmp_path / "r.csv")
    with path.open() as file:
        lines = list(csv.reader(file))
    place = lines[0].index("link_position_rad")
    for line in lines[1001:]:
        line[place] = "1e30"
    path.write_text("".join(f"{','.join(line)}\n" for line in lines))
    assert cli.main(["replay", str(path), "--joint", str(joint_path), "--json"]) == 0
    reasons = {one["reason"]: one["first_s"] for one in json.loads(capsys.readouterr().out)["not_valid"]}
    text = "the samples cannot be used: link position: the value is impossible"
    assert reasons[text] == pytest.approx(float(lines[1001][lines[0].index("time_s")]), abs=0.1), reasons


def test_a_file_in_the_place_of_the_plots_is_said_before_the_replay(tmp_path, joint_path, capsys):
    """It was said after it: "File exists"."""
    path = sine.ours(tmp_path / "r.csv")
    assert cli.main(["replay", str(path), "--joint", str(joint_path), "--plots", str(joint_path)]) == 2
    out, error = capsys.readouterr()
    assert not out and error == f"drivelink replay: {joint_path}: expected a folder, got a file\n"


def test_a_full_disk_for_the_plots_loses_no_result(tmp_path, joint_path, capsys, monkeypatch):
    def full(*_):
        raise OSError(errno.ENOSPC, "No space left on device", "plots/time.png")

    monkeypatch.setattr(Summary, "plot", full)
    path = sine.ours(tmp_path / "r.csv")
    assert (
        cli.main(["replay", str(path), "--joint", str(joint_path), "--plots", str(tmp_path / "plots")]) == 1
    )
    assert " cycles, " in capsys.readouterr().out
