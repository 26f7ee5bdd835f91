"""The main job: simulated drive, bus, daemon, zenoh, subscriber; truth beside estimate."""

import json
import math
import os
import signal
import subprocess
import sys
import time

import pytest

from drivelink.demo.comparison import Comparison
from drivelink.demo.rig import TruePoint
from drivelink.pubsub.wire import EstimateMessage
from estimator.sample import Status, TransmissionEstimate

DEMO = [sys.executable, "-m", "drivelink", "demo"]


def message(sequence: int, torque: float, stiffness: float, *, status: int = Status.VALID) -> EstimateMessage:
    each = TransmissionEstimate(torque, stiffness, 1.0, 0.1)
    return EstimateMessage(sequence, 0, int(status), torque, stiffness, 1.0, (each,))


def test_truth_and_estimate_are_paired_whichever_comes_first() -> None:
    comparison = Comparison()
    for sequence in range(10):
        truth = TruePoint(sequence, 2.0, 100.0)
        estimate = message(sequence, 2.02, 101.0)
        if sequence % 2:
            comparison.known(truth)
            comparison.received(estimate)
        else:
            comparison.received(estimate)
            comparison.known(truth)
    errors = comparison.errors()
    assert errors.cycles == 10
    assert errors.stiffness == pytest.approx(0.01)
    assert errors.flexibility_torque == pytest.approx(0.01)
    assert errors.covered == 1.0


def test_what_is_not_valid_is_not_counted_against_the_estimator() -> None:
    comparison = Comparison()
    comparison.received(message(1, 9.0, 900.0, status=Status(0)))
    comparison.known(TruePoint(1, 2.0, 100.0))
    assert comparison.errors().cycles == 0
    assert math.isnan(comparison.errors().stiffness)


def test_an_interval_that_misses_the_truth_is_not_covered() -> None:
    comparison = Comparison()
    comparison.received(message(1, 2.0, 103.0))
    comparison.known(TruePoint(1, 2.0, 100.0))
    assert comparison.errors().covered == 0.0


@pytest.mark.parametrize("case", ["constant", "quadratic", "vsa-ii"])
def test_the_demo_finds_the_stiffness_it_was_not_told(case: str) -> None:
    # Twelve seconds of motion; 3 % leaves room for a loaded machine that loses cycles, and is far below
    # the error of a chain with any sign, unit or time shift wrong.
    run = subprocess.run(
        [*DEMO, "--case", case, "--seconds", "12", "--json"],
        capture_output=True,
        text=True,
        timeout=90,
        check=False,
    )
    assert run.returncode == 0, run.stderr
    result = json.loads(run.stdout)  # pure: nothing else is printed
    assert result["case"] == case
    assert result["cycles"] > 1000
    assert result["stiffness_error_relative"] < 0.03
    assert result["flexibility_torque_error_relative"] < 0.03
    assert "Traceback" not in run.stderr


def test_ctrl_c_ends_the_demo_with_its_results_and_leaves_nothing_running() -> None:
    process = subprocess.Popen(
        [*DEMO, "--seconds", "60", "--headless"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    assert process.stderr is not None
    for line in process.stderr:
        if "stiffness" in line:
            break
    os.killpg(process.pid, signal.SIGINT)
    out, err = process.communicate(timeout=90)
    assert process.returncode == 130
    assert "truth beside estimate" in out
    assert "valid cycles" in out and "relative to the truth's rms" in out and "…" not in out
    assert "Traceback" not in err
    deadline = time.monotonic() + 10
    while time.monotonic() < deadline:
        try:
            os.killpg(process.pid, 0)
        except ProcessLookupError:
            return
        time.sleep(0.05)
    pytest.fail("a process of the demo is still running")
