"""Fit, prediction and diagnosis in Python, and the free run as the second judge of a model."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from joints import Plants, polynomial, record, simulate

import drivelink
from drivelink.errors import DrivelinkError
from estimator import Effect, EstimatorError, JointModel, LinkDynamics, Motor, Record, Transmission
from estimator.freerun import free_run, nrmse_fit

PERIOD_S = 0.001
SPRING = {"k_nm_rad": 8.0}
FRICTION = Effect(name="coulomb_friction", parameters={"torque_nm": 0.05, "smoothing_rad_s": 1e-3})


def joint(**motor: object) -> JointModel:
    made = Motor(
        inertia_kg_m2=0.02,
        viscous_damping_nm_s_rad=0.05,
        transmission=Transmission(model="linear", parameters=SPRING),
    )
    link = LinkDynamics(inertia_kg_m2=0.04, viscous_damping_nm_s_rad=0.01, gravity_nm=0.6)
    return JointModel(arrangement="single", motors=(replace(made, **motor),), link=link)


@cache
def run(seconds: float = 1.5) -> Record:
    torque, stiffness = polynomial(np.array([[[8.0]]]))
    plants = Plants(
        torque, stiffness, B=0.02, D=0.05, M=0.04,
        Dq=0.01, gravity=0.6, coulomb=0.05,
    )  # fmt: skip
    t = np.arange(round(seconds / PERIOD_S)) * PERIOD_S
    tau = 0.7 * np.sin(2 * np.pi * 0.9 * t) + 0.5 * np.sin(2 * np.pi * 2.3 * t + 1.0)
    return record(simulate(plants, tau[:, None, None], PERIOD_S, substeps=3), 0, PERIOD_S)


def test_the_free_run_of_the_true_model_is_what_another_integrator_gives():
    made = free_run(run(), joint(effects=(FRICTION,)), 1.5)
    assert made.channels == ("motor1_position", "link_position", "motor1_deflection")
    assert min(made.fit_percent.values()) > 99.0
    assert max(made.coasting_percent.values()) < 10.0  # no fit for nothing
    made = free_run(run(), replace(joint(effects=(FRICTION,)), link=None), 1.0)  # the measured link drives it
    assert made.channels == ("motor1_position", "motor1_deflection")
    assert min(made.fit_percent.values()) > 98.0


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


def test_the_horizon_shrinks_until_a_drifting_run_fits_and_windows_with_a_gap_are_left_out():
    truth = run()
    bad = joint(inertia_kg_m2=0.4)
    assert min(free_run(truth, bad, 1.5).fit_percent.values()) < 0.0
    chosen = free_run(truth, bad)
    assert chosen.horizon_s < 1.5 and min(chosen.fit_percent.values()) > 0.0
    gap = np.arange(len(truth)) + 7 * (np.arange(len(truth)) > 750)
    assert len(free_run(replace(truth, sequence=gap), joint(), 0.5).time_s) == 1000


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
    assert min(fit.predict(other, 0.05).fit_percent.values()) > 80.0
    assert fit.plot()._repr_png_().startswith(b"\x89PNG")
    better = fit.write(tmp_path / "better.toml")
    assert "covariance" in better.read_text(encoding="utf-8")
    with pytest.raises(DrivelinkError, match="exists"):
        fit.write(better)
    found = drivelink.diagnose(other, joint=better)
    assert str(found).startswith("The model is sufficient")
    assert found.plot()._repr_png_().startswith(b"\x89PNG")
    assert [path.name for path in found.report(tmp_path)] == ["report.json", "report.html"]
