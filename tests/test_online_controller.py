"""A motor that its own controller holds: its torque says what the controller does, not what the joint is.

A hand moves the link; the motor's torque follows from its own reading alone. Presliding friction that nobody
declared acts as a spring at the motor, and the balance closes with a stiffness that is too small.
"""

import heldmotor
import numpy as np
import onlinekit as kit


def test_the_stiffness_of_a_joint_that_its_controller_holds_is_not_valid():
    samples = heldmotor.moved(8.0)
    estimates, _ = kit.play(heldmotor.declared(), samples)
    # The balance closes, with a stiffness that is wrong by what the friction takes.
    softest = heldmotor.K * heldmotor.KP / (heldmotor.KP + heldmotor.PRESLIDING)
    assert 0.98 * softest < estimates.stiffness_nm_rad[-1] < 0.9 * heldmotor.K
    assert not np.any(estimates.valid)


def test_a_torque_of_its_own_tells_the_joint_from_the_controller():
    samples = heldmotor.moved(14.0, by_hand_until=6.0)
    estimates, _ = kit.play(heldmotor.declared(), samples)
    assert not np.any(kit.wrong(estimates, np.full(len(samples), heldmotor.K)))
    assert np.mean(estimates.valid[-4000:]) > 0.9
