"""Percentiles are those of the durations; an event is said once, however often it happens."""

import logging
from types import SimpleNamespace

import pytest

from drivelink.daemon.jointwatch import JointWatch, WatchedNode
from drivelink.daemon.status import EventLog
from drivelink.daemon.supervision import Supervisor
from drivelink.plaintext import PlainFormatter
from estimator.sample import Status


@pytest.fixture
def clock():
    return [0.0]


@pytest.fixture
def events(clock, caplog):
    caplog.set_level(logging.INFO)
    return EventLog(logging.getLogger("drivelink.test"), clock=lambda: clock[0])


@pytest.fixture
def supervisor(events):
    made = Supervisor.__new__(Supervisor)
    made._events, made._joint_events = events, {"elbow": events.of("elbow")}
    made._nodes = dict.fromkeys((1, 2), SimpleNamespace(loop_joint=SimpleNamespace(name="elbow")))
    return made


def test_a_condition_is_said_when_it_begins_and_when_it_ends(events, caplog):
    for _ in range(1000):
        events.begin("hot", "it is hot")
    assert events.active == {"hot": "it is hot"}
    for _ in range(1000):
        events.end("hot", "it is cool again")
    assert events.active == {}
    assert caplog.messages == ["it is hot", "it is cool again"]


def test_a_condition_that_holds_has_its_present_figures_and_is_said_once(events, caplog):
    events.begin("slow", "cycles left out so far: 1")
    events.begin("slow", "cycles left out so far: 206")
    assert events.active == {"slow": "cycles left out so far: 206"}
    assert caplog.messages == ["cycles left out so far: 1"]


def test_what_comes_and_goes_is_counted_not_repeated(events, clock, caplog):
    for _ in range(500):
        events.begin("flaky", "the cable is loose")
        events.end("flaky")
    (event,) = events.recent()
    assert (len(caplog.records), event["text"], event["count"]) == (1, "the cable is loose", 500)
    clock[0] = 60.0
    events.begin("flaky", "the cable is loose")
    assert caplog.messages[-1] == "the cable is loose (logged once for 500 occurrences)"


def test_what_comes_and_goes_for_an_hour_is_a_line_now_and_then_and_after_a_rest_news_again(
    events, clock, caplog
):
    for k in range(3600):
        clock[0] = float(k)
        events.begin("flaky", "the cable is loose")
        events.end("flaky")
    assert len(caplog.records) < 15
    for rest in (1300.0, 11.0, 11.0):
        clock[0] += rest
        lines = len(caplog.records)
        events.begin("flaky", "the cable is loose")
        events.end("flaky")
        assert len(caplog.records) == lines + 1


def test_the_same_with_other_figures_is_the_same(events, clock, caplog):
    for k in range(500):
        clock[0] = 0.1 * k
        events.begin("slow", f"{k} cycles left out so far")
        events.end("slow", f"it keeps up again; {k} were left out")
        events.report(f"the counter jumped, {k} times so far", key="jumped")
    assert len(caplog.records) == 3 * 3 and len(events.recent()) == 9  # at 0, 10 and 30 s
    assert events.recent()[-1]["text"] == "the counter jumped, 499 times so far"
    assert sum(event["count"] for event in events.recent()) == 1500


def test_the_log_ends_what_it_has_begin_and_nothing_else(events, clock, caplog):
    for second in range(3600):
        clock[0] = float(second)
        events.begin("slow", "it does not keep up")
        # After a longer time, too, in which an end alone would be news.
        clock[0] += 0.1 if second % 7 else 9.0
        events.end("slow", "it keeps up again")
    said = [message.partition(" (")[0] for message in caplog.messages]
    assert 4 < len(said) < 30 and said == ["it does not keep up", "it keeps up again"] * (len(said) // 2)


def test_emergencies_with_ever_other_codes_have_a_rate(supervisor, clock, caplog):
    for k in range(4000):
        clock[0] = k * 5e-4
        supervisor._emergency(0x081, (0x1000 + k).to_bytes(2, "little") + bytes(6))
    assert len(caplog.records) == EventLog._KINDS + 1
    assert sum(event["count"] for event in supervisor._events.recent()) == 4000
    supervisor._emergency(0x082, bytes.fromhex("1023000000000000"))
    assert "node 2: EMCY 0x2310" in caplog.messages[-1]  # another node is still heard


def test_every_message_has_a_rate_and_the_last_events_are_kept(events, clock, caplog):
    for k in range(5000):
        clock[0] = k * 1e-3
        events.report(f"event {k}", logging.WARNING)
    assert len(caplog.records) == EventLog._LINES
    assert [event["text"] for event in events.recent()] == [f"event {k}" for k in range(4984, 5000)]
    clock[0] = 20.0
    events.report("later", logging.WARNING)
    lost = f"{5000 - EventLog._LINES} messages were not logged: too many at a time"
    assert caplog.messages[-2:] == [lost, "later"]


def test_words_of_a_drive_are_plain_text(events, caplog):
    events.report("node 1: \x1b]0;owned\x07\x9b31m\u202ename\nnext", logging.WARNING)
    assert caplog.messages == [events.recent()[0]["text"]] == ["node 1: ]0;owned31mname next"]
    record = logging.LogRecord("x", logging.WARNING, "", 0, "a \x1b[2J\x9bb", (), None)
    assert PlainFormatter("%(message)s").format(record) == "a [2Jb"


def alarmed(watch, events, status, residual_nm, location="", floor_nm=(0.03,)):
    described = {"residual_nm": residual_nm, "floor_nm": list(floor_nm), "location": location}
    monitor = SimpleNamespace(describe=lambda: described)
    pipeline = SimpleNamespace(status=int(status), model_monitor=monitor)
    watch._check_model(SimpleNamespace(name="elbow", pipeline=pipeline), events)


def test_a_model_alarm_that_flickers_is_counted_whatever_its_residual(events, caplog):
    watch = JointWatch(lambda _joint: None)
    for k in range(1000):
        alarmed(watch, events, Status.VALID if k % 2 else Status.MODEL_ALARM, [1e-4 * k])
    assert len(caplog.records) == 2
    assert [event["count"] for event in events.recent()] == [500, 500]
    assert "3.3 times its baseline" in events.recent()[0]["text"]
    alarmed(watch, events, Status.MODEL_ALARM, [14.4])
    assert "is 480 times its baseline" in events.recent()[0]["text"]


def test_emergencies_with_other_bytes_of_the_maker_and_faults_of_one_kind_in_one_place_are_counted(
    supervisor, caplog
):
    for k in range(1000):
        supervisor._emergency(0x081, b"\x10\x23\x02" + k.to_bytes(5, "little"))
        supervisor._emergency(0x082, b"\x10\x23\x02" + k.to_bytes(5, "little"))
        supervisor._report_fault("elbow", IndexError(f"index {k} is out of range"))
    assert len(caplog.records) == 3
    assert [event["count"] for event in supervisor._events.recent()] == [1000] * 3


def test_the_log_says_when_the_model_alarm_comes_and_goes_and_what_to_do(events, caplog):
    watch = JointWatch(lambda _joint: None)
    for status in (Status.VALID, Status.VALID | Status.MODEL_ALARM, Status.MODEL_ALARM):
        alarmed(watch, events, status, [0.09, 0.01], "transmission", (0.03, 0.02))
    for _ in range(2):
        alarmed(watch, events, Status.VALID, [0.02, 0.01], "", (0.03, 0.02))
    begun, over = caplog.messages
    said = "elbow: model alarm: the residual is 3.0 times its baseline, likely at the transmission"
    assert begun.startswith(said) and "drivelink diagnose" in begun
    assert over == "elbow: the model alarm is over"


def test_a_second_device_is_reported_whenever_it_begins_where_no_frame_is_missing():
    """The end of a second without missing frames is no missing frame."""
    zero = {"received": 0, "missing": 0, "wrong_length": 0, "conflicting": 0, "ignored": 0}
    for begins in range(0, 20):  # tenths of a second
        counters = SimpleNamespace(**zero)
        assembler = SimpleNamespace(counters={2: counters})
        joint = SimpleNamespace(pipeline=SimpleNamespace(assembler=assembler))
        node, events = WatchedNode(SimpleNamespace(node_id=2), joint, 0), EventLog(logging.getLogger("t"))
        node.begin(SimpleNamespace(**zero), 0)
        for tenth in range(40):
            counters.conflicting += 10 * (begins <= tenth < begins + 2)
            node.check_counters(events, tenth * 100_000_000)
        assert any("different frames" in event["text"] for event in events.recent()), begins
