"""The joint file: what is right is read, what is wrong is one line."""

import itertools
import math
import re
from collections.abc import Iterator
from pathlib import Path
from typing import get_args, get_type_hints

import pytest

from drivelink import jointfile
from drivelink.errors import JointFileError
from drivelink.jointfile import apart
from estimator import make_estimator
from estimator.effects import LIBRARY
from estimator.errors import EstimatorError
from estimator.model import require_covariance
from estimator.ranges import range_of
from estimator.sample import Sample

ELBOW = """\
name = "elbow"                       # part of the key expression
arrangement = "single"

[[motor]]                            # one, or two for a VSA
inertia_kg_m2 = 0.125                # joint side
viscous_damping_nm_s_rad = 0.8
[motor.transmission]
model = "polynomial"
order = 2
[[motor.effect]]
name = "coulomb_friction"
parameters = { torque_nm = 0.25 }
[motor.drive]
node_id = 1
counts_per_rev = 16384

[link]
[link.encoder]
[link.dynamics]
inertia_kg_m2 = 0.4
viscous_damping_nm_s_rad = 0.1
gravity_nm = 6

[bus]
period_s = 0.001
[estimator]
mode = "robust"
[zenoh]
prefix = "drivelink"
"""


def test_the_contract_s_example_is_read_as_written():
    joint = jointfile.parse(ELBOW)
    model = joint.model()
    assert model.motors[0].inertia_kg_m2 == 0.125
    assert model.motors[0].transmission.order == 2
    assert dict(model.motors[0].effects[0].parameters) == {"torque_nm": 0.25}
    assert model.link is not None
    assert model.link.gravity_nm == 6.0
    assert joint.motor[0].drive is not None
    assert joint.motor[0].drive.counts_per_rev == 16384
    assert joint.bus.sync == "produce"


@pytest.mark.parametrize(
    ("right", "wrong", "message"),
    [
        ("inertia_kg_m2 = 0.125", "inertia_kg_m2 = -1", "motor[1].inertia_kg_m2: input should be greater than 0, got -1"),
        ("inertia_kg_m2 = 0.125", "", "motor[1].inertia_kg_m2: expected this key, it is missing"),
        ("inertia_kg_m2 = 0.125", "inertia_kg_m2 = nan", "motor[1].inertia_kg_m2: input should be a finite number, got nan"),
        ("order = 2", "order = 22", "motor[1].transmission: order: expected 1 to 9, got 22"),
        ("order = 2", "ordr = 2", "motor[1].transmission.ordr: unknown key, did you mean order?"),
        ("node_id = 1", 'node_id = "x"', "motor[1].drive.node_id: input should be a valid integer, got 'x'"),
        ("node_id = 1", "node_id = 128", "motor[1].drive.node_id: input should be less than or equal to 127, got 128"),
        ('name = "elbow"', "", "name: expected this key, it is missing"),
        ('name = "elbow"', 'name = "el/bow"', "name: expected letters from a to z, digits"),
        ('"robust"', '"rob"', "estimator.mode: input should be 'robust' or 'paper', got 'rob'"),
        ("gravity_nm", "grav", "link.dynamics.grav: unknown key, expected one of inertia_kg_m2"),
        ('"coulomb_friction"', '"ears"', 'motor[1].effect: effect "ears": expected one of'),
        ('"coulomb_friction"', '"friction"', 'motor[1].effect: effect "friction": did you mean coulomb_friction?'),
        ('"single"', '"serial"', 'motor: expected 2 [[motor]] with arrangement = "serial", got 1'),
        ("[bus]", "[bus", "expected TOML"),
        ('prefix = "drivelink"', 'prefix = "a b"', "zenoh.prefix: expected parts of a zenoh key"),
        ("inertia_kg_m2 = 0.4", "inertia_kg_m2 = -0.4", "link.dynamics: inertia_kg_m2: expected a finite number > 0"),
        # numbers beyond their range, with range and unit
        ("damping_nm_s_rad = 0.8", "damping_nm_s_rad = 1e200", "motor[1]: viscous_damping_nm_s_rad: expected -1e+09 to 1e+09 N·m·s/rad, got 1e+200"),
        ("= 0.125", "= 1e-300", "motor[1]: inertia_kg_m2: expected 1e-12 to 1e+09 kg·m², got 1e-300"),
        ("torque_nm = 0.25", "torque_nm = 1e200", "motor[1].effect[1]: torque_nm: expected -1e+09 to 1e+09"),
        ("torque_nm = 0.25", f"torque_nm = {[0.25] * 33}", "motor[1].effect[1]: torque_nm: expected at most 32 numbers, got 33"),
        ('mode = "robust"', "bandwidth_rad_s = 1e-12", "estimator: bandwidth_rad_s: expected 0.5 to 10000 rad/s, got 1e-12"),
        ("gravity_nm = 6", "gravity_nm = 1e11", "link.dynamics: gravity_nm: expected -1e+09 to 1e+09 N·m"),
        ("= 0.001", "= 1e-9", "bus.period_s: input should be greater than or equal to 0.0001, got 1e-09"),
    ],
)  # fmt: skip
def test_what_is_wrong_is_one_line_with_file_key_and_expectation(right, wrong, message):
    text = ELBOW.replace(right, wrong, 1)
    assert text != ELBOW
    with pytest.raises(JointFileError) as caught:
        jointfile.parse(text, "elbow.toml")
    assert str(caught.value).startswith(f"elbow.toml: {message}")
    assert "\n" not in str(caught.value)


def test_a_file_that_cannot_be_read_and_a_node_id_given_twice_are_one_line(tmp_path):
    path = tmp_path / "joint.toml"
    with pytest.raises(JointFileError, match=r"joint\.toml: cannot be read as a joint file: No such file"):
        jointfile.load(path)
    path.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(JointFileError, match="expected UTF-8 text"):
        jointfile.load(path)
    with pytest.raises(JointFileError, match="got 1 twice"):
        jointfile.parse(ELBOW.replace("[link.encoder]", '[link.encoder]\nsource = "cia406"\nnode_id = 1'))


DOTTED = """\
name = "elbow"
link.dynamics.inertia_kg_m2 = 0.2  # weighed
link.encoder.source = "drive"
[[motor]]
inertia_kg_m2 = 0.1
transmission.model = "linear"  # a soft one
transmission.parameters.k_nm_rad = 100.0
drive.node_id = 3
"""


@pytest.mark.parametrize(
    "text",
    [
        ELBOW,
        DOTTED,
        DOTTED.replace("parameters.k_nm_rad = 100.0", "parameters = { k_nm_rad = 100.0 }"),
        'name = "elbow"\nlink = { dynamics = { inertia_kg_m2 = 0.2 } }\n'
        "motor = [{ inertia_kg_m2 = 0.1, transmission = { model = 'linear' } }]\n",
    ],
    ids=["headers", "dotted", "inline parameters", "inline"],
)
def test_a_rewritten_model_keeps_everything_else_and_its_comments(tmp_path, text):
    source, target = tmp_path / "elbow.toml", tmp_path / "elbow2.toml"
    source.write_text(text, encoding="utf-8")
    effect = {"name": "torque_offset", "parameters": {"torque_nm": 0.2}}
    transmission = {"model": "linear", "parameters": {"k_nm_rad": 120.0}}
    changes = {
        "motor": [{"transmission": transmission, "effect": [effect]}],
        "link": {"dynamics": {"inertia_kg_m2": 0.3, "gravity_nm": 1.0}, "effect": [effect, effect]},
        "provenance": {"fit": {"seconds": 3.0}},
    }
    joint = jointfile.write_model(jointfile.load_text(source), target, changes)
    assert joint == jointfile.load(target)
    assert joint.motor[0].transmission.parameters == {"k_nm_rad": 120.0}
    assert joint.link.dynamics is not None
    assert (joint.link.dynamics.inertia_kg_m2, joint.link.dynamics.gravity_nm) == (0.3, 1.0)
    assert [one.name for one in joint.motor[0].effect] == ["torque_offset"] and len(joint.link.effect) == 2
    assert joint.motor[0].drive == jointfile.load(source).motor[0].drive
    for comment in ("# weighed", "# part of the key expression"):
        assert (comment in text) == (comment in target.read_text(encoding="utf-8"))
    target.unlink()
    with pytest.raises(JointFileError):  # an invalid rewrite writes nothing
        jointfile.write_model(jointfile.load_text(source), target, {"bus": {"period_s": -1.0}})
    assert not target.exists()


@pytest.fixture
def written(tmp_path: Path) -> Path:
    """A joint file as `fit --write` leaves it."""
    source, target = tmp_path / "elbow.toml", tmp_path / "fitted.toml"
    source.write_text(ELBOW, encoding="utf-8")
    parameters = {"coefficients_nm_rad": [100.0, 500.0]}
    changes = {"motor": [{"transmission": {"parameters": parameters}}], "provenance": {"recording": "r.csv"}}
    jointfile.write_model(jointfile.load_text(source), target, changes)
    return target


def test_no_part_of_a_written_file_is_taken_for_a_model(written):
    whole = written.read_bytes()
    assert whole.splitlines()[-1].startswith(b"# drivelink check: sha256 ")
    for end in range(len(whole) - 1):  # without its last line end it is still whole
        written.write_bytes(whole[:end])
        with pytest.raises(JointFileError) as caught:
            jointfile.load(written)
        assert "\n" not in str(caught.value) and str(caught.value).startswith(str(written))
        if end > 100:
            assert "truncated: its last line, the check line, is missing" in str(caught.value)


def test_a_written_file_may_be_edited_and_that_is_said(written, caplog):
    jointfile.load(written)
    # By a checkout on another system, and an editor there.
    written.write_bytes(b"\xef\xbb\xbf" + written.read_bytes().replace(b"\n", b"\r\n"))
    jointfile.load(written)
    assert not caplog.messages
    written.write_text(written.read_text().replace("500.0", "600.0"))
    assert jointfile.load(written).motor[0].transmission.parameters["coefficients_nm_rad"] == (100.0, 600.0)
    jointfile.load_text(written)
    assert caplog.messages == [f"{written}: edited since drivelink wrote it: read as it is now"]  # once
    source = jointfile.load_text(written)
    for _ in range(2):  # a copy has one check line
        jointfile.write_model(source, written, {"provenance": {"recording": "s.csv"}}, force=True)
        source = jointfile.load_text(written)
    assert source.text.count("# drivelink ") == 2 and source.joint.provenance == {"recording": "s.csv"}


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ("key = 1\n" * 1_000_000, "at most 256 KiB, got more"),
        ("\n" * 250_000, "at most 8192 lines, got 250001"),
        ("# " + "-" * 120_000, "line 1: expected at most 4 KiB, got 120002 letters"),
        ("a = [\n" + "[\n" * 8_000, "nested without end"),
        (".".join("a" * 2_000) + " = 1", "nested without end"),
        (".".join("a" * 40) + " = 1", "nested without end"),
        (("# " + "-" * 4_000 + "\n") * 60, "name: expected this key, it is missing"),
        ("name = [" + "'x',\n" * 8_000 + "]", "name: input should be a valid string"),
        ("\n".join(f"k{k} = 1" for k in range(8_000)), "(and 8001 more: motor, k0, k1)"),
    ],
)
def test_a_joint_file_that_grows_without_end_is_one_line(tmp_path, text, line):
    path = tmp_path / "joint.toml"
    path.write_text(text)
    for read in (lambda: jointfile.load(path), lambda: jointfile.parse(text)):
        with pytest.raises(JointFileError) as caught:
            read()
        assert line in str(caught.value) and "\n" not in str(caught.value) and len(str(caught.value)) < 600


def test_numbers_that_no_float_holds_and_covariances_without_bounds_are_one_line():
    """A whole number of TOML, and what becomes of JSON, may be as large as its line."""
    for text in ("bitrate = " + "9" * 400, "sdo_retries = " + "9" * 400):
        with pytest.raises(JointFileError, match=r"expected .* got inf$"):
            jointfile.parse(ELBOW.replace("period_s = 0.001", text))
    floor = "residual_nm = [0.1]\ntorque_nm = [1.0]\nlog_std = [0.1]\nseconds = "
    for seconds in ("9" * 400, "inf", "1e300"):
        joint = jointfile.parse(f"{ELBOW}[provenance.floor]\n{floor}{seconds}\n")
        assert joint.model().motors[0].fit_rms_nm is None
    with pytest.raises(EstimatorError, match="covariance: expected"):
        require_covariance([[0.0, 1e60], [1e60, 1.0]], 2)


def numeric_keys(kind: type, seen: set[type]) -> Iterator[str]:
    """Names of the numbers in a section and the sections below it."""
    if kind in seen:
        return
    seen.add(kind)
    for name, hint in get_type_hints(kind).items():
        parts = [hint, *get_args(hint), *(deep for part in get_args(hint) for deep in get_args(part))]
        if {int, float} & set(parts):
            yield name
        for part in parts:
            if isinstance(part, type) and part.__module__.startswith(("drivelink.", "estimator.")):
                yield from numeric_keys(part, seen)


def test_every_number_with_a_unit_has_a_range_of_that_unit():
    names = set(numeric_keys(jointfile.JointFile, set()))
    names |= {parameter.name for kind in LIBRARY.values() for parameter in kind.parameters}
    assert {"bandwidth_rad_s", "period_s", "torque_nm", "inertia_kg_m2", "rated_current_a"} <= names
    units = re.compile(r"_(rad|s|nm|a|kg|m|hz)\d?(_|$)")
    assert not {name for name in names if units.search(name) and not range_of(name).unit}


@pytest.mark.parametrize("period_s", [1e-4, 1.0])
def test_what_a_joint_file_may_say_is_prepared_in_a_moment(period_s):
    """At the ends of every range of [estimator] the estimator has a bounded size and takes one step."""
    for name, value in itertools.product(
        ("bandwidth_rad_s", "external_bandwidth_rad_s", "k_tau_rad_s", "false_alarms_per_hour"), (0, 1)
    ):
        limit = range_of(name)[value]
        joint = jointfile.parse(ELBOW.replace('mode = "robust"', f"{name} = {limit!r}"))
        made = make_estimator(joint.model(), joint.estimator, period_s)
        assert made.step(Sample(0, (0.0,), (math.nan,), (0.0,), 0.0)).sequence == 0


def test_a_running_daemon_has_a_joint_file_read_by_another_process(tmp_path, monkeypatch):
    path = tmp_path / "elbow.toml"
    path.write_text(ELBOW)
    assert apart.load_apart(path) == jointfile.load(path)
    path.write_text(ELBOW.replace("0.125", "nan"))
    with pytest.raises(JointFileError) as alone, pytest.MonkeyPatch.context() as here:
        here.setattr(apart, "from_json", lambda *_: pytest.fail("read here"))
        apart.load_apart(path)
    with pytest.raises(JointFileError, match=re.escape(str(alone.value))):
        jointfile.load(path)
    monkeypatch.setattr(apart, "_MAX_BYTES", 100)
    path.write_text(ELBOW)
    with pytest.raises(JointFileError, match=r"elbow\.toml: expected at most .* while a joint is served"):
        apart.load_apart(path)
    monkeypatch.setattr(apart, "_PATIENCE_S", 1e-3)
    with pytest.raises(JointFileError, match=r"elbow\.toml: expected to be read within 0\.001 s"):
        apart.load_apart(path)
