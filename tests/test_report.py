"""`drivelink diagnose`: report.json as promised, a page of its own, a joint file that knows the effect."""

from __future__ import annotations

import json
import re
from functools import cache
from pathlib import Path

import diagnosiskit as kit
import fleetkit
import joints
import numpy as np
import pytest

from drivelink import jointfile
from drivelink.cli import main
from drivelink.jointfile.apply_diagnosis import floor_entry, make_model_monitor
from drivelink.output.numbers import Units
from estimator.model import JointModel, Motor, Transmission
from estimator.sample import Record

JOINT = fleetkit.JOINT.format(name="elbow")
ERROR = {"before_rms_nm", "after_rms_nm", "before_relative", "after_relative"}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("diagnose")
    effects = [{}, {"coulomb_nm": 0.4}, {"late_s": 0.004}, {"bump_nm": 1.0}]
    for name, record in zip(("clean", "coulomb", "late", "bump"), kit.World(effects).run(), strict=True):
        joints.write_csv(record, folder / f"{name}.csv", 9)
    (folder / "joint.toml").write_text(JOINT, encoding="utf-8")
    return folder


@cache  # what was diagnosed once is looked at by several tests
def _diagnose(folder: Path, name: str, joint: str = "joint.toml", *more: str) -> dict:  # type: ignore[type-arg]
    out = folder / f"{name}-{joint}"
    arguments = ["diagnose", str(folder / f"{name}.csv"), "--joint", str(folder / joint), "--out", str(out)]
    assert main([*arguments, *more]) == 0
    return json.loads((out / "report.json").read_text(encoding="utf-8"))  # type: ignore[no-any-return]


def test_report_json_is_as_promised(folder: Path) -> None:
    report = _diagnose(folder, "coulomb")
    assert report["schema"] == "drivelink.diagnosis/1"
    assert report["verdict"] == "effect"
    assert report["bandwidth_hz"] > 0
    effect = report["effects"][0]
    assert {"name", "location", "parameters", "std", "alternatives"} <= set(effect)
    assert (effect["name"], effect["location"]) == ("coulomb_friction", "motor")
    assert set(report["error"]) == {"train", "validation"}
    assert set(report["error"]["train"]) == set(report["error"]["validation"]) == ERROR


@pytest.mark.parametrize(
    ("name", "effect"),
    [
        pytest.param("coulomb", "coulomb_friction", marks=pytest.mark.slow),
        pytest.param("late", "encoder_delay", marks=pytest.mark.slow),
    ],
)
def test_the_written_joint_file_knows_the_effect_and_its_floor(folder: Path, name: str, effect: str) -> None:
    better = f"{name}-better.toml"
    _diagnose(folder, name, "joint.toml", "--write", str(folder / better))
    joint = jointfile.load(folder / better)
    effects = joint.motor[0].effect if name == "coulomb" else joint.link.effect
    assert [e.name for e in effects] == [effect]
    assert make_model_monitor(joint) is not None
    assert _diagnose(folder, name, better)["verdict"] == "sufficient"


def test_an_unlisted_effect_comes_with_its_curve(folder: Path) -> None:
    effect = _diagnose(folder, "bump")["effects"][0]
    assert (effect["name"], effect["location"], effect["coordinates"]) == ("unlisted", "motor", ["position"])
    assert len(effect["curve"]["position"]) == len(effect["curve"]["torque_nm"]) > 100


def test_json_is_pure_and_what_the_file_says(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    report = _diagnose(folder, "clean", "joint.toml", "--json")
    assert json.loads(capsys.readouterr().out) == report


def test_the_report_has_units_bands_the_winner_and_what_is_left(folder: Path) -> None:
    _diagnose(folder, "coulomb")
    page = (folder / "coulomb-joint.toml" / "report.html").read_text(encoding="utf-8")
    assert "of the torque (" in page and "rms) stays unexplained" in page
    assert page.count("▶ ") == 2  # the one that was chosen, and what the mark means
    assert re.search(r'<tr class="chosen"><th>▶ Coulomb friction</th><td>(0\.9\d|1\.00)</td>', page)
    assert "asymmetric friction alone leaves less: an effect with more freedom" in page
    assert "Stiffness of motor 1's transmission, with 95 % bands" in page and ">refitted</text>" in page
    assert re.search(r"<th>torque_<wbr>nm</th><td>0\.\d+</td><td>\S+</td><td>N·m</td>", page)
    assert re.search(r"<th>k_<wbr>nm_<wbr>rad</th><td>\S+</td><td>\S+</td><td>N·m/rad</td>", page)
    assert "prefers-color-scheme: dark" in page and "currentColor" in page and "#ffffff" not in page


@pytest.mark.slow
def test_of_a_linear_axis_the_report_speaks_of_newtons_and_metres(folder: Path) -> None:
    (folder / "slide.toml").write_text(JOINT.replace("[[motor]]", 'axis = "linear"\n[[motor]]', 1))
    _diagnose(folder, "coulomb", "slide.toml")
    page = (folder / "coulomb-slide.toml" / "report.html").read_text(encoding="utf-8")
    assert re.search(r"<th>torque_<wbr>nm</th><td>\S+</td><td>\S+</td><td>N</td>", page)
    assert re.search(r"<th>k_<wbr>nm_<wbr>rad</th><td>\S+</td><td>\S+</td><td>N/m</td>", page)
    assert "N·m" not in page and "/ rad" not in page and "m/s" in page


def test_the_page_is_self_contained_and_says_the_verdict(folder: Path) -> None:
    _diagnose(folder, "coulomb")
    page = (folder / "coulomb-joint.toml" / "report.html").read_text(encoding="utf-8")
    assert "The model lacks Coulomb friction (motor)" in page
    assert page.count("<svg") >= 3
    for foreign in ('src="http', 'href="http', "@import", "<script"):
        assert foreign not in page


def test_a_page_without_a_curve_has_no_empty_section(folder: Path) -> None:
    _diagnose(folder, "clean", "joint.toml", "--json")
    _diagnose(folder, "coulomb")
    for name, there in (("clean", False), ("coulomb", True)):
        page = (folder / f"{name}-joint.toml" / "report.html").read_text(encoding="utf-8")
        assert ("What reveals it" in page) is there


@pytest.mark.slow
def test_a_fitted_joint_file_is_calibrated_and_watched(folder: Path) -> None:
    fitted = folder / "healthy.toml"
    arguments = [
        "fit",
        str(folder / "clean.csv"),
        "--joint",
        str(folder / "joint.toml"),
        "--write",
        str(fitted),
    ]
    assert main(arguments) == 0
    joint = jointfile.load(fitted)
    assert joint.link.dynamics is not None
    # The declared numbers are exact; noise moves them by less than a percent.
    assert joint.link.dynamics.inertia_kg_m2 == pytest.approx(kit.LINK_INERTIA, rel=0.01)
    assert make_model_monitor(joint) is not None
    assert _diagnose(folder, "clean", "healthy.toml")["verdict"] == "sufficient"


def test_what_cannot_be_diagnosed_is_one_line(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    text = (folder / "clean.csv").read_text(encoding="utf-8").splitlines()
    (folder / "short.csv").write_text("\n".join(text[:900]) + "\n", encoding="utf-8")
    arguments = ["diagnose", str(folder / "short.csv"), "--joint", str(folder / "joint.toml")]
    assert main([*arguments, "--out", str(folder / "no")]) == 3
    error = capsys.readouterr().err
    assert "too short" in error
    assert error.count("\n") == 1


def test_every_coefficient_of_a_polynomial_has_its_unit() -> None:
    text = Units(linear=False).value("coefficients_nm_rad", tuple(float(k) for k in range(1, 9)), None)
    units = ["rad", "rad³", "rad⁵", "rad⁷", "rad⁹", "rad¹¹", "rad¹³", "rad¹⁵"]
    assert text == ", ".join(f"{k} N·m/{unit}" for k, unit in enumerate(units, start=1))


def test_a_baseline_that_cannot_be_measured_is_a_warning(caplog: pytest.LogCaptureFixture) -> None:
    k, zeros = np.arange(50), np.zeros((50, 1))
    record = Record(
        period_s=1e-3, sequence=k, motor_position_rad=zeros, motor_torque_nm=zeros, link_position_rad=1e-3 * k
    )
    known = Transmission(model="linear", parameters={"k_nm_rad": 100.0})
    model = JointModel(arrangement="single", motors=(Motor(inertia_kg_m2=0.1, transmission=known),))
    assert floor_entry(record, model, 1.0) == {}
    assert "the daemon cannot raise the model alarm: " in caplog.text
