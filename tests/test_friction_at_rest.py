"""A motor that goes from place to place: what holds it at rest is any torque up to its dry friction."""

from dataclasses import replace

import joints
import numpy as np
import pytest

from drivelink import jointfile
from drivelink.jointfile.apply_diagnosis import diagnosed_model
from estimator.diagnosis import diagnose
from estimator.diagnosis.candidates import Candidate, grid
from estimator.diagnosis.frame import Corrections, Frame, Signals
from estimator.effects import LIBRARY
from estimator.identify import identify
from estimator.model import JointModel
from estimator.sample import FloatArray, Record

INERTIA, DAMPING, FRICTION, T, SECONDS = 0.08, 0.5, 0.4, 0.004, 20.0
COUNT = 2.0 * np.pi / 2**16
JOINT = jointfile.parse(
    f'name = "axis"\n[[motor]]\ninertia_kg_m2 = {INERTIA}\nviscous_damping_nm_s_rad = {DAMPING}\n'
    'transmission = { model = "none" }\n'
    f'effect = [{{ name = "coulomb_friction", parameters = {{ torque_nm = {FRICTION} }} }}]\n'
)


def moves(seed: int, rests_s: float = 0.7) -> Record:
    """Minimum-jerk moves and rests; at rest an integral controller leaves what the last move needed."""
    rng, n = np.random.default_rng(seed), round(SECONDS / T)
    at = (np.arange(n) + 0.5) * T  # the torque of a row acts until the next one
    theta, own, held = np.zeros(n), np.zeros(n), np.zeros(n)
    begin, place = 0.0, 0.0
    while begin < SECONDS:
        goal, takes, rests = rng.uniform(-0.5, 0.5), rng.uniform(0.4, 1.0), rng.uniform(0.3, 1.0) * rests_s
        x = np.clip((at - begin) / takes, 0.0, 1.0)
        mine, way = (x > 0.0) & (x < 1.0), goal - place
        theta += way * x**3 * (10.0 - 15.0 * x + 6.0 * x**2)
        velocity = way / takes * 30.0 * x**2 * (1.0 - x) ** 2
        acceleration = way / takes**2 * 60.0 * x * (1.0 - x) * (1.0 - 2.0 * x)
        own += np.where(mine, INERTIA * acceleration + DAMPING * velocity + FRICTION * np.sign(velocity), 0.0)
        held[(at >= begin + takes) & (at < begin + takes + rests)] = rng.uniform(-FRICTION, FRICTION)
        begin, place = begin + takes + rests, goal
    torque = own + held + rng.normal(0.0, 0.005, n)
    read: FloatArray = joints.quantise(np.interp(at - 0.5 * T, at, theta), COUNT)
    return joints.recorded(read, torque, None, T)


@pytest.mark.parametrize("seed", range(2))
def test_declared_friction_that_says_nothing_of_its_smoothing_holds_the_motor_at_rest(seed):
    found = diagnose(moves(seed), JOINT.model())
    assert (found.verdict, found.effects) == ("sufficient", ())
    (friction,) = diagnosed_model(JOINT, found).motors[0].effects
    assert friction.parameters["smoothing_rad_s"] < 0.005  # the default is 0.01
    (fitted,) = identify(moves(seed), JOINT.model()).model.motors[0].effects
    assert fitted.parameters["smoothing_rad_s"] == friction.parameters["smoothing_rad_s"]


def smoothed(smoothing_rad_s: float) -> JointModel:
    """The joint, which says something of its friction's smoothing."""
    model = JOINT.model()
    ((friction,),) = (motor.effects for motor in model.motors)
    told = replace(friction, parameters={**friction.parameters, "smoothing_rad_s": smoothing_rad_s})
    return joints.with_motor(model, effects=(told,))


def test_a_smoothing_that_is_declared_stays():
    assert diagnose(moves(0), smoothed(0.02)).smoothing_rad_s is None


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("smoothing_rad_s", [0.002, 0.004])
def test_what_declared_friction_may_hold_at_rest_is_no_missing_effect(seed, smoothing_rad_s):
    """A smoothing of another recording's fit: the rests of this one lacked "Stribeck friction", certain."""
    model = smoothed(smoothing_rad_s)
    found = diagnose(moves(seed), model)
    assert (found.verdict, found.effects) == ("sufficient", ())
    assert found.validation.before_relative > 0.05  # what is left is said
    torque = moves(seed).motor_torque_nm + 0.2 * np.sin(3.0 * moves(seed).motor_position_rad)
    assert diagnose(replace(moves(seed), motor_torque_nm=torque), model).verdict != "sufficient"


def test_rests_add_no_ripple_of_which_the_motor_passes_no_period():
    """Each rest has a torque and a place of its own: of hundreds of fast ripples some meet them all."""

    def fastest(rests_s: float) -> float:
        signals = Signals(moves(0, rests_s), 10.0)
        frame = Frame.make(JOINT.model(), signals, Corrections.none(1))
        ripples = grid(frame, Candidate(LIBRARY["cogging"], 0), signals.velocity_noise(0), 900)
        return ripples[-1]["periods_per_rev"]

    assert fastest(1.5) == pytest.approx(fastest(0.05), rel=0.5)
