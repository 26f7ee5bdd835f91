"""The joint of eqs 4-7: laws, equations, integration."""

import math

import numpy as np
import pytest
from simjoints import EXPONENTIAL, HARDENING, LINEAR, RIGID, VSA_II, energy, sea

from sim.errors import SimError
from sim.integration import integrator, whole_fraction
from sim.plant import JointPlant, LinkPlant, MotorPlant, Spring

SPRINGS = [LINEAR, HARDENING, VSA_II, EXPONENTIAL]


def run(plant, state, seconds, step_s, tau=0.0):
    step, whole = integrator(plant, step_s), [*state, 0.0, 0.0][:6]
    for _ in range(round(seconds / step_s)):
        step(whole, tau, 0.0, 0.0)
    state[:] = whole[: len(state)]
    return state


@pytest.mark.parametrize("spring", SPRINGS, ids=lambda spring: spring.model)
def test_torque_and_stiffness_are_the_derivatives_of_the_potential(spring):
    law, h = spring.law(), 1e-5
    for phi in np.linspace(-0.9, 0.9, 37):
        slope = (law.potential(phi + h) - law.potential(phi - h)) / (2 * h)
        rise = (law.torque(phi + h) - law.torque(phi - h)) / (2 * h)
        # Central differences: error h²/6 of the third derivative, which the exponential has largest;
        # its stiffness has a kink at zero, worth h b / 2.
        assert slope == pytest.approx(law.torque(phi), rel=1e-6, abs=1e-6)
        assert rise == pytest.approx(law.stiffness(phi), rel=1e-4)
        assert law.torque(-phi) == pytest.approx(-law.torque(phi), abs=1e-15)


def test_vsa_ii_goes_on_straight_where_the_linkage_is_stretched():
    law, stop = VSA_II.law(), 0.995 * 2.0 * math.asin(1.0 / 1.75)
    assert law.torque(stop + 1e-9) == pytest.approx(law.torque(stop - 1e-9), rel=1e-6)
    assert law.potential(stop + 1e-9) == pytest.approx(law.potential(stop - 1e-9), rel=1e-6)
    assert law.torque(3.0) - law.torque(2.0) == pytest.approx(law.stiffness(2.5), rel=1e-9)


@pytest.mark.parametrize(
    ("spring", "shape"),
    [
        (LINEAR, {}),
        (HARDENING, {}),
        (EXPONENTIAL, {}),
        (LINEAR, {"motors": 2}),
        (HARDENING, {"motors": 2, "lever": 0.7}),
    ],
    ids=["linear", "polynomial", "exponential", "antagonistic", "serial"],
)
def test_energy_is_kept_without_damping(spring, shape):
    plant = sea(spring, damping=0.0, **shape)
    state = [0.3, 0.0, 0.25, 0.0, 0.2, 0.0][: 2 + 2 * len(plant.motors)]
    before = energy(plant, state)
    run(plant, state, 5.0, 0.0005)
    # Runge-Kutta's own dissipation: (omega h)^5/72 a step at omega = 60 rad/s over 10^4 steps is 3e-6.
    # The exponential's kink at phi = 0 costs an order.
    assert energy(plant, state) == pytest.approx(before, rel=1e-5) and state[1] != 0.0


def test_two_masses_move_as_in_closed_form():
    """phi" = -K (1/M + 1/B) phi - tau/B from rest: phi = -tau/(B omega²) (1 - cos omega t)."""
    plant = sea(LINEAR, damping=0.0, gravity=0.0)
    k, b, m, tau, t = 150.0, 0.125, 0.4, 2.0, 1.234
    state = run(plant, [0.0] * 4, t, 0.0005, tau)
    omega = math.sqrt(k * (1 / b + 1 / m))
    phi = -tau / (b * omega**2) * (1.0 - math.cos(omega * t))
    centre = 0.5 * tau / (b + m) * t * t
    # Phase error of the method: t omega (omega h)^4/120 = 4e-7 rad.
    assert state[0] - state[2] == pytest.approx(phi, abs=2e-8)
    assert (m * state[0] + b * state[2]) / (m + b) == pytest.approx(centre, rel=1e-12)


def test_damped_motor_comes_to_the_closed_form_speed():
    motor = MotorPlant(inertia_kg_m2=0.2, viscous_damping_nm_s_rad=0.5, spring=RIGID)
    plant = JointPlant(arrangement="single", motors=(motor,), link=LinkPlant(inertia_kg_m2=0.3))
    state = run(plant, [0.0] * 4, 1.0, 0.001, 2.0)
    assert state[3] == pytest.approx(4.0 * -math.expm1(-1.0), rel=1e-12)
    assert state[:2] == state[2:]


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Spring(model="cubic", parameters={}), "expected one of"),
        (lambda: Spring(model="linear", parameters={}), "expected k_nm_rad, got nothing"),
        (lambda: Spring(model="linear", parameters={"k_nm_rad": -1.0}), "k_nm_rad: expected a finite number > 0"),
        (lambda: Spring(model="vsa-ii", parameters={"k_nm_rad": 0.5, "c": 0.9}), "c: expected a number > 1"),
        (lambda: Spring(model="polynomial", parameters={"coefficients_nm_rad": 3.0}), "expected a list"),
        (lambda: LinkPlant(inertia_kg_m2=0.0), "inertia_kg_m2: expected a finite number > 0"),
        (
            lambda: JointPlant(arrangement="antagonistic", motors=sea().motors, link=sea().link),
            r"expected 2 motor\(s\), got 1",
        ),
        (lambda: sea(RIGID, motors=2), "expected a flexible transmission"),
        *(
            (lambda step=step: whole_fraction(0.001, step, sea()), "plant_step_s: expected")
            for step in (0.0003, 0.002, 0.0, -0.001, math.nan)
        ),
    ],
)  # fmt: skip
def test_impossible_springs_joints_and_steps_are_one_clear_line(make, message):
    with pytest.raises(SimError, match=message) as caught:
        make()
    assert "\n" not in str(caught.value)
