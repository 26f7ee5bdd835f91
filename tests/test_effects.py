"""The library of effects, filters over whole recordings, and declared effects that are part of a transmission's curve."""

import math

import joints
import numpy as np
import pytest
from scipy.signal import lfilter

from estimator import Effect, EstimatorError, EstimatorSettings, JointModel, fit, make_estimator
from estimator.effects import LIBRARY, Coordinates, elements
from estimator.filters import StateVariableFilter
from estimator.sample import Sample

VALUES = {"power": 5.0, "exponent": 2.0, "shape": 0.5, "side": -1.0, "periods_per_rev": 7.0}


def _values(name: str) -> dict[str, float]:
    return {p.name: VALUES.get(p.name, 0.03 + 0.01 * k) for k, p in enumerate(LIBRARY[name].parameters)}


def _joint(*effects: Effect) -> JointModel:
    motor = tuple(e for e in effects if not LIBRARY[e.name].on_link)
    link = tuple(e for e in effects if LIBRARY[e.name].on_link)
    spring = {"model": "linear", "parameters": {"k_nm_rad": 100.0}}
    return joints.joint_model(0.1, **spring, effects=motor, link_effects=link)


@pytest.mark.parametrize("name", sorted(n for n, k in LIBRARY.items() if not k.remembers))
def test_a_term_is_the_same_for_arrays_and_for_numbers(name):
    kind, values = LIBRARY[name], _values(name)
    rng = np.random.default_rng(3)
    table = rng.standard_normal((len(Coordinates._fields), 40))
    arrays = kind.terms(Coordinates(*table), values)
    assert len(arrays) == len(kind.linear)
    for k, column in enumerate(table.T):
        numbers = kind.terms(Coordinates(*column.tolist()), values)
        np.testing.assert_allclose(arrays[:, k], numbers[:, 0], rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("name", sorted(LIBRARY))
def test_every_effect_that_a_joint_file_may_hold_runs_on_line(name):
    joint = _joint(Effect(name=name, parameters=_values(name)))
    estimator = make_estimator(joint, EstimatorSettings(), 1e-3)
    for k in range(50):
        angle = 0.2 * math.sin(0.05 * k)
        estimate = estimator.step(Sample(k, (angle,), (math.nan,), (angle,), 1.1 * angle))
    assert math.isfinite(estimate.flexibility_torque_nm)


def test_arrays_of_parameters_are_sums_of_elements():
    waves = {"sin_nm": (1.0, 0.5), "cos_nm": 0.0, "periods_per_rev": (6.0, 12.0)}
    made = elements(Effect(name="cogging", parameters=waves))[1]
    assert [(v["periods_per_rev"], v["sin_nm"]) for v in made] == [(6.0, 1.0), (12.0, 0.5)]


T = 1e-3


def test_the_paper_modes_residual_is_that_over_arrays():
    rng = np.random.default_rng(2)
    n, inertia, damping = 500, 0.05, 0.01
    t = np.arange(n) * T
    theta, omega = 0.2 * np.sin(9.0 * t), 1.8 * np.cos(9.0 * t)
    tau = rng.normal(size=n)
    model = joints.joint_model(inertia, damping, model="none")
    paper = make_estimator(model, EstimatorSettings(mode="paper", k_tau_rad_s=300.0), T)
    rows = zip(theta.tolist(), omega.tolist(), tau.tolist(), strict=True)
    estimated = [paper.step(Sample(k, (x,), (v,), (u,)))[2] for k, (x, v, u) in enumerate(rows)]
    y = inertia * omega + damping * theta - np.r_[0.0, np.cumsum(tau[:-1]) * T]
    a = np.exp(-300.0 * T)
    residual = lfilter([(1 - a) / T, (a - 1) / T], [1.0, -a], y - y[0])  # eq 14, exact for a straight y
    assert np.array(estimated) == pytest.approx(residual, abs=1e-9)


@pytest.mark.parametrize("held", [False, True])
def test_the_impulse_response_determines_the_filter(held):
    filter_ = StateVariableFilter(4, 60.0, T)
    signal = np.cumsum(np.random.default_rng(3).normal(size=1500))
    response = filter_.impulse(filter_.settling_periods, held=held)
    late = slice(len(response), None)
    for derivative, expected in enumerate(filter_.apply(signal, 3, held=held)):
        got = np.convolve(signal - signal[0], response[:, derivative])[: len(signal)]
        got += signal[0] * (derivative == 0)
        assert got[late] == pytest.approx(expected[late], abs=1e-5 * np.max(np.abs(expected)))


def test_a_recording_begins_at_rest_at_its_first_sample_and_orders_end_at_eight():
    constant, *rates = StateVariableFilter(8, 60.0, T).apply(np.full(500, 3.0), 7, held=True)
    assert constant == pytest.approx(np.full(500, 3.0)) and not np.any(rates)
    with pytest.raises(ValueError, match="order: expected 1 to 8, got 9"):
        StateVariableFilter(9, 60.0, T).apply(np.zeros(3))
    with pytest.raises(EstimatorError, match="bandwidth_rad_s: expected a finite number > 0"):
        StateVariableFilter(2, 0.0, T)


CURVE = (150.0, 400.0, 9000.0)  # N·m/rad, /rad³, /rad⁵
HIGHER = tuple(
    Effect(name="higher_order_stiffness", parameters={"coefficient": CURVE[h], "power": 2.0 * h + 1.0})
    for h in (1, 2)
)


@pytest.fixture(scope="module")
def rig():
    rng = np.random.default_rng(5)
    torque, stiffness = joints.polynomial(np.array([[CURVE]]))
    plants = joints.Plants(torque, stiffness, 0.12, 0.8, 0.45, 0.3, 5.0)
    tau = joints.sweep(rng, 9000, 1, 1, T, 10.0, 3.0)
    truth = joints.simulate(plants, tau, T)
    return truth, joints.record(truth, 0, T, motor_counts=16384 * 8, link_bits=18)


def _model(effects, order=1):
    return joints.joint_model(0.12, 0.8, order=order, effects=effects)


def test_stiffness_and_torque_on_line_are_those_of_model_and_elastic_effects_together(rig):
    truth, record = rig
    out = joints.estimates(_model(HIGHER), record)[4000:]
    sigma, tau = truth.sigma[4000:, 0, 0], truth.tau_e[4000:, 0, 0]
    assert np.ptp(sigma) > 0.1 * np.mean(sigma)  # the effects matter
    usable = out[:, 1].astype(int) & 3 == 3
    assert usable.mean() > 0.99
    # Counts leave a third of that. Formed behind a filter, φ⁵ left 0.5 % of the torque, which became effects.
    assert np.sqrt(np.mean((out[usable, 3] / sigma[usable] - 1) ** 2)) < 0.0005
    assert np.std(out[usable, 2] - tau[usable]) < 0.002 * np.std(tau)


def test_a_fit_honours_declared_effects(rig):
    _, record = rig
    found = fit(record, _model(HIGHER))[0]
    without = fit(record, _model(()))[0]
    assert abs(found.alpha[0] / CURVE[0] - 1) < 2e-3
    assert found.error_rms_nm < 0.5 * without.error_rms_nm
