"""Replay: the same pipeline, bit for bit, from every format; and what the command leaves behind."""

from __future__ import annotations

import csv
import itertools
import json
import logging
import math
import signal
import struct
import subprocess
import sys
import threading
from collections.abc import Callable, Sequence
from pathlib import Path

import can
import daemonkit
import numpy as np
import pytest
import zenohkit
from test_read_back import forge

from drivelink import cli, jointfile
from drivelink.canopen.layout import NodeLayout
from drivelink.cli.record import _daemon_layouts
from drivelink.errors import DrivelinkError, RecordingError
from drivelink.jointfile import JointFile, parse
from drivelink.pubsub.publisher import JointPublisher, describe_model, to_json
from drivelink.pubsub.session import close_session, open_client, open_session
from drivelink.pubsub.wire import EstimateMessage
from drivelink.recording import read
from drivelink.recording.formats import open_sink
from drivelink.recording.mapping import mapping_document, recorded_layouts
from drivelink.recording.playback import open_playback
from drivelink.recording.sinks import Sink
from estimator.sample import Estimate, Status

BEGIN_NS = 1_700_000_000_000_000_000
FORMATS = (".log", ".blf", ".asc", ".trc", ".mcap", ".csv")
CYCLES = 400


def bits(estimate: Estimate) -> bytes:
    values = [*estimate[2:5], *(value for one in estimate.transmissions for value in one)]
    return struct.pack(f"<qI{len(values)}d", estimate.sequence, int(estimate.status), *values)


class Recorded:
    """A daemon in lockstep with its devices, all its frames and estimates recorded in every format."""

    def __init__(
        self,
        folder: Path,
        text: str,
        disturb: Callable[[daemonkit.DaemonRig], None] | None,
        cycles: int = CYCLES,
        formats: Sequence[str] = FORMATS,
    ) -> None:
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

    def drain(self) -> None:
        """Write what was on the bus, with the stamps that a bus in real time would have given."""
        while (message := self.tap.recv(0)) is not None:
            if message.arbitration_id == 0x080:
                self.stamp_ns = max(self.stamp_ns, BEGIN_NS - 1_000_000) + 1_000_000
            for sink in self.sinks:
                late_ns = 0 if message.arbitration_id == 0x080 else 150_000
                sink.frame(self.stamp_ns + late_ns, message.arbitration_id, bytes(message.data))

    def replayed(self, suffix: str, frames: bool | None = None) -> list[Estimate]:
        path = self.folder / f"r{suffix}"
        playback = open_playback(path, self.joint, self.folder, frames=frames)
        return [played.tick.estimate for played in playback]


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Recorded:
    return Recorded(tmp_path_factory.mktemp("rec"), daemonkit.vsa_text(), None)


@pytest.mark.parametrize(
    ("suffix", "frames"), [(suffix, None) for suffix in FORMATS] + [(".mcap", True)], ids=str
)
def test_every_format_gives_the_published_estimates_bit_for_bit(
    recorded: Recorded, suffix: str, frames: bool | None
) -> None:
    # The mapping of the raw logs is the one the daemon configured by SDO, heard in the log itself.
    assert len(recorded.live) == CYCLES
    assert [bits(e) for e in recorded.replayed(suffix, frames)] == [bits(e) for e in recorded.live]


def disturb(rig: daemonkit.DaemonRig) -> None:
    at, syncs = rig.faults.at, rig.network.syncs
    node = rig.node
    at(syncs + 60, lambda: rig.faults.mute(node(2), rig.tpdo(2)[0]))
    at(syncs + 120, lambda: rig.faults.delay(node(3), rig.tpdo(3)[0], 2))
    at(syncs + 180, lambda: rig.faults.repeat(node(1), rig.tpdo(1)[0], cycles=3))
    at(syncs + 240, lambda: rig.faults.emergency(node(1), 0x2310, 0x02))
    at(syncs + 300, lambda: rig.faults.resize(node(2), rig.tpdo(2)[0], 6, cycles=2))


@pytest.mark.parametrize("suffix", [".log", ".blf", ".mcap"])
def test_a_disturbed_bus_is_judged_as_it_was_live(suffix: str, tmp_path: Path) -> None:
    recorded = Recorded(tmp_path, daemonkit.vsa_text(), disturb)
    statuses = {int(e.status) for e in recorded.live}
    assert len(statuses) > 3  # faults were seen at all
    assert [bits(e) for e in recorded.replayed(suffix)] == [bits(e) for e in recorded.live]


def upset(rig: daemonkit.DaemonRig) -> None:
    at, syncs, tap = rig.faults.at, rig.network.syncs, daemonkit.Listener(rig.joint)
    at(syncs + 60, lambda: rig.faults.reboot(rig.node(2)))
    at(syncs + 320, lambda: tap.send(0x080))


def test_what_begins_anew_or_is_not_learned_from_does_so_in_the_replay_of_samples(tmp_path: Path) -> None:
    recorded = Recorded(tmp_path, daemonkit.vsa_text(), upset)
    statuses = [e.status for e in recorded.live]
    assert any(status & Status.NODE_RESTARTED for status in statuses)
    assert any(status & Status.UNTIMED for status in statuses)
    assert [bits(e) for e in recorded.replayed(".mcap")] == [bits(e) for e in recorded.live]


def another_object(rig: daemonkit.DaemonRig) -> None:
    """Node 1's position frames carry something else for a while."""
    tpdo, other = rig.node(1).tpdos[rig.tpdo(1)[0]], itertools.count(123_456, 7)
    inner, syncs = tpdo.emit, rig.network.syncs

    def lie(can_id: int, data: bytes) -> None:
        begun = 2500 <= rig.network.syncs - syncs < 4500
        inner(can_id, struct.pack("<i", next(other)) + data[4:] if begun else data)

    tpdo.emit = lie


def another_unit(rig: daemonkit.DaemonRig) -> None:
    entry = rig.node(1).dictionary.find(0x6076, 0)

    def double() -> None:
        entry.value *= 2

    rig.faults.at(rig.network.syncs + 2500, double)


def one_forged_answer(rig: daemonkit.DaemonRig) -> None:
    """Somebody else answers once, before node 2, when its rated torque is read back."""
    rig.faults.at(rig.network.syncs + 2500, lambda: forge(rig, 2, (0x6076, 0), 5000, times=1))


def another_mapping(rig: daemonkit.DaemonRig) -> None:
    """Somebody else exchanges two objects of node 1's frame, which keeps its identifier and length."""
    number, cob_id = rig.tpdo(1)
    other = daemonkit.Listener(rig.joint)
    mapping, entries = 0x19FF + number, rig.daemon.layouts[1].tpdos[0].objects
    steps = [(0x17FF + number, 1, 1 << 31 | cob_id, 4), (mapping, 0, 0, 1)]
    for place, one in enumerate(reversed(entries), start=1):
        steps.append((mapping, place, one.index << 16 | one.subindex << 8 | one.bits, 4))
    steps += [(mapping, 0, len(entries), 1), (0x17FF + number, 1, cob_id, 4)]

    def write() -> None:
        for index, subindex, value, size in steps:
            head = bytes([0x23 | (4 - size) << 2]) + index.to_bytes(2, "little") + bytes([subindex])
            other.send(0x601, head + value.to_bytes(size, "little").ljust(4, b"\0"))
        other.close()

    rig.faults.at(rig.network.syncs + 2500, write)


@pytest.mark.parametrize(
    ("disturb", "event"),
    [
        (another_object, "as 0x6064:00, by SDO it is"),
        (another_unit, "0x6076:00 was"),
        (one_forged_answer, ""),
        (another_mapping, "somebody else writes its mapping"),
    ],
)
def test_what_a_daemon_reads_back_and_rejects_is_rejected_in_the_replay_at_the_same_cycle(
    disturb: Callable[[daemonkit.DaemonRig], None], event: str, tmp_path: Path
) -> None:
    text = daemonkit.vsa_text(bus="read_back_s = 0.05")
    recorded = Recorded(tmp_path, text, disturb, cycles=6500, formats=(".log", ".mcap"))
    rejected = [e for e in recorded.live[2500:] if not e.status & Status.VALID]
    if event:
        assert any(event in text for text in recorded.events)
        assert len(rejected) > 100
    else:
        assert rejected == []
    for suffix in (".log", ".mcap"):
        assert [bits(e) for e in recorded.replayed(suffix)] == [bits(e) for e in recorded.live]


def test_what_is_strange_in_a_log_is_said(
    recorded: Recorded, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    lines = (recorded.folder / "r.log").read_text().splitlines(keepends=True)
    strange = tmp_path / "strange.log"
    strange.write_text("".join([*lines, "no frame\n"]))
    with caplog.at_level(logging.WARNING, "drivelink.recording"):
        played = list(open_playback(strange, recorded.joint, tmp_path))
    assert len(played) == CYCLES and "1 line(s) are not CAN frames" in caplog.text
    late = tmp_path / "late.log"
    late.write_text("".join(lines[len(lines) // 2 :]))
    with pytest.raises(RecordingError, match=r"late\.log"):
        open_playback(late, recorded.joint, tmp_path)


def test_raw_frames_and_samples_make_the_same_record(recorded: Recorded) -> None:
    first = read(recorded.folder / "r.csv", recorded.joint)
    for suffix in (".log", ".mcap"):
        other = read(recorded.folder / f"r{suffix}", recorded.joint)
        assert np.array_equal(first.motor_position_rad, other.motor_position_rad)
        assert np.array_equal(first.motor_torque_nm, other.motor_torque_nm)
        assert first.period_s == other.period_s


def test_a_log_without_its_configuration_says_what_the_joint_file_must_declare(
    recorded: Recorded, tmp_path: Path
) -> None:
    lines = (recorded.folder / "r.log").read_text().splitlines(keepends=True)
    path = tmp_path / "late.log"
    path.write_text("".join(lines[len(lines) // 2 :]))
    with pytest.raises(DrivelinkError) as caught:
        open_playback(path, recorded.joint, tmp_path)
    assert "late.log" in str(caught.value) and "motor[1].drive" in str(caught.value)


def asked_over_zenoh(
    joint: JointFile, layouts: list[NodeLayout], endpoint: str, folder: Path
) -> Sequence[NodeLayout]:
    """The mapping that `record` takes from a daemon, beside a stranger who publishes another one."""
    serving, asking, stranger = (
        open_session(joint.zenoh, folder),
        open_client(endpoint),
        open_client(endpoint),
    )
    publisher, ended = JointPublisher(serving, joint), threading.Event()
    publisher.put_joint(joint, layouts)
    key = f"{publisher.key}/model"
    lie = to_json(describe_model(joint, layouts[:1]))
    lying = stranger.declare_queryable(key, lambda query: query.reply(key, lie), complete=True)

    def answer() -> None:
        while not ended.wait(0.05):
            publisher.answer()

    answering = threading.Thread(target=answer)
    answering.start()
    try:
        zenohkit.until(lambda: _daemon_layouts(asking, joint))
        return _daemon_layouts(asking, joint)
    finally:
        ended.set()
        answering.join()
        lying.undeclare()
        publisher.close()
        for session in (asking, stranger, serving):
            close_session(session)


@pytest.mark.parametrize("suffix", [".log", ".blf", ".asc", ".trc", ".mcap"])
def test_a_recording_begun_beside_a_running_daemon_replays_by_what_the_daemon_says(
    suffix: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The daemon configured the drives before the recording began: it is asked for the mapping, over zenoh."""
    endpoint = zenohkit.free_endpoint()
    text = daemonkit.vsa_text(endpoint=endpoint)
    joint = parse(text)
    path = tmp_path / f"late{suffix}"
    with can.Bus(interface="virtual", channel=joint.bus.channel) as tap, daemonkit.rig(joint) as rig:
        rig.run(20)
        known = asked_over_zenoh(joint, list(rig.daemon.layouts.values()), endpoint, tmp_path)
        sink = open_sink(path, joint, text)
        sink.mapping(mapping_document(joint.name, known, text, daemon=True), BEGIN_NS)
        while tap.recv(0) is not None:
            pass
        skipped, cycle = len(rig.collector.samples), 0
        rig.run(100)
        while (message := tap.recv(0)) is not None:
            cycle += message.arbitration_id == 0x080
            sink.frame(BEGIN_NS + cycle * 1_000_000, message.arbitration_id, bytes(message.data))
        live = [sample for sample, _ in rig.collector.samples[skipped:]]
    sink.close()
    played = [one.tick.sample for one in open_playback(path, joint, tmp_path, frames=True)]
    assert len(live) == 100
    assert [repr(one[1:]) for one in played if one is not None] == [repr(one[1:]) for one in live]
    # The joint file is kept as well: nothing else is needed to replay it.
    assert cli.main(["replay", str(path), "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert (document["joint"], document["cycles"]) == ("elbow", 100)


def test_what_a_daemon_said_counts_more_than_a_file_beside_the_recording(tmp_path: Path) -> None:
    joint = daemonkit.vsa()
    with daemonkit.rig(joint) as rig:
        layouts = list(rig.daemon.layouts.values())
    sink = open_sink(tmp_path / "r.mcap", joint)
    sink.mapping(mapping_document(joint.name, layouts[:1]), 0)
    sink.document("model", to_json(describe_model(joint, layouts)), 1)
    sink.close()
    assert len(recorded_layouts(tmp_path / "r.mcap", joint.name, daemon=False)) == 1
    assert len(recorded_layouts(tmp_path / "r.mcap", joint.name, daemon=True)) == len(layouts)
    (tmp_path / "r.log.mapping.json").write_text('{"joint": "elbow", "nodes": 7}')
    with pytest.raises(RecordingError, match="its mapping cannot be read"):
        recorded_layouts(tmp_path / "r.log", joint.name, daemon=False)


def test_a_log_with_another_period_is_taken_as_it_comes(
    recorded: Recorded, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    bus = recorded.joint.bus.model_copy(update={"period_s": 0.002})
    joint = recorded.joint.model_copy(update={"bus": bus})
    with caplog.at_level(logging.WARNING, "drivelink.recording"):
        playback = open_playback(recorded.folder / "r.log", joint, tmp_path)
    assert playback.period_s == 0.001 and "SYNC comes every 0.001 s" in caplog.text


# The command

SINE = """\
name = "sine"
[[motor]]
inertia_kg_m2 = 0.125
viscous_damping_nm_s_rad = 0.8
[motor.transmission]
model = "linear"
parameters = { k_nm_rad = 150.0 }
"""


def write_csv(path: Path, n: int, nan_row: int | None = None) -> Path:
    t = np.arange(n) * 0.002
    theta, q = 0.2 * np.sin(3 * t), 0.25 * np.sin(3 * t - 0.1)
    tau = 0.125 * -1.8 * np.sin(3 * t) + 0.8 * 0.6 * np.cos(3 * t) - 150.0 * (q - theta)
    table = np.column_stack((t, theta, tau, q))
    if nan_row is not None:
        table[nan_row, 1] = np.nan
    header = "time_s,motor1_position_rad,motor1_torque_nm,link_position_rad"
    np.savetxt(path, table, fmt="%.17g", delimiter=",", header=header, comments="")
    return path


@pytest.fixture
def joint_path(tmp_path: Path) -> Path:
    path = tmp_path / "sine.toml"
    path.write_text(SINE)
    return path


def rows(path: Path) -> list[dict[str, str]]:
    with path.open() as file:
        return list(csv.DictReader(file))


def test_estimates_csv_has_the_columns_of_the_contract_and_a_row_for_each_sample(
    tmp_path: Path, joint_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    recording = write_csv(tmp_path / "r.csv", 1500, nan_row=700)
    out, plots = tmp_path / "e.csv", tmp_path / "plots"
    arguments = ["--joint", str(joint_path), "--out", str(out), "--plots", str(plots)]
    assert cli.main(["replay", str(recording), *arguments]) == 0
    table = rows(out)
    assert list(table[0])[:5] == [
        "time_s", "flexibility_torque_nm", "stiffness_nm_rad", "stiffness_std_nm_rad", "observable"
    ]  # fmt: skip
    assert list(table[0])[5:8] == [
        "motor1_flexibility_torque_nm", "motor1_stiffness_nm_rad", "motor1_stiffness_std_nm_rad"
    ]  # fmt: skip
    assert [float(row["time_s"]) for row in table] == pytest.approx(np.arange(1500) * 0.002, abs=1e-12)
    assert {row["observable"] for row in table} <= {"0", "1"}
    assert {row["valid"] for row in table} == {"0", "1"}  # not valid where it begins
    assert all(int(row["status"]) & 1 == int(row["valid"]) for row in table)
    sure = [row for row in table if row["torque_valid"] == "1"]
    assert len(sure) > 700 and all(0.0 <= float(row["flexibility_torque_std_nm"]) < math.inf for row in sure)
    # The truth is 150 N·m/rad and noise-free: 1 % after three seconds is a wide bound.
    assert float(table[-1]["stiffness_nm_rad"]) == pytest.approx(150.0, rel=0.01)
    assert all((plots / name).stat().st_size > 5000 for name in ("stiffness.png", "time.png"))
    assert "1500 cycles" in capsys.readouterr().out


def test_estimates_csv_says_what_touches_the_link_where_its_dynamics_are_declared(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    joint = tmp_path / "linked.toml"
    joint.write_text(f"{SINE}\n[link.dynamics]\ninertia_kg_m2 = 0.4\n")
    recording, out = write_csv(tmp_path / "r.csv", 1500), tmp_path / "e.csv"
    assert cli.main(["replay", str(recording), "--joint", str(joint), "--out", str(out)]) == 0
    table = rows(out)
    assert list(table[0])[-6:] == [
        "external_torque_nm", "external_torque_std_nm", "external_valid", "contact",
        "link_flexibility_torque_nm", "flexibility_difference_nm",
    ]  # fmt: skip
    assert {row["external_valid"] for row in table} == {"0", "1"}
    last = [row for row in table if row["external_valid"] == "1"][-1]
    values = {name: float(value) for name, value in last.items()}
    assert values["external_torque_std_nm"] > 0.0
    assert all(map(math.isfinite, values.values()))


@pytest.mark.parametrize(
    ("arguments", "status", "line"),
    [
        (["none.csv", "--joint", "{joint}"], 3, "no such file"),
        (["{recording}"], 2, "--joint: expected the joint file"),
        (["{recording}", "--joint", "none.toml"], 2, "cannot be read as a joint file"),
        (["{recording}", "--joint", "{joint}", "--speed", "-1"], 2, "--speed: expected a number above 0"),
        (["{recording}", "--joint", "{joint}", "--out", "/no/such/folder/e.csv"], 3, "cannot be written"),
    ],
)
def test_wrong_use_is_one_line_and_a_status(
    arguments: list[str],
    status: int,
    line: str,
    tmp_path: Path,
    joint_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    recording = write_csv(tmp_path / "r.csv", 100)
    filled = [a.format(joint=joint_path, recording=recording) for a in arguments]
    assert cli.main(["replay", *filled]) == status
    err = capsys.readouterr().err
    assert line in err and err.count("\n") == 1


def test_ctrl_c_leaves_the_estimates_so_far(tmp_path: Path, joint_path: Path) -> None:
    recording = write_csv(tmp_path / "r.csv", 20_000)
    out = tmp_path / "e.csv"
    command = [sys.executable, "-m", "drivelink", "replay", str(recording), "--joint", str(joint_path)]
    process = subprocess.Popen(
        [*command, "--out", str(out), "--speed", "4"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    zenohkit.until(
        lambda: any(path.stat().st_size for path in tmp_path.glob(f".{out.name}.*"))
    )  # some estimates
    process.send_signal(signal.SIGINT)
    text, errors = process.communicate(timeout=90)
    assert process.returncode == 130 and not errors, errors
    assert "up to the interruption" in text
    table = rows(out)
    assert 0 < len(table) < 20_000 and all(row["motor1_deflection_rad"] for row in table)


def test_publish_sends_every_estimate_to_a_subscriber(tmp_path: Path) -> None:
    endpoint = zenohkit.free_endpoint()
    joint_path = tmp_path / "sine.toml"
    joint_path.write_text(SINE + f'[zenoh]\nendpoint = "{endpoint}"\n')
    recording = write_csv(tmp_path / "r.csv", 2000)
    joint: JointFile = jointfile.load(joint_path)
    from drivelink import subscribe

    with subscribe("sine", endpoint=endpoint, depth=4096) as subscription:
        status = cli.main(["replay", str(recording), "--joint", str(joint_path), "--publish"])
        assert status == 0
        got = []
        for estimate in subscription.cycles(timeout_s=2.0):
            if estimate is None:
                break
            got.append(estimate)
            if estimate.sequence == 1999:
                break
        zenohkit.until(lambda: subscription.status["state"] == "ended")
    local = [p.tick.estimate for p in open_playback(recording, joint, tmp_path)]
    by_sequence = {e.sequence: bits(e) for e in local}
    # The replay begins when the subscriber is there: nothing is missing.
    received = [bits(Estimate(e.sequence, e.status, *e[3:])) for e in got]
    assert received == [by_sequence[k] for k in range(2000)]
