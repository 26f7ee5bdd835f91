"""The example controller's mathematics, against finite differences and an integrator of its own."""

import math

import controllerkit as kit
import numpy as np
import pytest
from vsacontrol.laws import Decoupler, Regulator, Target
from vsacontrol.plant import State, deflections
from vsacontrol.references import WAYPOINTS, Reference
from vsacontrol.springs import spring, springs_of
from vsacontrol.tracking import StateTracker, Tracker

JOINT = kit.VSA
SPRINGS = {
    "vsa-ii": kit.SPRING,
    "polynomial": {"coefficients_nm_rad": (0.14, 0.11, 0.07)},
    "exponential": {"k_nm_rad": 0.3, "b_per_rad": 2.0},
    "linear": {"k_nm_rad": 0.3},
}
TRUE = (spring("vsa-ii", kit.SPRING),) * 2


@pytest.mark.parametrize("model", SPRINGS)
@pytest.mark.parametrize("phi", [-0.9, -0.2, 0.3, 1.0])
def test_each_derivative_of_a_spring_is_the_slope_of_the_one_before(model, phi):
    law, h = spring(model, SPRINGS[model]), 1e-4
    before, at, after = law(phi - h), law(phi), law(phi + h)
    for lower, higher in ((0, 1), (1, 2), (2, 3)):
        slope = (after[lower] - before[lower]) / (2 * h)
        assert slope == pytest.approx(at[higher], rel=1e-5, abs=1e-9)  # h² times the next derivative


def test_a_wrong_model_is_wrong_in_every_derivative_alike():
    true, nominal = spring("vsa-ii", kit.SPRING)(0.4), spring("vsa-ii", kit.SPRING, 0.8)(0.4)
    assert [a / b for a, b in zip(nominal, true, strict=True)] == pytest.approx([0.8] * 4)


def test_springs_are_taken_from_the_status_only_when_all_are_identified_and_possible():
    good = {"model": "vsa-ii", "parameters": kit.SPRING}
    assert springs_of([]) is None
    assert springs_of([good, {"model": "polynomial", "parameters": {}}]) is None
    assert springs_of([good, {"model": "vsa-ii", "parameters": {"k_nm_rad": 0.5, "c": 0.9}}]) is None
    laws = springs_of([good, {"model": "polynomial", "parameters": {"coefficients_nm_rad": [0.1, 0.5]}}])
    assert laws is not None
    assert laws[1](0.2).torque == pytest.approx(0.1 * 0.2 + 0.5 * 0.008)


@pytest.mark.parametrize(("torque", "stiffness"), [(0.0, 0.5), (-0.1, 0.7), (0.12, 0.6)])
def test_deflections_give_the_torque_and_the_stiffness_asked_for(torque, stiffness):
    one, two = deflections(TRUE, torque, stiffness, (0.5, -0.5))
    first, second = TRUE[0](one), TRUE[1](two)
    assert first.torque + second.torque == pytest.approx(torque, abs=1e-8)
    assert first.stiffness + second.stiffness == pytest.approx(stiffness, abs=1e-8)
    assert one > two


def test_impossible_stiffness_still_gives_finite_deflections():
    found = deflections(TRUE, 0.1, 0.05, (0.5, -0.5))
    assert all(map(math.isfinite, found))


# A plant of its own: eqs 6, 7 in exact springs, Runge-Kutta, torque held over each millisecond.


def rates(x, tau):
    q, dq, theta, dtheta = x[0], x[1], x[2:4], x[4:6]
    points = [TRUE[i](q - theta[i]).torque for i in range(2)]
    M, B = JOINT.link_inertia_kg_m2, np.array(JOINT.motor_inertia_kg_m2)
    ddq = -(JOINT.link_damping_nm_s_rad * dq + JOINT.gravity(q) + sum(points)) / M
    ddtheta = (np.array(tau) + points - np.array(JOINT.motor_damping_nm_s_rad) * dtheta) / B
    return np.array([dq, ddq, *dtheta, *ddtheta])


def step(x, tau, h=1e-3):
    a = rates(x, tau)
    b = rates(x + 0.5 * h * a, tau)
    c = rates(x + 0.5 * h * b, tau)
    d = rates(x + h * c, tau)
    return x + h / 6 * (a + 2 * b + 2 * c + d)


def at_rest(q, sigma):
    phi = deflections(TRUE, -JOINT.gravity(q), sigma, (0.5, -0.5))
    return np.array([q, 0.0, q - phi[0], q - phi[1], 0.0, 0.0])


def stiffness(x):
    return sum(TRUE[i](x[0] - x[2 + i]).stiffness for i in range(2))


def follow(law, springs, x, target, seconds):
    """(q, sigma) over time under exact state feedback."""
    rows = []
    for k in range(round(seconds * 1000)):
        state = State(x[0], x[1], (x[2], x[3]), (x[4], x[5]))
        x = step(x, law.torques(state, target(k * 1e-3), springs))
        rows.append((x[0], stiffness(x)))
    return np.array(rows)


def hold(q, sigma):
    return lambda _t: Target((q, 0.0, 0.0, 0.0, 0.0), (sigma, 0.0, 0.0))


@pytest.mark.parametrize(("q", "sigma"), [(0.4, 0.75), (-0.3, 0.55), (0.0, 0.9)])
def test_regulation_ends_at_the_wanted_position_and_stiffness(q, sigma):
    law = Regulator(joint=JOINT)
    rows = follow(law, TRUE, at_rest(0.0, 0.6), hold(q, sigma), 4.0)
    # the slowest pole found over the range is at -4 rad/s or faster: e^-16 of the way is left
    assert rows[-1] == pytest.approx([q, sigma], abs=1e-4)


def test_regulation_by_a_model_that_is_too_soft_ends_elsewhere():
    soft = (spring("vsa-ii", kit.SPRING, 0.8),) * 2
    rows = follow(Regulator(joint=JOINT), soft, at_rest(0.0, 0.6), hold(0.4, 0.75), 4.0)
    assert abs(rows[-1, 0] - 0.4) > 0.01
    assert abs(rows[-1, 1] - 0.75) > 0.02


def test_decoupling_moves_one_output_and_leaves_the_other():
    law = Decoupler(joint=JOINT)
    reference = Reference([kit_waypoint(0.0, 0.2, 0.6), kit_waypoint(0.8, 0.2, 0.8)])
    stiffer = follow(law, TRUE, at_rest(0.2, 0.6), reference.at, 0.8)
    # what is left is the torque held over a millisecond
    assert np.max(np.abs(stiffer[:, 0] - 0.2)) < 5e-4
    assert stiffer[-1, 1] == pytest.approx(0.8, abs=1e-3)
    reference = Reference([kit_waypoint(0.0, 0.2, 0.6), kit_waypoint(0.8, -0.3, 0.6)])
    moved = follow(law, TRUE, at_rest(0.2, 0.6), reference.at, 0.8)
    assert np.max(np.abs(moved[:, 1] - 0.6)) < 2e-3
    assert moved[-1, 0] == pytest.approx(-0.3, abs=2e-3)


def kit_waypoint(way_s, q, sigma):
    return WAYPOINTS["decoupling"][0]._replace(way_s=way_s, rest_s=0.0, q_rad=q, sigma_nm_rad=sigma)


def test_decoupled_errors_decay_as_their_poles_say():
    law = Decoupler(joint=JOINT, position_rad_s=15.0, stiffness_rad_s=20.0)
    rows = follow(law, TRUE, at_rest(0.1, 0.62), hold(0.0, 0.6), 0.6)
    t = (np.arange(len(rows)) + 1) * 1e-3
    q = 0.1 * np.exp(-15 * t) * (1 + 15 * t + (15 * t) ** 2 / 2 + (15 * t) ** 3 / 6)
    sigma = 0.6 + 0.02 * np.exp(-20 * t) * (1 + 20 * t)
    # a hold of a millisecond is half a millisecond of delay: about 1 % of a pole at 20 rad/s
    assert np.max(np.abs(rows[:, 0] - q)) < 2e-3
    assert np.max(np.abs(rows[:, 1] - sigma)) < 1e-3


def test_decoupling_without_pretension_gives_no_torque_rather_than_a_wrong_one():
    state = State(0.0, 0.0, (0.0, 0.0), (0.0, 0.0))
    assert all(map(math.isnan, Decoupler(joint=JOINT).torques(state, hold(0.1, 0.6)(0.0), TRUE)))


@pytest.mark.parametrize("name", WAYPOINTS)
def test_references_are_smooth_up_to_the_order_that_the_laws_use(name):
    reference, h = Reference(WAYPOINTS[name]), 1e-4
    for time_s in np.arange(0.05, reference.length_s - 0.05, 0.0317):
        before, at, after = (reference.at(time_s + d) for d in (-h, 0.0, h))
        for row in ("q", "sigma"):
            a, b, c = getattr(before, row), getattr(at, row), getattr(after, row)
            for n in range(len(b) - 1):
                scale = 10.0 * 15.0**n  # of the n-th derivative of these ways
                assert (c[n] - a[n]) / (2 * h) == pytest.approx(b[n + 1], rel=1e-3, abs=1e-3 * scale)


def test_tracker_follows_a_parabola_without_lag_and_predicts_it():
    tracker, T = Tracker(150.0, 1e-3), 1e-3
    path = [0.3 + 0.5 * k * T + 0.5 * 4.0 * (k * T) ** 2 for k in range(200)]
    for position in path:
        tracker.step(position, 1)
    t = 199 * T + 1.5e-3
    x, v = tracker.ahead(1.5e-3)
    assert x == pytest.approx(0.3 + 0.5 * t + 2.0 * t * t, abs=1e-6)
    assert v == pytest.approx(0.5 + 4.0 * t, abs=1e-3)


def test_state_tracker_bridges_a_short_gap_and_starts_anew_after_a_long_one():
    tracker = StateTracker(1e-3)
    for k in range(100):
        tracker.step(k, 2.0 * k * 1e-3, (0.0, 0.0))
    state = tracker.step(105, 2.0 * 105e-3, (0.0, 0.0))
    assert state.dq == pytest.approx(2.0, abs=0.02)
    state = tracker.step(500, 1.0, (0.0, 0.0))
    assert (state.q, state.dq) == (1.0, 0.0)
