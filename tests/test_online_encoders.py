"""Encoders from 12 to 26 bits, or that count from elsewhere: valid where the motion shows the stiffness, never wrong."""

import itertools
import math
from pathlib import Path

import joints
import numpy as np
import onlinekit as kit
import pytest
from numpy.polynomial import Polynomial

from drivelink.demo.simulate import world_from_joint
from drivelink.jointfile import load
from estimator import JointModel, Motor, Sample, Transmission
from sim.cases import case
from sim.world import record

QUADRATIC = Path(__file__).parent.parent / "examples/quadratic.toml"
SECONDS = 10.0
SETTLED = 5000
SLOW = pytest.mark.slow
FINE = (17, *(pytest.param(bits, marks=SLOW) for bits in (21,)), 26)
COARSE = (12, *(pytest.param(bits, marks=SLOW) for bits in (15,)))
QUIET = pytest.mark.parametrize("noise", [pytest.param(False, marks=SLOW), True], ids=["quiet", "noisy"])


def mostly_slow(names, *cases):
    """Every case; the ones that are no tuple of `cases` are slow."""
    every = [
        (name, value)
        for name in dict.fromkeys(c[0] for c in cases)
        for value in dict.fromkeys(c[1] for c in cases)
    ]
    marked = [case if case in cases else pytest.param(*case, marks=SLOW) for case in every]
    return pytest.mark.parametrize(names, marked)


def estimates_of(name, bits, noise, excitation=None):
    motion = kit.motion(name, SECONDS, bits=bits, noise=noise, excitation=excitation)
    estimates, _ = kit.play(kit.declared(name), motion.samples)
    return estimates, kit.wrong(estimates, motion.stiffness_nm_rad)


@QUIET
@pytest.mark.parametrize("bits", FINE)
@pytest.mark.parametrize("name", ["constant", "vsa-ii"])
@pytest.mark.parametrize("pace", ["fast", pytest.param("slow", marks=SLOW)])
def test_fine_encoders_cost_no_valid(name, pace, bits, noise):
    excitation = case(name).excitation if pace == "slow" else None  # slow: one sine of 0.05 Hz a motor
    estimates, wrong = estimates_of(name, bits, noise, excitation)
    assert not np.any(wrong)
    # At 17 bits the constant case has one false alarm in these 5 s; the 0.27 s after it are not valid.
    assert np.mean(estimates.valid[SETTLED:]) > (0.95 if (name, bits) == ("constant", 17) else 0.99)


@QUIET
@pytest.mark.parametrize("bits", COARSE)
@pytest.mark.parametrize("name", ["constant", "vsa-ii"])
def test_coarse_encoders_are_never_wrong_and_valid(name, bits, noise):
    """A large inertia behind 12 bits reveals no stiffness; then nothing is valid rather than something wrong."""
    _, wrong = estimates_of(name, bits, noise)
    assert not np.any(wrong)


def test_a_joint_that_turns_all_the_time_is_valid():
    """A position that never turns back has no small change; its resolution shows in the changes' changes."""
    motion = kit.motion("constant", SECONDS, bits=16)
    declared = kit.declared("constant")
    a_sample = 400 * 2.0 * math.pi / 2**16  # 38 rad/s, in whole counts; the spring sees nothing of it
    damping = declared.motors[0].viscous_damping_nm_s_rad * a_sample / kit.PERIOD_S
    turning = [
        sample._replace(
            motor_position_rad=(sample.motor_position_rad[0] + a_sample * sample.sequence,),
            link_position_rad=sample.link_position_rad + a_sample * sample.sequence,
            motor_torque_nm=(sample.motor_torque_nm[0] + damping,),
        )
        for sample in motion.samples
    ]
    found, _ = kit.play(declared, turning)
    assert not np.any(kit.wrong(found, motion.stiffness_nm_rad))
    # At 38 rad/s what is unknown of the link's delay makes the torque, not the stiffness, uncertain.
    sure = found.std_nm_rad < 0.2 * found.stiffness_nm_rad
    assert np.mean(sure[SETTLED:]) > 0.95


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_rounding_at_rest_is_no_effect(seed):
    """Moves of 2 s with rests of 1 s: both encoders stand, so their rounding is alike for a second and no noise."""
    period, stiffness, fine = 0.002, 500.0, 4  # the torque is held: its mean over a period
    share = np.minimum(np.arange(0.0, 3.0, period / fine) / 2.0, 1.0)
    way = share**3 * (10.0 - 15.0 * share + 6.0 * share**2)
    rng = np.random.default_rng(seed)
    places = rng.uniform(-1.0, 1.0, 16)
    q = np.concatenate([a + (b - a) * way for a, b in itertools.pairwise(places)])
    rate, bend = (lambda x: np.gradient(x, period / fine)), lambda x: rate(rate(x))
    theta = q + (0.3 * bend(q) + 6.0 * np.sin(q)) / stiffness
    torque = 0.03 * bend(theta) + 0.25 * rate(theta) + stiffness * (theta - q)
    held = torque.reshape(-1, fine).mean(axis=1) + 0.02 * rng.normal(size=len(q) // fine)
    count = 2.0 * math.pi / 2**17
    read = np.round(np.stack((theta, q))[:, ::fine] / count) * count
    joint = joints.joint_model(0.03, 0.25, model="linear", parameters={"k_nm_rad": stiffness})
    estimator = kit.make_estimator(joint, kit.EstimatorSettings(), period)
    for sample in joints.recorded(read[0], held, read[1], period).samples():
        estimate, at_s = estimator.step(sample), sample.sequence * period
        if at_s > 8.0:  # few blocks may show an effect for a moment
            assert estimator.undeclared() == [[]] and estimate.status & kit.VALID, at_s


LOST = 6000


def first(sample, off):
    own, *others = sample.motor_position_rad
    return sample._replace(motor_position_rad=(own + off, *others))


def second(sample, off):
    own, other = sample.motor_position_rad
    return sample._replace(motor_position_rad=(own, other + off))


def link(sample, off):
    return sample._replace(link_position_rad=sample.link_position_rad + off)


def rebooted(joint, samples, offs, reads=first, look=lambda _k, _estimator: None):
    """Estimates and estimator; from each of these samples on a reading is off by so much, as after a reboot."""
    begin = sorted(offs)
    off = np.array([0.0, *(offs[k] for k in begin)])[np.searchsorted(begin, range(len(samples)), "right")]

    def began(k, estimator):
        if k + 1 in offs:
            estimator.lose_zeros()
        look(k, estimator)

    return kit.play(joint, map(reads, samples, off.tolist()), look=began)


@mostly_slow(("name", "off"), ("constant", 0.1), ("quadratic", 0.0), ("vsa-ii", 2.6))
def test_a_drive_that_counts_from_elsewhere_after_a_reboot_is_not_believed_before_motion_has_shown_from_where(
    name, off
):
    motion, said = kit.motion(name, 14.0), []
    look = lambda k, estimator: k == LOST + 500 and said.append(estimator.why()[0])  # noqa: E731
    found, _ = rebooted(kit.declared(name), motion.samples, {LOST: off}, look=look)
    assert said == ["lost"]
    assert found.valid[LOST - 1000 : LOST].all() and found.valid[-4000:].mean() > 0.9
    assert np.all(np.abs(found.stiffness_nm_rad / motion.stiffness_nm_rad - 1.0)[found.valid] < 0.1)
    assert kit.is_right(found, motion, found.valid)


@pytest.mark.parametrize(
    ("name", "factor"),
    [
        ("quadratic", 0.8),
        pytest.param("quadratic", 1.5, marks=SLOW),
        pytest.param("constant", 0.8, marks=SLOW),
        pytest.param("vsa-ii", 1.2, marks=SLOW),
    ],
)
def test_a_spring_that_is_another_one_after_a_reboot_is_learned_anew(name, factor):
    """What was known of it before was believed for ever, or effects made up for what was wrong of it."""
    motion = kit.motion(name, 30.0, seed=2, step=(9.0, factor))
    found, estimator = rebooted(kit.declared(name), motion.samples, {9000: 0.0})
    valid = found.valid
    assert valid[8000:9000].all() and valid[-5000:].all() and not any(estimator.undeclared())
    off = np.abs(found.stiffness_nm_rad - motion.stiffness_nm_rad)
    assert np.all((off < np.maximum(0.1 * motion.stiffness_nm_rad, 3.0 * found.std_nm_rad))[valid])
    assert np.all(off[-5000:] < 0.01 * motion.stiffness_nm_rad[-5000:])


@pytest.mark.parametrize("begun", [0.0, 1.8])
def test_a_reboot_after_another_loses_one_motors_zero_and_nothing_that_was_found_since_the_first(begun):
    """Also where the first one was needed: what was read then is no measure of where the law is to hold."""
    samples, said = kit.motion("vsa-ii", 16.0).samples, set()

    def look(k, estimator):
        reason = estimator.why() if k >= 10000 else None
        if reason and reason[0] == "lost":
            said.add(reason[1][:7])

    found, _ = rebooted(kit.declared("vsa-ii"), samples, {0: begun, 1000: 0.1, 8000: 2.7}, second, look)
    assert all(found.valid[7500:8000]) and all(found.valid[-4000:])
    assert said == {"motor 2"}


def test_what_few_blocks_between_two_reboots_say_of_a_constant_torque_is_not_carried_over():
    """The zero was not where they took it to be, so the torque at it is none."""
    motion = kit.motion("quadratic", 10.0)
    found, _ = rebooted(kit.declared("quadratic"), motion.samples, {100: -0.06, 1100: 0.02})
    assert kit.is_right(found, motion, found.valid) and np.sum(found.valid) > 1000


def test_friction_is_found_anew_after_a_reboot():
    """A motion in one direction does not tell friction from where the zero of a straight spring is."""
    motion = kit.motion("constant", 24.0, seed=0)
    friction = 0.3 * np.sqrt(np.mean(motion.torque_nm**2))
    before = np.array([sample.motor_position_rad[0] for sample in motion.samples[:12000]])
    torques = friction * np.sign(np.diff(before, prepend=before[0]))
    rubbing = [
        sample._replace(motor_torque_nm=(sample.motor_torque_nm[0] + more, *sample.motor_torque_nm[1:]))
        for sample, more in zip(motion.samples, torques, strict=False)
    ]
    found, _ = rebooted(kit.declared("constant"), rubbing + motion.samples[12000:], {12000: 0.0})
    assert kit.is_right(found, motion, found.valid, 12000) and found.valid[-1]


def test_a_zero_that_was_only_guessed_is_no_measure_of_the_next_one():
    """The first reboot is at a time at which nothing is known: the zero is taken to be the declared one."""
    joint = load(QUADRATIC)
    motion = kit.moved(record(world_from_joint(joint, seed=1), 20.0))
    found, _ = rebooted(joint.model(), motion.samples, {400: 0.1876, 4400: -0.0625}, link)
    assert kit.is_right(found, motion, found.torque_valid) and found.valid[-1]


@mostly_slow(("name", "after"), ("constant", 840), ("quadratic", 880), ("constant", 920))
def test_a_doubted_sample_in_the_middle_of_that_judgement_does_not_end_it(name, after):
    """The half block before a sample whose moment is in doubt is not judged as a whole one."""
    motion = kit.motion(name, 14.0)
    doubt = lambda k, estimator: k == LOST + after - 1 and estimator.distrust()  # noqa: E731
    found, _ = rebooted(kit.declared(name), motion.samples, {LOST: 0.1}, look=doubt)
    assert kit.is_right(found, motion, found.valid, LOST)


def moves_with_rests(seconds, seed):
    """q and its four derivatives, (5, n): moves of 0.4 to 1.2 s within 0.3 rad, rests of 0.1 to 0.7 s."""
    rng, at, parts = np.random.default_rng(seed), 0.0, []
    x = Polynomial([0.0, 1.0])
    bell = (x**4 * (1.0 - x) ** 4).integ()
    while sum(part.shape[1] for part in parts) * kit.PERIOD_S < seconds:
        goal, lasts, rest = rng.uniform(-0.3, 0.3), rng.uniform(0.4, 1.2), rng.uniform(0.1, 0.7)
        share = np.minimum(np.arange(0.0, lasts + rest, kit.PERIOD_S) / lasts, 1.0)
        step = [bell.deriv(i)(share) / bell(1.0) / lasts**i for i in range(1, 5)]
        parts.append(np.array([at + (goal - at) * bell(share) / bell(1.0), *((goal - at) * d for d in step)]))
        at = goal
    return np.hstack(parts)


def stiff_joint(stiffness, counts, size, seconds, seed):
    """A fitted joint in closed form, what it reads as it moves within 0.3 `size` rad, and its spring's torque, N·m."""
    inertia, damping, link, gravity = 0.05, 0.13, 0.05, 1.2
    q, rate, second, third, fourth = size * moves_with_rests(seconds, seed)
    torque = link * second + gravity * np.sin(q)
    torque_rate = link * third + gravity * np.cos(q) * rate
    torque_second = link * fourth + gravity * (np.cos(q) * second - np.sin(q) * rate**2)
    motor = (
        inertia * (second + torque_second / stiffness) + damping * (rate + torque_rate / stiffness) + torque
    )
    held = 0.5 * (motor + np.append(motor[1:], motor[-1])) + 0.004 * np.random.default_rng(seed).normal(
        size=len(q)
    )
    count = 2.0 * math.pi / counts
    theta, link_read = (np.round(at / count) * count for at in (q + torque / stiffness, q))
    samples = [Sample(k, (theta[k],), (math.nan,), (held[k],), link_read[k]) for k in range(len(q))]
    variance = (0.14 * stiffness) ** 2
    known = {"parameters": {"coefficients_nm_rad": (stiffness,)}, "covariance": ((variance,),)}
    fitted = Motor(
        inertia_kg_m2=inertia,
        viscous_damping_nm_s_rad=damping,
        transmission=Transmission(model="polynomial", order=1, **known),
        inertia_std_relative=0.15,
        fit_rms_nm=(0.01, float(np.sqrt(np.mean(motor**2)))),
    )
    return JointModel(arrangement="single", motors=(fitted,)), samples, -torque


@pytest.mark.parametrize("seed", [0, 2])
def test_a_stiff_joint_that_rests_between_moves_keeps_its_stiffness(seed):
    """Deflections of 2 to 15 counts: at rest rounding is an error that stays, and no effect of the joint."""
    joint, samples, torque = stiff_joint(250.0, 2**16, 1.0, 12.0, seed)
    found, estimator = kit.play(joint, samples)
    valid = found.valid[SETTLED:]
    assert np.mean(valid) > 0.5  # it rests a third of the time
    # 1 %: a tenth of what the inertia leaves open; the stated deviation of its end is below 0.3 %.
    assert np.max(np.abs(found.stiffness_nm_rad[SETTLED:][valid] / 250.0 - 1.0)) < 0.01
    assert not np.any(kit.wrong_torque(found, torque))
    assert estimator.undeclared() == [[]]


def test_a_torque_of_less_than_a_count_is_not_valid_before_it_is_learned():
    """A fitted file knows how large the torque is; what is read of a deflection of half a count is its rounding."""
    joint, samples, torque = stiff_joint(800.0, 2**13, 0.5, 6.0, 1)
    found, _ = kit.play(joint, samples)
    assert not np.any(kit.wrong_torque(found, torque))
