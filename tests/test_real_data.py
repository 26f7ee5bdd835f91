"""Measured machines: EMPS and two axes of a KUKA robot, against the published errors.

Skipped where the recordings are not there: `../shared/data` beside the project, or $DRIVELINK_DATA.
"""

import os
from pathlib import Path

import joints
import numpy as np
import pytest

from drivelink import jointfile, recording
from estimator import Status
from estimator.diagnosis import diagnose

ROOT = Path(__file__).resolve().parents[1]
DATA = Path(os.environ.get("DRIVELINK_DATA", ROOT.parent / "shared" / "data"))
UW = ("DoubleLoopDisturbance", "InnerLoop")
pytestmark = pytest.mark.skipif(
    not (DATA / "emps" / "train.csv").exists(), reason=f"no measured data in {DATA} (see $DRIVELINK_DATA)"
)


def _diagnose(joint, train, validation, bandwidth_hz):
    declared = jointfile.load(ROOT / "examples" / f"{joint}.toml")
    data = [recording.read(DATA / name, declared) for name in (train, validation)]
    return diagnose(data[0], declared.model(), bandwidth_hz, data[1])


@pytest.mark.slow
def test_emps_friction_is_found_and_the_published_errors_are_beaten():
    found = _diagnose("emps", "emps/train.csv", "emps/pulses.csv", 40.0)
    assert found.effects[0].name in ("presliding_friction", "asymmetric_friction", "coulomb_friction")
    assert found.train.after_relative < 0.035  # published: 4.08 %, 3.11 % with asymmetric viscous friction
    assert found.validation.after_relative < 0.0598  # published: 5.98 %


@pytest.mark.slow
@pytest.mark.parametrize(("axis", "limit"), [(3, 0.24), (2, 0.36)])
def test_kuka_axes_have_friction_and_get_better_on_the_other_recording(axis, limit):
    recordings = [f"kuka_kr300/axis{axis}_{name}.csv" for name in "AB"]
    found = _diagnose(f"kuka_axis{axis}", recordings[0], recordings[1], 15.0)
    assert found.validation.after_relative < limit  # thirty lines of least squares: 23.7 % and 35.0 %
    assert found.validation.after_rms_nm < found.validation.before_rms_nm
    assert any("friction" in effect.name for effect in found.effects)


def test_a_motor_that_rests_half_of_the_time_does_not_hide_the_friction():
    """Its velocity is moved within its noise, however large the torque; by more, friction explains anything."""
    joint = jointfile.parse(
        'name = "uw_sea"\narrangement = "single"\n[bus]\nperiod_s = 0.005\n[[motor]]\ninertia_kg_m2 = 5.878e-4\n'
        'viscous_damping_nm_s_rad = 0.0\ntransmission = { model = "linear" }\n'
    )
    train, other = (recording.read(DATA / "uw_sea" / f"uw_{name}.csv", joint) for name in UW)
    found = diagnose(train, joint.model(), 10.0, other)
    assert found.validation.after_relative < 0.416  # thirty lines of least squares
    (spring,) = found.transmissions
    assert abs(spring.parameters["k_nm_rad"] - 0.462) < 1.96 * spring.std["k_nm_rad"]  # its authors'


@pytest.mark.parametrize(("name", "least"), [("A", 0.2), ("B", 0.4)])
def test_kuka_axis_3_is_valid_on_line_with_nothing_but_its_inertia(name, least):
    """The arm's weight keeps its deflection on one side; a constant spring's zero there is a constant torque."""
    declared = jointfile.load(ROOT / "examples" / "kuka_axis3.toml")
    record = recording.read(DATA / "kuka_kr300" / f"axis3_{name}.csv", declared)
    _, status, _, stiffness, std = joints.estimates(declared.model(), record).T
    valid = status.astype(int) & Status.VALID > 0
    assert np.mean(valid) > least
    assert np.mean((np.abs(stiffness - 4.10e6) < 2.0 * std)[valid]) > 0.9  # its authors'
