"""benchmarks/world.c, the independent joint in C, beside another integrator, and what it has shown."""

import shutil
import sys
from dataclasses import replace
from pathlib import Path

import joints
import numpy as np
import onlinekit as kit
import pytest

from estimator import (
    Effect,
    EstimatorError,
    JointModel,
    LinkDynamics,
    Status,
    fit,
)
from estimator.diagnosis import diagnose
from estimator.diagnosis.fourier import Shape
from estimator.freerun import free_run

sys.path.append(str(Path(__file__).parents[1] / "benchmarks"))
import motion
from world import simulate

pytestmark = pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler (cc)")


def simulated(settings: str):
    """A joint by the program's settings, `NAME=VALUE …`."""
    given = dict(one.split("=") for one in settings.split())
    return simulate(**{name: float(text) if name == "period" else text for name, text in given.items()})


EXACT = "motor_counts=0 link_bits=0 seconds=2"
COARSE = "motor_counts=262144 link_bits=17 torque_noise=0.0036"


@pytest.mark.parametrize(
    ("spring", "law"),
    [
        ("spring=cubic", joints.polynomial(np.array([[[150.0, 5000.0]]]))),
        ("spring=vsa-ii stiffness=500", joints.vsa_ii(np.array([[500.0]]), np.array([[1.75]]))),
    ],
    ids=["cubic", "vsa-ii"],
)
def test_the_joint_without_effects_is_that_of_another_integrator(spring, law):
    c = simulated(f"{spring} {EXACT}").columns
    plants = joints.Plants(*law, 0.12, 0.8, 0.45, 0.5, 3.0)
    truth = joints.simulate(plants, c["motor1_torque_nm"][:, None, None], 1e-3, 4)
    for name, expected in (
        ("motor1_position_rad", truth.theta),
        ("link_position_rad", truth.q),
        ("true_flexibility_torque_nm", truth.tau_e),
        ("true_stiffness_nm_rad", truth.sigma),
    ):
        assert np.allclose(c[name], expected.ravel(), rtol=1e-8, atol=1e-8), name


@pytest.mark.parametrize(
    ("effect", "law", "where"),
    [
        ("gear_loss=0.1", lambda c, w: -0.1 * np.abs(c["true_flexibility_torque_nm"]) * np.sign(w), 0.05),
        ("friction=coulomb coulomb=0.3", lambda c, w: -0.3 * np.sign(w), 0.05),
        ("friction=lugre coulomb=0.3", lambda c, w: -0.3 * np.sign(w), 0.4),
        ("cogging=0.2", lambda c, w: -0.2 * np.sin(32 * c["motor1_position_rad"]), 0.0),
    ],
)
def test_each_effect_leaves_in_the_balance_of_the_motor_what_it_is(effect, law, where):
    """B theta" + D theta' - tau_e - tau from differences of the columns, at the middle of each period."""
    c = simulated(f"{effect} {EXACT}").columns
    theta, torque = c["motor1_position_rad"], c["motor1_torque_nm"]
    speed = np.gradient(theta, 1e-3)
    held = (torque[1:-1] + torque[:-2]) / 2
    left = 0.12 * np.diff(theta, 2) / 1e-6 + 0.8 * speed[1:-1] - c["true_flexibility_torque_nm"][1:-1] - held
    off = np.abs(left - law(c, speed)[1:-1])[100:]
    assert np.quantile(off[np.abs(speed[101:-1]) > where], 0.5 if "lugre" in effect else 1.0) < 0.01


@pytest.mark.parametrize("friction", ["coulomb", "stribeck"])
def test_a_motor_that_friction_holds_does_not_creep(friction):
    c = simulated(f"friction={friction} coulomb=0.5 motion=harmonic size=0.4 gravity=0 {EXACT}").columns
    assert np.max(np.abs(c["motor1_position_rad"])) < 1e-6


def test_friction_is_named_where_slow_reversals_let_the_motor_stand():
    """A motor at rest has any friction up to its level: a law of the velocity alone leaves as much there."""
    number = 911
    case = list(motion.CASES.values())[number % len(motion.CASES)]  # Stribeck's
    joint = motion.joint_of(case, number)
    numbers = np.random.default_rng(1000 + number).uniform(-1.0, 1.0, (1, Shape.size(1)))
    numbers[0, 0] = 1.0  # begins a hundred times slower than it ends
    path = Shape(numbers, 12.0, joint.limits).path(1e-3)
    record = joint.moved(12.0, number, path).record
    found = diagnose(record, joint.model)
    assert motion.decided(found, case.names), found.effects
    assert found.validation.after_relative < 0.02


@pytest.mark.slow
def test_a_hand_that_moves_a_healthy_joint_shows_no_other_inertia():
    """The motor's torque is small: inertia and stiffness scaled down alike leave less, and explain nothing."""
    settings = (
        "motion=hand-guided size=8 push=4.42 seed=5121 seconds=20 stiffness=124.45 inertia=0.2483 damping=0.93 "
        "link_inertia=0.89 link_damping=0.058 gravity=0 link_delay=0.0007 motor_counts=65536 link_bits=18"
    )
    spring, sure = {"model": "linear", "parameters": {"k_nm_rad": 124.45}}, {"inertia_std_relative": 1e-4}
    found = diagnose(simulated(settings).record, joints.joint_model(0.2483, 0.93, **spring, motor=sure))
    assert found.verdict == "sufficient", found.effects


def test_the_interval_holds_what_the_shape_of_an_undeclared_effect_may_be_off():
    """A gear's losses are nearly, not quite, of the shape that the estimator has for them."""
    settings = "spring=cubic stiffness=120 cubic=3600 gear_loss=0.05 seconds=20 size=7.2 link_bits=18"
    record, truth, _ = simulated(settings)
    found, estimator = kit.play(joints.joint_model(0.12, 0.8), record.samples())
    off = np.abs(found.stiffness_nm_rad - truth)[found.valid]
    assert "load_dependent_friction" in estimator.undeclared()[0] and np.mean(found.valid) > 0.8
    assert np.mean(off < 1.96 * found.std_nm_rad[found.valid]) > 0.95


def test_a_stiff_joint_that_moves_fast_is_not_taken_for_a_soft_one_with_a_late_link():
    """Three periods of delay make fifty times the deflection that the spring has."""
    settings = (
        "stiffness=7.6e6 inertia=420 damping=1700 link_inertia=310 link_damping=520 gravity=700 period=0.004 size=3700 "
        "motion=pushes push=1850 seconds=12 seed=3 motor_counts=819200 link_bits=21 torque_noise=20 link_delay=0.012"
    )
    record = simulated(settings).record
    found, _ = kit.play(joints.joint_model(420.0, 1700.0), record.samples(), period_s=record.period_s)
    off = np.abs(found.stiffness_nm_rad / 7.6e6 - 1.0)
    # Noise of the encoders leaves a percent; a spring that holds the delay has a fiftieth of it.
    assert np.all(off[-250:] < 0.05) and np.all(off[found.valid] < 0.2)


HELD = "spring=cubic stiffness=120 cubic=3600 seconds=12 size=7 link_bits=17"


@pytest.mark.parametrize("dynamics", [None, LinkDynamics(inertia_kg_m2=0.4, gravity_nm=3.0)])
def test_a_link_that_is_held_shows_the_spring_and_nothing_of_the_link(dynamics):
    record = simulated(f"{HELD} link_inertia=1e7 gravity=0").record
    assert len(np.unique(record.link_position_rad)) < 4
    joint = joints.joint_model(0.12, 0.8, link=dynamics)
    (found,) = fit(record, joint)
    assert np.all(np.abs(found.alpha - [120.0, 3600.0]) < 3.0 * np.sqrt(np.diag(found.covariance)))
    assert diagnose(record, joint).verdict == "sufficient"


def test_a_link_encoder_that_is_silent_shows_no_spring():
    moving = simulated(f"{HELD} gravity=3").record
    silent = replace(moving, link_position_rad=np.full(len(moving), 0.3))
    (found,) = fit(silent, joints.joint_model(0.12, 0.8))
    assert not found.parameters
    joint = joints.joint_model(0.12, 0.8, model="linear", parameters={"k_nm_rad": 120.0})
    with pytest.raises(EstimatorError, match="expected a run without gaps"):
        free_run(joints.part(silent, slice(1)), joint)  # one sample neither moves nor stands


STIFF = "stiffness=15000 inertia=1.2 damping=8 link_inertia=4 link_damping=3 motor_counts=1638400 seconds=10"


def declared(settings: str, **spring: object) -> JointModel:
    """The joint that these settings make, as its file would declare it."""
    given = {name: float(x) for name, x in (one.split("=") for one in settings.split()) if name != "motion"}
    own = {"model": "linear", "parameters": {"k_nm_rad": given["stiffness"]}, "order": None} | spring
    link = LinkDynamics(
        inertia_kg_m2=given["link_inertia"],
        viscous_damping_nm_s_rad=given["link_damping"],
        gravity_nm=given["gravity"],
    )
    return joints.joint_model(given["inertia"], given["damping"], **own, link=link)


@pytest.mark.slow
def test_rounding_by_a_coarse_encoder_is_no_effect():
    """13 bits on a stiff gear: a count is 11 N·m, and the arm rests on one of them between its moves."""
    settings = f"{STIFF} gravity=80 link_bits=13 motion=point-to-point size=1"
    found = diagnose(simulated(settings).record, declared(settings))
    assert found.verdict == "sufficient", [(one.name, one.parameters) for one in found.effects]


SOFT = "stiffness=150 inertia=0.12 damping=0.8 link_inertia=0.45 link_damping=0.5 motor_counts=819200"


@pytest.mark.slow
def test_a_weight_that_nobody_declares_is_no_contact():
    """What touches always is no contact: no touch was seen."""
    settings = f"{SOFT} gravity=15.6 pull=10.8 size=4.8 seconds=12 seed=10"
    effects = diagnose(simulated(settings).record, declared(settings)).effects
    assert effects and "contact" not in [effect.name for effect in effects]


@pytest.mark.slow
def test_a_polynomial_of_open_order_follows_any_spring():
    settings = f"{SOFT} gravity=3 size=7 seconds=12"
    record = simulated(f"spring=exponential exponent=15 {settings}").record
    found = diagnose(record, declared(settings, model="polynomial", parameters={}))
    assert found.verdict == "sufficient" and found.transmissions[0].parameters


def test_a_late_reading_that_no_effect_stands_in_for_is_diagnosed():
    joint = motion.joint_of(motion.CASES["late link"], 54)
    moved = joint.moved(12.0, 54, **motion.MOTIONS[2]).record
    outcome = diagnose(moved, joint.model)
    assert [one.name for one in outcome.effects] == ["encoder_delay"]


def test_a_motor_that_sticks_where_it_turns_is_no_late_torque():
    joint = (
        f"stiffness=50 inertia=0.015 damping=0.065 link_inertia=0.07 link_damping=0.016 gravity=1.1 {COARSE}"
    )
    world = simulated(f"{joint} friction=coulomb coulomb=0.15 size=2 top_hz=4 seconds=14 period=0.002 seed=3")
    spring = {"order": 1, "parameters": {"coefficients_nm_rad": (50.0,)}, "covariance": ((0.07,),)}
    friction = Effect(name="coulomb_friction", parameters={"torque_nm": 0.15, "smoothing_rad_s": 0.004})
    fitted = {"fit_rms_nm": (0.015, 1.06)}
    model = joints.joint_model(0.015, 0.052, **spring, effects=(friction,), motor=fitted)
    said = joints.estimates(model, world.record)
    torque, valid = said[:, 2], said[:, 1].astype(int) & Status.TORQUE_VALID > 0
    truth = world.columns["true_flexibility_torque_nm"]
    assert np.mean(valid) > 0.9
    assert np.max(np.abs(torque - truth)[valid]) < 0.1 * np.std(truth)


def test_a_motor_that_sticks_where_it_turns_is_not_fitted_by_delays():
    joint = "stiffness=580 inertia=0.072 damping=0.46 link_inertia=0.56 link_damping=0.05 gravity=1"
    read = "motor_counts=131072 link_bits=17 torque_noise=0.017 seconds=14 seed=2"
    record = simulated(f"{joint} friction=coulomb coulomb=0.21 size=5 top_hz=4 {read}").record
    (found,) = fit(record, joints.joint_model(0.072, 0.46, order=None))
    assert (found.torque_delay_s, found.link_delay_s) == (0.0, 0.0)
    assert found.viscous_damping_nm_s_rad == pytest.approx(0.46, rel=0.02)
