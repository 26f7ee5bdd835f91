"""What nobody declared: a held motor's friction, springs that bend, a shape that the motion does not show."""

import itertools
from dataclasses import replace
from functools import cache

import heldmotor
import joints
import numpy as np
import onlinekit as kit
import pytest
from scipy.signal import lfilter

from estimator import Effect, Status
from sim.cases import case
from sim.effects import make

T = 1e-3


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


def test_a_vsa_whose_shape_small_deflections_do_not_show_is_as_stiff_as_it_is():
    small = dict(case("vsa-ii").rich, amplitude_nm=0.02, high_hz=1.0)
    motion = kit.motion("vsa-ii", 15.0, excitation=small)
    estimates, _ = kit.play(kit.declared("vsa-ii", parameters={}), motion.samples)
    off = np.abs(estimates.stiffness_nm_rad - motion.stiffness_nm_rad)[-8000:]
    assert np.mean(estimates.valid[-8000:]) > 0.99
    assert np.all(off < 3.0 * estimates.std_nm_rad[-8000:])
    assert np.all(estimates.std_nm_rad[-8000:] < 0.01 * motion.stiffness_nm_rad[-8000:])


def test_a_vsa_near_the_end_of_its_linkage_is_as_stiff_as_it_is_and_nothing_else():
    large = dict(case("vsa-ii").rich, amplitude_nm=0.3)
    motion = kit.motion("vsa-ii", 15.0, excitation=large)
    estimates, estimator = kit.play(kit.declared("vsa-ii", parameters={}), motion.samples)
    off = np.abs(estimates.stiffness_nm_rad / motion.stiffness_nm_rad - 1.0)[-10000:]
    assert np.ptp(motion.stiffness_nm_rad) > 10.0 * np.min(motion.stiffness_nm_rad)
    assert np.all(estimates.valid[-10000:])
    assert np.median(off) < 0.001  # encoders, filters and rounding leave half of that
    assert not any(estimator.undeclared())
    assert not np.any(estimates.status & int(Status.CHANGED))


@pytest.mark.parametrize(
    ("name", "parameters"),
    [("transmission_damping", {"damping_nm_s_rad": 0.002}), ("hysteresis", {"torque_nm": 0.015})],
)
def test_what_nobody_declared_is_named_near_the_end_of_the_linkage_too(name, parameters):
    large = dict(case("vsa-ii").rich, amplitude_nm=0.3)
    motion = kit.motion("vsa-ii", 16.0, seed=9, excitation=large, effects=(make(name, parameters, 0),))
    estimates, estimator = kit.play(kit.declared("vsa-ii"), motion.samples)
    off = np.abs(estimates.stiffness_nm_rad / motion.stiffness_nm_rad - 1.0)[-8000:]
    assert name in estimator.undeclared()[0] and not estimator.undeclared()[1]
    assert np.all(estimates.valid[-8000:])
    assert np.median(off) < 0.005  # hysteresis is of another law than ours
    assert not np.any(estimates.status & int(Status.CHANGED))


def test_a_spring_of_another_stiffness_on_either_side_is_named_and_right():
    def stiffness(phi):
        return np.where(phi > 0.0, 195.0, 105.0)

    plants = joints.Plants(lambda phi: stiffness(phi) * phi, stiffness, 0.12, 0.8, 0.45, 0.3, 3.0)
    truth = joints.simulate(plants, joints.sweep(np.random.default_rng(3), 12000, 1, 1, T, 8.0, 3.0), T)
    joint = joints.joint_model(0.12, 0.8, model="polynomial", order=1, parameters={})
    out = joints.estimates(joint, joints.record(truth, 0, T))[-6000:]
    torque = truth.tau_e[-6000:, 0, 0]
    assert np.mean(out[:, 1].astype(int) & kit.VALID > 0) > 0.99
    assert np.sqrt(np.mean((out[:, 2] - torque) ** 2)) < 0.02 * np.sqrt(np.mean(torque**2))
    assert np.median(np.abs(out[:, 3] / truth.sigma[-6000:, 0, 0] - 1.0)) < 0.005


@cache
def read(*stiffness):
    """A polynomial spring that a motor bends for twelve seconds: the truth, what is read, what is declared."""
    plants = joints.Plants(*joints.polynomial(np.array(stiffness)), 0.12, 0.8, 0.45, 0.3, 3.0)
    truth = joints.simulate(plants, joints.sweep(np.random.default_rng(4), 12000, 1, 1, T, 8.0, 3.0), T)
    noise = np.random.default_rng(5).normal(0.0, 0.02, (12000, 1))
    record = joints.record(truth, 0, T, motor_counts=8192, link_bits=17, torque_noise=noise)
    order = len(stiffness)
    return truth, record, joints.joint_model(0.12, 0.8, model="polynomial", order=order, parameters={})


def held_back(torque, by):
    """A torque that is read so many periods late or before it acts, or by "lag" behind a drive's filter of 20 ms."""
    if by == "lag":
        return lfilter([1.0 - np.exp(-T / 0.02)], [1.0, -np.exp(-T / 0.02)], torque, axis=0)
    moments = np.arange(len(torque))
    return np.interp(moments - by, moments, torque[:, 0])[:, None]


@pytest.mark.parametrize(
    ("by", "names", "most"),  # what has passed a filter, and is brought up again, is noisier
    [
        (0.5, [], 0.01),
        *(
            (by, ["torque_delay"], most)
            for by, most in ((3.0, 0.01), (6.0, 0.01), ("lag", 0.02), (-2.0, 0.01), (-5.0, 0.01))
        ),
    ],
)
def test_a_torque_that_is_read_late_or_early_is_no_other_effect(by, names, most):
    truth, record, joint = read(150.0, 8000.0)
    torque = held_back(record.motor_torque_nm, by)
    estimates, estimator = kit.play(joint, replace(record, motor_torque_nm=torque).samples())
    off = np.abs(estimates.stiffness_nm_rad / truth.sigma[:, 0, 0] - 1.0)[-4000:]
    assert estimator.undeclared()[0] == names
    assert np.mean(estimates.valid[-4000:]) > 0.99
    assert np.max(off) < most


def test_a_link_encoder_that_is_eccentric_is_named_and_the_stiffness_of_a_stiff_joint_right():
    """An error of 2e-4 rad (0.01°), a twentieth of the deflections: unexplained it moves the stiffness by a tenth."""
    truth, record, joint = read(1500.0, 5e6)
    q = record.link_position_rad
    estimates, estimator = kit.play(joint, replace(record, link_position_rad=q + 2e-4 * np.sin(q)).samples())
    off = np.abs(estimates.stiffness_nm_rad / truth.sigma[:, 0, 0] - 1.0)[-4000:]
    assert estimator.undeclared()[0] == ["encoder_eccentricity"]
    assert np.mean(estimates.valid[-4000:]) > 0.5  # the interval is nearly as wide as valid_within
    assert np.all(off < 3.0 * estimates.std_nm_rad[-4000:] / truth.sigma[-4000:, 0, 0])
    assert np.max(off) < 0.05


@pytest.mark.parametrize(("off_rad", "names"), [(0.001, []), (0.01, ["deflection_offset"])])
def test_a_zero_that_is_elsewhere_from_the_start_is_found_where_the_spring_shows_it(off_rad, names):
    truth, record, joint = read(150.0, 8000.0)
    moved = replace(record, link_position_rad=record.link_position_rad + off_rad)
    estimates, estimator = kit.play(joint, moved.samples())
    off = np.abs(estimates.torque_nm - truth.tau_e[:, 0, 0])
    rms = np.sqrt(np.mean(truth.tau_e[:, 0, 0] ** 2))
    assert estimator.undeclared()[0] == names
    assert np.mean(estimates.valid[-4000:]) > 0.99
    assert np.max(off[-4000:]) < 0.02 * rms
    assert np.mean(off[estimates.torque_valid] < kit.WRONG_TORQUE * rms) > 0.99


def test_the_torque_of_a_straight_line_is_not_valid_where_its_zero_or_the_torques_may_be_elsewhere():
    truth, record, joint = read(150.0)
    rms = np.sqrt(np.mean(truth.tau_e[:, 0, 0] ** 2))
    for share, valid in ((0.0, 1.0), (0.5, 0.0), (2.0, 0.0)):  # of the torque, that the zero makes
        moved = replace(record, link_position_rad=record.link_position_rad + share * rms / 150.0)
        estimates, estimator = kit.play(joint, moved.samples())
        assert np.mean(estimates.torque_valid[-8000:]) == pytest.approx(valid, abs=0.01)
        assert (
            estimator.why() is None
            if valid
            else "the zero between the encoders, or the torque's" in estimator.why()[1]
        )


def with_zero_moved(name, seed, off_rad):
    """A packaged motion whose motor 1 counts from elsewhere, and what the estimator makes of it."""
    motion = kit.motion(name, 12.0, seed=seed)
    samples = [
        s._replace(motor_position_rad=(s.motor_position_rad[0] + off_rad, *s.motor_position_rad[1:]))
        for s in motion.samples
    ]
    return motion, *kit.play(kit.declared(name), samples)


@pytest.mark.parametrize(
    ("name", "seed", "off_rad"),
    [
        ("constant", 1, 0.0258),
        ("constant", 4, 0.1641),
        ("quadratic", 5, -0.3109),
        ("quadratic", 5, -3.5073),
        ("quadratic", 1, -0.1),
        ("quadratic", 3, -1.0),
        ("vsa-ii", 0, 0.5),
        ("vsa-ii", 0, 0.7),
        ("vsa-ii", 2, -1.1),
    ],
)
def test_a_zero_elsewhere_from_the_start_is_found_or_its_torque_not_believed(name, seed, off_rad):
    """Of a line, beside effects that bend the curve, far from the zero, by few rows, and beyond where a law ends."""
    moved, estimates, _ = with_zero_moved(name, seed, off_rad)
    assert not np.any(kit.wrong(estimates, moved.stiffness_nm_rad))
    assert not np.any(kit.wrong_torque(estimates, moved.torque_nm))
    if name == "constant":  # wherever its zero is
        known = estimates.status & int(Status.STIFFNESS_VALID) > 0
        off = np.abs(estimates.stiffness_nm_rad / moved.stiffness_nm_rad - 1.0)
        assert np.mean(known[-8000:]) > 0.99 and np.max(off[-8000:]) < 0.02


@pytest.mark.parametrize(("name", "seed", "off_rad"), [("quadratic", 0, -0.1), ("vsa-ii", 0, 0.5)])
def test_a_zero_far_from_the_declared_one_is_found(name, seed, off_rad):
    """By a third and by nearly half of the deflections' range: the iteration goes there, and not beyond."""
    moved, estimates, estimator = with_zero_moved(name, seed, off_rad)
    assert "deflection_offset" in estimator.undeclared()[0]
    assert np.mean(estimates.valid[-8000:]) > 0.99
    off = np.abs(estimates.stiffness_nm_rad / moved.stiffness_nm_rad - 1.0)
    assert np.max(off[-8000:]) < 0.02


@pytest.mark.parametrize("name", ["constant", "quadratic", "vsa-ii"])
def test_a_change_is_found_beside_friction_that_nobody_declared(name):
    """A third of the torque. In a fast motion the filtered sign of the velocity is small although the motor never rests;
    the first blocks, of which friction was not known, must not hide what the next ones leave."""
    motors = len(kit.declared(name).motors)
    size = 0.3 * np.sqrt(
        np.mean([sample.motor_torque_nm[0] ** 2 for sample in kit.motion(name, 6.0).samples])
    )
    effects = [make("coulomb_friction", {"torque_nm": size}, motor) for motor in range(motors)]
    moved = kit.motion(name, 18.0, effects=effects, step=(12.0, 1.2))
    estimates, _ = kit.play(kit.declared(name), moved.samples)
    changed = np.flatnonzero(estimates.status & Status.CHANGED)
    off = np.abs(estimates.stiffness_nm_rad / moved.stiffness_nm_rad - 1.0)
    assert changed.size and 12000 <= changed[0] < 13500
    assert np.median(off[6000:12000]) < 0.001
    assert np.median(off[-1000:]) < 0.005
    assert not np.any(kit.wrong(estimates, moved.stiffness_nm_rad)[13500:])


@pytest.mark.parametrize(
    ("name", "effect", "parameters", "declared"),
    [
        ("constant", "back_driving_loss", {"coefficient": 0.3}, False),
        ("quadratic", "load_dependent_friction", {"coefficient": 0.1, "smoothing_rad_s": 0.01}, True),
    ],
)
def test_friction_of_the_load_is_no_change(name, effect, parameters, declared):
    """Its sign is anything at rest, as that of other friction is, found or declared: what blocks leave comes in bursts."""
    moved = kit.motion(name, 16.0, seed=1, effects=[make(effect, parameters, 0)])
    joint = kit.declared(name)
    if declared:
        joint = joints.with_motor(joint, effects=(Effect(name=effect, parameters=parameters),))
    estimates, estimator = kit.play(joint, moved.samples)
    assert ("load_dependent_friction" in estimator.undeclared()[0]) == (not declared)
    assert not np.any(estimates.status & Status.CHANGED)


@pytest.mark.parametrize("declared_nm", [0.0, 0.15])
def test_friction_at_rest_is_no_hysteresis(declared_nm):
    """Moves of a second between places, and a second's rest at each: there friction holds whatever the spring leaves."""
    plants = joints.Plants(
        *joints.polynomial(np.array([150.0, 8000.0])), 0.12, 0.8, 0.45, 0.3, 3.0, coulomb=np.array([0.15])
    )
    places = np.random.default_rng(6).uniform(-1.0, 1.0, 11)
    share = np.clip(np.arange(0.0, 2.0, T), 0.0, 1.0)
    way = share**3 * (10.0 - 15.0 * share + 6.0 * share**2)
    path = np.concatenate([a + (b - a) * way for a, b in itertools.pairwise(places)])

    def torque(k, state):
        return 60.0 * (path[k] - path[0] - state[:, :1]) - 4.0 * state[:, 1:2]

    truth = joints.simulate(plants, torque, T, size=(len(path), 1, 1), method=joints.HEUN)
    noise = np.random.default_rng(5).normal(0.0, 0.02, (len(path), 1))
    record = joints.record(truth, 0, T, motor_counts=8192, link_bits=17, torque_noise=noise)
    joint = joints.joint_model(0.12, 0.8, model="polynomial", order=2, parameters={})
    if declared_nm:
        friction = Effect(name="coulomb_friction", parameters={"torque_nm": declared_nm})
        joint = joints.with_motor(joint, effects=(friction,))
    estimates, estimator = kit.play(joint, record.samples())
    off = np.abs(estimates.stiffness_nm_rad / truth.sigma[:, 0, 0] - 1.0)
    assert estimator.undeclared()[0] == []
    assert np.mean(estimates.valid[-8000:]) > 0.95
    assert np.max(off[-8000:]) < 0.03
