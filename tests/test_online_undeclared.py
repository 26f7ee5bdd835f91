"""Friction that nobody declared, where a controller makes the torque: the interval of the stiffness holds it."""

import heldmotor
import numpy as np
import onlinekit as kit


def test_the_interval_of_a_held_motor_holds_what_friction_takes_from_the_stiffness():
    estimates, _ = kit.play(heldmotor.declared(), heldmotor.moved(8.0))
    off = np.abs(estimates.stiffness_nm_rad - heldmotor.K)[-2000:]
    assert np.min(off) > 0.05 * heldmotor.K  # the balance closes, with a spring that is too soft
    # At the border: the interval is nearly as wide as valid_within.
    assert np.mean(estimates.valid[-2000:]) > 0.5
    assert np.all(off < 2.58 * estimates.std_nm_rad[-2000:])  # one joint: 99 %
