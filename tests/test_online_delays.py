"""Declared delays: the balance is formed of channels of one moment, the torque is published for the present."""

import joints
import numpy as np
import onlinekit as kit
import pytest

from estimator.model import Effect

T = 1e-3
N = 12_000
B, D, K = 0.12, 0.8, 150.0
LATE_S = 0.0093  # a filtered and forwarded current, as on a measured drive line
SETTLED = slice(4000, None)


def _motion(t, spin):
    """Motor position, torque of the drive and deflection of a linear joint, in closed form (eq 5)."""
    waves = ((0.4, 5.0, 0.0), (0.1, 17.0, 0.4), (0.02, 41.0, 1.1))
    theta = spin * t + sum(a * np.sin(w * t + p) for a, w, p in waves)
    rate = spin + sum(a * w * np.cos(w * t + p) for a, w, p in waves)
    acceleration = -sum(a * w**2 * np.sin(w * t + p) for a, w, p in waves)
    phi = 0.05 * np.sin(7.0 * t + 0.3) + 0.02 * np.sin(23.0 * t) + 0.008 * np.sin(60.0 * t)
    return theta, B * acceleration + D * rate - K * phi, phi


def _joint(link_late_s):
    torque = Effect(name="torque_delay", parameters={"delay_s": -LATE_S})
    link = Effect(name="encoder_delay", parameters={"delay_s": link_late_s})
    return joints.joint_model(B, D, model="linear", effects=(torque,), link_effects=(link,))


@pytest.mark.parametrize(
    ("spin", "link_late_s", "left"),
    [
        (0.0, 0.0, 0.005),  # encoder noise is 0.05 % of the deflection; the rest is the stiffness's
        (200.0, 0.0, 0.005),
        (0.0, 2.6e-3, 0.01),  # nobody knows the last 2.6 ms of the deflection: they are foreseen
    ],
)
def test_a_torque_that_is_reported_late_is_published_for_the_present(spin, link_late_s, left):
    """Waiting for it would leave an eighth of the torque; a joint that spins at the start begins as well."""
    t = T * np.arange(N)
    noise = np.random.default_rng(4).normal(scale=1e-5, size=(2, N))
    theta, _, phi = _motion(t, spin)
    late_theta, _, late_phi = _motion(t - link_late_s, spin)
    torque = _motion(t + 0.5 * T - LATE_S, spin)[1]
    read = joints.recorded(theta + noise[0], torque, late_theta + late_phi + noise[1], T)
    found, _ = kit.play(_joint(link_late_s), read.samples())
    # A late link is known well enough for a torque at 200 rad/s after a second.
    assert np.mean(found.valid[SETTLED]) > 0.97
    assert np.abs(found.stiffness_nm_rad[SETTLED] / K - 1.0).max() < 0.01
    true = K * phi[SETTLED]
    error = np.std(found.torque_nm[SETTLED] - true)
    waiting = np.std(K * _motion(t - LATE_S, spin)[2][SETTLED] - true)
    assert error < left * np.std(true) < 0.1 * waiting


def test_a_link_that_is_late_is_no_effect_of_a_spring_that_bends():
    """What the link moves meanwhile is multiplied with the stiffness: of few of its terms, effects made up the rest."""
    t, k, b, late_s = T * np.arange(N), 60.0, 25.0, 1e-3
    theta, of_motor, phi = _motion(t, 0.0)
    late_theta, _, late_phi = _motion(t - late_s, 0.0)
    torque = k / b * np.sign(phi) * np.expm1(b * np.abs(phi))
    noise = np.random.default_rng(5).normal(scale=1e-5, size=(2, N))
    read = joints.recorded(theta + noise[0], of_motor + K * phi - torque, late_theta + late_phi + noise[1], T)
    found, estimator = kit.play(joints.joint_model(B, D, model="exponential"), read.samples())
    assert not estimator.undeclared()[0]
    assert np.mean(found.valid[-6000:]) > 0.97
    assert np.std((found.torque_nm - torque)[-6000:]) < 0.02 * np.std(torque)  # late_s × φ′ is 6 % of φ


def _slow(stiff, noise_rad, late_s=0.0, stated_s=0.0):
    """What is found of a slow joint whose file states all, in closed form (eq 5), and its torque's error over its rms."""
    t, rng = T * np.arange(N), np.random.default_rng(4)
    waves = ((0.4, 0.6, 0.0), (0.15, 1.3, 0.4), (0.05, 3.1, 1.1))

    def motion(t):
        theta = sum(a * np.sin(w * t + p) for a, w, p in waves)
        rate = sum(a * w * np.cos(w * t + p) for a, w, p in waves)
        phi = (1.2 * np.sin(0.7 * t + 0.3) + 0.6 * np.sin(2.3 * t)) / stiff
        acceleration = -sum(a * w**2 * np.sin(w * t + p) for a, w, p in waves)
        return theta, B * acceleration + D * rate - stiff * phi, phi

    theta, _, phi = motion(t)
    late_theta, _, late_phi = motion(t - late_s)
    noise = rng.normal(scale=noise_rad, size=(2, N))
    motor, link = (joints.quantise(x, 1e-6) for x in (theta + noise[0], late_theta + late_phi + noise[1]))
    read = joints.recorded(motor, motion(t + 0.5 * T)[1], link, T)
    late = Effect(name="encoder_delay", parameters={"delay_s": stated_s}, std={"delay_s": 1e-5})
    model = joints.joint_model(B, D, model="linear", parameters={"k_nm_rad": stiff}, link_effects=(late,))
    found, _ = kit.play(model, read.samples())
    return found, (found.torque_nm - stiff * phi) / np.std(stiff * phi)


@pytest.mark.parametrize("late_s", [2e-3, 4e-3, 6e-3])
def test_a_link_that_is_periods_later_than_a_fit_knew_surely_makes_no_wrong_torque(late_s):
    """Another master, or a restart, may move when it is sampled: on line it is believed to a period."""
    found, error = _slow(1500.0, 1e-6, late_s, 3e-3)
    assert np.mean(found.valid) > 0.8
    assert np.max(np.abs(error[found.valid])) < 0.25


def test_noise_moves_no_zero():
    """Half a step does, where a reading cuts off; by a deviation of the noise the zero was unknown for ten seconds."""
    found, error = _slow(6000.0, 1e-5)
    assert np.mean(found.valid[2000:]) > 0.5
    assert np.std(error[2000:][found.valid[2000:]]) < 0.05
