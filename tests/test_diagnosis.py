"""Injected effects are named, located and measured; clean recordings raise no alarm; faults are one line."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import diagnosiskit as kit
import joints
import numpy as np
import pytest

import drivelink
from drivelink import jointfile
from drivelink.demo.simulate import world_from_joint
from drivelink.jointfile.apply_diagnosis import as_read
from estimator.choices import choice
from estimator.diagnosis import diagnose
from estimator.diagnosis.heldout import Held
from estimator.errors import EstimatorError
from estimator.identify import identify
from estimator.model import Effect, JointModel, Transmission
from estimator.sample import FloatArray, Record
from estimator.transmissions import MODELS
from sim.world import record as simulated

# What is put into each joint, and what must come out: name, location, main parameter, its tolerance.
# Tolerances: 3 % for what enters linearly, more where the law differs from the library's (friction's shape).
# A torque constant is as uncertain as the declared numbers that it is held against: two deviations.
CASES: dict[str, tuple[dict[str, float], str, str, str, float, float]] = {
    "coulomb": ({"coulomb_nm": 0.4}, "coulomb_friction", "motor", "torque_nm", 0.4, 0.02),
    "cogging": ({"cogging_nm": 0.5}, "cogging", "motor", "periods_per_rev", 17.0, 0.05),
    "offset": ({"offset_nm": -0.3}, "torque_offset", "motor", "torque_nm", -0.3, 0.01),
    "constant": ({"constant": 0.06}, "torque_constant", "motor", "relative_error", 0.06, 0.006),
    "inertia": ({"inertia_kg_m2": 0.02}, "motor_inertia", "motor", "inertia_kg_m2", 0.02, 0.001),
    "hysteresis": (
        {"hysteresis_nm": 0.6, "hysteresis_rad": 0.01}, "hysteresis", "transmission", "torque_nm", 0.6, 0.03,
    ),
    "zero": ({"zero_rad": 0.006}, "deflection_offset", "measurement", "offset_rad", 0.006, 2e-4),
    "late": ({"late_s": 0.004}, "encoder_delay", "measurement", "delay_s", 0.004, 1e-4),
    "gauge": (
        {"gauge_late_s": 0.03}, "deflection_delay", "measurement", "delay_s", 0.03, 1e-4,
    ),
    "gravity": ({"gravity_nm": 0.8}, "gravity", "link", "sin_nm", 0.8, 0.03),
    "link": ({"link_nm": 0.3}, "link_coulomb_friction", "link", "torque_nm", 0.3, 0.02),
}  # fmt: skip
OTHERS: dict[str, dict[str, float]] = {
    "clean": {}, "clean2": {}, "skew": {"late_s": 0.0007}, "bump": {"bump_nm": 1.0},
    "harmonics": {"cogging_nm": 0.5, "second_nm": 0.3},
    "two": {"coulomb_nm": 0.4, "gravity_nm": 0.8},
    "stribeck": {"coulomb_nm": 0.4, "stribeck_nm": 0.4}, "gauge, little": {"gauge_late_s": 0.002},
}  # fmt: skip
SURFACES = {"push": {"push_nm": 2.0}, "fading": {"fading_nm": 0.8}, "ripple": {"ripple": 0.2}}


@pytest.fixture(scope="module")
def records() -> dict[str, Record]:
    effects = {name: case[0] for name, case in CASES.items()} | OTHERS
    return dict(zip(effects, kit.World(list(effects.values())).run(), strict=True))


SLOW_CASES = ("coulomb", "cogging", "gauge", "offset", "constant", "inertia", "zero", "link")


@pytest.mark.parametrize(
    "case", [pytest.param(case, marks=pytest.mark.slow) if case in SLOW_CASES else case for case in CASES]
)
def test_an_injected_effect_is_named_located_and_measured(case, records):
    _, name, location, parameter, value, tolerance = CASES[case]
    found = diagnose(records[case], kit.model())
    assert found.verdict == "effect"
    first = found.effects[0]
    assert (first.name, first.location) == (name, location)
    assert first.parameters[parameter] == pytest.approx(value, abs=tolerance)
    # An effect at the link does not show in the motor's balance, which then stays at its noise.
    at_noise = found.validation.after_relative < choice("floor")
    assert found.validation.after_rms_nm <= found.validation.before_rms_nm or at_noise
    assert first.probability > 0.9
    assert any(" is left in the motor's balance, " in note for note in found.notes)


def test_friction_that_peaks_at_standstill_is_named_on_a_motion_that_rarely_stands_still(records):
    friction, *more = diagnose(records["stribeck"], kit.model()).effects
    assert not more and friction.name == "stribeck_friction" and friction.probability > 0.9
    assert friction.parameters["torque_nm"] == pytest.approx(0.4, abs=0.02)
    assert friction.parameters["stribeck_velocity_rad_s"] == pytest.approx(0.05, rel=0.3)  # the laws differ


def test_a_small_delay_without_link_dynamics_may_be_another_effects(records):
    (late,) = diagnose(records["gauge, little"], kit.model(linked=False)).effects
    assert {"deflection_delay", "transmission_damping"} < {late.name, *late.alternatives}
    assert late.probability < 0.9


def test_two_ripples_of_one_kind_are_both_found(records):
    found = diagnose(records["harmonics"], kit.model())
    assert [effect.name for effect in found.effects] == ["cogging", "cogging"]
    (curve,), (spring,) = found.stiffness, found.transmissions
    middle = len(curve.deflection_rad) // 2  # one interval: the band's is the stated one
    assert curve.after_std_nm_rad[middle] == pytest.approx(spring.std["k_nm_rad"], rel=1e-9)
    periods = sorted(float(effect.parameters["periods_per_rev"]) for effect in found.effects)
    assert periods == pytest.approx([17.0, 34.0], abs=0.1)


@pytest.mark.slow
def test_two_effects_are_both_named_and_a_halved_inertia_is_doubted(records):
    declared, doubt = kit.model(), "hardly to be believed"
    names = {effect.name for effect in diagnose(records["two"], declared).effects}
    assert {"coulomb_friction", "gravity"} <= names
    found = diagnose(records["clean"], joints.with_motor(declared, inertia_kg_m2=kit.INERTIA / 2))
    assert found.effects[0].name == "motor_inertia"
    assert any(doubt in note for note in found.notes)
    assert not any(doubt in note for note in diagnose(records["inertia"], declared).notes)


@pytest.mark.parametrize("case", ["clean", pytest.param("clean2", marks=pytest.mark.slow), "skew"])
def test_clean_and_everyday_recordings_are_sufficient(case, records):
    found = diagnose(records[case], kit.model())
    assert (found.verdict, found.effects) == ("sufficient", ())
    # What is left is the encoders' and the torque's noise: well below a percent.
    assert found.validation.after_relative < 0.01
    if case == "skew":  # within a sample: aligned, and reported
        assert found.alignment["link_position_delay_s"] == pytest.approx(0.0007, abs=5e-5)
        assert 0.0 < found.alignment_std["link_position_delay_s"] < 5e-5


def test_what_is_in_no_library_is_located_and_described_by_a_curve(records):
    found = diagnose(records["bump"], kit.model())
    assert found.verdict == "unexplained"
    assert (found.effects[0].name, found.effects[0].location) == ("unlisted", "motor")
    assert found.effects[0].coordinates == ("position",)
    assert found.validation.after_rms_nm < 0.5 * found.validation.before_rms_nm
    curve = found.curves[0]
    assert curve.fitted_nm.max() == pytest.approx(1.0, abs=0.3)  # the filter rounds a narrow bump


@pytest.mark.parametrize(
    ("case", "location", "coordinates"),
    [
        ("push", "link", ("time",)),
        pytest.param("fading", "motor", ("velocity", "time"), marks=pytest.mark.slow),
        pytest.param("ripple", "motor", ("position", "torque"), marks=pytest.mark.slow),
    ],
)
def test_what_no_function_of_one_coordinate_explains_is_never_sufficient(case, location, coordinates):
    (record,) = kit.World([SURFACES[case]], seconds=16.0).run()  # a surface needs more data than a curve
    found = diagnose(record, kit.model())
    assert found.verdict == "unexplained"
    assert (found.effects[0].location, found.effects[0].coordinates) == (location, coordinates)
    if location == "motor":  # the error is that of the motor's balance
        assert found.validation.after_rms_nm < 0.5 * found.validation.before_rms_nm


@pytest.mark.slow
def test_a_ripple_of_less_than_two_periods_is_told_from_the_gears_which_reacts():
    """Motor side alone, a linear spring: the torques differ by the reaction alone."""

    class Short(kit.World):
        def _reference(self, n: int, rng: np.random.Generator) -> FloatArray:
            return 0.3 * super()._reference(n, rng)

    (record,) = Short([{"cogging_nm": 0.4}]).run()
    (effect,) = diagnose(record, kit.model(linked=False)).effects
    assert effect.name == "cogging" and "kinematic_error" not in effect.alternatives


@pytest.mark.slow
def test_without_link_dynamics_friction_is_still_found(records):
    found = diagnose(records["coulomb"], kit.model(linked=False))
    # Offset and asymmetry are one thing without the link's side: a half quantum of the encoders is enough.
    assert {found.effects[0].name, *found.effects[0].alternatives} >= {"coulomb_friction"}
    assert {effect.location for effect in found.effects} == {"motor"}


@pytest.mark.slow
def test_an_offset_of_the_motor_side_alone_names_its_twin(records):
    found = diagnose(records["offset"], kit.model(linked=False))
    (offset,) = found.effects
    assert (offset.name, offset.alternatives) == ("torque_offset", ("deflection_offset",))
    assert (offset.probability, offset.alternative_probabilities) == (0.5, (0.5,))


def test_a_model_that_knows_the_effect_is_sufficient(records):
    known = kit.model()
    first = diagnose(records["late"], known).effects[0]
    known = replace(known, link_effects=(Effect(name=first.name, parameters=first.parameters),))
    assert diagnose(records["late"], known).verdict == "sufficient"


@pytest.mark.slow
def test_declared_numbers_off_by_a_percent_are_everyday_and_calibrated_on_a_healthy_run(records):
    off = kit.model(error=0.01)
    assert diagnose(records["clean"], off).verdict == "sufficient"
    calibrated = identify(records["clean"], off).model
    assert diagnose(records["clean2"], calibrated).verdict == "sufficient"
    assert [e.name for e in diagnose(records["coulomb"], calibrated).effects] == ["coulomb_friction"]
    # The torque is the anchor and exact but for its noise, so the number itself comes back.
    assert calibrated.motors[0].inertia_kg_m2 == pytest.approx(kit.INERTIA, rel=5e-3)


@pytest.mark.slow
def test_what_a_healthy_rig_reads_skewed_and_shifted_is_calibrated_too(records):
    """An encoder 0.3 ms late, with another zero, and a torque 0.25 ms late: no findings of a suspect run."""
    rig = {"late_s": 0.0003, "zero_rad": 0.004}
    (healthy,) = kit.World([rig], seed=3).run()
    clean, rubbing = kit.World([rig, {**rig, "coulomb_nm": 0.4}], seed=4).run()
    healthy, clean, rubbing = (with_late_torque(r, 0.00025) for r in (healthy, clean, rubbing))
    calibrated = identify(healthy, kit.model(error=0.01)).model
    (motor,) = calibrated.motors
    readings = {e.name: e.parameters for e in (*motor.effects, *calibrated.link_effects)}
    assert readings["encoder_delay"]["delay_s"] == pytest.approx(0.0003, abs=3e-5)
    assert readings["deflection_offset"]["offset_rad"] == pytest.approx(0.004, abs=2e-4)
    # The kit's torque is held for a period and acts as read: reported late by 0.25 ms is -0.25 ms of delay.
    assert readings["torque_delay"]["delay_s"] == pytest.approx(-0.00025, abs=5e-5)
    assert diagnose(clean, calibrated).verdict == "sufficient"
    assert [e.name for e in diagnose(rubbing, calibrated).effects] == ["coulomb_friction"]


def with_late_torque(record: Record, late_s: float) -> Record:
    """The same with its torque reported later, between the samples by lines."""
    index = np.arange(len(record), dtype=np.float64)
    torque = np.interp(index - late_s / record.period_s, index, record.motor_torque_nm[:, 0])
    return replace(record, motor_torque_nm=torque[:, None])


@pytest.mark.slow
def test_a_slow_sine_decides_nothing():
    (record,) = kit.World([{"constant": 0.05}], slow=True, seconds=16.0).run()
    found = diagnose(record, kit.model(linked=False))
    assert found.verdict == "insufficient_excitation"


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda r: replace(r, motor_torque_nm=0.0 * r.motor_torque_nm), "motor1_torque_nm is constant"),
        (lambda r: replace(r, motor_torque_nm=np.nan * r.motor_torque_nm), "not finite"),
        (lambda r: replace(r, link_position_rad=None), "no link_position_rad"),
        (lambda r: joints.part(r, slice(500)), "too short"),
    ],
)
def test_a_fault_of_installation_is_one_line(change, message, records):
    with pytest.raises(EstimatorError, match=message):
        diagnose(change(records["clean"]), kit.model())


@pytest.mark.parametrize(
    ("gain", "best", "chosen"),
    [
        (0.0, 0.0, "coulomb_friction"),  # a parameter more has to gain
        (0.2, 0.0, "asymmetric_friction"),
        (np.resize([0.3, -0.2], 10), 0.0, "coulomb_friction"),  # a gain within its standard error is none
        (0.2, np.resize([2.3, -1.7], 10), "asymmetric_friction"),  # the best is not sure over either
    ],
)
def test_the_simplest_within_one_standard_error_is_chosen(gain, best, chosen, monkeypatch):
    simple, other, third = (
        SimpleNamespace(
            extra=None,
            name=name,
            keys=frozenset({(name, 0)}),
            scores=scores,
            terms=(),
            bends=frozenset(),
            log_prior=lambda *_, prior=prior: prior,
        )
        for name, scores, prior in (
            ("coulomb_friction", np.zeros(10), -6.0),
            ("asymmetric_friction", np.zeros(10) + gain, -9.0),
            ("presliding_friction", np.zeros(10) + best, -12.0),
        )
    )
    monkeypatch.setattr(Held, "scores", lambda _, one, among=(): one.scores)
    monkeypatch.setattr(Held, "squared", lambda _, one: float(np.mean(np.exp(-2.0 * one.scores))))
    monkeypatch.setattr(Held, "_relative", lambda _, floor: np.square(floor))
    monkeypatch.setattr(Held, "_independent", lambda *_: 300.0)
    monkeypatch.setattr("estimator.diagnosis.heldout.twins", lambda *_: ())
    held: Any = Held.__new__(Held)
    held.price, held.problem = 3.0, SimpleNamespace(floor=choice("floor"))
    for one, families, parameters in zip((simple, other, third), ("a", "ab", "abc"), (2, 3, 4), strict=True):
        one.families, one.parameters, one.regression = frozenset(families), parameters, held.problem
    found = held.simplest([simple, other, third])
    assert found.name == chosen
    assert held.weights([found, other if found is simple else simple], found)[0] > 0.9
    # A law that leaves what laws leave anyway is preferred, but not where it scores less than what is ruled out.
    third.families, third.scores = simple.families, simple.scores + 0.5
    simple.regression = other.regression = third.regression = SimpleNamespace(floor=3.0)
    assert held.simplest([simple, third]) is simple
    assert held.weights([simple, third], simple, naming=False)[1] > 0.9  # for an interval what is left counts
    other.families, other.parameters, other.scores = simple.families, simple.parameters, simple.scores + 0.5
    third.scores, third.log_prior = other.scores + np.resize([0.1, -0.12], 10), lambda *_: -8.0
    assert held.simplest([simple, other, third]) is third


def test_friction_is_named_where_the_declared_spring_carries_nothing():
    # A coupling that has come loose: the link moves on its own, and drags the motor along a little, so that no
    # stiffness above zero fits better than none. The motor's friction is still in its balance.
    time = 1e-3 * np.arange(20_000)
    motor = kit.model(linked=False).motors[0]
    w = np.array([2.0, 5.3])
    theta, velocity, acceleration = (
        np.array([0.5, 0.2]) @ (w[:, None] ** k * np.sin(np.outer(w, time) + 0.5 * np.pi * k))
        for k in range(3)
    )
    apart = 0.05 * np.sin(9.1 * time)
    torque = motor.inertia_kg_m2 * acceleration + motor.viscous_damping_nm_s_rad * velocity
    torque += 0.4 * np.tanh(velocity / 0.05) + 0.5 * apart
    rng = np.random.default_rng(7)
    theta_read, torque = (x + e * rng.standard_normal(len(time)) for x, e in ((theta, 1e-5), (torque, 0.01)))
    record = joints.recorded(theta_read, torque, theta + apart)
    found = diagnose(record, kit.model(linked=False))
    (first,) = found.effects
    assert first.name == "coulomb_friction"
    assert first.parameters["torque_nm"] == pytest.approx(0.4, abs=0.02)  # as among the cases above
    assert found.transmissions[0].parameters == {}
    assert any("no positive one fits better than none" in note for note in found.notes)


def test_rounding_of_a_healthy_joint_as_it_is_packaged_is_no_effect():
    """In its link's balance 3 % of the torque is rounding: less where all inertias and torques shrink alike."""
    joint = jointfile.load(Path(drivelink.__file__).parent / "joints" / "constant.toml")
    found = diagnose(joints.of_world(simulated(world_from_joint(joint), 40.0)), joint.model())
    assert (found.verdict, found.effects) == ("sufficient", ())


@pytest.mark.slow
def test_a_spring_that_is_no_polynomial_is_no_play_where_the_order_is_open():
    """Beside an effect the order is chosen with the effect, and play is as likely as another law at most."""
    lone, beside = kit.World([{"bend_nm_rad2": 1500.0}, {"bend_nm_rad2": 1500.0, "cogging_nm": 0.6}]).run()
    free = _open_polynomial(kit.model())
    assert all(f.name == "backlash" and f.probability <= 0.5 for f in diagnose(lone, free).effects)
    found = diagnose(beside, free)
    assert [f.name for f in found.effects] == ["cogging"]
    (spring,) = found.transmissions
    law, phi = MODELS["polynomial"], np.linspace(0.01, 0.06, 6)
    stiffness = law.stiffness(phi, law.alpha(spring.parameters))
    assert stiffness == pytest.approx(kit.STIFFNESS + 3000.0 * phi, rel=0.03)


def test_a_spring_that_the_declared_law_does_not_hold_is_no_finding_in_a_second_recording():
    first, second = (kit.World([{"bend_nm_rad2": 1500.0}], seed=seed).run()[0] for seed in (1, 2))
    cubic = joints.with_motor(kit.model(), transmission=Transmission(model="polynomial", order=2))
    fitted = identify(first, cubic)
    found = diagnose(second, as_read(fitted.model, first, fitted.surplus))
    assert (found.verdict, found.effects) == ("sufficient", ())


def test_what_the_motors_side_alone_leaves_open_is_said():
    """Friction that differs between the directions, or an offset beside it; an encoder or a gear, once a turn."""
    uneven, turning = kit.World([{"coulomb_nm": 0.4, "offset_nm": 0.15}, {"eccentric_rad": 0.006}]).run()
    for record, names in (
        (uneven, {"coulomb_friction", "asymmetric_friction"}),
        (turning, {"encoder_eccentricity", "kinematic_error"}),
    ):
        (effect,) = diagnose(record, kit.model(linked=False)).effects
        assert {effect.name, *effect.alternatives} >= names and effect.probability < 0.9


def test_no_order_is_chosen_whose_coefficients_no_joint_file_holds():
    """Of a stiff joint: a thousandth of the deflection, and so of the motion."""
    (record,) = kit.World([{"bend_nm_rad2": 1500.0}]).run()
    assert record.link_position_rad is not None
    heavy = {"inertia_kg_m2": 1e3 * kit.INERTIA, "viscous_damping_nm_s_rad": 1e3 * kit.DAMPING}
    stiff = joints.with_motor(kit.model(linked=False), **heavy)
    small = replace(
        record,
        motor_position_rad=1e-3 * record.motor_position_rad,
        link_position_rad=1e-3 * record.link_position_rad,
    )
    coefficients = (
        identify(small, _open_polynomial(stiff))
        .model.motors[0]
        .transmission.parameters["coefficients_nm_rad"]
    )
    assert isinstance(coefficients, tuple) and coefficients[0] == pytest.approx(1e3 * kit.STIFFNESS, rel=0.2)


def _open_polynomial(model: JointModel) -> JointModel:
    return joints.with_motor(model, transmission=Transmission(model="polynomial"))
