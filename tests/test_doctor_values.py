"""What the doctor says of the machine, the CAN interface and SYNC, and of the values of a joint that moves."""

import itertools
import json
import math
from types import SimpleNamespace

import pytest
from canopenkit import Slave, Wire, drive_objects, joint_text

from drivelink.canopen.bus import run_program
from drivelink.canopen.layout import Signal, roles
from drivelink.canopen.node import survey_node
from drivelink.cli import main
from drivelink.doctor import Section
from drivelink.doctor.livevalues import Asked, Series, record_of
from drivelink.doctor.machine import Daemons, examine_interface, examine_machine, judge_link, judge_sync
from drivelink.doctor.motion import judge_motion
from drivelink.jointfile import BusSection, parse
from drivelink.notice import Severity


def survey(**sections):
    slave = Slave(5, drive_objects(5))
    text = joint_text(drive="velocity = true", **sections)
    return run_program(survey_node(roles(parse(text))[0]), Wire([slave])), slave


def test_a_value_that_is_not_there_before_the_drive_runs_is_left_out():
    found, slave = survey()
    answer = slave._sdo
    slave._sdo = lambda data: (
        b"\x80" + data[1:4] + b"\x22\0\0\x08" if data[1:3] == b"\x6c\x60" else answer(data)
    )
    readings = run_program(Asked([found]).program(0.05), Wire([slave]))
    assert (Signal.MOTOR_VELOCITY, 0) not in readings
    assert readings[Signal.MOTOR_POSITION, 0].values


def moving(ratio=1.0, link=None, amplitude=0.5):
    times = [0.005 * k for k in range(400)]
    position = [amplitude * math.sin(3 * t) for t in times]
    values = {(Signal.MOTOR_POSITION, 0): position}
    values[Signal.MOTOR_VELOCITY, 0] = [amplitude * 3 * math.cos(3 * t) / ratio for t in times]
    if link is not None:
        values[Signal.LINK_POSITION, None] = [link * x for x in position]
    return {channel: Series(times, each, [0.001] * len(each)) for channel, each in values.items()}


@pytest.mark.parametrize(
    ("readings", "severity", "expected"),
    [
        (moving(), Severity.OK, "velocity agrees"),
        (moving(-1.0), Severity.WARNING, "opposite signs"),
        (moving(4.0), Severity.WARNING, "4 times as fast"),
        (moving(amplitude=1e-7), Severity.INFO, "stands still"),
        (moving(link=1.02), Severity.OK, "the link follows"),
        (moving(link=-1.0), Severity.WARNING, "moves -1 times as far"),
        (moving(link=20.0), Severity.WARNING, "moves 20 times as far"),
    ],
)
def test_signs_and_units_are_checked_against_each_other(readings, severity, expected):
    section = Section("Node 5")
    judge_motion(section, survey(link="[link.encoder]\ncounts_per_rev = 65536")[0], readings)
    finding = next(finding for finding in section.notices if expected in finding.text)
    assert finding.severity is severity


def test_positions_are_sampled_over_the_roll_over():
    node, slave = survey(link="[link.encoder]\ncounts_per_rev = 65536")
    slave.objects[0x6064, 0].value = 0x7FFFFFFF
    ticks = iter(range(10_000))

    def clock():
        k = next(ticks)
        slave.objects[0x6064, 0].value = (0x7FFFFFF0 + k) & 0xFFFFFFFF
        return 0.01 * k

    readings = run_program(Asked([node], clock).program(1.0), Wire([slave]))
    positions = readings[Signal.MOTOR_POSITION, 0].values
    assert all(0 < after - before < 1e-4 for before, after in itertools.pairwise(positions))


CHANNELS_READ = ((Signal.MOTOR_POSITION, 0), (Signal.MOTOR_TORQUE, 0), (Signal.LINK_POSITION, None))


def sines(times):
    """A sine, by each channel at its own times: those of all, and so long the answers took."""
    return {
        channel: Series(list(ts), [math.sin(2.0 * t) for t in ts], [0.001] * len(ts))
        for channel, ts in zip(CHANNELS_READ, times, strict=True)
    }


def test_values_read_one_after_the_other_are_put_on_one_grid():
    """Each at its own time: a sine that is read late by half a turn is no other sine."""
    readings = sines([[0.01 * k + 0.003 * j for k in range(500)] for j in range(3)])
    torque = readings[CHANNELS_READ[1]]
    for k in range(0, 500, 7):  # an answer that was long in coming, its time a bad guess
        torque.times_s[k] += 0.05
        torque.waits_s[k] = 0.1
    record = record_of(readings, 1, True)
    assert record.period_s == pytest.approx(0.01)
    # a straight line between two readings is off by at most (2 rad/s)² (0.01 s)² / 8, by four times that
    # where one between them is left out
    assert abs(record.motor_torque_nm[:, 0] - record.motor_position_rad[:, 0]).max() < 2.5e-4
    assert abs(record.link_position_rad - record.motor_position_rad[:, 0]).max() < 1e-4


def test_where_the_nodes_stall_there_is_a_gap_and_after_long_the_recording_ends():
    times = [0.01 * k + 0.5 * (k >= 200) + 0.1 * (k >= 400) for k in range(600)]
    record = record_of(sines([times] * 3), 1, True)
    assert len(record) == pytest.approx(400, abs=2)
    assert record.motor_position_rad[0, 0] == pytest.approx(math.sin(2.0 * 2.5), abs=1e-3)
    steps = [after - before for before, after in itertools.pairwise(record.sequence)]
    assert max(steps) in (11, 12) and steps.count(1) == len(steps) - 1  # 0.11 s, by where the grid lies


def test_a_timer_that_was_late_by_a_period_once_is_why_cycles_are_left_out(monkeypatch):
    """The daemon says of such a machine that the doctor says why."""
    now_ns, sleeps = [0], iter([0.0] * 50 + [0.002] + [0.0] * 1000)

    def sleep(seconds):
        now_ns[0] += int((seconds + next(sleeps)) * 1e9)

    monkeypatch.setattr(
        "drivelink.doctor.machine.time", SimpleNamespace(monotonic_ns=lambda: now_ns[0], sleep=sleep)
    )
    section = Section("Machine")
    examine_machine(section, 0.001, 0.5)
    (timer,) = (finding for finding in section.notices if finding.subject == "timer")
    assert timer.severity is Severity.WARNING and "leaves a cycle out" in timer.text and timer.fix


@pytest.mark.parametrize(("limit", "severity"), [(1024, Severity.WARNING), (8192, Severity.OK)])
def test_the_machine_is_examined_and_every_warning_has_a_fix(monkeypatch, capsys, limit, severity):
    monkeypatch.setattr("drivelink.doctor.machine.resource.getrlimit", lambda _: (limit, limit))
    section = Section("Machine")
    examine_machine(section, 0.001, 0.05)
    by_subject = {finding.subject: finding for finding in section.notices}
    assert {"kernel", "real time", "memory", "files", "timer"} <= set(by_subject)
    assert all(finding.fix for finding in section.notices if finding.severity is Severity.WARNING)
    assert by_subject["files"].severity is severity and str(limit) in by_subject["files"].text
    assert main(["doctor", "--seconds", "0.05"]) in (0, 1)  # without a joint it is the machine
    shown = capsys.readouterr().out
    assert "kernel" in shown and "timer" in shown


LINK = {
    "ifname": "can0", "link_type": "can", "flags": ["NOARP", "UP", "LOWER_UP"], "txqlen": 10, "mtu": 16,
    "linkinfo": {
        "info_kind": "can", "info_xstats": {"bus_off": 2},
        "info_data": {"state": "ERROR-PASSIVE", "berr_counter": {"tx": 128, "rx": 3}, "restart_ms": 0,
                      "bittiming": {"bitrate": 500000}},
    },
    "stats64": {"rx": {"dropped": 7}},
}  # fmt: skip


def test_a_sick_interface_is_seen_in_every_way_and_a_healthy_one_has_no_warning():
    section = Section("CAN")
    judge_link(section, LINK, BusSection(interface="socketcan", channel="can0"))
    said = "\n".join(str(finding) for finding in section.notices)
    for expected in (
        "runs at 500 kbit/s, the joint file says 1000", "error-passive, error counters: tx 128, rx 3",
        "transmit queue of 10", "txqueuelen 1000", "does not recover from bus-off", "restart-ms 100",
        "bus-off 2 times", "7 received frames were dropped",
    ):  # fmt: skip
        assert expected in said
    link = json.loads(json.dumps(LINK))
    link["txqlen"], link["stats64"]["rx"]["dropped"] = 1000, 0
    data = link["linkinfo"]["info_data"]
    data.update(state="ERROR-ACTIVE", restart_ms=100, bittiming={"bitrate": 1_000_000})
    del link["linkinfo"]["info_xstats"]
    section = Section("CAN")
    judge_link(section, link, BusSection(interface="socketcan", channel="can0"))
    assert {finding.severity for finding in section.notices} == {Severity.OK}


@pytest.mark.parametrize(
    ("change", "expected"),
    [({"flags": ["NOARP"]}, "is down"), ({"link_type": "ether"}, "is not a CAN interface")],
)
def test_an_interface_that_cannot_work_is_an_error_with_a_fix_and_a_virtual_bus_is_explained(
    change, expected
):
    section = Section("CAN")
    judge_link(section, {**LINK, **change}, BusSection(interface="socketcan", channel="can0"))
    (finding,) = [f for f in section.notices if f.severity is Severity.ERROR]
    assert expected in finding.text and finding.fix
    examine_interface(section, BusSection())
    assert "one process" in section.notices[-1].text


def sync(period_s, jitter_s=0.0, count=500):
    return [k * period_s + (jitter_s if k % 2 else 0.0) for k in range(count)]


OURS_RUNS, WRIST_RUNS = Daemons(ours=True, others=()), Daemons(ours=False, others=("wrist",))


@pytest.mark.parametrize(
    ("stamps", "bus", "daemons", "severity", "words"),
    [
        (sync(0.001), {"sync": "follow"}, None, Severity.OK, "every 1.000 ms"),
        (sync(0.002), {"sync": "follow", "period_s": 0.001}, None, Severity.ERROR, "the joint file says 1 ms"),
        (sync(0.002), {"sync": "follow"}, None, Severity.OK, "every 2.000 ms"),
        ([], {"sync": "follow"}, None, Severity.ERROR, "nobody makes SYNC"),
        ([], {}, None, Severity.OK, "drivelink run will"),
        (sync(0.001), {}, None, Severity.WARNING, "another master produces it"),
        (sync(0.001), {}, OURS_RUNS, Severity.OK, "produced by the drivelink daemon"),
        (sync(0.001), {}, WRIST_RUNS, Severity.WARNING, "wrist"),
    ],
)  # fmt: skip
def test_sync_is_judged_by_rate_and_role(stamps, bus, daemons, severity, words):
    section = Section("Bus")
    judge_sync(section, stamps, BusSection(**bus), *([daemons] if daemons else []))
    (finding,) = section.notices
    assert finding.severity is severity and words in finding.text
    if daemons is not None:  # our own daemon is no reason to follow; two joints belong into one command
        assert "one command" in finding.fix if daemons.others else not finding.fix
