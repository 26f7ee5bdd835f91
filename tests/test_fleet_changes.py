"""Change points of a fleet: what is there is found, at the declared rate of false ones; what is odd is not."""

import numpy as np
import pytest
from scipy.stats import false_discovery_control

pytest.importorskip("pyarrow", reason="the extra [fleet] is not installed")

from drivelink.fleet.changes import LEAST, appearance, changes, series_test
from estimator.sample import FloatArray

NIGHTS, SCATTER = 25, 0.004
TIME_S = np.arange(NIGHTS) * 86400.0
STATED = np.full(NIGHTS, 0.5 * SCATTER)


def series(rng: np.random.Generator, change: FloatArray | float = 0.0) -> FloatArray:
    return np.asarray(1.0 + change + SCATTER * rng.standard_normal(NIGHTS))


def test_a_fleet_without_changes_has_no_discovery_beyond_the_declared_rate():
    rng = np.random.default_rng(1)
    p = np.array([series_test(TIME_S, series(rng), STATED).p_value for _ in range(400)])
    # Bonferroni's bound: at most 5 % below 0.05. Binomial, 400 draws: 8.6 % is 3.3 sigma above.
    assert np.mean(p < 0.05) < 0.086
    assert not np.any(false_discovery_control(p) <= 0.05)


def test_a_drift_of_three_per_cent_is_found_in_nearly_all():
    rng = np.random.default_rng(2)
    drift = -0.03 * TIME_S / TIME_S[-1]
    hits = [series_test(TIME_S, series(rng, drift), STATED).p_value < 1e-3 for _ in range(200)]
    assert np.mean(hits) >= 0.95


def test_a_step_is_dated_and_its_size_lies_in_its_interval():
    rng = np.random.default_rng(3)
    inside = []
    for _ in range(100):
        (found,) = changes(TIME_S, series(rng, 0.03 * (np.arange(NIGHTS) >= 15)), STATED, 1e-3)
        assert found.kind == "step"
        assert found.earliest <= found.first <= found.latest
        assert abs(found.first - 15) <= 1
        inside.append(abs(found.amount - 0.03) < 1.96 * found.amount_std)
    assert np.mean(inside) > 0.87  # 95 %, three sigma of 100 draws below


def test_a_drift_that_begins_later_and_two_steps_are_dated():
    rng, night = np.random.default_rng(4), np.arange(NIGHTS)
    (found,) = changes(TIME_S, series(rng, 0.06 * np.maximum(night - 10, 0) / 14), STATED, 1e-3)
    assert found.kind == "drift" and found.earliest <= 10 <= found.latest
    both = changes(TIME_S, series(rng, 0.05 * (night >= 8) - 0.1 * (night >= 17)), STATED, 1e-3)
    assert [(one.kind, one.first) for one in both] == [("step", 8), ("step", 17)]


@pytest.mark.parametrize("night", [0, 12, NIGHTS - 1])
def test_one_odd_recording_is_no_change(night):
    value = series(np.random.default_rng(6))
    value[night] += 20.0 * SCATTER
    assert series_test(TIME_S, value, STATED).p_value > 0.05


def test_nights_that_resemble_each_other_are_not_taken_for_a_trend():
    rng, p = np.random.default_rng(7), []
    for _ in range(500):
        noise = rng.standard_normal(NIGHTS)
        for k in range(1, NIGHTS):
            noise[k] = 0.3 * noise[k - 1] + np.sqrt(1.0 - 0.3**2) * noise[k]
        p.append(series_test(TIME_S, 1.0 + SCATTER * noise, STATED).p_value)
    assert np.mean(np.array(p) < 0.05) < 0.08  # binomial, 500 draws: three sigma above 5 %


def test_recordings_of_little_use_hide_neither_a_step_nor_a_ramp():
    step = np.array([232.1, 221.9, 213.3, 231.9, 232.1, 208.8, 226.2, 208.9, 208.8, 208.6])
    half = np.array([0.07, 7.7, 23.0, 0.4, 0.06, 0.07, 120.0, 0.08, 0.07, 1.4])
    assert series_test(TIME_S[:10], step, half / 1.96).p_value < 1e-4
    ramp = 0.65 + 0.055 * np.arange(10) + 0.003 * np.random.default_rng(9).standard_normal(10)
    ramp[3] += 0.8
    std = np.where(np.arange(10) == 3, 0.27, 0.002)
    assert series_test(TIME_S[:10], ramp, std).p_value < 1e-4


def test_too_few_recordings_none_that_scatter_and_some_of_one_moment():
    few, rising = LEAST - 1, np.linspace(1.0, 1.2, NIGHTS)
    assert series_test(TIME_S[:few], rising[:few], STATED[:few]).p_value == 1.0
    assert changes(TIME_S[:few], rising[:few], STATED[:few], 0.05) == []
    assert series_test(TIME_S, np.ones(NIGHTS), np.zeros(NIGHTS)).p_value == 1.0
    assert series_test(TIME_S, 1.0 + (TIME_S[9] <= TIME_S), np.zeros(NIGHTS)).p_value < 1e-6
    assert series_test(np.zeros(NIGHTS), rising, STATED).p_value < 1e-6  # taken in order


def test_an_effect_that_appears_is_dated_and_one_that_comes_and_goes_is_not_significant():
    appeared = appearance(np.arange(NIGHTS) >= 14)
    assert appeared.first == 14
    assert appeared.p_value < 1e-4
    assert appearance(np.arange(NIGHTS) % 5 == 0).p_value > 0.2
    assert appearance(np.ones(NIGHTS, dtype=bool)).p_value == 1.0
    assert appearance(np.arange(NIGHTS) < 10).p_value == 1.0  # it went away
