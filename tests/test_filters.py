"""Discretisations against closed forms."""

import numpy as np
import pytest
import scipy.linalg
from hypothesis import given
from hypothesis import strategies as st

from estimator.bank import FilterBank
from estimator.filters import StateVariableFilter, _exponential, critically_damped
from estimator.residuals import FirstOrder, SecondOrder, first_order, motor_balance, second_order

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


@pytest.mark.parametrize("block", [1, 10])
def test_filters_of_a_whole_recording_and_of_blocks_agree(block):
    rng = np.random.default_rng(1)
    x = np.cumsum(rng.normal(size=(801, 2)), axis=0)
    bank = FilterBank(1, 1, 0, 60.0, T, block)
    bank.rest(x[0, :1].tolist(), x[0, 1:].tolist())
    ticks, lightly = [], []
    for rows in np.split(x[1:], 800 // block):
        lightly.append(bank.pass_light(rows[:, :1], rows[:, 1:]).copy())
        bank.pass_main(np.zeros((block, 0)))
        ticks.append(bank.outputs())
    light = StateVariableFilter(3, 300.0, T)
    main = StateVariableFilter(4, 60.0, T)
    for channel, held in ((0, False), (1, True)):
        first = light.apply(x[:, channel], 2, held=held)
        expected = main.apply(first[0], 2)
        for derivative in range(3):
            got = np.array([tick[derivative][channel] for tick in ticks])
            scale = np.max(np.abs(expected[derivative]))
            assert got == pytest.approx(expected[derivative][block::block], abs=1e-8 * scale)
            along = np.concatenate([path[derivative, :, channel] for path in lightly])
            scale = np.max(np.abs(first[derivative]))
            assert along == pytest.approx(first[derivative][1:], abs=1e-8 * scale)


def test_residuals_over_arrays_and_tick_by_tick_agree():
    rng = np.random.default_rng(2)
    theta = np.cumsum(rng.normal(size=500)) * 1e-3
    omega, tau = rng.normal(size=500), rng.normal(size=500)
    y = motor_balance(0.05, 0.01, theta, omega, tau, T)
    one, two = FirstOrder(0.05, 0.01, 300.0, T), SecondOrder(0.05, 0.01, 300.0, 20.0, T)
    ticks = [(one.update(*row), two.update(*row)) for row in zip(theta, omega, tau, strict=True)]
    assert np.array(ticks)[:, 0] == pytest.approx(first_order(y, 300.0, T), abs=1e-9)
    assert np.array(ticks)[:, 1] == pytest.approx(second_order(y, 300.0, 20.0, T), abs=1e-7)


@pytest.mark.parametrize("held", [False, True])
def test_the_answer_to_a_pulse_tells_the_whole_filter(held):
    filter_ = StateVariableFilter(4, 60.0, T)
    signal = np.cumsum(np.random.default_rng(3).normal(size=1500))
    response = filter_.impulse(filter_.settling_periods, held=held)
    late = slice(len(response), None)
    for derivative, expected in enumerate(filter_.apply(signal, 3, held=held)):
        got = np.convolve(signal - signal[0], response[:, derivative])[: len(signal)]
        got += signal[0] * (derivative == 0)
        assert got[late] == pytest.approx(expected[late], abs=1e-5 * np.max(np.abs(expected)))


@given(st.integers(1, 6), st.floats(1e-4, 1.0))
def test_the_exponential_is_scipys(order, bandwidth):
    companion = np.eye(order, k=1) - np.outer(np.eye(order)[-1], critically_damped(order, bandwidth))
    assert _exponential(companion) == pytest.approx(scipy.linalg.expm(companion), rel=1e-12, abs=1e-14)
