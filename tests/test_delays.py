"""Delays that a drive or a bus has are fitted and found; longer ones are errors of the time stamps."""

import diagnosiskit as kit
import joints
import numpy as np
import pytest

from estimator.diagnosis import diagnose
from estimator.identify import identify
from estimator.sample import Record

EVERY = 5  # samples of a millisecond in one period of the slow recording


def slow(record: Record) -> Record:
    """The same motion with a longer period: the torque is that of its hold."""
    assert record.link_position_rad is not None
    torque = record.motor_torque_nm.reshape(-1, EVERY).mean(axis=1)
    theta, q = record.motor_position_rad[::EVERY], record.link_position_rad[::EVERY]
    return joints.recorded(theta, torque, q, EVERY * record.period_s)


def test_fit_writes_a_delay_of_two_samples_and_none_of_tens_of_milliseconds():
    usual, long = (slow(one) for one in kit.World([{"late_s": 0.010}, {"late_s": 0.022}]).run())
    found = identify(usual, kit.model(linked=False))
    (effect,) = found.model.link_effects
    assert effect.parameters["delay_s"] == pytest.approx(0.010, abs=2e-4)
    assert found.fits[0].parameters["k_nm_rad"] == pytest.approx(kit.STIFFNESS, rel=0.02)
    found = identify(long, kit.model(linked=False))
    assert found.model.link_effects == ()
    assert found.fits[0].link_delay_s == 0.0
    assert any("encoder_delay of 0.022 s" in note and "time stamps" in note for note in found.notes)
    # Without the delay the model does not hold: the interval covers the other explanation.
    assert abs(found.fits[0].alpha[0] - kit.STIFFNESS) < 3.0 * np.sqrt(found.fits[0].covariance[0, 0])


@pytest.mark.slow
def test_diagnose_names_no_delay_of_tens_of_milliseconds():
    (record,) = kit.World([{"late_s": 0.030}]).run()
    found = diagnose(record, kit.model(), 15.0)
    assert found.verdict == "unexplained"
    assert [(e.name, e.location, e.coordinates, e.parameters) for e in found.effects] == [
        ("unlisted", "measurement", ("link_velocity",), {})
    ]
    assert "link_position_delay_s" not in found.alignment
    assert any("encoder_delay of 0.03 s" in note for note in found.notes)
    assert not found.transmissions[0].parameters  # a stiffness that rests on a delay that is none
    assert any("no stiffness is reported" in note for note in found.notes)
