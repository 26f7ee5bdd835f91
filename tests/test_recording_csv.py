"""CSV recordings: what is understood, what is mended and said, and what is one clear line."""

import logging
import shutil
import subprocess
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivelink import cli
from drivelink.errors import RecordingError
from drivelink.jointfile import load, parse
from drivelink.recording import read
from drivelink.recording.columns import parse_column_map
from drivelink.recording.grid import find_grid

SINGLE = 'name = "j"\n[[motor]]\ninertia_kg_m2 = 0.1\n'
DRIVE = "[motor.drive]\nnode_id = 1\ntorque_constant_nm_a = 0.05\ngear_ratio = 50.0\n"
COLUMNS = ("time_s", "motor1_position_rad", "motor1_torque_nm", "link_position_rad")


def rows(n=50, period_s=0.001, start_s=0.0):
    k = np.arange(n)
    return np.column_stack((start_s + k * period_s, np.sin(0.01 * k), np.cos(0.01 * k), np.sin(0.011 * k)))


def write(path, table, names=COLUMNS, separator=","):
    lines = [separator.join(names), *(separator.join(map(repr, row)) for row in table.tolist())]
    path.write_text("\n".join(lines) + "\n")
    return path


@pytest.fixture
def said(caplog):
    caplog.set_level(logging.WARNING, "drivelink.recording")
    return caplog


@contextmanager
def one_line(begins, *parts):
    with pytest.raises(RecordingError) as caught:
        yield
    message = str(caught.value)
    assert message.startswith(begins) and all(part in message for part in parts) and "\n" not in message


def test_a_clean_file_comes_back_bit_for_bit(tmp_path, said):
    table = rows()
    record = read(write(tmp_path / "r.csv", table), parse(SINGLE))
    assert record.period_s == 0.001
    assert np.array_equal(record.sequence, np.arange(50))
    assert np.array_equal(record.motor_position_rad[:, 0], table[:, 1])
    assert np.array_equal(record.motor_torque_nm[:, 0], table[:, 2])
    assert record.link_position_rad is not None
    assert np.array_equal(record.link_position_rad, table[:, 3])
    assert record.motor_velocity_rad_s is None
    assert not said.messages


@pytest.mark.parametrize("period_s", [0.00025, 0.0013, 1 / 300, 0.5])
@pytest.mark.parametrize("start_s", [0.0, -3.0, 1_790_000_000.25])
def test_any_rate_is_found_exactly(tmp_path, period_s, start_s):
    record = read(write(tmp_path / "r.csv", rows(400, period_s, start_s)))
    # UNIX time as a float has steps of 2.4e-7 s; a round period is still found as such.
    assert record.period_s == pytest.approx(period_s, rel=1e-12 if start_s <= 0 else 1e-5)
    assert len(record) == 400 and record.sequence[-1] == 399


def test_a_clock_that_is_50_ppm_off_shifts_no_sample(tmp_path):
    table = rows(60_000)
    table[:, 0] *= 1 + 50e-6
    record = read(write(tmp_path / "r.csv", table))
    assert record.sequence[-1] == 59_999
    assert record.time_s[-1] == pytest.approx(table[-1, 0], abs=0.25e-3)


def test_a_current_becomes_a_torque_at_the_joint(tmp_path):
    table, names = rows(), ("time_s", "motor1_position_rad", "motor1_current_a", "link_position_rad")
    path = write(tmp_path / "r.csv", table, names)
    record = read(path, parse(SINGLE + DRIVE))
    assert record.motor_torque_nm[:, 0] == pytest.approx(table[:, 2] * 0.05 * 50.0, rel=1e-15)
    turned = parse("recording.scale = { motor1_torque_nm = -1 }\n" + SINGLE + DRIVE)  # as the gate says
    assert np.array_equal(read(path, turned).motor_torque_nm, -record.motor_torque_nm)
    with one_line("", "motor[1].drive.torque_constant_nm_a"):
        read(path, parse(SINGLE))


def test_missing_rows_are_a_gap_of_whole_periods(tmp_path, said):
    table = np.delete(rows(), [10, 11, 30], axis=0)
    record = read(write(tmp_path / "r.csv", table))
    assert np.array_equal(record.sequence, np.delete(np.arange(50), [10, 11, 30]))
    assert "2 gaps, 3 of 50 samples missing, the longest 0.002 s" in said.text


def test_rows_with_nan_are_gaps_for_a_fit_and_rows_for_a_replay(tmp_path, said):
    path, table = tmp_path / "r.csv", rows()
    table[20, 1], table[21, 3] = np.nan, np.inf
    lines = write(path, table).read_text().split("\n")
    time_s, _, *rest = lines[11].split(",")
    path.write_text("\n".join([*lines[:11], ",".join((time_s, "", *rest)), *lines[12:]]))  # an empty cell
    record = read(path)
    assert np.array_equal(record.sequence, np.delete(np.arange(50), [10, 20, 21]))
    assert "taken as gaps: 3 rows with missing values" in said.text
    kept = read(path, keep_nan=True)
    assert len(kept) == 50 and np.isnan(kept.motor_position_rad[20, 0])


def test_repeated_stamps_are_left_out_and_reported(tmp_path, said):
    table = np.insert(rows(), 10, rows()[9], axis=0)
    record = read(write(tmp_path / "r.csv", table))
    assert np.array_equal(record.sequence, np.arange(50))
    assert "omitted: 1 row equal to the row before" in said.text


def test_stamps_that_jitter_like_arrival_times_are_put_on_the_grid(tmp_path, said):
    table = np.delete(rows(2000), slice(1000, 1005), axis=0)
    # Delays are one-sided, up to two periods, and nothing overtakes: some stamps are the same.
    table[:, 0] = np.maximum.accumulate(table[:, 0] + np.random.default_rng(1).exponential(2e-4, 1995))
    record = read(write(tmp_path / "r.csv", table))
    # The mean delay may drift by a tenth of a period from one end to the other.
    assert record.period_s == pytest.approx(1e-3, rel=1e-4)
    assert np.array_equal(record.sequence, np.delete(np.arange(2000), slice(1000, 1005)))
    assert "taken as arrival times" in said.text


@pytest.mark.parametrize("spread", [0.3, 0.9])
def test_irregular_stamps_that_the_motion_follows_are_resampled(spread, tmp_path, said):
    time = np.cumsum(1e-3 * np.random.default_rng(2).uniform(1.0 - spread, 1.0 + spread, 4000))
    table = np.column_stack((time, np.sin(20.0 * time), np.cos(20.0 * time), 0.5 * np.sin(20.0 * time)))
    record = read(write(tmp_path / "r.csv", table))
    at = record.start_s + record.period_s * record.sequence
    assert "resampled" in said.text
    assert np.max(np.abs(record.motor_position_rad[:, 0] - np.sin(20.0 * at))) < 1e-3
    # A held torque is late by half a step; its impulse is kept.
    impulse = record.period_s * np.sum(record.motor_torque_nm[:, 0])
    assert impulse == pytest.approx(np.sum(table[:-1, 2] * np.diff(time)), abs=2e-3)


@pytest.mark.skipif(shutil.which("awk") is None, reason="no awk")
@pytest.mark.parametrize(
    "stamps",
    [
        lambda t: np.sort(np.random.default_rng(3).uniform(0.0, t[-1], len(t))),
        lambda t: np.repeat(t[9::10], 10),
    ],
    ids=["random", "in batches"],
)
def test_stamps_that_say_nothing_are_refused_with_the_command_that_numbers_the_rows(stamps, tmp_path):
    table, path = rows(2000), tmp_path / "my run.csv"
    table[:, 0] = stamps(table[:, 0])
    with pytest.raises(RecordingError, match="the motion does not follow them") as refused:
        read(write(path, table))
    command = str(refused.value)[str(refused.value).index("awk ") :]
    subprocess.run(["sh", "-c", command], check=True)
    record = read(tmp_path / "my run-numbered.csv")
    assert record.period_s == pytest.approx(1e-3, rel=0.01)
    assert np.array_equal(record.motor_position_rad[:, 0], table[:, 1])


HEAD = "time_s,motor1_position_rad,motor1_torque_nm\n"


@pytest.mark.parametrize(
    ("content", "line"),
    [
        (lambda t: t[:2], "at least 3 samples, got 2"),
        (lambda t: t[:0], "expected samples below the header, got none"),
        (lambda t: np.column_stack((np.zeros(50), t[:, 1:])), "stands still"),
        (lambda t: np.column_stack((t[:, 0] * np.nan, t[:, 1:])), "at least 3 samples, got 0"),
        (lambda t: np.vstack((t, t)), "time_s runs backwards 1 time"),
        (lambda t: np.column_stack((t[:, 0] * 1e-6, t[:, 1:])), "period_s: expected 1e-06 to 100 s, got 1e-09"),
        (lambda t: np.column_stack((t[:, 0] ** 2, t[:, 1:])), "expected uniform sampling"),
        (lambda t: np.column_stack((t[:, :2], t[:, 2] * np.nan, t[:, 3])), "motor1_torque_nm holds no numeric value"),
        ("", "expected a CSV file with a line of column names"),
        ("0,1,2\n3,4,5\n", "found 0, 1, 2 ([recording.columns] of the joint file says which is which)"),
        ("Zeit [ms];Position Motor 1 [°]\n0;1\n", "found Zeit [ms], Position Motor 1 [°] ("),
        (HEAD.replace("\n", "\r") + "0,1,2\r", "line 1: expected a line feed at its end, got carriage returns alone"),

        ("time_s,motor1_position_rad\n0,1\n1,2\n2,3\n", "expected a column motor1_torque_nm (or motor1_current_a)"),
        ("time_s,motor1_pos_rad,motor1_torque_nm\n0,1,1\n1,2,1\n2,3,1\n", "did you mean it by motor1_pos_rad?"),
        ("time_s,time_s\n0,0\n", "column time_s appears twice"),
        (HEAD + "0,1,2\n0.1,oops,3\n0.2,1,1\n", "line 3: motor1_position_rad: expected a number, got 'oops'"),
        (HEAD + "0,1,2\n0.1,3\n0.2,1,1\n", "line 3: expected 3 columns, got 2"),
        (None, "no such file"),
        (Path.mkdir, "got a folder"),
    ],
)  # fmt: skip
def test_what_is_no_recording_or_cannot_be_mended_is_one_clear_line(tmp_path, content, line):
    path = tmp_path / "r.csv"
    if content is Path.mkdir:
        path.mkdir()
    elif isinstance(content, str):
        path.write_text(content)
    elif content:
        write(path, content(rows()))
    with one_line(f"{path}: ", line):
        read(path)


def comma(value):
    return repr(value).replace(".", ",")


BESIDE = ("utf-8", repr, ",", "\n")
NAMED = ("time_s", "motor1_position_rad", "motor1_torque_nm", "Winkel [°]=link_position_rad")


@pytest.mark.parametrize(
    ("start", "names", "encoding", "number", "separator", "end"),
    [
        ("\ufeff# exported\r\n", COLUMNS, "utf-8", comma, ";", "\r\n"),  # a spreadsheet
        ("sep=,\n", NAMED, *BESIDE),  # Excel
        ("", NAMED, "cp1252", *BESIDE[1:]),  # Windows
        ("# measured on a bench, by hand\n# ", NAMED, *BESIDE),
        ("# ", COLUMNS, "utf-8", repr, " ", "\n"),  # numpy
    ],
)
def test_what_other_programs_make_of_a_file_is_read(start, names, encoding, number, separator, end, tmp_path):
    table, path = rows(), tmp_path / "r.csv"
    lines = [separator.join(name.split("=")[0] for name in names)]
    lines += [separator.join(map(number, row)) for row in table.tolist()]
    path.write_bytes((start + end.join([*lines, ""])).encode(encoding))
    record = read(path, names=parse_column_map([name for name in names if "=" in name]))
    assert np.array_equal(record.motor_position_rad[:, 0], table[:, 1])
    assert np.array_equal(record.link_position_rad, table[:, 3])


def test_cells_of_spreadsheets_and_columns_without_a_name_are_read(tmp_path, said):
    path = tmp_path / "r.csv"
    lines = [",".join(("", *COLUMNS)), *(",".join(map(repr, row)) for row in np.c_[:50, rows()].tolist())]
    lines[20] = lines[20].rpartition(",")[0] + ",#N/A"
    lines[21] += " # the belt slipped"
    path.write_text("\n".join([*lines, ""]))
    assert np.array_equal(read(path).sequence, np.delete(np.arange(50), 19))
    assert "ignored" not in said.text


def test_a_last_line_that_a_crash_cut_off_is_left_out(tmp_path, said):
    path = write(tmp_path / "r.csv", rows())
    whole = path.read_bytes()
    for cut in (1, 2, 5, 30):  # without its end, inside its last number, inside another column
        path.write_bytes(whole[:-cut])
        record = read(path)
        assert np.array_equal(record.motor_torque_nm[:, 0], rows()[:49, 2])
        assert "the last line has no end and is omitted" in said.text
        said.clear()


def test_the_joint_says_how_many_motors_there_are(tmp_path):
    two = parse('name = "j"\narrangement = "antagonistic"\n' + "[[motor]]\ninertia_kg_m2 = 0.1\n" * 2)
    with one_line("", "motor2_position_rad"):
        read(write(tmp_path / "r.csv", rows()), two)


def test_a_rigid_joint_needs_no_link_position_and_a_flexible_one_does(tmp_path, capsys):
    path, joint = write(tmp_path / "r.csv", rows()[:, :3], COLUMNS[:3]), tmp_path / "j.toml"
    joint.write_text(SINGLE + '[motor.transmission]\nmodel = "none"\n')
    assert read(path, load(joint)).link_position_rad is None
    assert cli.main(["replay", str(path), "--joint", str(joint)]) == 0
    assert capsys.readouterr().out.splitlines()[0].endswith("observable 0.0 %")  # it has no stiffness
    with pytest.raises(RecordingError, match="link_position_rad"):
        read(path, parse(SINGLE))


@settings(max_examples=60, deadline=None)
@given(st.floats(1e-4, 0.5), st.floats(-1e6, 1e6), st.lists(st.integers(1, 4), min_size=20, max_size=120))
def test_a_grid_with_gaps_is_found_whatever_period_and_origin(period_s, start_s, steps):
    steps = [1, 1, 1] * 80 + steps  # gaps are the exception
    truth = np.concatenate(([0], np.cumsum(steps)))
    grid = find_grid(start_s + truth * period_s, "x")
    assert np.array_equal(grid.sequence, truth)
    # Half a period of error over the whole recording would shift a sample.
    assert abs(grid.period_s - period_s) * truth[-1] < 0.5 * period_s
