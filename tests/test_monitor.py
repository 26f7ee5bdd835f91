"""The live views: what fits where, and what is distinguished."""

import fcntl
import io
import json
import math
import os
import pty
import re
import select
import struct
import subprocess
import sys
import termios
import time
from datetime import UTC, datetime
from types import SimpleNamespace
from typing import NamedTuple

import pytest
import zenohkit
from rich.console import Console

from drivelink import cli
from drivelink.cli.monitor import _picture
from drivelink.monitor.history import GrowingCurve, JointHistory
from drivelink.monitor.statuslines import shape, status_lines
from drivelink.monitor.terminal import joints_table
from drivelink.monitor.view import JointView, flags
from drivelink.monitor.web import snapshot
from drivelink.output.numbers import number, shared_range, usual_range, with_interval
from drivelink.pubsub.wire import ExternalMessage
from estimator.sample import Estimate, Sample, Status, TransmissionEstimate

STATUS = {
    "state": "running", "rate_hz": 999.8, "cycles": 5000, "missed_cycles": 2, "cpu_fraction": 0.123,
    "latency": {"p50_us": 60.0, "p99_us": 95.0, "max_us": 300.0},
    "response": {"p50_us": 300.0, "p99_us": 420.0, "max_us": 700.0},
    "jitter": {"p50_us": 60.0, "p99_us": 110.0, "max_us": 900.0},
    "nodes": {"1": {"state": "operational", "fault": False}, "2": {"state": "stopped", "fault": True}},
    "bus": {"load": 0.38}, "residual_nm": 0.00312, "conditions": ["node 2 reports a fault"],
    "events": [{"time": 1.7e9, "text": "node 2 reports a fault", "count": 1}],
}  # fmt: skip


class Truth(NamedTuple):
    flexibility_torque_nm: float
    stiffness_nm_rad: float


def estimate(k, motors=2, status=3):
    phis = [0.1 * math.sin((1.3 + 0.4 * i) * k * 1e-3) for i in range(motors)]
    ones = [TransmissionEstimate(100 * x + 1000 * x**3, 100 + 3000 * x * x, 2 + 20 * abs(x), x) for x in phis]
    return Estimate(k, status, sum(o[0] for o in ones), sum(o[1] for o in ones), 4.0, tuple(ones))


def filled(motors=2, truth=False, n=4000):
    view = JointView("elbow", subtitle="vsa-ii on the virtual bus")
    for k in range(n):
        e = estimate(k, motors)
        view.update(e, k * 1e-3, Truth(e[2] * 1.01, e[3] * 1.002) if truth else None)
    view.status = STATUS
    view.errors = (0.002, 0.01) if truth else view.errors
    return view


def lines(view, width=80, height=24):
    console = Console(width=width, height=height, record=True, file=io.StringIO())
    console.print(view)
    return console.export_text().rstrip("\n").split("\n")


@pytest.mark.parametrize("motors", [1, 2])
@pytest.mark.parametrize("truth", [True, False])
def test_the_view_fits_the_terminal(motors, truth):
    view = filled(motors, truth)
    for width, height in ((80, 24), (132, 50), (60, 20), (40, 12)):
        shown = lines(view, width, height)
        assert len(shown) <= height and all(len(line) <= width for line in shown)


def test_a_narrow_view_ends_a_number_with_an_ellipsis_and_has_no_sparkline_of_one_sign():
    for width, truth in ((80, True), (80, False), (60, True), (60, False), (50, False)):
        for line in lines(filled(truth=truth), width)[1:4]:
            text = line[2:-2].rstrip()
            assert text.endswith("…") or len(text) < width - 4, line  # else the frame cuts it
            assert width < 80 or "…" not in text


@pytest.mark.parametrize(("motors", "external", "truth"), [(2, True, True), (1, False, False)])
def test_the_legend_explains_what_is_there_and_fits_the_terminal(motors, external, truth):
    view = filled(motors, truth)
    if external:
        view.update_external(ExternalMessage(1, 0, 1, 0.2, 0.01), 4.0)
    shown = [re.match("│ ([a-z][a-z ]{,9})", line) for line in lines(view)]
    labels = {match[1].rstrip() for match in shown if match} - {""}
    view.help = True
    legend = lines(view)
    text = "\n".join(legend)
    assert len(legend) <= 24 and {line[2:12].rstrip() for line in legend[1:-1]} > labels - {"each"}
    assert [word in text for word in ("magenta", "external", "contact", "yellow")] == [
        motors > 1, external, external, truth
    ]  # fmt: skip


def test_of_several_joints_the_legend_is_that_of_their_table():
    views = {name: filled(truth=False) for name in ("elbow", "knee")}
    watcher, console = SimpleNamespace(views=views), Console(width=80, height=24)
    table, legend = (lines(_picture(watcher, console, "", 0.0, helping)) for helping in (False, True))
    assert "? legend" in table[-1] and "? back" in legend[-1]
    for column in re.findall(r"[a-z]+(?: seconds)?", table[0].replace("N·m/rad", "").replace("N·m", "")):
        assert column in ("joint", "rad") or any(line.startswith(column) for line in legend), column


def test_the_view_says_what_matters_at_80_by_24():
    text = "\n".join(lines(filled(truth=True)))
    for part in ("elbow", "running", "stiffness", "±", "N·m/rad", "truth", "rms error 0.20 %", "torque", "deflection",
                 "1000 Hz", "95", "missed 2", "1 operational", "2 stopped FAULT", "node 2 reports a fault",
                 "valid", "observable", "bus 38 %"):  # fmt: skip
        assert part in text, part
    assert sum(ord(c) > 0x2800 and ord(c) < 0x2900 for c in text) > 100  # the curves


@pytest.mark.parametrize(
    ("std_nm", "band"), [(0.0123, "± 0.024 N·m"), (None, ""), (-1.0, ""), (1e999, ""), ("x", "")]
)
def test_the_torque_has_the_interval_of_the_last_status(std_nm, band):
    view = filled()
    view.status = {**STATUS, "flexibility_torque_std_nm": std_nm}
    (row,) = (line for line in lines(view) if "torque" in line and "over time" not in line)
    assert band in row and ("±" in row) == bool(band)
    assert (f"{band}," if band else "N·m,") in view.line().partition("torque")[2]


def test_a_view_without_anything_yet_says_so():
    view = JointView("elbow")
    assert "waiting for the first estimate" in "\n".join(lines(view))
    assert view.line() == "elbow: no estimate yet"
    view.update(Estimate(1, 0, *[math.nan] * 3, (TransmissionEstimate(*[math.nan] * 4),)), 1.0)
    assert "no values yet" in "\n".join(lines(view)) and "nan" not in view.line()
    view = filled()
    assert view.line().endswith("node 2 reports a fault")  # where there are only plain lines, too
    view.status = {"state": "running"}  # no baseline: not a word of what is observable beside a green one
    text = "\n".join(lines(view, 120, 40))
    assert view.line().endswith("observable")  # and no comma after it, as in a replay
    assert "no baseline: drivelink fit" in text and "● observable" in text and "not observable" not in text


def test_a_finding_has_its_age_and_that_of_an_earlier_event_says_so():
    view, now_s = filled(), time.time()
    view.finding = {
        "state": "nothing",
        "sentence": "The model is sufficient.",
        "time": datetime.fromtimestamp(now_s - 725.0, UTC).isoformat(),
    }
    alarm = {"time": now_s - 724.0, "text": "elbow: model alarm: the residual is 3 times its baseline"}
    view.status = {"residual_alarm": {"active": True}, "events": [alarm]}
    assert "finding: 12 min ago: The model is sufficient." in view.line()
    assert any("finding    12 min ago: The model" in line for line in lines(view))
    alarm["time"] = now_s - 5.0
    assert "finding: 12 min ago, an earlier event: The model is sufficient." in view.line()
    assert snapshot(view, True, {})["finding"]["age"] == "12 min ago, an earlier event"
    view.finding["time"] = "soon"
    assert "finding: The model is sufficient." in view.line()


def test_the_view_shows_what_touches_the_link_where_that_is_known():
    view = filled()
    assert not any(line.startswith("│ external") for line in lines(view))
    for k in range(4000):
        view.update_external(ExternalMessage(k, k * 1_000_000, 3 if k > 3900 else 1, 0.5, 0.1), k * 1e-3)
    (row,) = (line for line in lines(view) if line.startswith("│ external"))
    assert "0.5" in row and "± 0.20 N·m" in row and "contact" in row
    assert ("contact", "yellow") in view.flags
    assert flags(Status.VALID | Status.TORQUE_VALID) == [("valid", "green"), ("not observable", "yellow")]
    assert flags(Status.TORQUE_VALID)[2:] == [("torque valid", "green")]
    assert flags(Status.STIFFNESS_VALID)[2:] == [("stiffness valid", "green")]
    assert flags(Status.OBSERVABLE | Status.STALE) == [("not valid", "red"), ("stale", "bold red")]
    assert "external 0.50 ± 0.20 N·m" in view.line() and "contact" in view.line()
    view.update_external(ExternalMessage(4000, 4_000_000_000, 0, math.nan, math.nan), 4.0)
    (row,) = (line for line in lines(view) if line.startswith("│ external"))
    assert "not valid" in row and "its filters are settling" in row
    assert "external not valid (its filters are settling)" in view.line()
    view.update(Estimate(4001, 0, *[math.nan] * 3, (TransmissionEstimate(*[math.nan] * 4),)), 4.001)
    view.status = {"not_valid": "the samples cannot be used"}
    assert "external not valid (as the estimate)" in view.line()
    assert snapshot(view, True, {})["external_not_valid"] == "the samples cannot be used"
    assert len(view.history.touches) <= 605  # thinned; the begin of a contact is kept


def test_the_page_gets_each_external_torque_once_and_a_gap_where_it_is_not_valid():
    view, since = filled(n=2000), {}

    def touched(k, status, torque=0.5, std=0.1):
        view.update(estimate(k), k * 1e-3)
        view.update_external(ExternalMessage(k, k * 1_000_000, status, torque, std), k * 1e-3)

    assert snapshot(view, True, since)["touches"] == [] and snapshot(view, True, {})["external"] is None
    kinds = {(2000, 2500): (0, math.nan, math.nan), (2500, 3000): (1, 0.5, 0.1), (3000, 4000): (3, 0.5, 0.1)}
    for span, kind in kinds.items():
        for k in range(*span):
            touched(k, *kind)
    displayed = snapshot(view, True, since)
    times = [touch[0] for touch in displayed["touches"]]
    assert len(times) > 90 and times == sorted(set(times)) and times[0] == 2.0
    for (begin, end), (status, *_) in kinds.items():
        expected = (0.5, 0.1, status == 3, True) if status else (None, None, False, False)
        assert {tuple(rest) for t, *rest in displayed["touches"] if begin <= 1e3 * t < end} == {expected}
    assert 3.0 in times  # the begin of a contact is not thinned out
    assert displayed["external"] == [3.999, 0.5, 0.1, True, True]
    assert ["contact", "yellow"] in displayed["estimate"]["flags"]
    assert json.dumps(displayed, allow_nan=False)
    assert snapshot(view, True, since)["touches"] == []  # they have been given
    for k in range(10):  # a daemon that starts anew
        touched(k, 1)
    again = snapshot(view, True, since)
    assert again["restart"] and [one[0] for one in again["touches"]] == [0.0]


def test_no_curve_over_time_goes_on_across_a_gap():
    view = filled(n=10)
    for k in (*range(10, 500, 10), *range(2500, 3000, 10)):  # two seconds of nothing
        view.update(estimate(k), k * 1e-3)
        view.update_external(ExternalMessage(k, k * 1_000_000, 1, 0.5, 0.1), k * 1e-3)
        view.history.add_sample(Sample(k, (0.1,) * 2, (0.2,) * 2, (0.3,) * 2), k * 1e-3)
        view.history.add_residual(0.5)
    sent = snapshot(view, True, {})
    assert json.dumps(sent, allow_nan=False)
    curves = [[(m[0], m[1]) for m in sent[name]] for name in ("moments", "touches", "residuals")]
    for curve in [*curves, [(time_s, torques[0]) for time_s, torques, *_ in sent["signals"]]]:
        assert [value for time_s, value in curve if 0.495 < time_s < 2.5] == [None]


def test_unobservable_estimates_leave_the_curve_as_it_is_and_a_daemon_that_starts_anew_clears_it():
    history = JointHistory()
    history.add(estimate(1, 1), 0.0)
    history.add(estimate(400, 1, status=int(Status.VALID)), 0.4)
    assert len(history.curves[0].points()) == len(history.doubtful[0].points()) == 1
    assert [math.isnan(m.torque_nm) for m in history.moments] == [False, True, False]  # a pause is a gap
    history.add(estimate(1), 0.2)
    assert [m.time_s for m in history.window()] == [0.2]


@pytest.mark.parametrize(
    ("value", "half", "text"),
    [
        (0.0, None, "0.000"), (123.456, None, "123.5"), (-0.0123456, None, "−0.0123"), (4.1e6, None, "4.100e6"),
        (-2e-5, None, "−2.000e−5"), (99999.4, None, "99999"), (math.nan, None, "–"),
        (5.1e-5, 0.027, "0.000 ± 0.027"), (0.0974198, 0.0064, "0.0974 ± 0.0064"), (-1e-9, 3e-9, "−1.0e−9 ± 3.0e−9"),
        (123456.0, 1234.0, "123500 ± 1200"), (9.96, 0.0996, "9.96 ± 0.10"), (150.0, math.nan, "150.0"),
        (math.nan, 1.0, "–"), (9.96e-5, 4.4e-5, "1.00e−4 ± 0.44e−4"), (-0.001, 0.5, "0.00 ± 0.50"),
        (-0.0, None, "0.000"),
    ],
)  # fmt: skip
def test_numbers_are_short_and_their_digits_follow_the_uncertainty(value, half, text):
    if half is None:
        assert number(value) == text
    else:
        assert with_interval(value, half, "N·m") == f"{text} N·m"


# Between processes


def printed(wanted, *arguments):
    """The first line that `drivelink monitor` prints of which this is true."""
    with zenohkit.process("monitor", "--every", "0.2", *arguments) as process:
        return next(filter(wanted, process.stdout))


def test_without_a_terminal_monitor_prints_plain_or_json_lines(daemon):
    line = printed(lambda line: "no estimate yet" not in line, "elbow", "--endpoint", daemon)
    assert "elbow: stiffness 700.0 ± 5.9 N·m/rad" in line and "\x1b" not in line
    complete = lambda line: '"live": true' in line and '"estimate"' in line and '"running"' in line  # noqa: E731
    displayed = json.loads(printed(complete, "--json", "--endpoint", daemon))
    assert displayed["joint"] == "elbow" and displayed["status"]["state"] == displayed["state"] == "running"
    assert displayed["estimate"]["stiffness"] == 700.0


def test_in_a_terminal_question_mark_shows_the_legend_and_q_quits(daemon):
    master, slave = pty.openpty()
    fcntl.ioctl(slave, termios.TIOCSWINSZ, struct.pack("HHHH", 24, 100, 0, 0))
    before = termios.tcgetattr(slave)
    command = [sys.executable, "-m", "drivelink", "monitor", "elbow", "--endpoint", daemon]
    environment = os.environ | {"TERM": "xterm"}

    def drained():
        """What the terminal has shown since the last call."""
        return os.read(master, 65536) if select.select([master], [], [], 0.01)[0] else b""

    with subprocess.Popen(command, stdin=slave, stdout=slave, stderr=slave, env=environment) as process:
        try:
            # The second ? brings a plot back to where the legend is.
            for text in ("N·m/rad", "half its 95 % interval", "torque over time, N·m"):
                shown = bytearray()
                zenohkit.until(lambda: shown.extend(drained()) or text.encode() in shown)  # noqa: B023
                os.write(master, b"q" if text.startswith("torque") else b"?")
            zenohkit.until(lambda: drained() is not None and process.poll() is not None)
            assert process.returncode == 0
            assert termios.tcgetattr(slave) == before  # the terminal shows what is typed again
        finally:
            process.kill()
    os.close(slave)
    os.close(master)


def test_a_joint_that_nobody_serves_is_not_live_and_the_nearest_is_named(daemon, capsys, monkeypatch):
    monkeypatch.setattr("drivelink.monitor.watcher.PATIENCE_S", 0.3)
    assert (
        cli.main(["monitor", "elbwo", "--endpoint", daemon, "--every", "0.2", "--seconds", "1", "--json"])
        == 6
    )
    displayed = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert displayed["joint"] == "elbwo" and not displayed["live"] and "estimate" not in displayed
    assert displayed["state"] == 'no daemon of "elbwo"; did you mean "elbow"?'


def test_plain_lines_repeat_nothing_and_end_where_nobody_serves_the_joint(daemon, capsys, monkeypatch):
    monkeypatch.setattr("drivelink.cli.monitor._ABSENT_S", 0.5)
    assert cli.main(["monitor", "elbwo", "--endpoint", daemon, "--every", "0.1"]) == 6
    said = capsys.readouterr()
    lines = [line.split(" ", 1)[1] for line in said.out.splitlines()]
    assert len(lines) == len(set(lines)) <= 2 and lines[0] == "elbwo: no estimate yet"
    assert said.err.startswith("drivelink monitor: no ") and said.err.count("\n") == 1


def test_a_daemon_that_is_silent_or_gone_leaves_no_green_and_no_live_numbers():
    view = filled()
    view.silent_s = 3.0
    assert not view.live and "no estimates, last estimate 3 s ago" in "\n".join(lines(view))
    view.gone, view.silent_s = True, 12.0
    text = "\n".join(lines(view))
    assert "daemon gone, last estimate 12 s ago" in text
    assert "operational" not in text and "● valid" not in text
    displayed = snapshot(view, False, {})
    assert not displayed["live"] and displayed["estimate"]["flags"] == [[view.state, "bold red"]]
    assert "daemon gone" in view.line() and "observable" not in view.line()


def test_what_is_not_valid_is_marked_in_every_curve():
    view, statuses = JointView("elbow"), [3] * 10 + [0] * 5 + [3] * 10
    for k, status in enumerate(statuses):
        view.history.add(estimate(k, 1, status=status), 0.05 * k)
    moments = snapshot(view, True, {})["moments"]
    assert [moment[4] for moment in moments] == [status == 3 for status in statuses]
    assert not any(moment[1] is None for moment in moments)


def test_one_wild_value_does_not_flatten_an_axis():
    low, high = usual_range([math.sin(0.1 * k) for k in range(500)] + [1e6, math.nan, -1e9])
    assert -3.0 < low < -0.9 and 0.9 < high < 3.0
    curve = GrowingCurve()
    for place in [*(1e-3 * k for k in range(200)), 1e6, *(1e-3 * k for k in range(200))]:
        curve.add(place, 100.0, 1.0)
    assert len(curve.points()) > 40  # the wild place has not made the others coarse
    assert usual_range([]) == pytest.approx((math.nan, math.nan), nan_ok=True)


def test_what_is_not_valid_is_inside_a_plot_and_leaves_room_to_what_is():
    sure = [0.0, 1.0, 2.0]
    assert shared_range(sure, [-1.0, 4.0] * 9) == (-1.0, 4.0)
    assert shared_range(sure, [1.0, 1e9] * 9) == pytest.approx((0.0, 8.0))
    assert shared_range(sure, [1e9])[1] == pytest.approx(2.67, abs=0.01)  # a moment of it
    assert shared_range([], [1.0, 3.0]) == (1.0, 3.0) and shared_range(sure, [math.nan]) == (0.0, 2.0)
    assert shared_range([700.0, 700.0], [650.0] * 2) == (650.0, 700.0)  # beside a steady value, too


ALARM = STATUS | {
    "transmissions": [{}],
    "residual_alarm": {"active": True, "residual_nm": [0.09, 0.01], "floor_nm": [0.03, 0.02], "ratio": 3.0,
                       "location": "transmission"},
}  # fmt: skip
IMPROVED = {"provenance": {"diagnosis": {"error_before_relative": 0.081, "error_after_relative": 0.012}}}


def test_the_residual_is_a_gauge_against_its_baseline_before_and_after():
    shown = shape(ALARM, IMPROVED)
    assert [(b.name, round(b.ratio, 6)) for b in shown.balances] == [("motor", 3.0), ("link", 0.5)]
    text = "\n".join(line.plain for line in status_lines(ALARM, 130, IMPROVED))
    assert "motor ██████████ 3.0" in text and "link ██▌░░░░░░░ 0.50" in text  # half a bar is the baseline
    assert "effects: 8.1 → 1.2 %" in text
    view = filled()
    view.status, view.model = ALARM, IMPROVED
    assert view.history.residuals[-1][1] == pytest.approx(3.0)
    displayed = snapshot(view, True, {})
    assert displayed["status"]["balances"][0][3] == pytest.approx(3.0) and displayed["residuals"]
    assert "residual 3.0" in view.line() and "8.1 % before its effects, 1.2 % after" in view.line()


def test_every_view_says_what_to_do_on_a_model_alarm():
    view = filled()
    view.status = ALARM
    assert "do not control on it; drivelink diagnose says why" in "\n".join(lines(view, 80))
    for text in (view.line(), "\n".join(lines(view, 240)), snapshot(view, True, {})["status"]["advice"]):
        assert "likely at the transmission" in text and "drivelink diagnose" in text
    view.status = STATUS
    assert "diagnose" not in view.line() and not snapshot(view, True, {})["status"]["alarm"]


def test_several_joints_are_one_line_each_and_no_column_is_cut_off():
    far, gone, wild = filled(), filled(1), {"stiffness_nm_rad": -1.23456e7, "stiffness_std_nm_rad": 9.87e6}
    gone.gone = True
    for k in range(10):
        far.update(estimate(9000 + k)._replace(**wild, flexibility_torque_nm=-1e-5), 100.0 + k)
    for width in (60, 80, 100, 120, 160):
        shown = lines(joints_table({"elbow": filled(), "wrist": gone, "far": far}, width), width)
        assert len(shown) == 4 and "daemon gone" in "".join(shown)
        assert all(len(line) <= width and "…" not in line for line in shown), shown


def test_without_a_bus_no_node_is_operational_and_what_several_nodes_lack_is_said_once():
    view = filled()
    view.status = view.status | {
        "state": "bus lost",
        "conditions": [f"node {k}: frames are missing" for k in (1, 2)],
    }
    text = "\n".join(lines(view, 120, 40))
    assert "1 not heard" in text and "operational" not in text
    assert "nodes 1, 2: frames are missing" in text


def test_why_no_estimate_was_valid_is_not_said_of_one_that_is():
    view = filled()
    view.status = view.status | {"not_valid": "filters are settling"}  # a few times a second
    assert "settling" not in view.line() and "settling" not in "\n".join(lines(view, 120, 40))
    view.update(estimate(6000, status=0), 6.0)
    assert "settling" in view.line()


def test_an_error_of_the_valid_cycles_does_not_stand_beside_an_estimate_that_is_not():
    view = filled(truth=True)
    last = estimate(5000, status=0)
    view.update(last, 5.0, Truth(last[2], last[3]))
    assert "truth" in "\n".join(lines(view)) and " error " not in "\n".join(lines(view)) + view.line()


@pytest.mark.parametrize(
    ("watching", "why"), [(True, "its filters are settling"), (False, "no baseline: drivelink fit")]
)
def test_a_residual_without_gauge_is_not_always_one_without_baseline(watching, why):
    view = filled()
    view.status = {"residual_nm": 0.0, "residual_alarm": {"active": watching, "watching": watching}}
    assert "0.00 N·m" not in f"{view.line()}{lines(view)}"  # there is none
    assert snapshot(view, True, {})["status"]["no_gauge"].startswith(why)
    assert why in "\n".join(lines(view, 120, 40))
