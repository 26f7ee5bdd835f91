"""Filters over whole recordings; their discretisation is tested where it is, in `filters.rs`."""

import numpy as np
import pytest
from scipy.signal import lfilter

from estimator import (
    EstimatorError,
    EstimatorSettings,
    JointModel,
    Motor,
    Sample,
    Transmission,
    make_estimator,
)
from estimator.filters import StateVariableFilter

T = 1e-3


def test_the_paper_modes_residual_is_that_over_arrays():
    rng = np.random.default_rng(2)
    n, inertia, damping = 500, 0.05, 0.01
    t = np.arange(n) * T
    theta, omega = 0.2 * np.sin(9.0 * t), 1.8 * np.cos(9.0 * t)
    tau = rng.normal(size=n)
    motor = Motor(
        inertia_kg_m2=inertia, viscous_damping_nm_s_rad=damping, transmission=Transmission(model="none")
    )
    model = JointModel(arrangement="single", motors=(motor,))
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
