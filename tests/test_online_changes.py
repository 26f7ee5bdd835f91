"""What changes is found, what only is not declared is no change, and what was fitted is not left for a wrong value."""

from dataclasses import replace

import joints
import numpy as np
import onlinekit as kit
import pytest

from estimator import (
    EstimatorSettings,
    JointModel,
    Motor,
    Status,
    Transmission,
    fit,
    make_estimator,
    register_table,
    transmissions,
)

T = 1e-3
N = 3


def run(seconds, *, scale_at=(np.inf, 1.0), coulomb=0.0, seed=11):
    """N soft joints in rich motion: what an estimator says of each, and the truth."""
    rng = np.random.default_rng(seed)
    n = round(seconds / T)
    K = rng.uniform(80, 220, (N, 1))
    alpha = np.stack([K, K * rng.uniform(10, 60, (N, 1))], axis=-1)
    B, D = rng.uniform(0.08, 0.2, (N, 1)), rng.uniform(0.4, 1.2, (N, 1))
    more = {"coulomb": coulomb, "scale_at": scale_at}
    plants = joints.Plants(*joints.polynomial(alpha), B, D, 0.45, 0.3, 3.0, **more)
    truth = joints.simulate(plants, joints.sweep(rng, n, N, 1, T, 7.0, 3.0), T)
    how, found = {"motor_counts": 8192, "link_bits": 17, "velocity_rad_s": None}, []
    for j in range(N):
        record = joints.record(truth, j, T, **how, torque_noise=rng.normal(0, 0.04, (n, 1)))
        found.append(joints.estimates(joints.joint_model(B[j, 0], D[j, 0]), record))
    return found, truth


def has(out, bit):
    return out[:, 1].astype(int) & int(bit) > 0


def test_where_the_lever_of_a_serial_joint_goes_its_spring_is_learned_anew():
    """What is declared, and what was learned, is of another lever: nothing is valid then, and why is said."""
    at, again, n = 5000, 8500, 11000  # eight blocks of motion, and the filters, after the lever has moved
    rng, alpha = np.random.default_rng(3), np.array([[[120.0, 2400.0]]])
    inertia, damping = np.array([[0.1]]), np.array([[0.6]])
    plants = joints.Plants(
        *joints.polynomial(alpha), inertia, damping, 0.45, 0.3, 3.0, scale_at=(at * T, 1.6)
    )
    truth = joints.simulate(plants, joints.sweep(rng, n, 1, 1, T, 7.0, 3.0), T)
    record = joints.record(truth, 0, T, motor_counts=8192, link_bits=17, velocity_rad_s=None)
    lever = np.interp(np.arange(n), [at - 100, at + 100], [0.1, 0.4])
    record = replace(
        record,
        motor_position_rad=np.column_stack([record.motor_position_rad, lever]),
        motor_torque_nm=np.column_stack([record.motor_torque_nm, rng.normal(0.0, 0.01, n)]),
    )
    declared = {"coefficients_nm_rad": (120.0, 2400.0)}
    (carrying,) = joints.joint_model(0.1, 0.6, parameters=declared).motors
    setting = Motor(inertia_kg_m2=0.01, transmission=Transmission(model="none"))
    estimator = make_estimator(
        JointModel(arrangement="serial", motors=(carrying, setting)), EstimatorSettings(), T
    )
    out, reasons = [], []
    for sample in record.samples():
        out.append(estimator.step(sample)[:5])
        reasons.append(estimator.why())
    out = np.array(out)
    error = np.abs(out[:, 3] / truth.sigma[:, 0, 0] - 1)
    valid = has(out, Status.VALID)
    assert np.mean(valid[1000:at]) > 0.95 and np.max(error[1000:at][valid[1000:at]]) < 0.02
    assert not np.any(valid[at : at + 1500]) and reasons[at + 1500][0] == "lever"
    assert np.mean(valid[again:]) > 0.95 and np.max(error[at:][valid[at:]]) < 0.05


@pytest.mark.parametrize("factor", [0.9, *(pytest.param(f, marks=pytest.mark.slow) for f in (0.8, 1.25))])
def test_a_step_of_the_stiffness_is_announced_and_followed_and_not_valid_meanwhile(factor):
    at = 7000
    estimates, truth = run(9.0, scale_at=(at * T, factor))
    for j, out in enumerate(estimates):
        assert not np.any(has(out, Status.CHANGED)[:at])
        found = at + int(np.argmax(has(out, Status.CHANGED)[at:]))
        assert has(out, Status.CHANGED)[found] and found < at + 250
        error = np.abs(out[:, 3] / truth.sigma[:, j, 0] - 1)
        assert np.median(error[at + 500 :]) < 0.02
        # From the alarm on nothing is valid that is off by more than its interval.
        beyond = has(out, Status.VALID) & (error > 0.1) & (error * truth.sigma[:, j, 0] > 5 * out[:, 4])
        assert not np.any(beyond[found:])


@pytest.mark.slow
def test_friction_that_nobody_declared_is_no_change_but_widens_the_interval():
    """0.3 N·m is 3 to 5 % of the torque: it comes in bursts, at reversals."""
    widths = []
    for coulomb in (0.0, 0.3):
        estimates, truth = run(14.0, coulomb=coulomb)
        late = slice(5000, None)
        for j, out in enumerate(estimates):
            assert not np.any(has(out, Status.CHANGED))
            assert np.mean(has(out, Status.VALID)[late]) > 0.95
            off = np.abs(out[late, 3] - truth.sigma[late, j, 0])
            assert np.mean(off < 3.0 * out[late, 4]) > 0.9
        widths.append(np.median([np.median(out[late, 4] / out[late, 3]) for out in estimates]))
    assert widths[1] > 1.2 * widths[0]


def test_a_fitted_spring_is_not_left_for_a_wrong_one():
    record = kit.recorded(kit.motion("constant", 20.0).samples)
    found = fit(record, kit.declared("constant", parameters={}))
    for seed in (1, 2):
        motion = kit.motion("constant", 8.0, seed=seed)
        estimates, _ = kit.play(kit.declared("constant", parameters=found[0].parameters), motion.samples)
        assert not np.any(kit.wrong(estimates, motion.stiffness_nm_rad))
        assert np.mean(estimates.valid[4000:]) > 0.99


def test_a_measured_curve_is_a_model_too(monkeypatch):
    """A table of tau_e, declared; the spring is 15 % stiffer than it was measured."""
    name = "table-for-test"
    monkeypatch.setattr(transmissions, "MODELS", dict(transmissions.MODELS))
    phi = np.linspace(0.02, 0.8, 40)
    register_table(name, phi, 100.0 * phi + 400.0 * phi**3)
    rng = np.random.default_rng(4)
    n = 6000
    alpha = 1.15 * np.array([[[100.0, 400.0]]])
    plants = joints.Plants(*joints.polynomial(alpha), 0.12, 0.8, 0.45, 0.3, 3.0)
    truth = joints.simulate(plants, joints.sweep(rng, n, 1, 1, T, 7.0, 3.0), T)
    record = joints.record(truth, 0, T, motor_counts=16384, link_bits=18, velocity_rad_s=None)
    model = joints.joint_model(0.12, 0.8, model=name, parameters={"k_nm_rad": 1.0})
    estimator = make_estimator(model, EstimatorSettings(), T)
    out = np.array([estimator.step(sample)[:5] for sample in record.samples()])
    late = slice(3000, None)
    # A cubic between points of the table is good to a few parts in ten thousand.
    assert out[late, 3] == pytest.approx(truth.sigma[late, 0, 0], rel=5e-3)
    assert np.mean(has(out, Status.VALID)[late]) > 0.95
    assert estimator.parameters()[0]["parameters"]["k_nm_rad"] == pytest.approx(1.15, rel=2e-3)
