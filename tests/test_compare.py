"""`drivelink compare`, and fit, prediction, diagnosis and the free run in Python: what tells models apart is told."""

import io
import json
import math
import re
from dataclasses import replace
from functools import cache, partial
from pathlib import Path

import joints
import numpy as np
import pytest
from rich.console import Console

import drivelink
from drivelink import cli, jointfile
from drivelink.comparison import compare
from drivelink.demo.simulate import alter, world_from_joint
from drivelink.errors import DrivelinkError
from drivelink.output.comparison import Difference, simulated
from drivelink.output.document import show
from estimator import Effect, EstimatorError, JointModel, LinkDynamics, Record, Transmission
from estimator.filters import smoothed
from estimator.freerun import free_run, nrmse_fit
from sim.world import record

ELBOW = Path(__file__).parent.parent / "examples" / "elbow.toml"
SOFTER = {"motor1_coefficient1_nm_rad": 108.0, "motor1_coefficient2_nm_rad": 360.0}


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A healthy run, one with a softer spring, one with friction."""
    folder = tmp_path_factory.mktemp("runs")
    kinds = {"healthy": ((), {}), "soft": ((), SOFTER), "friction": (("coulomb_friction=0.6",), {})}
    for name, (effects, parameters) in kinds.items():
        world = world_from_joint(jointfile.load(ELBOW))
        alter(world, effects, parameters)
        joints.write_csv(joints.of_world(record(world, 3.0)), folder / f"{name}.csv")
    return folder


def test_two_machines_differ_in_the_stiffness_and_each_model_fits_its_own(runs):
    made = compare(runs / "healthy.csv", runs / "soft.csv", ELBOW, horizon_s=1.0)
    stiffness, friction = made.differences()
    assert "Where the curves differ most" in repr(made) and len(repr(made)) < 5000
    out = io.StringIO()
    show(made.sections(), Console(file=out, width=80))
    # No cell folds.
    assert re.search(r"│ friction / N·m +│ +\S+ │ +\S+ │ +\S+ rad/s │ +\S+ σ │\n", out.getvalue())
    assert abs(stiffness.b / stiffness.a - 0.9) < 0.02
    assert abs(stiffness.b - stiffness.a) > 10.0 * stiffness.std > 0.0
    assert abs(friction.b - friction.a) < 5.0 * friction.std
    for own, (side, *pair) in enumerate(made.runs):
        fits = [run.fit_percent["motor1_deflection"] for run in pair]
        assert fits[own] > 99.0 > 90.0 > fits[1 - own]
        cross = [made.residuals(side, run)[1] for run in pair]
        most = [np.max(np.abs(one.value)) / one.band for one in cross]
        assert most[1 - own] > 1.5 * most[own]  # what the wrong spring leaves goes with the torque


def test_friction_that_nobody_declared_is_in_the_curve_and_in_the_free_run(runs):
    made = compare(ELBOW, runs / "friction.csv", horizon_s=2.0)
    friction = made.differences()[1]
    assert abs(abs(friction.b - friction.a) - 0.6) < 0.1
    (_, declared, fitted) = made.runs[0]
    assert min(fitted.fit_percent.values()) > 99.0 > 90.0 > max(declared.fit_percent.values())


def test_two_numbers_beside_each_other_are_in_one_notation():
    made = compare(ELBOW, ELBOW)
    row = made._row(Difference(1, "friction", 0.02, 9e-5, 0.00386, 4.8e-4))
    assert row[1:3] == ("0.00009", "0.00386")


def test_the_verb_writes_a_page_and_numbers(runs, capsys):
    healthy = str(runs / "healthy.csv")
    assert cli.main(["compare", str(ELBOW), healthy, "--horizon", "1", "--out", str(runs / "page")]) == 0
    out = capsys.readouterr().out
    assert "fit of healthy.csv" in out and "A: elbow.toml · B: healthy.csv" in out
    document = json.loads((runs / "page" / "comparison.json").read_text())
    assert document["free_runs"][0]["horizon_s"] == [1.0, 1.0]
    page = (runs / "page" / "comparison.html").read_text()
    assert page.count("<svg") == 4 and "A: elbow.toml · B: healthy.csv" in page
    assert cli.main(["compare", str(ELBOW), str(ELBOW), "--json"]) == 0  # models alone: curves
    document = json.loads(capsys.readouterr().out)
    assert document["free_runs"] == [] and document["curves"][0]["a"] == document["curves"][0]["b"]
    assert cli.main(["compare", str(ELBOW), healthy, "--horizon", "0"]) == 2
    assert cli.main(["compare", str(ELBOW), str(runs / "none.csv")]) == 3
    bare = runs / "bare.toml"  # what is missing in a joint file is not said of the recording
    bare.write_text(re.sub(r"\[motor.transmission.parameters\]\n.*\n", "", ELBOW.read_text(encoding="utf-8")))
    assert cli.main(["compare", str(bare), healthy]) == 3
    assert cli.main(["compare", str(bare), str(ELBOW)]) == 0
    out, err = capsys.readouterr()
    (row,) = (line for line in out.splitlines() if "stiffness" in line)
    assert "│ not known │   known │" in row
    errors = [line for line in err.splitlines() if line.startswith("drivelink")]
    assert len(errors) == 3 and "expected a number above 0" in errors[0]
    assert errors[2].startswith(
        f"drivelink compare: {bare}, over {healthy}: transmission.parameters: expected"
    )
    assert "--horizon" not in errors[2]


PERIOD_S = 0.001
SPRING = {"k_nm_rad": 8.0}
FRICTION = Effect(name="coulomb_friction", parameters={"torque_nm": 0.05, "smoothing_rad_s": 1e-3})


def joint(**motor: object) -> JointModel:
    link = LinkDynamics(inertia_kg_m2=0.04, viscous_damping_nm_s_rad=0.01, gravity_nm=0.6)
    return joints.with_motor(
        joints.joint_model(0.02, 0.05, model="linear", parameters=SPRING, link=link), **motor
    )


@cache
def run(seconds: float = 1.5) -> Record:
    torque, stiffness = joints.polynomial(np.array([[[8.0]]]))
    plants = joints.Plants(
        torque, stiffness, B=0.02, D=0.05, M=0.04,
        Dq=0.01, gravity=0.6, coulomb=0.05,
    )  # fmt: skip
    t = np.arange(round(seconds / PERIOD_S)) * PERIOD_S
    tau = 0.7 * np.sin(2 * np.pi * 0.9 * t) + 0.5 * np.sin(2 * np.pi * 2.3 * t + 1.0)
    truth = joints.simulate(plants, tau[:, None, None], PERIOD_S, substeps=3)
    return joints.record(truth, 0, PERIOD_S)


def test_the_free_run_of_the_true_model_is_what_another_integrator_gives():
    made = free_run(run(), joint(effects=(FRICTION,)), 1.5)
    assert "array" not in repr(made)  # its numbers, in a line
    assert made.channels == ("motor1_position", "link_position", "motor1_deflection")
    assert min(made.fit_percent.values()) > 99.0
    assert max(made.coasting_percent.values()) < 10.0  # no fit for nothing
    made = free_run(run(), replace(joint(effects=(FRICTION,)), link=None), 1.0)  # the measured link drives it
    assert made.channels == ("motor1_position", "motor1_deflection")
    assert min(made.fit_percent.values()) > 98.0


def test_the_horizon_shrinks_until_a_drifting_run_fits_and_windows_begin_behind_each_gap():
    truth = run()
    bad = joint(inertia_kg_m2=0.4)
    assert min(free_run(truth, bad, 1.5).fit_percent.values()) < 0.0
    chosen = free_run(truth, bad)
    assert chosen.horizon_s < 1.0 and min(chosen.fit_percent.values()) > 0.0
    gap = np.arange(len(truth)) + 7 * (np.arange(len(truth)) > 750)
    assert len(free_run(replace(truth, sequence=gap), joint(), 0.5).time_s) == 1000
    lossy = truth.rows(np.arange(len(truth)) % 400 != 399)  # a busy machine: no second is whole
    assert free_run(lossy, joint()).horizon_s < 0.4
    made = simulated(lossy, fitted=joint(effects=(FRICTION,)))["fitted"]
    # One figure everywhere.
    assert made.fit_percent == free_run(lossy, joint(effects=(FRICTION,))).fit_percent
    assert 0.38 < made.horizon_s < 0.4 and len(made.time_s) == 3 * 389
    assert min(made.fit_percent.values()) > 95.0


@pytest.mark.parametrize("rows", [5, 21])
def test_a_cubic_is_smoothed_to_itself_up_to_both_ends(rows):
    t = 0.1 * np.arange(40)
    cubics = np.stack((t**3 - 2 * t, 1 + t**2), axis=1)
    rates, bends = np.stack((3 * t**2 - 2, 2 * t), axis=1), np.stack((6 * t, 2 + 0 * t), axis=1)
    for derivative, expected in enumerate((cubics, rates, bends)):
        np.testing.assert_allclose(smoothed(cubics, rows, derivative, 0.1), expected, atol=1e-9)


def test_what_cannot_be_simulated_is_one_line_and_the_fit_figure_is_that_of_matlab_s_compare():
    with pytest.raises(EstimatorError, match=r"transmission\.parameters: expected"):
        free_run(run(1.0), joint(transmission=Transmission(model="linear")), 0.5)
    with pytest.raises(EstimatorError, match="without gaps of 5 s"):
        free_run(run(1.0), joint(), 5.0)
    y = np.array([0.0, 1.0, 2.0, 3.0])
    assert (nrmse_fit(y, y), nrmse_fit(y, np.full(4, 1.5))) == (100.0, 0.0)
    assert np.isnan(nrmse_fit(np.ones(4), y))


@pytest.mark.slow
def test_three_lines_fit_predict_plot_and_write(fleet, tmp_path):
    run, other = (fleet / "recordings" / f"elbow-2026-01-0{day}.csv" for day in (5, 6))
    fit = drivelink.fit(run, joint=fleet / "joints" / "elbow.toml")
    assert "motor 1: linear" in repr(fit) and "k_nm_rad" in str(fit)
    assert min(fit.predict(other, 0.05).fit_percent.values()) > 80.0
    assert fit.plot()._repr_png_().startswith(b"\x89PNG")
    better = fit.write(tmp_path / "better.toml")
    assert "covariance" in better.read_text(encoding="utf-8")
    with pytest.raises(DrivelinkError, match="exists"):
        fit.write(better)
    found = drivelink.diagnose(other, joint=better)
    assert repr(found) == str(found) and str(found).startswith("The model is sufficient")
    assert found.plot()._repr_png_().startswith(b"\x89PNG")
    assert [path.name for path in found.report(tmp_path)] == ["report.json", "report.html"]


@pytest.mark.parametrize("value", [-1, 0, math.nan, math.inf, "8"])
def test_a_number_of_the_python_interface_that_cannot_be_is_one_line(value):
    for call, argument in (
        (drivelink.fit, {"bandwidth_hz": value}),
        (drivelink.diagnose, {"bandwidth_hz": value}),
        (partial(drivelink.compare, "a.toml"), {"horizon_s": value}),
    ):
        with pytest.raises(ValueError, match=f"^{next(iter(argument))}: expected a number above 0, got "):
            call("nosuch.csv", **argument)


@pytest.mark.parametrize(
    "wrong",
    [
        {},  # without the friction
        {"effects": (FRICTION,), "inertia_kg_m2": 0.026},
        {"effects": (FRICTION,), "transmission": Transmission(model="linear", parameters={"k_nm_rad": 6.0})},
    ],
)
def test_a_wrong_model_fits_worse(wrong):
    right, worse = (
        free_run(run(), one, 0.5).fit_percent for one in (joint(effects=(FRICTION,)), joint(**wrong))
    )
    assert all(worse[name] < right[name] - 1.0 for name in ("motor1_position", "motor1_deflection"))
