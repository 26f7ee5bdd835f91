"""The robust mode on drive-like signals: accuracy, honesty, standstill, bad input."""

import math
from functools import lru_cache

import joints
import numpy as np
import onlinekit as kit
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from estimator import EstimatorSettings, JointModel, Motor, Sample, Status, Transmission, make_estimator

T = 1e-3
USABLE = int(Status.VALID | Status.OBSERVABLE)
DRIVE = {"motor_counts": 8192, "link_bits": 16, "velocity_rad_s": None}


class RecordedJoint:
    """Soft joints on one motion; from a time on they rest."""

    def __init__(self, N=6, rest_at=math.inf):
        rng, n = np.random.default_rng(21), 9000
        K = rng.uniform(80, 220, (N, 1))
        self.alpha = np.stack([K, K * rng.uniform(2, 12, (N, 1))], axis=-1)
        self.B, self.D = rng.uniform(0.08, 0.2, (N, 1)), rng.uniform(0.4, 1.2, (N, 1))
        plants = joints.Plants(*joints.polynomial(self.alpha), self.B, self.D, 0.45, 0.3, 5.0)
        tau = joints.sweep(rng, n, N, 1, T, 8.0, 3.0)
        tau[np.arange(n) * T >= rest_at] = 0.0
        self.truth = joints.simulate(plants, tau, T)

    def record(self, j, **how):
        noise = np.random.default_rng(j).normal(0, 0.04, self.truth.tau[:, j].shape)
        return joints.record(self.truth, j, T, **{**DRIVE, "torque_noise": noise, **how})

    def run(self, j, samples=None, B=1.0, D=1.0, **how):
        model = joints.joint_model(B * self.B[j, 0], D * self.D[j, 0])
        estimator = make_estimator(model, EstimatorSettings(**how), T)
        samples = self.record(j).samples() if samples is None else samples
        return np.array([estimator.step(sample)[:5] for sample in samples]), estimator

    def errors(self, j, out):
        """Relative, while it is usable; with the share that is, and of it the share within 95 % intervals."""
        usable = (out[:, 1].astype(int) & USABLE == USABLE) & (np.arange(len(out)) > 4000)
        off = np.abs(out[usable, 3] - self.truth.sigma[usable, j, 0])
        rms = np.sqrt(np.mean((off / self.truth.sigma[usable, j, 0]) ** 2))
        return rms, usable.mean(), np.mean(off < 1.96 * out[usable, 4])


@pytest.fixture(scope="module")
def rig():
    return RecordedJoint()


@pytest.mark.parametrize(("B", "D"), [(1.0, 1.0), (1.05, 0.8)])
def test_stiffness_is_right_along_the_motion_declared_parameters_exact_or_not(rig, B, D):
    errors, usable, inside = np.array([rig.errors(j, rig.run(j, B=B, D=D)[0]) for j in range(6)]).T
    assert min(usable) > 0.4
    # Asked for: 0.1 % median, 0.3 % worst after convergence; here the first seconds count, too.
    assert np.median(errors) < 1.5e-3 and max(errors) < 4e-3
    # Six joints are six draws, each slow to change: 95 % of them on average needs many more draws (benchmarks/estimators.py).
    assert np.mean(inside) > 0.85


def test_black_box_needs_no_model_and_stays_within_its_bound(rig):
    assert max(rig.errors(j, rig.run(j, method="bbe")[0])[0] for j in range(2)) < 0.025


def test_torque_noise_is_a_tenth_of_the_paper_modes(rig):
    late, window = slice(4000, None), np.hanning(41) / np.hanning(41).sum()
    samples = list(rig.record(0, velocity_rad_s=0.1047).samples())  # 1 rpm
    noise = {}
    for mode in ("robust", "paper"):
        out, _ = rig.run(0, samples, mode=mode, k_tau_rad_s=60.0)
        error = out[late, 2] - rig.truth.tau_e[late, 0, 0]
        # The paper's residual lags by design: only what is faster than the motion is noise.
        noise[mode] = np.std(error - np.convolve(error, window, "same"))
    assert noise["robust"] < 0.1 * noise["paper"]


@pytest.mark.parametrize("late", [0, 1, 3])
def test_deflection_is_that_of_this_moment_however_late_the_link_encoder(rig, late):
    estimator = make_estimator(joints.joint_model(rig.B[0, 0], rig.D[0, 0]), EstimatorSettings(), T)
    samples, settled = rig.record(0, link_delay=late).samples(), slice(4000, None)
    deflection = np.array([estimator.step(sample).transmissions[0].deflection_rad for sample in samples])
    phi = rig.truth.q[:, 0] - rig.truth.theta[:, 0, 0]
    rate, error = np.gradient(phi, T)[settled], (deflection - phi)[settled]
    assert abs(rate @ (error - error.mean()) / (rate @ rate)) < 0.1 * T


@pytest.mark.parametrize("seed", [0, *(pytest.param(s, marks=pytest.mark.slow) for s in (1, 2))])
def test_the_first_reversal_of_a_motion_is_no_change(seed):
    """Coulomb friction is unknown before it, so one large innovation is foreseen there; three are not."""
    rng = np.random.default_rng(seed)
    N, n, reversal = 4, 4000, 3000
    K = rng.uniform(80, 220, (N, 1))
    B, D = rng.uniform(0.08, 0.2, (N, 1)), rng.uniform(0.8, 1.2, (N, 1))
    plants = joints.Plants(*joints.polynomial(np.stack([K, 5 * K], axis=-1)), B, D, 0.45, 0.3, 0.0)
    tau = joints.sweep(rng, n, N, 1, T, 3.0, 3.0)
    tau += np.where(np.arange(n) < reversal, 10.0, -10.0)[:, None, None]
    truth = joints.simulate(plants, tau, T)
    assert np.all(truth.omega[600:reversal] > 0) and np.all(truth.omega[-1] < 0)
    for j in range(N):
        noise = np.random.default_rng(j).normal(0, 0.02, tau[:, j].shape)
        record = joints.record(truth, j, T, **DRIVE, torque_noise=noise)
        out = joints.estimates(joints.joint_model(B[j, 0], D[j, 0]), record)
        assert not np.any(out[:, 1].astype(int) & Status.CHANGED)


def test_standstill_moves_nothing_and_is_not_called_observable():
    resting = RecordedJoint(N=2, rest_at=3.0)
    for j in range(2):
        out, estimator = resting.run(j)
        rest = slice(8000, None)
        assert np.ptp(out[rest, 3]) < np.min(out[rest, 4])
        assert not np.any(out[rest, 1].astype(int) & Status.OBSERVABLE)
        assert np.all(out[rest, 1].astype(int) & Status.VALID)
        (reported,) = estimator.parameters()
        found = reported["parameters"]["coefficients_nm_rad"][0]
        assert found == pytest.approx(resting.alpha[j, 0, 0], rel=1e-2)


def test_replay_gives_the_same_bits_as_live(rig):
    first, estimator = rig.run(0)
    estimator.reset()
    again = np.array([estimator.step(sample)[:5] for sample in rig.record(0).samples()])
    other, _ = rig.run(0)
    assert first.tobytes() == other.tobytes()
    assert first.tobytes() == again.tobytes()


SPOILT = {  # field: (probability, value); nothing: the sample is lost
    "a link position that is no number": (0.3, {"link_position_rad": math.nan}),
    "an infinite torque": (0.1, {"motor_torque_nm": (math.inf,)}),
    "a spike": (0.02, {"motor_position_rad": (5.0,)}),
    "lost samples": (0.2, None),
    "a gap": (1.0, None),
    "a huge torque": (1.0, {"motor_torque_nm": (1e300,)}),
}


@pytest.mark.parametrize("name", SPOILT)
def test_bad_input_is_named_and_leaves_no_trace(rig, name):
    (probability, values), rng, samples = SPOILT[name], np.random.default_rng(5), []
    for k, sample in enumerate(rig.record(0).samples()):
        if not (4000 <= k < 4600 and rng.random() < probability):
            samples.append(sample)
        elif values is not None:
            samples.append(sample._replace(**values))
    out, _ = rig.run(0, samples)
    status, tick = out[:, 1].astype(int), out[:, 0].astype(int)
    during, after = (tick >= 4000) & (tick < 4650), tick > 5600
    assert np.any(status[during] & (Status.INPUT_REJECTED | Status.GAP | Status.RESTARTED))
    assert np.all(status[after] & Status.VALID)
    assert np.max(np.abs(out[after, 3] / rig.truth.sigma[tick[after], 0, 0] - 1)) < 0.02


@pytest.mark.parametrize("channel", ["motor_position_rad", "link_position_rad", "motor_torque_nm"])
def test_a_frozen_channel_is_noticed_and_survived(rig, channel):
    samples = list(rig.record(0).samples())
    frozen = getattr(samples[4000], channel)
    for k in range(4000, 4800):
        samples[k] = samples[k]._replace(**{channel: frozen})
    out, _ = rig.run(0, samples)
    status = out[:, 1].astype(int)
    assert np.mean(status[4100:4800] & Status.INPUT_REJECTED > 0) > 0.9
    assert not np.any(status[4100:4800] & Status.VALID)
    assert np.median(np.abs(out[6500:, 3] / rig.truth.sigma[6500:, 0, 0] - 1)) < 0.01


@pytest.mark.parametrize(
    ("name", "rest_s", "all_hang"),
    [("quadratic", 0.0, False), ("vsa-ii", 0.0, False), ("vsa-ii", 3.0, False), ("vsa-ii", 0.0, True)],
)
def test_a_drive_that_hangs_in_the_first_second_of_motion_is_noticed(name, rest_s, all_hang):
    """How long readings repeat is learned from their changes in motion: neither at rest nor from what hangs."""
    motion, rest = kit.motion(name, 7.0, seed=8), round(rest_s / kit.PERIOD_S)
    hung = motion.samples[955]
    last = {key: getattr(hung, key)[-1] for key in ("motor_position_rad", "motor_torque_nm")}

    def hangs(sample):
        return sample._replace(**{key: (*getattr(sample, key)[:-1], value) for key, value in last.items()})

    moving = [
        sample if not 955 <= k < 1755 else hung if all_hang else hangs(sample)
        for k, sample in enumerate(motion.samples)
    ]
    samples = [sample._replace(sequence=k) for k, sample in enumerate(moving[:1] * rest + moving)]
    found, _ = kit.play(kit.declared(name), samples)
    valid, stiffness = found.valid[rest:], motion.stiffness_nm_rad
    off = np.abs(found.stiffness_nm_rad[rest:] - stiffness)
    assert np.all((off < np.maximum(0.1 * stiffness, 3.0 * found.std_nm_rad[rest:]))[valid])
    assert not any(valid[980:1755]) and any(valid[-1000:])


def test_a_link_encoder_that_repeats_itself_for_a_moment_has_not_moved_its_zero():
    motion = kit.motion("vsa-ii", 8.0, seed=5)
    hung = motion.samples[1512].link_position_rad
    samples = [
        sample._replace(link_position_rad=hung) if 1512 <= k < 1542 else sample
        for k, sample in enumerate(motion.samples)
    ]
    found, _ = kit.play(kit.declared("vsa-ii"), samples)
    assert kit.is_right(found, motion, found.valid) and np.mean(found.valid[2000:]) > 0.9


def test_an_encoder_that_moves_its_zero_is_followed(rig):
    samples = list(rig.record(0).samples())
    for k in range(4000, len(samples)):
        samples[k] = samples[k]._replace(link_position_rad=samples[k].link_position_rad + 0.5)
    out, _ = rig.run(0, samples)
    assert np.max(np.abs(out[5000:, 3] / rig.truth.sigma[5000:, 0, 0] - 1)) < 0.03


@settings(max_examples=60, deadline=None)
@given(
    st.lists(st.tuples(st.integers(-5, 50), st.floats(), st.floats(), st.floats()), max_size=30),
    st.sampled_from(["robust", "paper"]),
    st.sampled_from(["polynomial", "vsa-ii", "none", "unknown"]),
)
def test_no_float_makes_a_tick_raise(rows, mode, model):
    joint = joints.joint_model(0.1, model=model, order=None)
    estimator = make_estimator(joint, EstimatorSettings(mode=mode), T)
    with np.errstate(all="ignore"):
        for sequence, theta, tau, q in rows:
            out = estimator.step(Sample(sequence, (theta,), (math.nan,), (tau,), q))
            assert out.sequence == sequence
            assert len(out.transmissions) == 1


@pytest.mark.slow
def test_vsa_ii_is_found_from_nothing_on_both_sides():
    t, B = np.arange(10_000) * T, np.full((1, 2), 0.02)
    plants = joints.Plants(*joints.vsa_ii(np.array(0.5), np.array(1.75)), B, B, 0.05, 0.01, 0.0)
    waves = [(0.5, 1.3, 0.05), (0.7, 1.7, -0.05)]
    tau = [0.06 * np.sin(2 * np.pi * a * t) + size * np.sin(2 * np.pi * b * t) for a, b, size in waves]
    truth = joints.simulate(plants, np.stack(tau, axis=-1)[:, None], T)
    record = joints.record(truth, 0, T, motor_counts=65536, link_bits=18, velocity_rad_s=None)
    model = joints.joint_model(0.02, 0.02, model="vsa-ii", order=None, m=2)
    estimator = make_estimator(model, EstimatorSettings(), T)
    out = np.array([estimator.step(sample)[:5] for sample in record.samples()])[6000:]
    for reported in estimator.parameters():
        assert reported["model"] == "vsa-ii"
        assert reported["parameters"] == pytest.approx({"k_nm_rad": 0.5, "c": 1.75}, rel=5e-3)
    assert out[:, 3] == pytest.approx(truth.sigma[6000:, 0].sum(1), rel=0.02)


def test_serial_takes_the_first_transmission_and_asks_for_a_rigid_second():
    spring = Transmission(model="linear", parameters={"k_nm_rad": 50.0})
    flexible = Motor(inertia_kg_m2=0.1, transmission=spring)
    rigid = Motor(inertia_kg_m2=0.01, transmission=Transmission(model="none"))

    def serial(*motors):
        return make_estimator(JointModel(arrangement="serial", motors=motors), EstimatorSettings(), T)

    estimator = serial(flexible, rigid)
    for k in range(30):
        out = estimator.step(Sample(k, (0.0, 0.2), (math.nan,) * 2, (0.0, 0.0), 0.01))
    assert out.stiffness_nm_rad == out.transmissions[0].stiffness_nm_rad == 50.0
    with pytest.raises(ValueError, match="serial"):
        serial(flexible, flexible)


# What is called valid is right, whatever reaches the estimator: gaps, garbage, glitches, any joint.


SPOILT_SAMPLES = 15_000  # filters settle after each fault: what is learned from comes to two seconds in ten


@lru_cache(maxsize=2)
def spoilt_rigs(stiff):
    """Soft (series elastic) or stiff (harmonic drive) joints in rich motion."""
    rng = np.random.default_rng(31 + stiff)
    low, high, cubic = (5000, 12000, 2e4) if stiff else (80, 220, 12.0)
    K = rng.uniform(low, high, (4, 1))
    alpha = np.stack([K, K * rng.uniform(0, cubic, (4, 1))], -1)
    B, D = rng.uniform(0.08, 0.2, (4, 1)), rng.uniform(0.4, 1.2, (4, 1))
    scale = 6.0 if stiff else 1.0
    M, Dq, gravity, size = (1.5, 2.0, 20.0, 40.0) if stiff else (0.45, 0.3, 5.0, 8.0)
    plants = joints.Plants(*joints.polynomial(alpha), scale * B, scale * D, M, Dq, gravity)
    tau = joints.sweep(rng, SPOILT_SAMPLES, 4, 1, T, size, 3.0)
    return plants, joints.simulate(plants, tau, T)


def spoilt(record, seed):
    """Gaps of up to 60 samples, and up to 12 samples at a time that are garbage: one of both every 0.2 s."""
    rng = np.random.default_rng(seed)
    n = len(record)
    keep = np.ones(n, bool)
    for start in rng.integers(0, n, n // 320):
        keep[start : start + rng.integers(1, 60)] = False
    left = joints.part(record, keep)  # copies
    columns = (left.motor_position_rad, left.motor_torque_nm, left.link_position_rad)
    for start in rng.integers(0, len(left), n // 530):
        value = rng.choice([np.nan, np.inf, 1e30, 5.0, -1e200])
        columns[rng.integers(3)][start : start + rng.integers(1, 12)] = value
    return keep, left


def run_spoilt(stiff, j, seed, order):
    """What an estimator says of a spoilt recording: error, standard deviation, truth and status."""
    plants, truth = spoilt_rigs(stiff)
    noise = np.random.default_rng(seed).normal(0, 0.1 if stiff else 0.04, truth.tau[:, j].shape)
    fine = {"motor_counts": 8192 * 400, "link_bits": 20} if stiff else {"link_bits": 17}
    record = joints.record(truth, j, T, **(DRIVE | fine), torque_noise=noise)
    keep, record = spoilt(record, seed)
    model = joints.joint_model(plants.B[j, 0], plants.D[j, 0], order=order)
    out = joints.estimates(model, record)
    sigma = truth.sigma[keep, j, 0]
    return np.abs(out[:, 3] - sigma), out[:, 4], sigma, out[:, 1].astype(int)


@pytest.mark.slow
@settings(max_examples=5, deadline=None, derandomize=True)
@given(st.booleans(), st.integers(0, 3), st.sampled_from(range(64)), st.sampled_from([2, 3, None]))
def test_what_is_called_valid_is_no_nonsense(stiff, j, seed, order):
    error, std, sigma, status = run_spoilt(stiff, j, seed, order)
    valid, usable = status & 1 == 1, status & 3 == 3
    # Six standard deviations, or what a controller does not notice; far beyond what noise can do.
    assert np.all(error[usable] <= np.maximum(6 * std[usable], 0.15 * sigma[usable]))
    assert np.all(error[valid] <= np.maximum(6 * std[valid], 0.45 * sigma[valid]))


def test_most_of_a_spoilt_recording_is_called_valid_as_a_rule():
    shares = [np.mean(run_spoilt(False, j, seed, 2)[3] & 1) for j in (0, 1) for seed in range(8)]
    # A gap or garbage comes every 0.2 s, and filters settle for 0.35 s; garbage that could be true costs more.
    assert np.median(shares) > 0.3
