"""The robust mode on drive-like signals: accuracy, honesty, standstill, bad input."""

import math

import joints
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from estimator import EstimatorSettings, JointModel, Motor, Sample, Status, Transmission, make_estimator

T = 1e-3
USABLE = int(Status.VALID | Status.OBSERVABLE)


class RecordedJoint:
    """Soft joints on one motion; from a time on they rest."""

    def __init__(self, N: int = 6, rest_at: float = math.inf) -> None:
        rng, n = np.random.default_rng(21), 9000
        K = rng.uniform(80, 220, (N, 1))
        self.alpha = np.stack([K, K * rng.uniform(2, 12, (N, 1))], axis=-1)
        torque, stiffness = joints.polynomial(self.alpha)
        self.B, self.D = rng.uniform(0.08, 0.2, (N, 1)), rng.uniform(0.4, 1.2, (N, 1))
        plants = joints.Plants(torque, stiffness, self.B, self.D, 0.45, 0.3, 5.0)
        tau = joints.sweep(rng, n, N, 1, T, 8.0, 3.0)
        tau[np.arange(n) * T >= rest_at] = 0.0
        self.truth = joints.simulate(plants, tau, T)

    def record(self, j, **how):
        noise = np.random.default_rng(j).normal(0, 0.04, self.truth.tau[:, j].shape)
        how = {"motor_counts": 8192, "link_bits": 16, "velocity_rad_s": None, "torque_noise": noise, **how}
        return joints.record(self.truth, j, T, **how)

    def run(self, j, samples=None, B=1.0, D=1.0, **how):
        estimator = make_estimator(
            joints.joint_model(B * self.B[j, 0], D * self.D[j, 0]), EstimatorSettings(**how), T
        )
        samples = self.record(j).samples() if samples is None else samples
        return np.array([estimator.step(sample)[:5] for sample in samples]), estimator


@pytest.fixture(scope="module")
def rig():
    return RecordedJoint()


def _usable(out):
    return (out[:, 1].astype(int) & USABLE == USABLE) & (np.arange(len(out)) > 4000)


@pytest.mark.parametrize(("B", "D"), [(1.0, 1.0), (1.05, 0.8)])
def test_stiffness_is_right_along_the_motion_declared_parameters_exact_or_not(rig, B, D):
    errors, inside = [], []
    for j in range(6):
        out, _ = rig.run(j, B=B, D=D)
        usable = _usable(out)
        off = np.abs(out[usable, 3] - rig.truth.sigma[usable, j, 0])
        inside.append(np.mean(off < 1.96 * out[usable, 4]))
        errors.append(np.sqrt(np.mean((out[usable, 3] / rig.truth.sigma[usable, j, 0] - 1) ** 2)))
        assert usable.mean() > 0.4
    # Asked for: 0.1 % median, 0.3 % worst after convergence; here the first seconds count, too.
    assert np.median(errors) < 1.5e-3
    assert max(errors) < 4e-3
    # Six joints are six draws, each slow to change: 95 % of them on average needs many more draws (benchmarks/ensembles.py).
    assert np.mean(inside) > 0.85


def test_black_box_needs_no_model_and_stays_within_its_bound(rig):
    for j in range(2):
        out, _ = rig.run(j, method="bbe")
        usable = _usable(out)
        assert np.sqrt(np.mean((out[usable, 3] / rig.truth.sigma[usable, j, 0] - 1) ** 2)) < 0.025


def test_torque_noise_is_a_tenth_of_the_paper_modes(rig):
    for j in range(2):
        record = rig.record(j, velocity_rad_s=0.1047)  # 1 rpm
        model = joints.joint_model(rig.B[j, 0], rig.D[j, 0])
        late = slice(4000, None)
        errors = []
        for mode in ("robust", "paper"):
            estimator = make_estimator(model, EstimatorSettings(mode=mode, k_tau_rad_s=60.0), T)
            out = np.array([estimator.step(sample)[2] for sample in record.samples()])
            error = out[late] - rig.truth.tau_e[late, j, 0]
            # The paper's residual lags by design: only what is faster than the motion is noise.
            window = np.hanning(41) / np.hanning(41).sum()
            errors.append(np.std(error - np.convolve(error, window, "same")))
        assert errors[0] < 0.1 * errors[1]


@pytest.mark.parametrize("late", [0, 1, 3])
def test_deflection_is_that_of_this_moment_however_late_the_link_encoder(rig, late):
    for j in range(2):
        estimator = make_estimator(joints.joint_model(rig.B[j, 0], rig.D[j, 0]), EstimatorSettings(), T)
        samples = rig.record(j, link_delay=late).samples()
        deflection = np.array([estimator.step(sample).transmissions[0].deflection_rad for sample in samples])
        phi = rig.truth.q[:, j] - rig.truth.theta[:, j, 0]
        settled = slice(4000, None)
        rate = np.gradient(phi, T)[settled]
        error = deflection[settled] - phi[settled]
        assert abs(rate @ (error - error.mean()) / (rate @ rate)) < 0.1 * T


@pytest.mark.parametrize("seed", [0, *(pytest.param(s, marks=pytest.mark.slow) for s in (1, 2))])
def test_the_first_reversal_of_a_motion_is_no_change(seed):
    """Coulomb friction is unknown before it, so one large innovation is foreseen there; three are not."""
    rng = np.random.default_rng(seed)
    N, n, reversal = 4, 4000, 3000
    K = rng.uniform(80, 220, (N, 1))
    torque, stiffness = joints.polynomial(np.stack([K, 5 * K], axis=-1))
    B, D = rng.uniform(0.08, 0.2, (N, 1)), rng.uniform(0.8, 1.2, (N, 1))
    plants = joints.Plants(torque, stiffness, B, D, 0.45, 0.3, 0.0)
    tau = joints.sweep(rng, n, N, 1, T, 3.0, 3.0)
    tau += np.where(np.arange(n) < reversal, 10.0, -10.0)[:, None, None]
    truth = joints.simulate(plants, tau, T)
    assert np.all(truth.omega[600:reversal] > 0) and np.all(truth.omega[-1] < 0)
    for j in range(N):
        noise = np.random.default_rng(j).normal(0, 0.02, tau[:, j].shape)
        how = {"motor_counts": 8192, "link_bits": 16, "velocity_rad_s": None, "torque_noise": noise}
        estimator = make_estimator(joints.joint_model(B[j, 0], D[j, 0]), EstimatorSettings(), T)
        samples = joints.record(truth, j, T, **how).samples()
        assert not any(estimator.step(sample).status & Status.CHANGED for sample in samples)


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


def _nan_link(sample, rng):
    return sample._replace(link_position_rad=math.nan) if rng.random() < 0.3 else sample


def _infinite_torque(sample, rng):
    return sample._replace(motor_torque_nm=(math.inf,)) if rng.random() < 0.1 else sample


def _spike(sample, rng):
    return sample._replace(motor_position_rad=(5.0,)) if rng.random() < 0.02 else sample


def _lost(sample, rng):
    return None if rng.random() < 0.2 else sample


def _gone(sample, rng):
    return None


def _huge(sample, rng):
    return sample._replace(motor_torque_nm=(1e300,))


@pytest.mark.parametrize("spoil", [_nan_link, _infinite_torque, _spike, _lost, _gone, _huge])
def test_bad_input_is_named_and_leaves_no_trace(rig, spoil):
    rng = np.random.default_rng(5)
    samples = [
        spoil(sample, rng) if 4000 <= k < 4600 else sample for k, sample in enumerate(rig.record(0).samples())
    ]
    out, _ = rig.run(0, [sample for sample in samples if sample is not None])
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


def test_an_encoder_that_moves_its_zero_is_followed(rig):
    samples = list(rig.record(0).samples())
    moved = [
        s if k < 4000 else s._replace(link_position_rad=s.link_position_rad + 0.5)
        for k, s in enumerate(samples)
    ]
    out, _ = rig.run(0, moved)
    assert np.max(np.abs(out[5000:, 3] / rig.truth.sigma[5000:, 0, 0] - 1)) < 0.03


@settings(max_examples=60, deadline=None)
@given(
    st.lists(
        st.tuples(
            st.integers(-5, 50),
            st.floats(allow_nan=True, allow_infinity=True),
            st.floats(allow_nan=True, allow_infinity=True),
            st.floats(allow_nan=True, allow_infinity=True),
        ),
        max_size=30,
    ),
    st.sampled_from(["robust", "paper"]),
    st.sampled_from(["polynomial", "vsa-ii", "none", "unknown"]),
)
def test_no_float_makes_a_tick_raise(rows, mode, model):
    joint = JointModel(
        arrangement="single", motors=(Motor(inertia_kg_m2=0.1, transmission=Transmission(model=model)),)
    )
    estimator = make_estimator(joint, EstimatorSettings(mode=mode), T)
    with np.errstate(all="ignore"):
        for sequence, theta, tau, q in rows:
            out = estimator.step(Sample(sequence, (theta,), (math.nan,), (tau,), q))
            assert out.sequence == sequence
            assert len(out.transmissions) == 1


@pytest.mark.slow
def test_vsa_ii_is_found_from_nothing_on_both_sides():
    n = 10_000
    t = np.arange(n) * T
    torque, stiffness = joints.vsa_ii(np.array(0.5), np.array(1.75))
    B = np.full((1, 2), 0.02)
    plants = joints.Plants(torque, stiffness, B, B, 0.05, 0.01, 0.0)
    tau = np.zeros((n, 1, 2))
    tau[:, 0, 0] = 0.06 * np.sin(2 * np.pi * 0.5 * t) + 0.05 * np.sin(2 * np.pi * 1.3 * t)
    tau[:, 0, 1] = 0.06 * np.sin(2 * np.pi * 0.7 * t) - 0.05 * np.sin(2 * np.pi * 1.7 * t)
    truth = joints.simulate(plants, tau, T)
    record = joints.record(truth, 0, T, motor_counts=65536, link_bits=18, velocity_rad_s=None)
    estimator = make_estimator(
        joints.joint_model(0.02, 0.02, model="vsa-ii", order=None, m=2), EstimatorSettings(), T
    )
    out = np.array([estimator.step(sample)[:5] for sample in record.samples()])
    for reported in estimator.parameters():
        assert reported["model"] == "vsa-ii"
        assert reported["parameters"]["k_nm_rad"] == pytest.approx(0.5, rel=5e-3)
        assert reported["parameters"]["c"] == pytest.approx(1.75, rel=5e-3)
    late = slice(6000, None)
    assert out[late, 3] == pytest.approx(truth.sigma[late, 0].sum(1), rel=0.02)


@pytest.mark.slow
def test_what_a_nonlinear_model_is_declared_with_does_not_matter_after_some_seconds():
    """Right, or k 20 % too small and c too large: the same curve is found, and its interval holds."""
    rng = np.random.default_rng(5)
    N, n = 4, 12_000
    k, c = rng.uniform(300, 700, (N, 1)), rng.uniform(1.5, 1.9, (N, 1))
    torque, stiffness = joints.vsa_ii(k, c)
    B, D = rng.uniform(0.08, 0.2, (N, 1)), rng.uniform(0.4, 1.2, (N, 1))
    plants = joints.Plants(torque, stiffness, B, D, 0.45, 0.3, 3.0)
    truth = joints.simulate(plants, joints.sweep(rng, n, N, 1, T, 8.0, 3.0), T)
    late = slice(8000, None)
    inside = []
    for j in range(N):
        noise = rng.normal(0, 0.04, (n, 1))
        record = joints.record(
            truth, j, T, motor_counts=8192, link_bits=17, velocity_rad_s=None, torque_noise=noise
        )
        found = []
        for k_off, c_off in ((1.0, 1.0), (0.8, 1.2)):
            declared = {"k_nm_rad": k_off * k[j, 0], "c": 1.0 + c_off * (c[j, 0] - 1.0)}
            model = joints.joint_model(B[j, 0], D[j, 0], model="vsa-ii", order=None, parameters=declared)
            estimator = make_estimator(model, EstimatorSettings(), T)
            out = np.array([estimator.step(sample)[:5] for sample in record.samples()])[late]
            found.append(out[:, 3])
            inside.append(np.mean(np.abs(out[:, 3] - truth.sigma[late, j, 0]) < 1.96 * out[:, 4]))
            error = out[:, 3] / truth.sigma[late, j, 0] - 1
            assert np.sqrt(np.mean(error**2)) < 2e-3
        assert found[1] == pytest.approx(found[0], rel=1e-3)
    assert np.mean(inside) > 0.85  # eight draws of what is slow to change


def test_serial_takes_the_first_transmission_and_asks_for_a_rigid_second():
    flexible = Motor(
        inertia_kg_m2=0.1, transmission=Transmission(model="linear", parameters={"k_nm_rad": 50.0})
    )
    rigid = Motor(inertia_kg_m2=0.01, transmission=Transmission(model="none"))
    estimator = make_estimator(
        JointModel(arrangement="serial", motors=(flexible, rigid)), EstimatorSettings(), T
    )
    for k in range(30):
        out = estimator.step(Sample(k, (0.0, 0.2), (math.nan,) * 2, (0.0, 0.0), 0.01))
    assert out.stiffness_nm_rad == out.transmissions[0].stiffness_nm_rad == 50.0
    with pytest.raises(ValueError, match="serial"):
        make_estimator(JointModel(arrangement="serial", motors=(flexible, flexible)), EstimatorSettings(), T)
