"""Nonsense among real frames and damaged inputs of every parser: a result or one line, never VALID and wrong."""

import logging
import math
import random

import pytest
from fuzzparsers import CORPUS, PARSERS, damaged, seeds, take
from fuzzrun import FuzzRun

from estimator.sample import Status


@pytest.fixture(autouse=True)
def quiet():
    logging.disable(logging.CRITICAL)
    yield
    logging.disable(logging.NOTSET)


@pytest.mark.parametrize(
    "seed", [101, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (102, 103, 104))]
)
def test_whatever_wires_and_confused_nodes_do_what_is_valid_is_of_its_sync(seed):
    run = FuzzRun(seed)
    run.run(60_000 if seed == 101 else 200_000)
    print(run.summary())
    # The fuzz must leave enough to be judged, and forged frames that fit must stay the exception they are.
    assert run.judge.valid > 0.15 * run.loop.cycles
    assert run.judge.unknowable < 0.01 * run.judge.valid


@pytest.mark.parametrize(
    ("seed", "how"),
    [(201, "hostile"), pytest.param(202, "hostile", marks=pytest.mark.slow), (301, "passive")],
)
def test_forged_answers_to_the_configuration_raise_nothing_and_a_passive_daemon_sends_nothing(seed, how):
    run = FuzzRun(seed, **{how: True})
    run.run(25_000)
    print(run.summary())
    assert run.judge.samples


def test_the_real_estimator_comes_out_of_it_with_finite_values():
    run = FuzzRun(401, real=True)
    run.run(20_000)
    print(run.summary())
    assert run.judge.samples
    run.bus.rate = 0.0
    for _ in range(4000):
        run.cycle()
    estimate = run.pipeline.estimate
    assert estimate is not None
    assert not estimate.status & Status.STALE
    assert math.isfinite(estimate.flexibility_torque_nm + estimate.stiffness_nm_rad)


def test_after_all_that_a_calm_bus_gives_valid_estimates_again():
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


@pytest.mark.parametrize("times", [25, pytest.param(200, marks=[pytest.mark.slow, pytest.mark.timeout(900)])])
@pytest.mark.parametrize("parser", PARSERS)
def test_damaged_inputs_are_read_or_refused_in_one_line(parser, times, tmp_path, caplog):
    caplog.set_level(logging.CRITICAL)
    kept = sorted((CORPUS / parser).glob("*"))
    assert kept, "a parser without a corpus"
    for path in kept:
        take(parser, path.read_bytes(), tmp_path)
    for good in seeds(parser):
        take(parser, good, tmp_path)
    rng = random.Random(times)
    for _ in range(times):
        take(parser, damaged(rng.choice(seeds(parser)), rng), tmp_path)
