import itertools
import json
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path

import can
import daemonkit
import joints
import numpy as np
import pytest
from canopenkit import Item, Slave, Wire, drive_objects, eds_text
from rich.console import Console
from zenohkit import free_endpoint

from drivelink.canopen import scan as scanning
from drivelink.canopen.bus import run_program
from drivelink.canopen.guard import check_frame
from drivelink.canopen.layout import NodeLayout, roles
from drivelink.canopen.node import survey_node
from drivelink.canopen.passive import PassiveConfigurator
from drivelink.canopen.pdo import decode
from drivelink.canopen.scan import _identify, listen, scan
from drivelink.cli import main
from drivelink.cli import new as cli_new
from drivelink.demo.simulate import network_from_joint, world_from_joint
from drivelink.doctor import Report, Section, examine, examine_eds, nodes
from drivelink.doctor.livevalues import Asked, Heard, record_of
from drivelink.doctor.motion import judge_record
from drivelink.doctor.nodes import _describe_node
from drivelink.jointfile import parse
from drivelink.notice import Severity

REPOSITORY = Path(__file__).parents[1]
CHANNELS = itertools.count()
OURS = sorted((REPOSITORY / "sim/eds").glob("*.eds"))


def joint_on(channel, extra="", encoder=""):
    return f"""
name = "elbow"
[[motor]]
inertia_kg_m2 = 0.1
[motor.transmission]
model = "linear"
parameters = {{ k_nm_rad = 100.0 }}
[motor.drive]
node_id = 5
counts_per_rev = 8192
gear_ratio = 20.0
torque_constant_nm_a = 0.05
{extra}
[link.encoder]
source = "cia406"
node_id = 9
{encoder}
[link.dynamics]
inertia_kg_m2 = 0.2
[bus]
channel = "{channel}"
sdo_timeout_s = 0.3
[zenoh]
endpoint = "{free_endpoint()}"
"""


@pytest.fixture
def rig():
    channel = f"doctor-{next(CHANNELS)}"
    with daemonkit.served(parse(joint_on(channel))):
        yield channel


def texts(report, severity=None):
    return [
        f"{finding.subject}: {finding.text}"
        for section in report.sections
        for finding in section.notices
        if severity is None or finding.severity is severity
    ]


def test_a_healthy_bus_is_found_healthy_and_nothing_is_written(rig):
    sent = []
    with can.Bus(interface="virtual", channel=rig) as spy:
        report = examine(parse(joint_on(rig)), Path(), 0.5)
        while (message := spy.recv(0.0)) is not None:
            sent.append((message.arbitration_id, bytes(message.data)))
    said = "\n".join(texts(report))
    assert report.worst < Severity.ERROR, said
    for expected in ("CiA 402 (drive)", "CiA 406 (encoder)", "the cycle needs"):
        assert expected in said
    offered = {
        f.fix: f.text for section in report.sections for f in section.notices if f.subject == "cross-check"
    }
    for fix, begin in {
        '[motor.drive] checks = ["current"]': "current (0x6078:00) can be compared with torque",
        '[motor.drive] checks = ["velocity", "current"]': "all of them",
        "[bus] sync_counter_overflow = 240": "a SYNC counter ",
        '[motor.drive] second_encoder = "0x60E4:01"': "second encoder (0x60E4:01)",
    }.items():
        assert offered[fix].startswith(begin)
    out = Console(record=True, width=120, force_terminal=True)
    report.show(out)
    shown = out.export_text()
    assert shown.count("can be compared with torque") == shown.count("sync_counter_overflow") == 1
    assert "1 more, as with node 5" in shown
    questions = [(cob_id, data) for cob_id, data in sent if cob_id == 0 or 0x601 <= cob_id <= 0x67F]
    assert len(questions) > 127
    for cob_id, data in questions:  # uploads and their segments only
        check_frame(cob_id, data)
        assert cob_id != 0 and data[0] >> 5 in (2, 3, 4)


def live(change=lambda text: text, seconds=5.0):
    """What the doctor says of a joint that moves, its joint file changed; no clock is read.

    A SYNC moves the world on by a millisecond, and an SDO takes one.
    """
    channel = f"doctor-{next(CHANNELS)}"
    section = Section("Units and signs")
    joint = parse(change(joint_on(channel)))
    virtual = {"interface": "virtual", "channel": channel}
    with can.Bus(**virtual) as bus, can.Bus(**virtual) as ours:
        world = world_from_joint(parse(joint_on(channel)))
        network = network_from_joint(parse(joint_on(channel)), bus, world=world)

        def step():
            ours.send(can.Message(arbitration_id=0x80, is_extended_id=False))
            network.poll()

        surveys = [run_program(survey_node(role), ours, idle=step) for role in roles(joint)]
        readings = run_program(Asked(surveys, lambda: world.time_s).program(seconds), ours, idle=step)
    judge_record(section, joint, record_of(readings, 1, True))
    return section


@pytest.mark.parametrize(
    ("old", "new", "said", "line"),
    [
        ("", "", "no unit or sign of positions and torque looks wrong", ""),
        ("torque_constant_nm_a = 0.05", 'torque_constant_nm_a = 50.0\ntorque_source = "current"',
         "the motor torque looks like N·mm", "motor[1].drive.torque_constant_nm_a = 0.05"),
    ],
)  # fmt: skip
def test_a_moving_joint_passes_the_gate_of_recordings_and_a_fault_is_named_with_the_line_to_paste(
    old, new, said, line
):
    (finding,) = live(lambda text: text.replace(old, new, 1)).notices
    assert finding.severity is (Severity.ERROR if line else Severity.OK), finding
    assert said in finding.text and line in (finding.fix or "")


def test_where_samples_are_lost_what_seems_right_is_no_verdict(monkeypatch):
    monkeypatch.setattr("drivelink.doctor.motion._is_sparse", lambda _: True)
    (finding,) = live().notices  # and no "no problem found"
    assert finding.severity is Severity.WARNING and finding.fix.startswith("this machine is too busy")


def test_too_short_a_look_and_a_joint_at_rest_are_no_judgement():
    (finding,) = live(seconds=1.0).notices
    assert finding.severity is Severity.INFO and "too short" in finding.text
    assert "the joint moves: look longer" in finding.fix  # it is not told to move what moves
    section = Section("Units and signs")
    for sequence in (np.arange(9000), np.arange(9000) * 2):
        record = replace(joints.recorded(*np.zeros((3, 9000))), sequence=sequence)
        judge_record(section, parse(joint_on("still")), record)
    at_rest, busy = section.notices
    assert "move the joint during the check" in at_rest.fix
    assert busy.severity is Severity.WARNING
    assert "samples are missing" in busy.text and busy.fix.startswith("this machine is too busy")


def test_a_bus_that_may_not_be_touched_is_judged_by_its_frames():
    text = daemonkit.vsa_text() + '[sim.excitation]\nkind = "rich"\n'
    frames = []
    with daemonkit.rig(parse(text)) as made:
        layouts = list(made.daemon.layouts.values())
        with can.Bus(interface="virtual", channel=made.joint.bus.channel) as spy:
            for _ in range(5):
                made.run(500)
                while (message := spy.recv(0.0)) is not None:
                    frames.append(message)
    passive = text.replace("[bus]", '[bus]\nconfigure = false\nsync = "follow"')
    # Of the encoder: the map is the real one, what the joint file says of it is not.
    for direction in (1, -1):
        joint = parse(passive.replace('source = "cia406"', f'source = "cia406"\ndirection = {direction}'))
        configurator = PassiveConfigurator([joint])
        configurator.adopt([turned(one) if one.motor is None and direction < 0 else one for one in layouts])
        heard, syncs, section = Heard(joint, configurator), 0, Section("Units and signs")
        for message in frames:
            syncs += message.arbitration_id == 0x80
            message.timestamp = 1e9 + 1e-3 * syncs
            heard.feed(message)
        record = record_of(heard.readings(), 2, True)
        assert len(record) > 2000
        judge_record(section, heard.joint, record)
        (finding,) = section.notices
        assert finding.severity is (Severity.ERROR if direction < 0 else Severity.OK), finding
    assert "the link position has the wrong sign" in finding.text
    assert "link.encoder.direction = 1" in finding.fix


def turned(layout):
    """The layout of an encoder whose sign is believed to be the other one."""
    tpdos = tuple(
        replace(tpdo, objects=tuple(replace(mapped, scale=-mapped.scale) for mapped in tpdo.objects))
        for tpdo in layout.tpdos
    )
    return replace(layout, tpdos=tpdos)


@pytest.mark.parametrize(
    ("old", "new", "severity", "words"),
    [
        ("counts_per_rev = 8192", "counts_per_rev = 4096", Severity.WARNING,
         ("counts per motor revolution", "8192", "4096")),
        ("node_id = 5", "node_id = 6", Severity.ERROR, ("node 6", "does not answer, only node 5")),
        ('channel = "doctor', 'channel = "empty', Severity.ERROR, ("no node answers",)),
        ("[bus]", '[bus]\ninterface = "socketcan"', Severity.ERROR, ("doctor-",)),
        ("node_id = 5", 'node_id = 5\neds = "elmo.eds"', Severity.WARNING, ("elmo.eds is of vendor",)),
    ],
)  # fmt: skip
def test_what_does_not_agree_with_the_bus_is_one_finding(rig, old, new, severity, words, tmp_path):
    source = next(path for path in OURS if "elmo" in path.name)
    (tmp_path / "elmo.eds").write_bytes(source.read_bytes())
    report = Report()
    nodes.examine_bus(report, parse(joint_on(rig).replace(old, new, 1)), tmp_path, 0.1, ())
    said = texts(report, severity)
    assert [line for line in said if all(word in line for word in words)], said


def sheet_of(*addresses, tmp_path):
    """What is said of a data sheet with these objects and two empty maps."""
    objects = {f"x{address}": (4, "") for address in addresses} | {"x1A00": (7, "")}
    for n in range(2):
        pdo, mapping = f"x{0x1800 + n:X}", f"x{0x1A00 + n:X}"
        objects |= {f"{pdo}sub1": (7, f"0x80000{n + 1}81"), f"{pdo}sub2": (5, 255), f"{mapping}sub0": (5, 0)}
        objects[f"{mapping}sub1"] = (7, "")
    path = tmp_path / "nano.eds"
    path.write_text(eds_text("VendorName=Nano\nProductName=NANO 7\nVendorNumber=0x26C", **objects))
    return examine_eds(path)


def test_of_a_sheet_every_link_encoder_is_named_and_only_what_run_uses_is_mapped(tmp_path):
    report = sheet_of("6064", "6077", "6041", "606C", "60E4sub1", "60E4sub2", tmp_path=tmp_path)
    said = texts(report)
    (line,) = [line for line in said if line.startswith("link position")]
    assert "sensorless" in line and "by link.encoder.object, 0x60E4:02" in line
    (line,) = [line for line in said if line.startswith("cross-check: second encoder")]
    assert "0x60E4:02" in line
    assert any(line.startswith("nano.eds: NANO 7, vendor 0x26C, ") for line in said)  # the maker only once
    mapped = [entry for frame in report.sections[0].facts["mapping"] for entry in frame["objects"]]
    assert mapped and not any(entry.startswith("0x606C") for entry in mapped)
    out = Console(record=True, width=120, force_terminal=True)
    report.show(out)
    assert "this device gives what is needed" in out.export_text()


def test_the_command_prints_one_json_object(capsys):
    assert main(["doctor", "--eds", str(OURS[0]), "--json"]) == 0
    printed = json.loads(capsys.readouterr().out)
    assert printed["schema"] == "drivelink.doctor/1"
    assert printed["verdict"] in ("ok", "info", "warning")
    assert {"section", "severity", "subject", "text", "fix"} == set(printed["findings"][0])


def test_a_placeholder_that_is_still_there_is_found(tmp_path, capsys):
    path = tmp_path / "elbow.toml"
    assert main(["new", str(path), "--interface", "virtual", "--channel", "nobody"]) == 0
    for inertia, found in (("0.1", True), ("0.25", False)):
        path.write_text(path.read_text().replace("inertia_kg_m2 = 0.1 ", f"inertia_kg_m2 = {inertia} "))
        capsys.readouterr()
        main(["doctor", str(path), "--json", "--seconds", "0.1"])
        assert ("placeholder" in capsys.readouterr().out) is found


def test_scanning_asks_every_id_and_listening_counts_what_is_not_canopen_too():
    wire = Wire([Slave(3, drive_objects(3)), Slave(77, drive_objects(77))])
    wire.put(0x705, b"\x05")  # alive, but without SDO
    found, traffic = scan(wire)
    assert (found, len(wire.sent)) == ([3, 5, 77], 127)
    assert traffic.heartbeats == {5: "operational"}
    wire.queue.append(can.Message(is_error_frame=True))
    wire.queue.append(can.Message(arbitration_id=0x12345, is_extended_id=True))
    wire.queue.append(can.Message(arbitration_id=0x181, is_extended_id=False, is_fd=True, data=bytes(12)))
    traffic = listen(wire, 0.02)
    assert (traffic.error_frames, traffic.counts) == (1, {0x181: 1})


def encoder_sheet(count, entry):
    return eds_text(
        x1000=(7, "0x20196"), x6004=(7, ""), x6501=(7, 65536), x1800sub1=(7, "$NODEID+0x180"), x1800sub2=(5, 1),
        x1A00sub0=(5, count), x1A00sub1=(7, entry),
    )  # fmt: skip


@pytest.mark.parametrize("mappable", [0, 1])
def test_an_encoder_whose_position_cannot_be_mapped_does_not_pass(tmp_path, mappable):
    path = tmp_path / "encoder.eds"
    path.write_text(encoder_sheet(0, "").replace("PDOMapping=1", f"PDOMapping={mappable}"))
    assert main(["doctor", "--eds", str(path)]) == (0 if mappable else 1)
    said = texts(examine_eds(path), Severity.ERROR)
    assert said == [] or any("0x6004:00 is there, but cannot be mapped into a TPDO" in line for line in said)
    assert bool(said) != bool(mappable)


def test_passive_nothing_is_sent_and_the_map_of_a_data_sheet_is_offered_to_paste(rig, tmp_path):
    fixed = encoder_sheet(1, "0x60040020").replace("AccessType=rw", "AccessType=const")
    (tmp_path / "encoder.eds").write_text(fixed)
    text = joint_on(rig, encoder='eds = "encoder.eds"')
    text = text.replace("[bus]", '[bus]\nconfigure = false\nsync = "follow"')
    with can.Bus(interface="virtual", channel=rig) as spy:
        report, heard = examine(parse(text), tmp_path, 0.3), []
        while (message := spy.recv(0.0)) is not None:
            heard.append(message.arbitration_id)
    assert not [cob_id for cob_id in heard if cob_id in (0, 0x80) or 0x601 <= cob_id <= 0x67F]
    errors, said = " ".join(texts(report, Severity.ERROR)), " ".join(texts(report))
    assert "nobody makes SYNC" in errors and "mapping is not known" in errors
    line = 'tpdo = [{ cob_id = 0x189, objects = ["0x6004:00:32"], default = true }]'
    assert f"in [link.encoder] {line}" in said and "has this map" not in said
    pasted = parse(text.replace("eds =", f"{line}\neds ="))
    assert "0x6004" not in " ".join(texts(examine(pasted, tmp_path, 0.1), Severity.WARNING))


def test_a_passive_bus_is_judged_by_what_the_running_daemon_has_learnt(rig, monkeypatch):
    active = parse(joint_on(rig))
    with can.Bus(interface="virtual", channel=rig) as bus:
        surveys = [run_program(survey_node(role), bus, active.bus) for role in roles(active)]
    known = [
        NodeLayout(node_id=one.role.node_id, motor=one.role.motor, tpdos=decode(one.tpdos, one.available))
        for one in surveys
    ]
    joint = parse(joint_on(rig).replace("[bus]", '[bus]\nconfigure = false\nsync = "follow"'))
    for served, says in (((), "no daemon of elbow runs"), ((joint.name,), "as the running daemon knows it")):
        monkeypatch.setattr(nodes, "daemon_mapping", lambda *_: known)
        report = Report()
        nodes.examine_bus(report, joint, Path(), 0.1, served)
        assert ("mapping is not known" in " ".join(texts(report))) is not bool(served)
        assert says in " ".join(texts(report))


def test_words_of_a_drive_do_not_reach_the_terminal_as_commands(capsys):
    objects = drive_objects(5)
    objects[0x1008, 0] = Item(b"\x1b]0;owned\x07\x9b2J[red]servo", 19)
    node = run_program(_identify(5), Wire([Slave(5, objects)]))
    report = Report()
    section = report.section("Nodes")
    section.ok("node 5", _describe_node(node))
    section.ok("\x1b[2Jnode 6", "\x9b2J\u202eother")
    report.show(Console())
    shown = capsys.readouterr().out + str(report.as_dict())
    assert "]0;owned2J[red]servo" in shown
    assert not set("\x1b\x07\x9b\u202e") & set(shown)


def test_in_a_pipe_nothing_is_folded_or_padded(capsys):
    report = Report()
    section = report.section("Machine")
    section.warn("timer", "late " * 40, "another kernel")
    section.ok("kernel", "Linux")
    report.show(Console())
    lines = capsys.readouterr().out.splitlines()
    assert [line for line in lines if line != line.rstrip()] == [] and len(lines) == 6, lines
    assert lines[1].count("late") == 40 and lines[2].strip() == "fix: another kernel"


class Babbler(Slave):
    """Answers for its device type, and to every other question with something else."""

    def handle(self, cob_id, data):
        if data[1:4] != b"\x00\x10\x00":
            return [(cob_id - 0x80, b"\x43\xff\xff\xff" + bytes(4))] if cob_id == 0x600 + self.node else []
        return super().handle(cob_id, data)


def test_nodes_that_do_not_answer_what_is_asked_get_a_limited_time_and_what_was_not_asked_is_said(
    monkeypatch, tmp_path, capsys
):
    wire = Wire([Babbler(node, drive_objects(node)) for node in range(1, 128)])
    monkeypatch.setattr(scanning, "ASKED_S", 0.2)
    monkeypatch.setattr(nodes, "open_bus", lambda _: nullcontext(wire))
    report = Report()
    nodes.examine_bus(report, parse(joint_on("babble")), Path(), 0.1)
    said = " ".join(texts(report))
    assert said.count("was not asked further: the time for it is over") == 2  # ours
    assert "125 more: not in the joint file, not asked for want of time: node 1," in said
    monkeypatch.setattr(cli_new, "open_bus", lambda _: nullcontext(wire))
    path = str(tmp_path / "elbow.toml")
    assert main(["new", path, "--scan"]) == 5
    assert "127 nodes answer, 127 of them were not asked" in capsys.readouterr().err
    assert not Path(path).exists()
