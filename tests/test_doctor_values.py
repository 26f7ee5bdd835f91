"""What the doctor reads of a joint that moves: signs and units against each other, and one grid for all values."""

import itertools
import math

import pytest
from canopenkit import Slave, Wire, drive_objects, joint_text

from drivelink.canopen.bus import run_program
from drivelink.canopen.layout import Signal, roles
from drivelink.canopen.node import survey_node
from drivelink.doctor import Section
from drivelink.doctor.livevalues import Asked, Series, record_of
from drivelink.doctor.motion import judge_motion
from drivelink.jointfile import parse
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
