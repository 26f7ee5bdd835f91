"""Friction that nobody declared, where a controller makes the torque, and springs that bend: right, or in the interval."""

import heldmotor
import numpy as np
import onlinekit as kit
import pytest

from sim.effects import make


def test_the_interval_of_a_held_motor_holds_what_friction_takes_from_the_stiffness():
    estimates, _ = kit.play(heldmotor.declared(), heldmotor.moved(8.0))
    off = np.abs(estimates.stiffness_nm_rad - heldmotor.K)[-2000:]
    assert np.min(off) > 0.05 * heldmotor.K  # the balance closes, with a spring that is too soft
    # At the border: the interval is nearly as wide as valid_within.
    assert np.mean(estimates.valid[-2000:]) > 0.5
    assert np.all(off < 2.58 * estimates.std_nm_rad[-2000:])  # one joint: 99 %


@pytest.mark.parametrize(
    ("name", "parameters"),
    [
        ("asymmetric_stiffness", {"coefficient_nm_rad2": 0.15}),
        ("higher_order_stiffness", {"coefficient": 1.0, "power": 3.0}),
    ],
)
def test_a_spring_that_is_declared_linear_and_bends_is_named_and_right(name, parameters):
    motion = kit.motion("constant", 12.0, effects=(make(name, parameters),))
    estimates, estimator = kit.play(kit.declared("constant"), motion.samples)
    off = np.abs(estimates.stiffness_nm_rad / motion.stiffness_nm_rad - 1.0)[-6000:]
    assert np.ptp(motion.stiffness_nm_rad) > 0.03  # of 0.1 N·m/rad
    assert name in estimator.undeclared()[0]
    assert np.mean(estimates.valid[-6000:]) > 0.99
    assert np.mean(off[estimates.valid[-6000:]] < 0.05) > 0.99
