"""What `fit` prints, what fit.json says, and what `--write` writes are the same numbers."""

import contextlib
import io
import json
import math
import os
import tomllib
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import diagnosiskit as kit
import gatekit
import joints
import numpy as np
import pytest

from drivelink import analysis, jointfile, recording
from drivelink.cli import main
from drivelink.errors import JointFileError
from drivelink.output.fitreport import _effects
from drivelink.output.numbers import Units
from estimator import Effect, fit
from estimator.identify import identify

ROOT = Path(__file__).resolve().parents[1]
KUKA = Path(os.environ.get("DRIVELINK_DATA", ROOT.parent / "shared" / "data")) / "kuka_kr300"
LATE_S, ZERO_RAD = 6e-4, 0.004
MOTOR = """\
[[motor]]
inertia_kg_m2 = {inertia}
viscous_damping_nm_s_rad = {damping}
[motor.transmission]
model = "{model}"
"""
ONE = 'name = "elbow"\n' + MOTOR.format(
    inertia=1.01 * kit.INERTIA, damping=0.98 * kit.DAMPING, model="{model}"
)
LINK = f"""\
[link.dynamics]
inertia_kg_m2 = {1.02 * kit.LINK_INERTIA}
viscous_damping_nm_s_rad = {kit.LINK_DAMPING}
gravity_nm = {0.98 * kit.GRAVITY}
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("written")
    worlds = kit.World([{}, {"late_s": LATE_S, "zero_rad": ZERO_RAD}], seconds=6.0).run()
    for name, record in zip(("clean", "skewed"), worlds, strict=True):
        joints.write_csv(record, folder / f"{name}.csv")
    pair = gatekit.draw("antagonistic", 1, seconds=6.0, effects=False)
    joints.write_csv(pair.record, folder / "pair.csv")
    texts = (
        MOTOR.format(inertia=m.inertia_kg_m2, damping=m.viscous_damping_nm_s_rad, model="polynomial")
        for m in pair.model.motors
    )
    rigid = gatekit.draw("none", 1, seconds=12.0, effects=False)
    joints.write_csv(rigid.record, folder / "rigid.csv")
    (m,) = rigid.model.motors
    text = MOTOR.format(inertia=m.inertia_kg_m2, damping=m.viscous_damping_nm_s_rad, model="none")
    (folder / "rigid.toml").write_text('name = "rigid"\n' + text)
    (folder / "pair.toml").write_text('name = "pair"\narrangement = "antagonistic"\n' + "".join(texts))
    return folder


@cache
def _fit(folder: Path, run: str, joint: str) -> tuple[str, Any, list[Any]]:
    """Text of the written file, fit.json, and the printed tables as [(name, text of the value)] each."""
    source, target = folder / f"{run}.toml", folder / "written.toml"
    if joint:
        source = folder / "joint.toml"
        source.write_text(joint)
    asked = ["fit", str(folder / f"{run}.csv"), "--joint", str(source), "--out", str(folder)]
    with contextlib.redirect_stdout(io.StringIO()) as printed:
        assert main([*asked, "--write", str(target), "--force"]) == 0
    document, tables = json.loads((folder / "fit.json").read_text()), _tables(printed.getvalue())
    if run == "rigid":  # to write the file changes nothing that is said
        with contextlib.redirect_stdout(io.StringIO()) as printed:
            assert main(asked) == 0
        assert json.loads((folder / "fit.json").read_text()) == document
        assert _tables(printed.getvalue()) == tables
    return target.read_text(), document, tables


def _tables(text: str) -> list[list[tuple[str, str]]]:
    tables: list[list[tuple[str, str]]] = []
    for line in text.splitlines():
        if line.startswith("┏"):
            tables.append([])
        if line.startswith("│"):
            name, value, *_ = (cell.strip() for cell in line.strip("│").split("│"))
            tables[-1].append((name, value))
    return tables


def _numbers(table: Any, prefix: str = "") -> Iterator[tuple[str, float]]:
    """Names as printed and values of a table of the written file."""
    for key, value in table.items():
        many = isinstance(value, list) and key != "effect"
        for i, x in enumerate(value, start=1) if many else ():
            yield f"{prefix}{key}[{i}]", x
        if isinstance(value, (int, float)) and not isinstance(value, bool) and "_std" not in key:
            yield f"{prefix}{key}", value


def _of_motor(motor: Any) -> dict[str, float]:
    found = dict(_numbers(motor)) | dict(_numbers(motor["transmission"].get("parameters", {})))
    return found | _of_effects(motor)


def _of_effects(owner: Any) -> dict[str, float]:
    effects = owner.get("effect", [])
    return {k: v for e in effects for k, v in _numbers(e["parameters"], f"{e['name']}.")}


def _same(printed: list[tuple[str, str]], written: dict[str, float]) -> None:
    assert {name for name, _ in printed} == set(written)
    for name, text in printed:
        mantissa, _, power = text.replace("−", "-").partition("e")
        last = 10.0 ** (int(power or 0) - len(mantissa.partition(".")[2]))  # as precise as its interval
        tail = len(mantissa) - len(mantissa.rstrip("0")) if "." not in mantissa else 0
        assert abs(float(f"{mantissa}e{power or 0}") - written[name]) <= 0.51 * last * 10**tail, name


@pytest.mark.parametrize(
    ("model", "link", "run"),
    [
        ("linear", LINK, "skewed"),
        ("polynomial", "", "clean"),
        *(
            pytest.param(m, k, run, marks=pytest.mark.slow)
            for m, k, run in (
                ("linear", "", "skewed"),
                ("polynomial", LINK, "skewed"),
                ("linear", LINK, "clean"),
            )
        ),
        ("", "", "pair"),
        ("", "", "rigid"),
    ],
)
def test_what_is_printed_is_what_is_written(model, link, run, folder):
    text, document, tables = _fit(folder, run, ONE.format(model=model) + link if model else "")
    written = tomllib.loads(text)
    owner = written.get("link", {})
    assert document.get("link", {}) == owner
    *_, last, _ = tables
    if owner:
        _same(last, dict(_numbers(owner.get("dynamics", {}))) | _of_effects(owner))
    motors = written["motor"]
    *tables, simulated = tables  # its numbers are of the free run
    fits = document["free_runs"][0]["fitted"]
    assert [text for _, text in simulated] == [f"{fit:.1f} %" for fit in fits.values()]
    assert min(fits.values()) > 50.0
    assert len(tables) == len(motors) + bool(owner)
    for table, motor, entry in zip(tables, motors, document["transmissions"], strict=False):
        _same(table, _of_motor(motor))
        assert entry["parameters"] == motor["transmission"].get("parameters", {})
        if entry["parameters"]:
            std = np.sqrt(np.diag(motor["transmission"]["covariance"]))
            stated = np.concatenate([np.atleast_1d(x) for x in entry["std"].values()])
            assert np.allclose(std, stated, rtol=1e-6)
        own = entry["motor"]
        assert motor["viscous_damping_std_nm_s_rad"] == own["viscous_damping_std_nm_s_rad"]
        share = own["inertia_std_kg_m2"] / own["inertia_kg_m2"]
        assert motor["inertia_std_relative"] == pytest.approx(share, rel=1e-3)
        known = {k: own[k] for k in ("inertia_kg_m2", "viscous_damping_nm_s_rad")}
        assert known == dict(_numbers(motor))
        assert entry.get("effects", []) == motor.get("effect", [])


@pytest.mark.parametrize(
    "link", [pytest.param("", marks=pytest.mark.slow), LINK], ids=["no link dynamics", "link dynamics"]
)
def test_skew_and_zero_of_the_readings_are_written_and_fitted_again_they_stay(link, folder):
    text, first, _ = _fit(folder, "skewed", ONE.format(model="linear") + link)
    written = tomllib.loads(text)
    # Encoders round down: half of their steps is part of the zero that is read.
    (zero,) = (
        e["parameters"]["offset_rad"]
        for e in written["motor"][0]["effect"]
        if e["name"] == "deflection_offset"
    )
    assert zero == pytest.approx(ZERO_RAD, abs=kit.MOTOR_LSB + kit.LINK_LSB)
    (late,) = (e["parameters"]["delay_s"] for e in written["link"]["effect"])
    assert late == pytest.approx(LATE_S, rel=0.05)
    k, std = (first["transmissions"][0][x]["k_nm_rad"] for x in ("parameters", "std"))
    assert k == pytest.approx(kit.STIFFNESS, rel=2e-3)
    _, second, _ = _fit(folder, "skewed", text)
    assert math.isclose(second["transmissions"][0]["parameters"]["k_nm_rad"], k, abs_tol=std)


@pytest.mark.parametrize(
    ("covariance", "expected"),
    [
        ("[[1.0]]", "2 rows of 2 numbers"),
        ("[[1.0, 0.0], [0.0]]", "2 rows of 2 numbers"),
        ("[[1.0, 0.0], [0.5, 1.0]]", "symmetric"),
        ("[[1.0, 2.0], [2.0, 1.0]]", "without negative eigenvalues"),
        ("[[-1.0, 0.0], [0.0, 1.0]]", "variances of 0 or more"),
    ],
)
def test_a_covariance_of_another_shape_is_refused(covariance, expected):
    text = ONE.format(model="vsa-ii") + "parameters = {{ k_nm_rad = 500.0, c = 1.7 }}\ncovariance = {}\n"
    good = jointfile.parse(text.format("[[4.0, 0.01], [0.01, 0.0025]]")).model()
    assert good.motors[0].transmission.covariance == ((4.0, 0.01), (0.01, 0.0025))
    with pytest.raises(JointFileError, match=expected):
        jointfile.parse(text.format(covariance))


@pytest.mark.skipif(not KUKA.exists(), reason=f"no measured data in {KUKA} (see $DRIVELINK_DATA)")
@pytest.mark.parametrize("axis", [2, 3])
@pytest.mark.parametrize("run", ["A", "B"])
def test_on_a_machine_no_zero_is_written_that_spoils_the_balance(axis, run):
    joint = jointfile.load(ROOT / "examples" / f"kuka_axis{axis}.toml")
    record = recording.read(KUKA / f"axis{axis}_{run}.csv", joint)
    found = identify(record, joint.model())
    (alone,), (again,) = found.fits, fit(record, found.model)
    # The readings are interpolated anew: equal within a percent.
    assert again.error_rms_nm < 1.01 * alone.error_rms_nm


@pytest.mark.skipif(not KUKA.exists(), reason=f"no measured data in {KUKA} (see $DRIVELINK_DATA)")
@pytest.mark.parametrize("run", ["A", "B"])
def test_on_a_machine_the_fitted_file_makes_its_recordings_valid(run, tmp_path):
    """The balance leaves a sixth of the torque there: what the fit has left is what is foreseen."""
    example = ROOT / "examples" / "kuka_axis3.toml"
    written, source = tmp_path / "fitted.toml", KUKA / f"axis3_{run}.csv"
    assert main(["fit", str(source), "--joint", str(example), "--write", str(written)]) == 0
    joint = jointfile.load(written)
    for other in "AB":
        record = recording.read(KUKA / f"axis3_{other}.csv", joint)
        status = joints.estimates(joint.model(), record)[:, 1].astype(int)
        assert np.mean(status & 1) > 0.8  # a few of a hundred without the fit's residual


def test_an_effect_that_was_fitted_is_printed_with_its_interval():
    effect = Effect(name="deflection_offset", parameters={"offset_rad": 1.3e-5}, std={"offset_rad": 4.6e-5})
    (row,) = _effects((effect,), Units(False))
    assert row == ("deflection_offset.offset_rad", "1.3e−5", "9.0e−5", "rad")


def test_of_another_joint_no_number_is_stated(folder, tmp_path, monkeypatch, capsys):
    def of(factor):
        file = tmp_path / "other.toml"
        motor = MOTOR.format(inertia=factor * kit.INERTIA, damping=kit.DAMPING, model="polynomial")
        file.write_text('name = "elbow"\n' + motor)
        return [str(folder / "clean.csv"), "--joint", str(file), "--out", str(tmp_path)]

    assert main(["fit", *of(1000.0)]) == 3
    told = capsys.readouterr()
    assert "expected a recording of this joint" in told.err.splitlines()[-1] and not told.out
    outcome = SimpleNamespace(validation=SimpleNamespace(after_relative=195.0))
    monkeypatch.setattr(analysis, "_diagnose", lambda *_: outcome)
    assert main(["diagnose", *of(1.0)]) == 3
    assert "leaves 19500 % of the motor torque: expected" in capsys.readouterr().err


def test_a_number_that_is_stated_because_it_is_declared_is_said_to_be(folder):
    record = recording.read(folder / "clean.csv")
    for factor, said in ((0.4, ["the inertia of motor 1 is the declared one"]), (1.0, [])):
        motor = MOTOR.format(inertia=factor * kit.INERTIA, damping=kit.DAMPING, model="polynomial")
        notes = identify(record, jointfile.parse('name = "elbow"\n' + motor).model()).notes
        assert [one.partition(":")[0] for one in notes if "declared" in one] == said
