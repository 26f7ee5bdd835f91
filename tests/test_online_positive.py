"""A stiffness that is not above zero, or whose interval holds zero, is never valid and never written."""

import os
from dataclasses import replace
from itertools import product
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import onlinekit as kit
import pytest

from drivelink import jointfile, recording
from drivelink.errors import JointFileError
from estimator import EstimatorSettings, Motor, Status, Transmission, fit, make_estimator
from estimator.errors import EstimatorError
from estimator.gate import judge
from sim.cases import CASES

ROOT = Path(__file__).resolve().parents[1]
DATA = Path(os.environ.get("DRIVELINK_DATA", ROOT.parent / "shared" / "data"))
measured = pytest.mark.skipif(
    not (DATA / "kuka_kr300").exists(), reason=f"no measured data in {DATA} (see $DRIVELINK_DATA)"
)


def unusable(estimates):
    """Valid although the stiffness, or the end of its interval, is not above zero; no interval counts as none."""
    std = np.where(np.isnan(estimates.std_nm_rad), 0.0, estimates.std_nm_rad)
    return estimates.valid & ~(estimates.stiffness_nm_rad - 1.96 * std > 0.0)


@pytest.mark.parametrize("name", CASES)
def test_what_is_valid_is_above_zero(name):
    motion = kit.motion(name, 6.0)
    for mode, method in product(("paper", "robust"), ("mbe", "bbe")):
        estimates, _ = kit.play(kit.declared(name, parameters={}), motion.samples, mode=mode, method=method)
        assert not np.any(unusable(estimates)), (mode, method)


def test_a_paper_stiffness_that_changes_its_sign_is_hardly_ever_valid():
    motion = kit.motion("vsa-ii", 8.0)
    estimates, _ = kit.play(kit.declared("vsa-ii"), motion.samples, mode="paper")
    assert np.mean(estimates.stiffness_nm_rad <= 0.0) > 0.2
    assert np.mean(estimates.valid) < 0.01


def test_a_paper_stiffness_that_holds_still_is_valid():
    motion = kit.motion("constant", 10.0)
    estimates, _ = kit.play(kit.declared("constant"), motion.samples, mode="paper", method="mbe")
    late = slice(6000, None)
    assert np.mean(estimates.valid[late]) > 0.95
    assert estimates.stiffness_nm_rad[late] == pytest.approx(motion.stiffness_nm_rad[late], rel=0.01)


@measured
@pytest.mark.parametrize("mode", ["paper", "robust"])
@pytest.mark.parametrize("axis", [2, 3])
def test_on_a_measured_axis_too(axis, mode):
    joint = jointfile.load(ROOT / "examples" / f"kuka_axis{axis}.toml")
    record = recording.read(DATA / "kuka_kr300" / f"axis{axis}_A.csv", joint)
    estimator = make_estimator(joint.model(), EstimatorSettings(mode=mode), record.period_s)
    rows = [estimator.step(sample)[:5] for sample in record.samples()]
    _, status, torque, stiffness, std = np.array(rows).T
    estimates = kit.Estimates(status.astype(int), torque, stiffness, std)
    assert not np.any(unusable(estimates))


def test_a_fit_with_the_torque_reversed_has_no_stiffness_and_the_gate_says_why():
    samples, model = kit.motion("constant", 12.0).samples, kit.declared("constant", parameters={})
    assert fit(kit.recorded(samples), model)[0].stiffens
    wrong = kit.recorded(samples, -1.0)
    assert "wrong sign" in judge(wrong, model).remark
    assert not fit(wrong, model)[0].stiffens


@pytest.mark.parametrize("coefficients", [(-5.0,), (-1.0, 200.0), (0.0, 0.0)])
def test_a_declared_stiffness_below_zero_is_refused(coefficients):
    transmission = Transmission(parameters={"coefficients_nm_rad": coefficients})
    model = replace(kit.declared("constant"), motors=(Motor(inertia_kg_m2=0.1, transmission=transmission),))
    with pytest.raises(EstimatorError, match="expected a stiffness above 0"):
        make_estimator(model, EstimatorSettings(), kit.PERIOD_S)
    listed = f"model = 'polynomial'\nparameters = {{ coefficients_nm_rad = {list(coefficients)} }}\n"
    with pytest.raises(JointFileError, match=r"motor.*expected a stiffness above 0 N·m/rad"):
        jointfile.parse(f'name = "a"\n[[motor]]\ninertia_kg_m2 = 0.1\n[motor.transmission]\n{listed}')


def test_valid_and_the_model_alarm_do_not_stand_together():
    samples, alarm = kit.motion("constant", 3.0).samples, SimpleNamespace(step=lambda *_: True, describe=dict)
    quiet, _ = kit.play(kit.declared("constant"), samples)
    alarmed, _ = kit.play(kit.declared("constant"), samples, model_monitor=alarm)
    assert np.any(quiet.valid)
    assert np.all(alarmed.status & int(Status.MODEL_ALARM))
    assert not np.any(alarmed.valid)
