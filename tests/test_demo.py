"""The main job: simulated drive, bus, daemon, zenoh, subscriber; truth beside estimate."""

import io
import itertools
import json
import logging
import math
import os
import re
import select
import signal
import subprocess
import sys
import termios
import threading
import time
from pathlib import Path
from types import SimpleNamespace

import pytest
from rich.console import Console
from zenohkit import LIMIT_S, until

from drivelink import cli, jointfile
from drivelink.demo.closedloop import CASES, STEPS, ClosedLoop
from drivelink.demo.rig import RunSummary
from drivelink.demo.watching import Comparison, DemoRun, RigProcess, as_json
from drivelink.demo.watching import closing as closing_section
from drivelink.monitor.history import TruePoint
from drivelink.monitor.view import JointView
from drivelink.output.document import show
from drivelink.pubsub.wire import EstimateMessage
from estimator.sample import Status, TransmissionEstimate

ELBOW = Path(__file__).parent.parent / "examples" / "elbow.toml"
DEMO = [sys.executable, "-m", "drivelink", "demo"]


def message(sequence: int, torque: float, stiffness: float, *, status: int = Status.VALID) -> EstimateMessage:
    each = TransmissionEstimate(torque, stiffness, 1.0, 0.1)
    return EstimateMessage(sequence, 0, int(status), torque, stiffness, 1.0, (each,))


def test_truth_and_estimate_are_paired_and_the_end_says_over_what_the_errors_are():
    comparison = Comparison()
    for sequence in range(1000):
        pair = [
            (comparison.known, TruePoint(sequence, 2.0, 100.0)),
            (comparison.received, message(sequence, 2.02, 101.0)),
        ]
        for take, what in pair if sequence % 2 else reversed(pair):
            take(what)  # type: ignore[operator]
    errors = comparison.errors()
    assert (errors.cycles, errors.covered) == (1000, 1.0)
    assert (errors.stiffness, errors.flexibility_torque) == pytest.approx((0.01, 0.01))
    said = closing(comparison)
    assert "over all 1000 valid cycles (1.0 s), relative to the truth's rms" in said
    assert "held the truth in 100 % of 1000 valid cycles" in said
    assert "not valid" not in said and "–" not in said


def test_what_is_not_valid_is_not_counted_and_an_interval_that_misses_the_truth_is_not_covered():
    invalid, missed = Comparison(), Comparison()
    for comparison, estimate in (
        (invalid, message(1, 9.0, 900.0, status=Status(0))),
        (missed, message(1, 2.0, 103.0)),
    ):
        comparison.received(estimate)
        comparison.known(TruePoint(1, 2.0, 100.0))
    assert invalid.errors().cycles == 0 and math.isnan(invalid.errors().stiffness)
    assert missed.errors().covered == 0.0


@pytest.fixture(autouse=True)
def _logging_as_before():
    """The demo silences its client's log for the rest of its process."""
    log = logging.getLogger("drivelink.client")
    level = log.level
    yield
    log.setLevel(level)


SUMMARY = RunSummary(1200, 1150, 3, 180.0, 40.0, 0.0005, "")


def test_a_live_view_is_drawn_by_the_thread_that_feeds_it(monkeypatch):
    """Another one would find the history longer in the middle of it."""
    drawn, draw = [], JointView.__rich_console__
    monkeypatch.setattr(
        JointView, "__rich_console__", lambda *a: [drawn.append(threading.current_thread()), *draw(*a)][1:]
    )
    console = Console(file=io.StringIO(), force_terminal=True, width=80, height=24)
    run, begin = DemoRun(jointfile.load(ELBOW), console, live=True), time.monotonic()

    def poll(seconds):
        time.sleep(seconds)
        run.summary = SUMMARY if time.monotonic() > begin + 0.6 else None

    subscription = SimpleNamespace(cycles=lambda _: [message(1, 2.0, 100.0), None], status=None)
    run.follow(RigProcess(SimpleNamespace(poll=poll), lambda: None), subscription)
    assert len(drawn) > 2 and set(drawn) == {threading.current_thread()}


def test_keys_are_not_echoed_into_the_view_nor_left_for_the_shell(monkeypatch):
    master, slave = os.openpty()
    console = Console(file=io.StringIO(), force_terminal=True, width=80, height=24)
    run, echoed = DemoRun(jointfile.load(ELBOW), console, live=True), []
    subscription = SimpleNamespace(cycles=lambda _: [None], status=None)

    def poll(_):
        echoed.append(bool(termios.tcgetattr(slave)[3] & termios.ECHO))
        os.write(master, b"x")
        run.summary = SUMMARY if len(echoed) > 2 else None

    with os.fdopen(slave) as terminal:
        monkeypatch.setattr("sys.stdin", terminal)
        run.follow(RigProcess(SimpleNamespace(poll=poll), lambda: None), subscription)
        assert echoed == [False, False, False] and termios.tcgetattr(slave)[3] & termios.ECHO
        assert not select.select([slave], [], [], 0)[0]
    os.close(master)


@pytest.mark.parametrize(
    ("pressed", "why"), [(["n"], "not accepted"), ([], "the time is over (--seconds): nobody accepted")]
)
def test_a_loop_that_stays_open_says_why(pressed, why, monkeypatch):
    console = Console(width=100, record=True, file=io.StringIO())
    offer = SimpleNamespace(lines=lambda: ["friction"])
    monkeypatch.setattr("drivelink.demo.closedloop.proposal", lambda _: offer)
    run = ClosedLoop(
        jointfile.load(ELBOW), ELBOW, CASES["friction"], console, live=False, yes=False, limit_s=0.3
    )
    run._keys = SimpleNamespace(there=True, pressed=lambda: pressed)
    run.times = dict.fromkeys(("changed", "alarm"), time.time())
    ended = []
    run._stop = lambda: ended.append(True)
    subscription = SimpleNamespace(
        cycles=lambda _: [], status=None, finding={"state": "proposed"}, model=None, latest=lambda: None
    )
    while not ended:
        run._take(subscription)
        time.sleep(0.05)
    assert console.export_text().splitlines()[-1] == why


def test_a_loop_whose_time_is_over_before_its_joint_runs_has_not_ended_unexpectedly(capsys):
    assert cli.main(["demo", "--case", "friction", "--headless", "--seconds", "0.1"]) == 1
    captured = capsys.readouterr()
    assert "the time is over (--seconds): there was no model alarm" in captured.out
    assert "unexpectedly" not in captured.err


def closing(comparison: Comparison, received: int = 1150) -> str:
    console = Console(width=100, record=True, file=io.StringIO())
    show([closing_section("vsa-ii", comparison, SUMMARY, received, 1e-3)], console)
    return console.export_text()


@pytest.mark.parametrize(("interrupted", "status"), [(True, 130), (False, 1)])
def test_a_rig_that_ctrl_c_ended_first_has_not_ended_unexpectedly(interrupted, status, monkeypatch, capsys):
    monkeypatch.setattr(DemoRun, "follow", lambda *_: interrupted)
    assert cli.main(["demo", "--headless", "--case", "constant"]) == status
    assert ("ended unexpectedly" in capsys.readouterr().err) is not interrupted


def test_an_end_before_the_first_valid_cycle_gives_no_error():
    comparison = Comparison()
    nothing, unheard = closing(comparison), closing(comparison, 0)
    assert "no estimate came over zenoh" in unheard and "┏" not in unheard
    comparison.known(TruePoint(1, 2.0, 100.0))
    comparison.received(message(1, 9.0, 900.0, status=Status(0)))
    said = closing(comparison)
    assert "of the last cycle, which is not valid" in said and "of the last cycle" not in nothing
    assert "± 0.00098" in said  # the torque's
    for text in (nothing, said):
        assert "no valid cycle, so no error" in text and "1200 cycles, 3 missed" in text
        assert "relative to" not in text and "held the truth" not in text
    document = as_json("vsa-ii", comparison, SUMMARY, 1150)
    assert document["valid_cycles"] == 0 and document["stiffness_error_relative"] is None


@pytest.mark.parametrize("case", [pytest.param("quadratic", marks=pytest.mark.slow), "vsa-ii"])
def test_the_demo_finds_the_stiffness_it_does_not_know(case):
    # 3 % leaves room for a loaded machine that loses cycles, and is far below the error of a chain with
    # any sign, unit or time shift wrong.
    result = json.loads(interrupted("--case", case, "--json", valid_lines=2))  # nothing else is printed
    assert result["case"] == case
    assert result["stiffness_error_relative"] < 0.03
    assert result["flexibility_torque_error_relative"] < 0.03


@pytest.mark.slow
@pytest.mark.timeout(300)
def test_the_loop_closes_on_what_nobody_declared():
    # Three processes: joint and daemon, black box with its diagnoses, the one that watches and accepts.
    command = [*DEMO, "--case", "friction", "--yes", "--json"]  # all effects: benchmarks/loop.py
    done = subprocess.run(command, capture_output=True, text=True, timeout=240)
    result = json.loads(done.stdout)
    assert done.returncode == 0, done.stderr
    for one in result["parameters"].values():
        assert abs(one["found"] - one["truth"]) < 4.0 * one["std"] < abs(one["truth"])
    assert result["error"]["after_rms_nm"] < 0.25 * result["error"]["before_rms_nm"]
    steps = [result[f"{step}_s"] for step in STEPS]
    assert steps == sorted(steps) and "Traceback" not in done.stderr


def interrupted(*options: str, valid_lines: int) -> str:
    """What a demo prints that Ctrl-C ends after so many lines, one a second, of a valid estimate."""
    process = subprocess.Popen(
        [*DEMO, "--seconds", "600", *options],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    assert process.stderr is not None
    valid = (line for line in process.stderr if "rad, valid" in line)
    lines = list(itertools.islice(valid, valid_lines))
    assert len(lines) == valid_lines and all(re.match(r"\d\d:\d\d:\d\d \w", line) for line in lines)
    os.killpg(process.pid, signal.SIGINT)
    out, err = process.communicate(timeout=LIMIT_S)
    assert process.returncode == 130
    assert "Traceback" not in err
    with pytest.raises(ProcessLookupError):  # nothing is left running
        until(lambda: os.killpg(process.pid, 0))
    return out


@pytest.mark.slow
def test_ctrl_c_ends_the_demo_with_its_results():
    out = interrupted("--headless", "--case", "constant", valid_lines=1)
    assert "truth beside estimate" in out
    assert "relative to the truth's rms" in out and "held the truth in" in out and "…" not in out
    errors = [float(number) for number in re.findall(r"([\d.]+) % │", out)]
    assert len(errors) == 2 and max(errors) < 3.0
