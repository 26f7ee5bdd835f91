"""`drivelink compare`: what tells two models apart is told, and what does not differ is not."""

from __future__ import annotations

import json
import math
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from drivelink import cli, jointfile
from drivelink.comparison import compare
from drivelink.demo.simulate import alter, world_from_joint
from drivelink.output.comparison import fits
from sim.world import record

ELBOW = Path(__file__).parent.parent / "examples" / "elbow.toml"
SOFTER = {"motor1_coefficient1_nm_rad": 108.0, "motor1_coefficient2_nm_rad": 360.0}
COLUMNS = ("time_s", "motor1_position_rad", "motor1_velocity_rad_s", "motor1_torque_nm", "link_position_rad")


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A healthy run, one with a softer spring, one with friction."""
    folder = tmp_path_factory.mktemp("runs")
    kinds = {"healthy": ((), {}), "soft": ((), SOFTER), "friction": (("coulomb_friction=0.6",), {})}
    for name, (effects, parameters) in kinds.items():
        world = world_from_joint(jointfile.load(ELBOW))
        alter(world, effects, parameters)
        columns = record(world, 3.0)
        rows = np.column_stack([columns[column] for column in COLUMNS])
        np.savetxt(folder / f"{name}.csv", rows, "%.17g", ",", header=",".join(COLUMNS), comments="")
    return folder


def test_two_machines_differ_in_the_stiffness_and_each_model_fits_its_own(runs):
    made = compare(runs / "healthy.csv", runs / "soft.csv", ELBOW, horizon_s=1.0)
    stiffness, friction = made.differences()
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


def test_motion_at_constant_velocity_stands_beside_a_free_run_only_where_it_beats_the_mean(runs):
    run = compare(ELBOW, runs / "healthy.csv", horizon_s=1.0).runs[0][1]
    names = run.channels
    shown = []
    for coasting in ([-500.0] * 3, [40.0, -500.0, math.nan]):
        one = replace(run, coasting_percent=dict(zip(names, coasting, strict=True)))
        (grid,) = fits({"declared": one}, "healthy.csv").blocks
        shown.append((grid.head[-1], [row[-1] for row in grid.rows]))
    assert shown[0][0] == "declared" and "diverges" not in shown[0][1]
    assert shown[1] == ("at constant velocity", ["40.0 %", "below 0 %", "–"])


def test_the_verb_writes_a_page_and_numbers(runs, capsys):
    healthy = str(runs / "healthy.csv")
    assert cli.main(["compare", str(ELBOW), healthy, "--horizon", "1", "--out", str(runs / "page")]) == 0
    assert "fit of healthy.csv" in capsys.readouterr().out
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
    errors = [line for line in capsys.readouterr().err.splitlines() if line.startswith("drivelink")]
    assert len(errors) == 3 and "expected a number above 0" in errors[0]
    assert errors[2].startswith(
        f"drivelink compare: {bare}, over {healthy}: transmission.parameters: expected"
    )
