"""What touches the link: pushes injected and found again, free motion left alone, and when nothing may be said."""

import math
from dataclasses import replace
from pathlib import Path

import joints
import numpy as np
import onlinekit
import pytest

from drivelink import jointfile
from drivelink._core import Assembler, JointPipeline
from estimator import (
    EstimatorError,
    EstimatorSettings,
    ExternalStatus,
    LinkDynamics,
    Sample,
    Status,
    make_estimator,
)
from estimator.filters import StateVariableFilter
from estimator.identify import identify
from sim.effects import parse
from sim.excitation import build
from sim.plant import JointPlant, LinkPlant, MotorPlant, Spring
from sim.sensors import DriveHardware, LinkEncoder
from sim.world import World, record

T = 1e-3
VALID, CONTACT = int(ExternalStatus.VALID), int(ExternalStatus.CONTACT)
GRAVITY_NM = 6.0
PUSHES = ((8.0, 1.5), (9.0, -1.5), (10.0, 0.8), (11.0, -3.0))  # begin, torque; each lasts PUSH_S
PUSH_S = 0.4
LOST = 12_000  # samples until positions count from elsewhere
LEARNED = 6000  # samples of free motion after which the spring is known
W = EstimatorSettings().external_bandwidth_rad_s
CERTAIN = {"inertia_std_kg_m2": 0.0, "viscous_damping_std_nm_s_rad": 0.0, "gravity_std_nm": 0.0}
LINK = LinkDynamics(inertia_kg_m2=0.4, viscous_damping_nm_s_rad=0.1, gravity_nm=GRAVITY_NM, **CERTAIN)


def world(
    seed=1,
    external=None,
    effects=(),
    payload=(0.0, 0.0),
    amplitude_nm=8.0,
    high_hz=4.0,
    counts_per_rev=4096.0,
):
    """A series elastic joint behind a gear with dry friction, in rich motion; payload: kg·m², N·m."""
    spring = Spring(model="polynomial", parameters={"coefficients_nm_rad": (150.0, 1500.0)})
    table = {
        "kind": "rich",
        "amplitude_nm": amplitude_nm,
        "low_hz": min(0.15, 0.1 * high_hz),
        "high_hz": high_hz,
    }
    excitation = build(table | {"centring_nm_rad": 10.0, "centring_nm_s_rad": 1.0}, 1)
    motor = MotorPlant(inertia_kg_m2=0.125, viscous_damping_nm_s_rad=0.8, spring=spring)
    inertia, gravity = 0.4 + payload[0], GRAVITY_NM + payload[1]
    link = LinkPlant(inertia_kg_m2=inertia, viscous_damping_nm_s_rad=0.1, gravity_nm=gravity)
    drive = DriveHardware(
        counts_per_rev=counts_per_rev, gear_ratio=50.0, torque_constant_nm_a=0.05, rated_current_a=6.0,
        current_noise_a=0.012,
    )  # fmt: skip
    return World(
        JointPlant(arrangement="single", motors=(motor,), link=link),
        (drive,),
        LinkEncoder(counts_per_rev=2.0**17),
        excitation=replace(excitation, external=external),
        effects=[parse(text) for text in ("coulomb_friction=0.75", *effects)],
        period_s=T,
        seed=seed,
    )


def push(t):
    return sum(size for begin, size in PUSHES if begin <= t < begin + PUSH_S)


def model(link=LINK, **transmission):
    return joints.joint_model(0.125, 0.8, link=link, **transmission)


def samples(rows, measured=False):
    record = joints.of_world(rows, period_s=T)
    return replace(record, external_torque_nm=rows["external_torque_nm"] if measured else None).samples()


class Estimates:
    """What an estimator said of every sample."""

    def __init__(self, joint, rows, *, measured=False, **settings):
        self.estimator = make_estimator(joint, EstimatorSettings(**settings), T)
        estimates, external = [], []
        for sample in samples(rows, measured):
            estimates.append(self.estimator.step(sample)[:3])
            external.append(self.estimator.external)
        self.estimate_valid = np.array([int(e[1]) & int(Status.VALID) > 0 for e in estimates])
        self.flexibility = np.array([e[2] for e in estimates])
        self.status = np.array([e.status for e in external])
        self.valid, self.contact = self.status & VALID > 0, self.status & CONTACT > 0
        self.torque, self.std, self.link_torque, self.difference = np.array([e[2:] for e in external]).T


@pytest.fixture(scope="module")
def pushed():
    return record(world(external=push), 12.0)


@pytest.fixture(scope="module")
def free():
    return record(world(seed=2), 20.0)


@pytest.fixture(scope="module")
def estimated(pushed):
    return Estimates(model(), pushed, contact_torque_nm=0.2)


def filtered(x):
    """The truth as the estimate has it: through the same filter."""
    return StateVariableFilter(3, W, T).apply(x)[0]


def test_a_push_is_found_within_three_per_cent_raises_a_contact_and_nothing_else_does(pushed, estimated):
    for begin, size in PUSHES:
        at = round(begin / T)
        # 60 ms are four delays of the filter: what it still lacks of a step then is 0.05 %
        window = slice(at + round(0.06 / T), at + round(PUSH_S / T))
        assert estimated.valid[window].all()
        off = estimated.torque[window] - size
        assert abs(np.mean(off)) < 0.03 * abs(size), (begin, size, np.mean(off))
        # What is left around that is the noise that the link encoder's steps make of 0.4 kg·m²: 0.045 N·m.
        assert np.sqrt(np.mean(off**2)) < 0.03 * abs(size) + 0.05
        assert not estimated.contact[at - 200 : at].any()
        first = int(np.argmax(estimated.contact[at : at + 400]))
        # Beyond what undeclared friction may be.
        assert estimated.contact[at + first] and first <= 35, (begin, first)
        assert not estimated.contact[at + round((PUSH_S + 0.1) / T)]
    assert not estimated.contact[:8000].any()


def test_it_is_valid_where_the_estimate_is_and_its_standard_deviation_is_that_of_the_error(pushed, estimated):
    """It holds its error, and is not much larger either: a controller's threshold is made of it."""
    assert not (estimated.valid & ~estimated.estimate_valid).any()
    assert not (estimated.contact & ~estimated.valid).any()
    assert not estimated.valid[:100].any()  # the filter has to settle
    assert np.all(np.isfinite(estimated.torque[estimated.valid]) & (estimated.std[estimated.valid] > 0.0))
    use = estimated.valid & (np.arange(len(estimated.torque)) > LEARNED)
    off = (estimated.torque - filtered(pushed["external_torque_nm"]))[use] / estimated.std[use]
    assert np.mean(np.abs(off) < 1.96) > 0.90
    # The motor's dry friction is undeclared: what the balance leaves of it widens the interval.
    assert np.sqrt(np.mean(off**2)) > 0.1


@pytest.mark.parametrize("error", [pytest.param(0.02, marks=pytest.mark.slow), -0.05, 0.10])
def test_a_link_that_is_off_by_what_is_declared_raises_no_contact(free, error):
    link = replace(
        LINK,
        inertia_kg_m2=(1.0 + error) * 0.4,
        gravity_nm=(1.0 + error) * GRAVITY_NM,
        inertia_std_kg_m2=abs(error) * 0.4,
        gravity_std_nm=abs(error) * GRAVITY_NM,
    )
    estimated = Estimates(model(link), free, contact_torque_nm=0.0)
    assert np.mean(estimated.valid[LEARNED:]) > 0.9
    assert not estimated.contact.any()
    # It is wrong by what it says: errors that do not average out are in the standard deviation.
    off = np.abs(estimated.torque / estimated.std)[estimated.valid]
    assert 0.1 < np.sqrt(np.mean(off**2)) < 1.5


def test_a_hand_that_guides_the_link_is_no_error_of_its_dynamics():
    truth, measured = joints.guided(*joints.polynomial(np.array([[[150.0]]])), 15000)
    link = LinkDynamics(inertia_kg_m2=0.55, viscous_damping_nm_s_rad=0.13, gravity_nm=0.02)
    known = {"parameters": {"k_nm_rad": 150.0}, "covariance": ((1.0,),)}  # as `fit` has written it
    model = joints.joint_model(0.12, 0.8, model="linear", **known, link=link)
    estimator = make_estimator(model, EstimatorSettings(), T)
    said = []
    for sample in measured.samples():
        estimator.step(sample)
        said.append(estimator.external[1:4])
    status, torque, std = np.array(said)[5000:].T
    speed, carried = truth.q_rate[:, 0], truth.tau_e[:, 0, 0]
    hand = (0.55 * np.gradient(speed, T) + 0.13 * speed + 0.02 * np.sin(truth.q[:, 0]) + carried)[5000:]
    off = torque - hand
    assert np.all(status.astype(int) & VALID)
    # The filter's delay of 12 ms is a fifth of a radian at 3 Hz; a declared link 5 % off is as much again.
    assert np.sqrt(np.mean(off**2)) < 0.25 * np.sqrt(np.mean(hand**2))
    assert np.mean(np.abs(off) < 2.0 * std) > 0.95


@pytest.mark.parametrize("high_hz", [4.0, 0.5])
def test_a_motor_that_friction_stops_is_not_suspected_of_a_frozen_reading(high_hz):
    """A bearing becomes tight: from then on the motor sticks for up to half a second while the link moves.

    A slow motion stops within a few periods, of which a fine encoder shows that they are several.
    """
    joint = world(amplitude_nm=4.0, high_hz=high_hz, counts_per_rev=65536.0)
    joint.alter(effects=[parse("coulomb_friction=0.1")])
    before = record(joint, 4.0)
    joint.advance()
    joint.alter(effects=[parse("coulomb_friction=1.5")])
    after = record(joint, 11.0)
    rows = {name: np.concatenate([before[name], after[name]]) for name in before}
    moves = np.flatnonzero(np.diff(rows["motor1_position_rad"]))
    assert np.sum(np.diff(moves) > 60) > 5  # three times as long as what no reading repeats itself for
    estimator = make_estimator(model(), EstimatorSettings(), T)
    for sample in samples(rows):
        estimator.step(sample)
        suspicion = estimator.suspicion()
        assert suspicion is None or suspicion["reason"] != "frozen", sample.sequence


@pytest.mark.parametrize("again", [False, True])
def test_a_light_motor_that_is_in_motion_when_it_is_seen_is_not_suspected(again):
    """It turns with 200 rad/s²: more than the bare motor of a small drive usually does."""
    estimator = make_estimator(joints.joint_model(5e-4, 5e-3, model="none"), EstimatorSettings(), T)
    for k in range(2000):
        if again and k == 1000:
            estimator.core.lose_zeros()
        turn = np.sin(10.0 * k * T + 1.2)
        estimator.step(Sample(k, (2.0 * turn,), (np.nan,), (-0.1 * turn,)))
        assert estimator.suspicion() is None, k


def test_a_bias_takes_a_payload_in_and_lets_a_lasting_push_fade():
    """A constant torque fades as exp(-t/bias_s): here to 13.5 % in 4 s at most, which is what it costs."""
    begin, size = 9.0, 2.0
    rows = record(world(seed=4, external=lambda t: size * (t >= begin)), 14.0)
    with_bias = Estimates(model(), rows, contact_torque_nm=0.5, external_bias_s=2.0)
    without = Estimates(model(), rows, contact_torque_nm=0.5)
    at = round((begin + 4.0) / T)
    assert without.torque[at] == pytest.approx(size, rel=0.05)
    # while it fades, what is left of it comes and goes with the estimate of the link's friction
    assert abs(np.mean(with_bias.torque[at : at + 1000])) < size * (math.exp(-2.0) + 0.1)
    assert with_bias.contact[round(begin / T) + 30]
    assert without.contact[at]


def test_fit_finds_the_link_with_its_payload_in_a_free_motion():
    """1 kg at 0.3 m, declared by nobody: fitted to one motion, it is no contact in another, and a push is right."""
    payload = (1.0 * 0.3**2, 1.0 * 0.3 * 9.81)
    rows = record(world(seed=7, payload=payload), 14.0)
    declared = LinkDynamics(inertia_kg_m2=0.4, viscous_damping_nm_s_rad=0.1, gravity_nm=GRAVITY_NM)
    found = identify(joints.of_world(rows), model(declared))
    link = found.model.link
    truth = {"inertia_kg_m2": 0.4 + payload[0], "gravity_nm": GRAVITY_NM + payload[1]}
    for name, value in truth.items():
        off = abs(getattr(link, name) - value)
        assert off < 0.02 * value and off < 3.0 * found.link_std[name], (name, off)
    again = record(world(seed=8, external=push, payload=payload), 12.0)
    without, loaded = (Estimates(m, again, contact_torque_nm=0.2) for m in (model(declared), found.model))
    use = slice(LEARNED, 8000)  # a free motion
    assert np.sqrt(np.mean(loaded.torque[use] ** 2)) < 0.1 * np.sqrt(np.mean(without.torque[use] ** 2))
    assert not loaded.contact[:8000].any()
    for begin, size in PUSHES:
        window = slice(round((begin + 0.06) / T), round((begin + PUSH_S) / T))
        assert abs(np.mean(loaded.torque[window]) - size) < 0.03 * abs(size) + 0.02 * payload[1]


def test_the_flexibility_torque_from_the_link_side_is_the_true_one(pushed):
    """Eqs 12, 13 in robust mode: with tau_k measured, -r is tau_e behind the filter and the difference is nothing."""
    estimated = Estimates(model(), pushed, measured=True)
    use = slice(LEARNED, None)
    truth = filtered(pushed["truth_flexibility_torque_nm"])[use]
    # tau_k is held over a period, where the filter takes it as straight: half a period, at a push's edges only
    off = estimated.link_torque[use] - truth
    # 0.04 N·m of encoder noise are 1.6 % of it, half a period between the encoders up to 1 %.
    assert np.sqrt(np.mean(off**2)) < 0.025 * np.sqrt(np.mean(truth**2))
    assert np.sqrt(np.mean(estimated.difference[use] ** 2)) < 0.025 * np.sqrt(np.mean(truth**2))
    consistency = estimated.estimator.consistency
    # its ten seconds begin while the spring is known to a tenth
    assert consistency.difference_rms_nm < 0.1 * consistency.link_flexibility_torque_rms_nm


def test_nothing_is_said_where_nothing_is_declared_and_a_rigid_transmission_reveals_nothing(free):
    undeclared, rigid = (
        make_estimator(joint, EstimatorSettings(), T) for joint in (model(None), model(model="none"))
    )
    for sample in samples({name: column[:500] for name, column in free.items()}):
        undeclared.step(sample)
        assert undeclared.external is None and undeclared.consistency is None
        rigid.step(sample)
        assert rigid.external.status == 0 and math.isnan(rigid.external.external_torque_nm)


@pytest.mark.parametrize("signal", [pytest.param("motor", marks=pytest.mark.slow), "link", "all alike"])
def test_it_returns_when_positions_count_from_elsewhere_and_gravity_is_found_again(signal):
    joint = jointfile.load(Path(__file__).parents[1] / "examples" / "vsa-ii.toml")
    estimator = make_estimator(joint.model(), joint.estimator, 1e-3)
    late = []
    for sample in onlinekit.motion("vsa-ii", 30.0, seed=1).samples:
        if sample.sequence == LOST:
            estimator.lose_zeros()
        if sample.sequence >= LOST and signal == "motor":
            first, *others = sample.motor_position_rad
            sample = sample._replace(motor_position_rad=(first + 0.3, *others))
        elif sample.sequence >= LOST:
            sample = sample._replace(link_position_rad=sample.link_position_rad + 0.7)
            if signal == "all alike":  # as after a power failure of the whole arm: no deflection shows it
                moved = tuple(position + 0.7 for position in sample.motor_position_rad)
                sample = sample._replace(motor_position_rad=moved)
        estimator.step(sample)
        if sample.sequence >= LOST:
            late.append(estimator.external)
    assert all(one.status & VALID for one in late[-5000:])
    valid = [one for one in late if one.status & VALID]
    # Nobody touches the link: gravity in a wrong phase would be up to 0.2 N·m.
    inside = [abs(one.external_torque_nm) < 1.96 * one.external_torque_std_nm for one in valid]
    assert np.mean(inside) > 0.95
    assert not any(one.status & CONTACT for one in late)


def test_a_cycle_without_a_sample_and_a_service_bit_take_its_validity(free):
    class Alarm:
        def step(self, *_):
            return True

        def describe(self):
            return {}

    plain, alarmed = (
        JointPipeline(Assembler((), 0), make_estimator(model(), EstimatorSettings(), T), *alarm)
        for alarm in ((), (Alarm(),))
    )
    tick = None
    for sample in samples({name: column[:8000] for name, column in free.items()}):
        tick = plain.step(sample)
        assert alarmed.step(sample).external.status == 0
    assert tick.external.status & VALID and tick.external_payload is not None
    carried = plain.carry_on(8000)
    assert (carried.external.sequence, carried.external.status) == (8000, 0)
    assert carried.external.external_torque_nm == tick.external.external_torque_nm


def test_whatever_a_sample_holds_nothing_wrong_is_called_valid_and_after_a_restart_it_settles_anew(free):
    estimator = make_estimator(model(), EstimatorSettings(), T)
    rows = list(samples({name: column[:13_000] for name, column in free.items()}))
    begin = 0
    for end, spoilt in (
        (8000, {"link_position_rad": math.nan}),
        (9000, {"link_position_rad": 1e300}),
        (10_000, {"motor_torque_nm": (math.inf,)}),
        (11_000, None),  # a gap too long to be bridged
    ):
        for row in rows[begin:end]:
            estimator.step(row)
        assert estimator.external.status & VALID, end
        begin = end + 200 * (spoilt is None)
        for row in rows[begin : begin + 5] if spoilt else rows[begin : begin + 1]:
            estimator.step(row._replace(**(spoilt or {})))
            assert estimator.external.status == 0
        begin += 5


@pytest.mark.parametrize(
    ("key", "value"),
    [("external_bandwidth_rad_s", 0.0), ("contact_torque_nm", -1.0), ("external_bias_s", 0.0)],
)
def test_a_setting_that_cannot_be_is_one_line_and_an_uncertainty_that_is_not_declared_is_the_priors(
    key, value
):
    with pytest.raises(EstimatorError, match=f"{key}: expected a finite number"):
        EstimatorSettings(**{key: value})
    link = LinkDynamics(inertia_kg_m2=2.0, viscous_damping_nm_s_rad=0.5, gravity_nm=-6.0)
    assert link.std == pytest.approx((0.2, 0.1, 0.6))
    assert replace(link, gravity_std_nm=0.0).std[2] == 0.0
    with pytest.raises(EstimatorError, match="gravity_std_nm: expected a finite number >= 0"):
        replace(link, gravity_std_nm=-1.0)
