"""Discretisations against closed forms."""

import numpy as np
import pytest
import scipy.linalg
from hypothesis import given
from hypothesis import strategies as st

from estimator import EstimatorSettings, JointModel, Motor, Sample, Transmission, make_estimator
from estimator.filters import StateVariableFilter, _exponential, critically_damped, linear_filter

T = 1e-3


@pytest.mark.parametrize("frequency", [1.0, 10.0, 40.0])
@pytest.mark.parametrize("derivative", [0, 1, 2, 3])
def test_derivatives_of_a_sine_keep_their_exact_ratios(frequency, derivative):
    w, bandwidth = frequency, 60.0
    t = np.arange(0, 4, T)
    out = StateVariableFilter(4, bandwidth, T).apply(np.sin(w * t), derivative)[derivative]
    H = (1j * w) ** derivative * (bandwidth / (1j * w + bandwidth)) ** 4 * np.exp(1j * w * t)
    droop = 1 - (w * T) ** 2 / 12  # of straight lines between samples, the same for every derivative
    late = slice(2000, None)
    # What is left are aliases of the interpolation and droop's next term, (omega T)^4 / 360.
    assert out[late] == pytest.approx(H.imag[late] * droop, abs=1e-5 * abs(H[0]))


def test_a_held_torque_is_filtered_exactly():
    bandwidth = 60.0
    out = StateVariableFilter(2, bandwidth, T).apply(np.r_[0.0, np.ones(200)], held=True)[0]
    t = np.arange(200) * T
    assert out[1:] == pytest.approx(1 - np.exp(-bandwidth * t) * (1 + bandwidth * t), abs=1e-10)


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
    residual = linear_filter([(1 - a) / T, (a - 1) / T], [1.0, -a], y - y[0])  # eq 14, exact for a straight y
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


@pytest.mark.parametrize("held", [False, True])
@pytest.mark.parametrize("order", [2, 4, 8])
def test_a_recording_is_filtered_as_sample_by_sample_however_narrow(order, held):
    filter_ = StateVariableFilter(order, 3.0, T)
    step = filter_.held if held else filter_.smooth
    signal = np.cumsum(np.random.default_rng(4).normal(size=5000))
    states = np.zeros((len(signal), order))
    for k in range(1, len(signal)):
        old, new = signal[k - 1 : k + 1] - signal[0]
        states[k] = step.advance @ states[k - 1] + step.old * old + step.new * new
    states[:, 0] += signal[0]
    for expected, got in zip(states.T, filter_.apply(signal, 1, held=held), strict=False):
        assert got == pytest.approx(
            expected, abs=1e-8 * np.max(np.abs(expected))
        )  # its digits, less the gain's


@given(st.integers(1, 6), st.floats(1e-4, 1.0))
def test_the_exponential_is_scipys(order, bandwidth):
    companion = np.eye(order, k=1) - np.outer(np.eye(order)[-1], critically_damped(order, bandwidth))
    expected = scipy.linalg.expm(companion)
    rounding = 1e-13 * np.linalg.norm(expected)  # of both, in an element that others cancel in
    assert _exponential(companion) == pytest.approx(expected, rel=1e-12, abs=rounding)
