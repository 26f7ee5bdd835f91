"""`--map`: columns of others under our names and in our units; and results for machines, pure."""

import json
import math
from pathlib import Path

import numpy as np
import pytest

from drivelink import cli
from drivelink.errors import JointFileError, RecordingError, UsageError
from drivelink.jointfile import parse
from drivelink.jointfile.columns import UNITS
from drivelink.recording import read
from drivelink.recording.columns import column_map, parse_column_map
from drivelink.recording.formats import FORMATS, Format, open_sink
from drivelink.recording.playback import open_playback

TEXT = """\
name = "sine"
[[motor]]
inertia_kg_m2 = 0.125
viscous_damping_nm_s_rad = 0.8
[motor.transmission]
model = "linear"
"""
JOINT = parse(TEXT)
MAP = [
    "t=time_s:ms",
    "theta [°]=motor1_position_rad:deg",
    "i=motor1_torque_nm:-0.05",
    "q=link_position_rad:mrad",
]


def motion(n: int = 2500) -> np.ndarray:
    """(n, 4) time, motor position, torque, link position of a sprung joint: 150 N·m/rad, two tones."""
    t = np.arange(n) * 0.002
    rates = np.array([[3.0], [7.1]])
    theta = (np.array([[0.2], [0.1]]) * np.sin(rates * t)).sum(axis=0)
    speed = (np.array([[0.2], [0.1]]) * rates * np.cos(rates * t)).sum(axis=0)
    push = (-np.array([[0.2], [0.1]]) * rates**2 * np.sin(rates * t)).sum(axis=0)
    q = 1.3 * theta
    return np.column_stack((t, theta, 0.125 * push + 0.8 * speed - 150.0 * (q - theta), q))


def ours(path: Path, n: int = 2500, nan_row: int | None = None) -> Path:
    header, table = "time_s,motor1_position_rad,motor1_torque_nm,link_position_rad", motion(n)
    if nan_row is not None:
        table[nan_row, 1] = np.nan
    np.savetxt(path, table, fmt="%.17g", delimiter=",", header=header, comments="")
    return path


def theirs(path: Path, header: str = "t;theta [°];i;q;state") -> Path:
    """The same with names, units and signs of its own, decimal commas, and a column of words."""
    rows = [header]
    for t, theta, tau, q in motion().tolist():
        numbers = (t * 1e3, math.degrees(theta), tau / -0.05, q * 1e3)
        rows.append(";".join([*(repr(x).replace(".", ",") for x in numbers), "running"]))
    path.write_text("\n".join(rows) + "\n")
    return path


COLUMN_NAMES = ("motor_position_rad", "motor_torque_nm", "link_position_rad")


def test_columns_of_others_are_read_in_our_names_and_units_also_in_place_of_ours(tmp_path):
    record = read(theirs(tmp_path / "rig.csv"), JOINT, names=parse_column_map(MAP))
    same = read(ours(tmp_path / "r.csv"), JOINT)
    assert record.period_s == same.period_s and np.array_equal(record.sequence, same.sequence)
    for name in COLUMN_NAMES:
        assert np.allclose(getattr(record, name), getattr(same, name), rtol=1e-14, atol=1e-15)
    places = ("link_position_rad", "motor1_position_rad")
    swapped = parse_column_map([f"{a}={b}" for a, b in (places, places[::-1])])
    record = read(tmp_path / "r.csv", JOINT, names=swapped)
    assert np.array_equal(record.motor_position_rad[:, 0], same.link_position_rad)
    assert np.array_equal(record.link_position_rad, same.motor_position_rad[:, 0])
    assert UNITS["_rad_s"]["rpm"] * 60 == UNITS["_rad"]["rev"] == 360 * UNITS["_rad"]["deg"] == 2 * math.pi
    assert parse_column_map(["a=b=time_s:us"])["time_s"] == ("a=b", 1e-6, True, "us")
    assert parse_column_map("a=time_s") == parse_column_map(["a=time_s"])  # a text, not its letters


def test_a_format_with_columns_is_one_entry(tmp_path, monkeypatch):
    entry = Format("arrays", columns=lambda path, _: (dict(np.load(path)), ()))
    monkeypatch.setitem(FORMATS, ".npz", entry)
    record, path = read(ours(tmp_path / "r.csv"), JOINT), tmp_path / "r.npz"
    motor, link = record.motor_position_rad[:, 0], record.link_position_rad
    columns = {"motor1_position_rad": motor, "motor1_torque_nm": record.motor_torque_nm[:, 0]}
    np.savez(path, time_s=record.time_s, link_position_rad=link, **columns)
    assert np.array_equal(read(path, JOINT).motor_torque_nm, record.motor_torque_nm)
    find = pytest.importorskip("drivelink.fleet.storage").find
    assert [one.name for one in find([str(tmp_path)])[0]] == ["r.csv", "r.npz"]  # for `fleet`, too


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ("q", "expected SOURCE=COLUMN"),
        ("=time_s", "expected SOURCE=COLUMN"),
        ("q=link_angle", "with COLUMN one of"),
        ("q=link_position_rad:degree", "expected one of rad, mrad, urad, deg, rev"),
        ("q=link_position_rad:0", "or a factor"),
        ("q=link_position_rad:inf", "or a factor"),
    ],
)
def test_a_mapping_that_cannot_be_is_one_line(text, line):
    with pytest.raises(UsageError) as caught:
        parse_column_map([text])
    assert line in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("axis", "unit", "right"),
    [("rotary", "mm", "deg"), ("linear", "deg", "um"), ("rotary", "kN", "kNm"), ("linear", "rpm", "rad/s")],
)
def test_a_unit_of_the_other_axis_is_refused(axis, unit, right):
    name = next(
        f"motor1_{end}"
        for end in ("position_rad", "velocity_rad_s", "torque_nm")
        if unit in UNITS[end[end.index("_") :]]
    )
    joint = parse(f'axis = "{axis}"\n{TEXT}')
    with pytest.raises(UsageError, match=f"{name}: {unit} is no unit of a {axis} axis: give the factor"):
        column_map(joint, parse_column_map([f"x={name}:{unit}"]))
    declared = f'[recording.columns]\n{name} = {{ name = "x", unit = "{unit}" }}\n'
    with pytest.raises(UsageError, match="is no unit of"):
        column_map(parse(f'axis = "{axis}"\n{TEXT}{declared}'), None)
    assert column_map(joint, parse_column_map([f"x={name}:{right}", "i=motor1_current_a:mA"]))


def test_what_a_mapping_asks_for_in_vain_is_one_line(tmp_path):
    names = parse_column_map([*MAP[:3], "stat=link_position_rad"])
    with pytest.raises(
        RecordingError,
        match=r"--map stat=link_position_rad: no such column 'stat', found .*; did you mean state\?$",
    ):
        read(theirs(tmp_path / "rig.csv"), JOINT, names=names)
    with pytest.raises(UsageError, match="given twice"):
        parse_column_map(["a=time_s", "b=time_s"])
    open_sink(tmp_path / "r.mcap", JOINT).close()
    with pytest.raises(UsageError, match="only CSV files have columns to be named"):
        read(tmp_path / "r.mcap", JOINT, names=names)
    with pytest.raises(UsageError, match=r"rig.csv: --frames: expected a raw CAN log, this one has samples"):
        open_playback(tmp_path / "rig.csv", JOINT, tmp_path, frames=True)
    with pytest.raises(UsageError, match=r"rig.csv: --channel: expected a raw CAN log, this one has samples"):
        open_playback(tmp_path / "rig.csv", JOINT, tmp_path, channel="can1")


COLUMNS = """\
[recording.columns]
time_s = { name = "t", unit = "ms" }
motor1_position_rad = { name = "theta [°]", unit = "deg" }
motor1_torque_nm = { name = "i", unit = 0.05, sign = -1 }
link_position_rad = { name = "q", unit = "mrad" }
"""


def test_the_joint_file_names_columns_once(tmp_path):
    joint, path, own = parse(TEXT + COLUMNS), theirs(tmp_path / "rig.csv"), ours(tmp_path / "r.csv")
    record, same = read(path, joint), read(path, JOINT, names=parse_column_map(MAP))
    for name in COLUMN_NAMES:
        assert np.array_equal(getattr(record, name), getattr(same, name))
    # A file with our own names is read as it is, and --map has the last word.
    assert np.array_equal(read(own, joint).motor_torque_nm, read(own, JOINT).motor_torque_nm)
    swapped = read(path, joint, names=parse_column_map(["q=link_position_rad:rad"]))
    assert np.allclose(swapped.link_position_rad, 1e3 * same.link_position_rad, rtol=1e-14, atol=0.0)
    with pytest.raises(RecordingError, match=r"recording.columns.link_position_rad: no such column 'q'"):
        read(theirs(tmp_path / "x.csv", "t;theta [°];i;angle;state"), joint)


@pytest.mark.parametrize(
    ("line", "said"),
    [
        ('q = { name = "a" }', 'columns: expected names of columns like "motor1_position_rad", got "q"'),
        ('time_s = { name = "a", unit = "deg" }', "columns.time_s.unit: expected one of s, ms"),
        ('time_s = { name = "a", sign = 2 }', "sign"),
        ("time_s = { unit = 's' }", "recording.columns.time_s.name: expected this key, it is missing"),
    ],
)
def test_a_column_of_the_joint_file_that_cannot_be_is_one_line(line, said):
    with pytest.raises(JointFileError) as caught:
        parse(f"{TEXT}[recording.columns]\n{line}\n")
    assert said in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("verb", "declared"), [("replay", False), ("replay", True), ("fit", False), ("diagnose", True)]
)
def test_every_verb_that_reads_takes_the_mapping_and_needs_a_joint(verb, declared, tmp_path, capsys):
    joint = tmp_path / "sine.toml"
    joint.write_text(TEXT + (COLUMNS if declared else ""))
    options = [] if declared else [word for text in MAP for word in ("--map", text)]
    out = ["--out", str(tmp_path / "out")] if verb == "diagnose" else []
    recording = str(theirs(tmp_path / "rig.csv"))
    assert cli.main([verb, recording, "--joint", str(joint), *options, *out]) == 0, capsys.readouterr().err
    assert cli.main([verb, recording]) == 2  # it carries none
    assert "expected --joint FILE, the joint file that it was recorded with" in capsys.readouterr().err


def test_fit_takes_the_joint_from_a_recording_that_carries_it(tmp_path, capsys):
    bus = "[bus]\nperiod_s = 0.002\n"
    path, target = tmp_path / "r.mcap", tmp_path / "fitted.toml"
    joint = parse(TEXT + bus)
    sink = open_sink(path, joint, TEXT + bus + '[provenance]\nremark = "kept"\n')
    for sample in read(ours(tmp_path / "r.csv"), joint).samples():
        sink.sample(sample, sample.sequence * 2_000_000)
    sink.close()
    assert cli.main(["fit", str(path), "--json", "--out", str(tmp_path / "d"), "--write", str(target)]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document == json.loads((tmp_path / "d" / "fit.json").read_text())
    (one,) = document["transmissions"]
    assert one["parameters"]["k_nm_rad"] == pytest.approx(150.0, rel=1e-3)  # noise-free
    assert 'remark = "kept"' in target.read_text() and "k_nm_rad" in target.read_text()
    assert cli.main(["diagnose", str(path), "--out", str(tmp_path / "d")]) == 0
    assert json.loads((tmp_path / "d" / "report.json").read_text())["verdict"] == "sufficient"
