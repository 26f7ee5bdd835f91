"""The script of the live view's page, run by node on what the server sends: reading values, pause, axes, the end."""

import json
import math
import re
import shutil
import subprocess
from pathlib import Path

import pytest

from drivelink.monitor.view import JointView
from drivelink.monitor.web import snapshot
from drivelink.pubsub.wire import ExternalMessage
from estimator.sample import Estimate, Status, TransmissionEstimate

NODE = shutil.which("node")
pytestmark = pytest.mark.skipif(NODE is None, reason="needs node")
HERE = Path(__file__).parent
PAGE = HERE.parent / "drivelink" / "monitor" / "page.html"
STATUS = {
    "state": "running", "rate_hz": 1000.0, "nodes": {"1": {"state": "operational", "fault": False}},
    "residual_alarm": {"active": False, "residual_nm": [0.01], "floor_nm": [0.02]}, "transmissions": [{}],
    "events": [{"time": 1.7e9, "text": "node 2 reports a fault", "count": 1}],
}  # fmt: skip
SPAN = """
    take(sent[0]);
    const { X, Y, T, B } = $("torqueplot").shown;
"""


def fed(seconds=4.0, wild=None, document=STATUS):
    """A joint whose torque is a sine of 2 N·m; one torque of it may be wild."""
    view = JointView("elbow")
    for k in range(int(1000 * seconds)):
        phi = 0.02 * math.sin(2.0e-3 * k)
        torque = wild if wild is not None and k == 2000 else 100.0 * phi
        one = TransmissionEstimate(torque, 100.0, 1.0, phi)
        status = int(Status.VALID | Status.OBSERVABLE)
        view.update(Estimate(k, status, torque, 100.0, 1.0, (one,)), 1e-3 * k)
    view.status = document
    return view


def page(scenario, *views):
    """What a scenario returns; `sent[i]` is what the server sends of each view."""
    script = re.search(r"<script>(.*)</script>", PAGE.read_text(encoding="utf-8"), re.DOTALL)[1]
    sent = json.dumps([{"joints": {view.name: snapshot(view, True, {})}} for view in views])
    program = (HERE / "page.js").read_text(encoding="utf-8") + script
    program += f"const sent = {sent};\nconsole.log(JSON.stringify((() => {{ {scenario} }})()));\n"
    done = subprocess.run([NODE, "-"], input=program, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def test_the_page_shows_numbers_flags_gauge_and_nodes_and_that_the_monitor_has_ended():
    texts, ended, band = page(
        """
        const look = names => names.map(shown);
        take(sent[0]);
        const texts = look(['stiffness', 'band', 'state', 'flags', 'gauges', 'nodes']);
        events.onerror();
        return [texts, look(['state', 'flags', 'link']), [measured(2.2e-4, 2.2e-4), measured(0.1000015, 8.06e-6)]];
        """,
        fed(),
    )
    assert band == ["0.00022", "0.1000015"]  # the digits that the interval leaves
    assert texts[:4] == ["100.0", "± 2.0", "running · rate 1000 Hz", "valid observable"]
    assert "0.50 × baseline" in texts[4] and "node 1 operational" in texts[5]
    state, flags, link = ended
    assert state == "no connection: these are the last numbers"
    assert flags == "no connection" and link.startswith("drivelink monitor has ended")


@pytest.mark.parametrize(
    ("alarm", "ratio", "style"), [(True, 2.0, "over"), (False, 2.0, "above"), (False, 1.0, "bar")]
)
def test_a_residual_above_its_baseline_is_not_green(alarm, ratio, style):
    one = json.dumps({"balances": [["motor", 0.1, 0.05, ratio]], "alarm": alarm})
    bars = page(f"gauges({one}); return $('gauges').children.map(row => row.children[1].className);")
    assert bars[0].split()[-1] == style


def test_an_error_that_does_not_fall_has_no_two_bars_of_one_length():
    assert page(
        """
        showFinding({ finding: { state: "nothing", sentence: "", cause: "asked", since: null, recording: "", error: [0.1, 0.1], details: [] } });
        return $("fall").hidden;
        """
    )


def test_the_pointer_reads_the_curve_at_its_place():
    text, moment, hidden, left = page(
        SPAN
        + """
        const m = joints.elbow.moments.at(-50), now = joints.elbow.moments.at(-1)[0];
        hover("torqueplot", X(m[0] - now), Y(m[1]));
        const text = $("tip").textContent;
        $("tip").offsetWidth = 300; innerWidth = 390;  // a phone, and the end of a curve
        hover("torqueplot", X(m[0] - now), Y(m[1]));
        $("torqueplot").onmouseleave();
        return [text, [number(m[0] - now, 3), number(m[1])], $("tip").hidden, parseFloat($("tip").style.left)];
        """,
        fed(),
    )
    assert 4.0 <= left <= 390 - 300 - 4  # the tooltip stays inside the window
    assert text == f"time {moment[0]} s\n{moment[1]} N·m" and hidden is True


@pytest.mark.parametrize("how", ["press(' ');", "$('pause').onclick();"])
def test_a_pause_holds_numbers_and_curves_and_what_came_is_there_afterwards(how):
    before, held, after = page(
        f"""
        const look = () => [shown("torque"), $("torqueplot").shown.series[0].length, shown("link"), shown("pause")];
        take(sent[0]);
        const before = look();
        {how}
        take(sent[1]);
        hover("torqueplot", 300, 100);
        const held = look();
        {how}
        return [before, held, look()];
        """,
        fed(4.0),
        fed(5.5),
    )
    assert held[:2] == before[:2] and held[2:] == ["paused", "go on"]
    assert after[0] != before[0] and after[1] > before[1] and after[2:] == ["connected", "pause"]


@pytest.mark.parametrize("wild", [1e6, -1e6])
def test_one_wild_value_does_not_flatten_an_axis(wild):
    low, high, height = page(SPAN + "return [Y(-2), Y(2), B - T];", fed(4.0, wild))
    assert low - high > 0.5 * height  # the sine fills more than half of the plot


def test_what_is_not_valid_is_shown_grey_with_the_reason_and_leaves_the_scale_to_what_is():
    view, one = fed(), (TransmissionEstimate(500.0, 900.0, 1.0, 0.01),)
    for k in range(4000, 6000):
        view.update(Estimate(k, int(Status.OBSERVABLE), 500.0, 900.0, 1.0, one), 1e-3 * k)
    low, high, height, tip, title, style, key = page(
        SPAN
        + """
        hover("torqueplot", X(-1), Y(500));
        return [Y(-2), Y(2), B - T, $("tip").textContent, document.title, $("stiffness").className,
                written.includes("not valid")];
        """,
        view,
    )
    assert key and not page("take(sent[0]); return written.includes('not valid');", fed())  # what grey means
    assert low - high > 0.2 * height and tip.endswith("500.0 N·m\nnot valid")
    assert (title, style) == ("not valid · elbow · drivelink", "past")


def test_a_daemon_that_is_gone_leaves_no_green_and_no_live_numbers():
    gone = fed()
    gone.gone, gone.silent_s = True, 12.0
    state, style, flags, number_style, gauges, hidden, rows, events = page(
        """
        take(sent[0]);
        take(sent[1]);
        const styles = $("flags").children.map(flag => flag.className);
        return [shown("state"), $("state").className, styles, $("stiffness").className, $("gauges").hidden,
                $("cyclesection").hidden, $("cycle").children.length, shown("nodes")];
        """,
        fed(),
        gone,
    )
    assert state == "daemon gone, last estimate 12 s ago" and style == "red"
    assert flags == ["flag red"] and number_style == "past"
    assert gauges and hidden and rows == 0
    assert "operational" not in events and "node 2 reports a fault" in events  # what led to it stays


def test_undo_stays_on_the_page_when_a_newer_finding_has_come():
    assert page(
        """
        const hidden = (state, undoable) => {
          showFinding({ finding: { state, sentence: "", cause: "", since: null, recording: "", error: [], details: [] },
                        acceptable: true, undoable });
          return document.getElementById("undo").hidden;
        };
        return [hidden("proposed", false), hidden("accepted", true), hidden("diagnosing", true)];
        """
    ) == [True, False, False]


def test_a_finding_that_proposes_nothing_says_so_in_words():
    about = page(
        """
        showFinding({ finding: { state: "nothing", sentence: "", cause: "asked", since: null, recording: "", error: [], details: [] } });
        return shown("about");
        """
    )
    assert about == "nothing to accept · asked"


def test_the_axis_of_the_external_torque_fits_its_band():
    view = fed()
    for k in range(4000):
        torque_nm = 1e-3 * math.sin(2e-3 * k)
        view.update_external(ExternalMessage(k, k * 1_000_000, 1, torque_nm, 0.01), 1e-3 * k)
    span = SPAN.replace("torqueplot", "externalplot")
    low, high, height = page(span + "return [Y(-0.0196), Y(0.0196), B - T];", view)
    assert 0.7 * height < low - high < height


def test_an_external_torque_that_is_not_valid_has_no_unit():
    view = fed()
    view.update_external(ExternalMessage(4000, 4_000_000_000, 0, math.nan, math.nan), 4.0)
    assert page("take(sent[0]); return [shown('external'), $('externalunit').hidden];", view) == [
        "not valid",
        True,
    ]
