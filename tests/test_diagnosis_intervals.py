"""Intervals of a diagnosis hold where errors are no noise; how sure the inertia is can be declared."""

from dataclasses import replace

import diagnosiskit as kit
import joints
import numpy as np
import pytest

from drivelink import jointfile
from drivelink.errors import JointFileError
from estimator import Effect
from estimator.batch import fit
from estimator.diagnosis import diagnose
from estimator.diagnosis.covariance import hac_covariance
from estimator.diagnosis.hypothesis import Fitted
from estimator.diagnosis.problem import Problem
from estimator.gate import at_limit
from estimator.identify import identify
from estimator.model import JointModel, Transmission
from estimator.sample import SIGMA_95, FloatArray, Record

PARTS = 4
BANDWIDTH_HZ = 20.0
# Physics that the declared model lacks, in sizes of some per cent of the torque.
MISSING: list[dict[str, float]] = [
    {"coulomb_nm": 0.4}, {"cogging_nm": 0.5}, {"hysteresis_nm": 0.6, "hysteresis_rad": 0.01},
    {"ripple": 0.2}, {"bump_nm": 1.0}, {"fading_nm": 0.8},
]  # fmt: skip


def parts(record: Record) -> list[Record]:
    length = len(record) // PARTS
    return [joints.part(record, slice(k * length, (k + 1) * length)) for k in range(PARTS)]


def stiffness(record: Record, model: JointModel) -> tuple[float, float]:
    """K and its standard deviation under the declared model, nothing searched."""
    problem = Problem([record], model, BANDWIDTH_HZ)
    fitted = problem.null()
    return k_of(fitted), float(np.sqrt(hac_covariance(problem, fitted)[0, 0]))


def k_of(fitted: Fitted) -> float:
    assert fitted.slots[0].kind == "base"
    return float(fitted.slots[0].taken + fitted.posterior.x[0])


def chi_squared(k: FloatArray, std: FloatArray) -> float:
    mean = np.sum(k / std**2) / np.sum(1.0 / std**2)
    return float(np.sum(((k - mean) / std) ** 2))


@pytest.mark.slow
def test_parts_of_a_recording_agree_within_what_is_said_though_physics_is_missing():
    """Without the link's dynamics, as most machines are; nothing of what is missing is declared."""
    model = kit.model(linked=False)
    pairs = [
        np.array([stiffness(one, model) for one in parts(record)]).T for record in kit.World(MISSING).run()
    ]
    freedom = len(MISSING) * (PARTS - 1)
    ratio = sum(chi_squared(k, std) for k, std in pairs) / freedom
    # 18 degrees of freedom: chance alone moves the ratio between 0.46 and 1.75 (95 %).
    assert 0.4 < ratio < 1.75


@pytest.mark.slow
def test_an_effect_that_moves_the_stiffness_is_in_the_interval_of_a_fit():
    """Undeclared hysteresis, which stiffens the joint in all parts of the motion alike."""
    missing = [{"hysteresis_nm": nm, "hysteresis_rad": rad} for nm, rad in ((0.6, 0.01), (2.0, 0.05))]
    for record in kit.World(missing).run():
        k, std = _stated(record, kit.model(linked=False))
        assert 0.04 < k / kit.STIFFNESS - 1.0 < SIGMA_95 * std / kit.STIFFNESS


@pytest.mark.parametrize("linked", [True, False])
def test_a_torque_gain_that_drifts_is_in_the_interval_of_a_fit_and_a_healthy_drive_widens_none(linked):
    """The inertias follow the gain, and with them the stiffness."""
    (record,) = kit.World([{}]).run()
    gain = 1.0 + 0.1 * np.expm1(-np.arange(len(record)) * kit.PERIOD_S / 4.0)
    warm = replace(record, motor_torque_nm=record.motor_torque_nm / gain[:, None])
    off, half = [], []
    for one in (record, warm):
        k, std = _stated(one, kit.model(linked=linked))
        off.append(k / kit.STIFFNESS - 1.0)
        half.append(SIGMA_95 * std / kit.STIFFNESS)
    assert half[0] < 0.005
    assert 0.04 < off[1] < half[1] < 0.3


def test_a_loss_while_the_link_drives_is_in_the_interval_of_a_fit():
    """Half of it both ways, and a softer spring, leave the same."""
    (record,) = kit.World([{"back_share": 0.15}]).run()
    k, std = _stated(record, kit.model())
    assert 0.05 < 1.0 - k / kit.STIFFNESS < SIGMA_95 * std / kit.STIFFNESS < 0.2


@pytest.mark.parametrize("linked", [True, False])
def test_an_effect_is_no_delay_of_a_reading_and_in_the_interval_of_the_damping(linked):
    """Undeclared hysteresis is late and damps; what fits it explains the delay."""
    (record,) = kit.World([{"hysteresis_nm": 0.6, "hysteresis_rad": 0.01}]).run()
    found = identify(record, kit.model(linked=linked))
    assert not found.model.link_effects
    (motor,) = found.model.motors
    std = motor.viscous_damping_std_nm_s_rad
    assert std is not None and abs(motor.viscous_damping_nm_s_rad - kit.DAMPING) < SIGMA_95 * std


@pytest.mark.slow
def test_no_shape_is_stated_that_the_law_does_not_have():
    """A constant spring declared as a VSA-II's: no joint file holds the shape that fits it."""
    (record,) = kit.World([{"hysteresis_nm": 0.6, "hysteresis_rad": 0.01}]).run()
    found = diagnose(record, joints.with_motor(kit.model(), transmission=Transmission(model="vsa-ii")))
    assert not found.transmissions[0].parameters
    assert any("leaves the range that the law has" in note for note in found.notes)


def _stated(record: Record, model: JointModel) -> tuple[float, float]:
    """K and its standard deviation by `fit`."""
    (found,) = fit(record, model)
    k, std = found.parameters["k_nm_rad"], found.std["k_nm_rad"]
    assert isinstance(k, float) and isinstance(std, float)
    return k, std


def test_where_a_torque_rests_on_its_limit_more_may_have_acted():
    """Taken as it is, it makes a stiffness 3 % wrong and a friction that is not there."""
    (record,) = kit.World([{}]).run()
    torque = record.motor_torque_nm
    limit = 0.8 * np.max(np.abs(torque))
    clipped = replace(record, motor_torque_nm=np.clip(torque, -limit, limit))
    found = diagnose(clipped, kit.model())
    assert found.verdict == "sufficient"
    assert any("as if clipped" in note for note in found.notes)
    identified = identify(clipped, kit.model())
    assert any("as if clipped" in note for note in identified.notes)
    k = identified.fits[0].parameters["k_nm_rad"]
    assert k == pytest.approx(kit.STIFFNESS, rel=0.002)


@pytest.mark.parametrize("order", [3, 4])
def test_the_zero_of_a_spring_that_bends_is_found_before_it_is_judged(order):
    """Far from it a straight line through the spring promises more than there is."""
    (record,) = kit.World([{"bend_nm_rad2": 3000.0, "zero_rad": 0.02}]).run()
    spring = Transmission(model="polynomial", order=order)
    model = joints.with_motor(kit.model(linked=False), transmission=spring)
    fitted = Problem([record], model, 15.0).null()
    assert fitted.total("everyday", "deflection_offset", 0, run=0)[0] == pytest.approx(0.02, abs=3e-4)


def test_a_torque_that_is_often_at_its_limit_is_as_it_is():
    """So is one that passes its peak within what a line bridges."""
    (record,) = kit.World([{}], seconds=2.0).run()
    assert not len(at_limit(record))
    assert not len(at_limit(replace(record, motor_torque_nm=np.sign(record.motor_torque_nm))))
    few = record.motor_torque_nm.copy()
    few[100:105] = 2.0 * np.max(few)
    assert at_limit(replace(record, motor_torque_nm=few)).tolist() == [[100, 104]]


def test_a_peak_that_rounding_makes_flat_is_not_clipped():
    (record,) = kit.World([{}], seconds=2.0).run()
    sine = np.sin(3.0 * np.arange(len(record)) * record.period_s)[:, None]
    rounded, clipped = np.round(sine, 3), np.round(np.clip(sine, -1.0, 0.9), 3)
    assert not len(at_limit(replace(record, motor_torque_nm=rounded)))
    assert len(at_limit(replace(record, motor_torque_nm=clipped)))


def test_a_declared_friction_errs_as_one_that_is_found():
    """Its sign changes over another velocity than declared: a healthy joint "lacked" an encoder's delay."""
    (record,) = kit.World([{"coulomb_nm": 2.0}], seconds=8.0).run()
    friction = Effect(name="coulomb_friction", parameters={"torque_nm": 2.0, "smoothing_rad_s": 0.03})
    found = diagnose(record, joints.with_motor(kit.model(linked=False), effects=(friction,)))
    assert found.verdict == "sufficient"


def test_an_inertia_moves_as_far_as_it_is_declared_unsure():
    """Twenty per cent too much, declared unsure and declared as certain."""
    (record,) = kit.World([{}]).run()
    exact, found = kit.model(linked=False), {}
    for std in (0.5, 1e-5):
        declared = joints.with_motor(exact, inertia_kg_m2=1.2 * kit.INERTIA, inertia_std_relative=std)
        (found[std],) = Problem([record], declared, BANDWIDTH_HZ).null().total("everyday", "motor_inertia", 0)
    assert found[0.5] == pytest.approx(-0.2 * kit.INERTIA, rel=0.02)
    assert abs(found[1e-5]) < 0.02 * kit.INERTIA


def test_the_joint_file_says_how_sure_the_inertia_is():
    text = 'name = "axis"\n[[motor]]\ninertia_kg_m2 = 0.1\ninertia_std_relative = {}\n'
    assert jointfile.parse(text.format(0.2)).model().motors[0].inertia_std_relative == 0.2
    for wrong in ("0.0", "-0.1", '"wide"'):
        with pytest.raises(JointFileError, match="inertia_std_relative"):
            jointfile.parse(text.format(wrong))


# Delays that a drive or a bus has are fitted and found; longer ones are errors of the time stamps.

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
