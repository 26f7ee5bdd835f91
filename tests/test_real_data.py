"""Measured machines: EMPS and two axes of a KUKA robot, against the published errors.

Skipped where the recordings are not there: `../shared/data` beside the project, or $DRIVELINK_DATA.
"""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from drivelink import jointfile, recording
from estimator.diagnosis import Diagnosis, diagnose

ROOT = Path(__file__).resolve().parents[1]
DATA = Path(os.environ.get("DRIVELINK_DATA", ROOT.parent / "shared" / "data"))
pytestmark = pytest.mark.skipif(
    not (DATA / "emps" / "train.csv").exists(), reason=f"no measured data in {DATA} (see $DRIVELINK_DATA)"
)


def _diagnose(joint: str, train: str, validation: str, bandwidth_hz: float) -> Diagnosis:
    declared = jointfile.load(ROOT / "examples" / f"{joint}.toml")
    data = [recording.read(DATA / name, declared) for name in (train, validation)]
    return diagnose(data[0], declared.model(), bandwidth_hz, data[1])


def test_emps_friction_is_found_and_the_published_errors_are_beaten() -> None:
    found = _diagnose("emps", "emps/train.csv", "emps/pulses.csv", 40.0)
    assert found.effects[0].name == "asymmetric_friction"
    assert found.train.after_relative < 0.035  # published: 4.08 %, 3.11 % with asymmetric viscous friction
    assert found.validation.after_relative < 0.0598  # published: 5.98 %


@pytest.mark.parametrize(("axis", "limit", "nominal"), [(3, 0.24, 4.10e6), (2, 0.36, 7.52e6)])
def test_kuka_axes_have_skewed_encoders_and_friction(axis: int, limit: float, nominal: float) -> None:
    recordings = [f"kuka_kr300/axis{axis}_{name}.csv" for name in "AB"]
    found = _diagnose(f"kuka_axis{axis}", recordings[0], recordings[1], 15.0)
    assert found.validation.after_relative < limit  # with friction and a velocity term: 23 % and 44 %
    # The authors regress 2.6 to 2.9 ms of skew; it is less than a sample and no effect.
    assert found.alignment["link_position_delay_s"] == pytest.approx(2.6e-3, abs=3e-4)
    assert any("friction" in effect.name for effect in found.effects)
    stiffness = found.transmissions[0]["k_nm_rad"]
    assert isinstance(stiffness, float)
    assert 0.4 * nominal < stiffness < 1.2 * nominal
