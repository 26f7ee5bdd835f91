"""Mode "balance": the estimate as algebra on sums of blocks, beside the mode "robust" on the same motion."""

from functools import cache

import numpy as np
import onlinekit as kit
import pytest

from estimator import EstimatorSettings, make_estimator
from estimator.sample import SIGMA_95
from sim.effects import parse

SETTLED = 8000  # samples: the columns' size and some thirty blocks are there


@cache
def moved(effect=None, seed=1):
    return kit.motion("quadratic", 16.0, seed=seed, effects=[parse(effect)] if effect else [])


def told(motion, mode):
    estimator = make_estimator(kit.declared("quadratic"), EstimatorSettings(mode=mode), kit.PERIOD_S)
    rows = np.array([estimator.step(sample)[:5] for sample in motion.samples])[SETTLED:]
    valid = rows[:, 1].astype(int) & kit.VALID > 0
    truth = motion.stiffness_nm_rad[SETTLED:]
    error = np.abs(rows[:, 3] - truth)
    return estimator, valid, error, rows[:, 4], truth


def test_a_healthy_joint_is_known_within_its_interval_and_nothing_is_named():
    for seed in (1, 2, 3):
        estimator, valid, error, std, truth = told(moved(seed=seed), "balance")
        assert valid.mean() > 0.95
        assert np.median(error / truth) < 1e-3  # quantisation and noise of a drive leave some 1e-4
        assert np.mean(error < 2 * SIGMA_95 * std) > 0.95
        assert estimator.core.undeclared(0) == []


@pytest.mark.parametrize(
    ("effect", "name"),
    [("load_dependent_friction=0.1", "load_dependent_friction"), ("hysteresis=0.0014", "hysteresis")],
)
def test_what_nobody_declared_is_named_while_the_joint_moves(effect, name):
    estimator, *_ = told(moved(effect), "balance")
    assert name in estimator.core.undeclared(0)


def test_undeclared_friction_of_the_load_costs_less_than_a_half_of_what_it_costs_the_robust_mode():
    worst = {}
    for mode in ("balance", "robust"):
        _, valid, error, _, truth = told(moved("load_dependent_friction=0.1"), mode)
        assert valid.any()
        worst[mode] = np.sqrt(np.mean((error[valid] / truth[valid]) ** 2))
    assert worst["balance"] < 0.5 * worst["robust"]


def test_a_stiffness_step_is_announced_and_followed():
    motion = kit.motion("quadratic", 16.0, seed=1, step=(8.0, 0.8))
    estimator = make_estimator(kit.declared("quadratic"), EstimatorSettings(mode="balance"), kit.PERIOD_S)
    rows = np.array([estimator.step(sample)[:5] for sample in motion.samples])
    status = rows[:, 1].astype(int)
    changed = status & int(kit.Status.CHANGED) > 0
    assert changed[8000:9500].any()
    assert not changed[3000:8000].any()
    assert not np.any(changed & (status & kit.VALID > 0))  # what is doubted is not valid
    last = slice(-500, None)
    assert np.median(np.abs(rows[last, 3] / motion.stiffness_nm_rad[last] - 1)) < 0.02


def test_every_estimate_that_is_not_valid_has_a_reason():
    estimator = make_estimator(kit.declared("quadratic"), EstimatorSettings(mode="balance"), kit.PERIOD_S)
    for sample in moved().samples[:6000]:
        estimate = estimator.step(sample)
        assert (estimate.status & kit.VALID > 0) == (estimator.core.why() is None)
