"""`drivelink diagnose`: report.json as promised, a page of its own, a joint file that knows the effect."""

import io
import json
import re
from functools import cache

import diagnosiskit as kit
import fleetkit
import joints
import numpy as np
import pytest
from rich.console import Console

from drivelink import jointfile
from drivelink.cli import main
from drivelink.jointfile.apply_diagnosis import floor_entry, make_model_monitor
from drivelink.output.document import Grid, Section, show
from drivelink.output.numbers import Units
from estimator.sample import Record

JOINT = fleetkit.JOINT.format(name="elbow")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("diagnose")
    effects = [{}, {"coulomb_nm": 0.4}, {"late_s": 0.004}, {"bump_nm": 1.0}]
    for name, record in zip(
        ("clean", "coulomb", "late", "bump"), kit.World(effects, seconds=8.0).run(), strict=True
    ):
        joints.write_csv(record, folder / f"{name}.csv", 9)
    (folder / "joint.toml").write_text(JOINT, encoding="utf-8")
    return folder


@cache  # what was diagnosed once is looked at by several tests
def _diagnose(folder, name, joint="joint.toml", *more):  # type: ignore[type-arg]
    out = folder / f"{name}-{joint}"
    arguments = ["diagnose", str(folder / f"{name}.csv"), "--joint", str(folder / joint), "--out", str(out)]
    assert main([*arguments, *more]) == 0
    return json.loads((out / "report.json").read_text(encoding="utf-8"))  # type: ignore[no-any-return]


def test_report_json_is_as_promised(folder):
    report = _diagnose(folder, "coulomb")
    assert (report["schema"], report["verdict"]) == ("drivelink.diagnosis/1", "effect")
    assert report["bandwidth_hz"] > 0
    effect, error = report["effects"][0], report["error"]
    assert {"name", "location", "parameters", "std", "alternatives"} <= set(effect)
    assert (effect["name"], effect["location"]) == ("coulomb_friction", "motor")
    names = {f"{when}_{what}" for when in ("before", "after") for what in ("rms_nm", "relative")}
    assert {name: set(error[name]) for name in error} == {"train": names, "validation": names}


@pytest.mark.slow
@pytest.mark.parametrize(("name", "effect"), [("coulomb", "coulomb_friction"), ("late", "encoder_delay")])
def test_the_written_joint_file_knows_the_effect_and_its_floor(folder, name, effect):
    better = f"{name}-better.toml"
    _diagnose(folder, name, "joint.toml", "--write", str(folder / better))
    joint = jointfile.load(folder / better)
    effects = joint.motor[0].effect if name == "coulomb" else joint.link.effect
    assert [e.name for e in effects] == [effect]
    assert make_model_monitor(joint) is not None
    assert _diagnose(folder, name, better)["verdict"] == "sufficient"


@pytest.mark.slow  # what is found is tested in test_diagnosis
def test_an_unlisted_effect_comes_with_its_curve(folder):
    effect = _diagnose(folder, "bump")["effects"][0]
    assert (effect["name"], effect["location"], effect["coordinates"]) == ("unlisted", "motor", ["position"])
    assert len(effect["curve"]["position"]) == len(effect["curve"]["torque_nm"]) > 100
    page = (folder / "bump-joint.toml" / "report.html").read_text(encoding="utf-8")
    assert "None was chosen: a free curve over position leaves less." in page


def test_json_is_pure_and_a_page_without_a_curve_has_no_empty_section(folder, capsys):
    report = _diagnose(folder, "clean", "joint.toml", "--json")
    assert json.loads(capsys.readouterr().out) == report
    page = (folder / "clean-joint.toml" / "report.html").read_text(encoding="utf-8")
    assert "What reveals it" not in page


def test_the_report_is_self_contained_and_has_the_verdict_units_bands_the_winner_and_what_is_left(folder):
    _diagnose(folder, "coulomb")
    page = (folder / "coulomb-joint.toml" / "report.html").read_text(encoding="utf-8")
    for part in (
        "The model lacks Coulomb friction (motor)", "of the torque (", "rms) stays unexplained", "What reveals it",
        "asymmetric friction alone leaves less: an effect with more freedom", ">refitted</text>",
        "Stiffness of motor 1's transmission, with 95 % bands", "prefers-color-scheme: dark", "currentColor",
    ):  # fmt: skip
        assert part in page, part
    for foreign in ("#ffffff", 'src="http', 'href="http', "@import", "<script"):
        assert foreign not in page
    assert (
        page.count("<svg") >= 3 and page.count("▶ ") == 2
    )  # the one that was chosen, and what the mark means
    assert re.search(r'<tr class="chosen"><th>▶ Coulomb friction</th><td>(0\.9\d|1\.00)</td>', page)
    assert re.search(r"<th>torque_<wbr>nm</th><td>0\.\d+</td><td>\S+</td><td>N·m</td>", page)
    assert re.search(r"<th>k_<wbr>nm_<wbr>rad</th><td>\S+</td><td>\S+</td><td>N·m/rad</td>", page)


@pytest.mark.slow
def test_of_a_linear_axis_the_report_speaks_of_newtons_and_metres(folder):
    (folder / "slide.toml").write_text(JOINT.replace("[[motor]]", 'axis = "linear"\n[[motor]]', 1))
    _diagnose(folder, "coulomb", "slide.toml")
    page = (folder / "coulomb-slide.toml" / "report.html").read_text(encoding="utf-8")
    assert re.search(r"<th>torque_<wbr>nm</th><td>\S+</td><td>\S+</td><td>N</td>", page)
    assert re.search(r"<th>k_<wbr>nm_<wbr>rad</th><td>\S+</td><td>\S+</td><td>N/m</td>", page)
    assert "N·m" not in page and "/ rad" not in page and "m/s" in page


@pytest.mark.slow
def test_a_fitted_joint_file_is_calibrated_and_watched(folder):
    clean, declared, fitted = (str(folder / name) for name in ("clean.csv", "joint.toml", "healthy.toml"))
    assert main(["fit", clean, "--joint", declared, "--write", fitted]) == 0
    joint = jointfile.load(folder / "healthy.toml")
    # The declared numbers are exact; noise moves them by less than a percent.
    assert joint.link.dynamics.inertia_kg_m2 == pytest.approx(kit.LINK_INERTIA, rel=0.01)
    assert make_model_monitor(joint) is not None
    assert _diagnose(folder, "clean", "healthy.toml")["verdict"] == "sufficient"


def test_what_cannot_be_diagnosed_is_one_line(folder, capsys):
    text = (folder / "clean.csv").read_text(encoding="utf-8").splitlines()
    (folder / "short.csv").write_text("\n".join(text[:900]) + "\n", encoding="utf-8")
    arguments = ["diagnose", str(folder / "short.csv"), "--joint", str(folder / "joint.toml")]
    assert main([*arguments, "--out", str(folder / "no")]) == 3
    error = capsys.readouterr().err
    assert "too short" in error
    assert error.count("\n") == 1


def test_every_coefficient_of_a_polynomial_has_its_unit():
    text = Units(linear=False).value("coefficients_nm_rad", tuple(float(k) for k in range(1, 9)), None)
    units = ["rad", "rad³", "rad⁵", "rad⁷", "rad⁹", "rad¹¹", "rad¹³", "rad¹⁵"]
    assert text == ", ".join(f"{k} N·m/{unit}" for k, unit in enumerate(units, start=1))


@pytest.mark.parametrize("columns", [40, 60, 80])
def test_a_printed_table_keeps_every_letter_in_a_narrow_terminal(columns):
    names = ("viscous_damping_nm_s_rad", "coefficients_nm_rad[2]")
    grid = Grid(
        ("where they differ most", "at", "of A", "of B"),
        [(name, "−0.0147 rad/s", "140.00 N·m/rad", "–") for name in names],
    )
    console = Console(width=columns, file=io.StringIO(), record=True)
    show([Section("", [grid])], console)
    lines = console.export_text().splitlines()
    first = "".join(line[1:].split("│")[0].strip() for line in lines if line.startswith("│"))
    assert first == "".join(names) and max(map(len, lines)) <= columns


def test_a_baseline_that_cannot_be_measured_is_a_warning(caplog):
    k, still = np.arange(50), np.zeros((50, 1))
    columns = {"motor_position_rad": still, "motor_torque_nm": still, "link_position_rad": 1e-3 * k}
    record = Record(period_s=1e-3, sequence=k, **columns)
    model = joints.joint_model(0.1, 0.0, model="linear", order=None, parameters={"k_nm_rad": 100.0})
    assert floor_entry(record, model, 1.0) == {}
    assert "the daemon cannot raise the model alarm: " in caplog.text
