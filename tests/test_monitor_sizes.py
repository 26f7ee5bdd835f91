"""Live views in a terminal that is small, or has more to show than lines."""

import io
import math
import signal
from types import SimpleNamespace

import pytest
import zenohkit
from rich.console import Console
from test_monitor import STATUS, filled, lines

from drivelink.cli.monitor import _picture
from drivelink.monitor.statuslines import shape, status_lines
from drivelink.monitor.terminal import can_draw, joints_table
from drivelink.monitor.view import JointView
from drivelink.monitor.web import snapshot
from estimator.sample import Estimate, TransmissionEstimate


def test_a_small_view_has_its_names_whole_and_says_whether_it_is_valid():
    for width, height in ((60, 16), (60, 10), (44, 9)):
        shown = "\n".join(lines(filled(), width, height))
        assert "deflection" in shown and "N·m/rad" in shown and "● valid" in shown, (width, height, shown)


def test_what_to_look_at_is_not_cut_at_the_first_line():
    said = "drivelink-vsa-ii: the bus is lost: Failed to receive: [Errno 104] Connection reset by peer"
    shown = [line.plain for line in status_lines(STATUS | {"conditions": [said]}, 76)]
    assert shown[-2].startswith("look here  drivelink-vsa-ii") and "Errno" in shown[-2]
    assert shown[-1].endswith("  Connection reset by peer")
    assert all(len(line) <= 76 for line in shown)


def test_where_lines_are_left_out_the_last_one_says_so():
    document = STATUS | {"conditions": ["drivelink-vsa-ii: the bus is lost: " + "and so on " * 9]}
    whole, cut = (status_lines(document, 76, most=most) for most in (None, 3))
    assert len(cut) == 3 < len(whole) and not whole[2].plain.endswith("…")
    assert cut[-1].plain.endswith(" …") and all(len(line.plain) <= 76 for line in cut)
    assert not status_lines(document, 76, most=0)


def test_the_load_of_a_lost_bus_is_not_shown():
    assert shape(STATUS).load == "38 %" and shape(STATUS | {"state": "bus lost"}).load == ""


def test_every_gauge_of_a_pair_and_its_link_is_seen_at_80_columns():
    alarm = {"active": False, "residual_nm": [0.03, 0.02, 0.01], "floor_nm": [0.02, 0.02, 0.02]}
    residual = status_lines(STATUS | {"transmissions": [{}, {}], "residual_alarm": alarm}, 76)[2].plain
    assert "motor 1" in residual and "motor 2" in residual and residual.rstrip().endswith("0.50 ×"), residual


def test_a_long_name_leaves_room_for_the_state():
    views = {"elbow": filled(1), "wrist-with-a-very-long-name-" * 3: filled(2)}
    for width in (60, 80, 100, 120, 160):
        shown = lines(joints_table(views, width), width)
        assert sum(line.rstrip().endswith("running") for line in shown) == 2, shown
        assert "".join(line.split(" ")[0] for line in shown[2:]) in views, shown


def test_more_joints_than_lines_are_counted_and_what_needs_a_look_comes_first():
    views = {f"joint-{k}": filled(1, n=50) for k in range(30)}
    views["joint-25"].gone = True
    console = Console(width=100, height=24, record=True, file=io.StringIO())
    watcher = SimpleNamespace(views=views)
    console.print(_picture(watcher, console, "", 0.0))
    shown = console.export_text().rstrip("\n").split("\n")
    assert len(shown) <= 24 and "joint-25" in shown[1] and "and 19 more" in "".join(shown)
    assert sum(line.startswith("joint-") and line.endswith("node 2 reports a fault") for line in shown) == 8


def test_a_rigid_joint_is_not_said_to_have_no_stiffness_yet():
    view = JointView("axis")
    view.update(Estimate(1, 1, 0.5, math.nan, math.nan, (TransmissionEstimate(0.5, *[math.nan] * 3),)), 1.0)
    view.model = {"motors": [{"transmission": {"model": "none"}}]}
    assert "a rigid joint has none" in "\n".join(lines(view)) and snapshot(view, True, {})["status"]["rigid"]
    view.model = {"motors": [{"transmission": {"model": "linear"}}]}
    assert "no values yet" in "\n".join(lines(view)) and not snapshot(view, True, {})["status"]["rigid"]


def test_a_live_view_needs_a_terminal_with_its_characters():
    for encoding, able in (("utf-8", True), ("ascii", False), ("latin-1", False)):
        file = io.TextIOWrapper(io.BytesIO(), encoding=encoding)
        assert can_draw(Console(file=file, force_terminal=True)) is able
        assert not can_draw(Console(file=file, force_terminal=False))
        assert not can_draw(Console(file=file, force_terminal=True, _environ={"TERM": "dumb"}))


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_view_is_stopped_by_a_signal_and_that_is_no_failure(number):
    endpoint = zenohkit.free_endpoint()
    with zenohkit.process("monitor", "--web", "--port", "0", "--endpoint", endpoint) as view:
        assert "live view: http://127.0.0.1:" in view.stdout.readline()
        view.send_signal(number)
        assert view.wait(60.0) == 0 and view.stderr.read() == ""
