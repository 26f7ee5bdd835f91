"""Frames of nonsense among the real ones: never an exception, never an estimate VALID and wrong."""

import logging
import math
from collections.abc import Iterator

import pytest
from fuzzrun import FuzzRun

from estimator.sample import Status


@pytest.fixture(autouse=True)
def quiet() -> Iterator[None]:
    logging.disable(logging.CRITICAL)
    yield
    logging.disable(logging.NOTSET)


@pytest.mark.parametrize(
    "seed", [101, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (102, 103, 104))]
)
def test_whatever_wires_and_confused_nodes_do_what_is_valid_is_of_its_sync(seed: int) -> None:
    run = FuzzRun(seed)
    run.run(100_000 if seed == 101 else 200_000)
    print(run.summary())
    # The fuzz must leave enough to be judged, and forged frames that fit must stay the exception they are.
    assert run.judge.valid > 0.15 * run.loop.cycles
    assert run.judge.unknowable < 0.01 * run.judge.valid


@pytest.mark.parametrize("seed", [201, pytest.param(202, marks=pytest.mark.slow)])
def test_forged_answers_to_the_configuration_raise_nothing(seed: int) -> None:
    run = FuzzRun(seed, hostile=True)
    run.run(50_000)
    print(run.summary())
    assert run.judge.samples


def test_a_passive_daemon_fuzzed_raises_nothing_and_sends_nothing() -> None:
    run = FuzzRun(301, passive=True)
    run.run(50_000)
    print(run.summary())
    assert run.judge.samples


def test_the_real_estimator_comes_out_of_it_with_finite_values() -> None:
    run = FuzzRun(401, real=True)
    run.run(40_000)
    print(run.summary())
    assert run.judge.samples
    run.bus.rate = 0.0
    for _ in range(4000):
        run.cycle()
    estimate = run.pipeline.estimate
    assert estimate is not None
    assert not estimate.status & Status.STALE
    assert math.isfinite(estimate.flexibility_torque_nm + estimate.stiffness_nm_rad)


def test_after_all_that_a_calm_bus_gives_valid_estimates_again() -> None:
    run = FuzzRun(501)
    layouts = dict(run.configurator.layouts)
    run.run(20_000)
    run.bus.rate = 0.0
    for node in run.bus.nodes:
        run.bus.send(0x000, bytes((0x81, node.node)))
    for _ in range(4000):  # retries of the configuration take seconds
        run.cycle()
    before = run.judge.valid
    for _ in range(1000):
        run.cycle()
    assert run.judge.valid - before == 1000
    assert dict(run.configurator.layouts) == layouts
    assert run.supervisor.node_status(run.loop.loop_joints[0])["2"]["state"] == "operational"
