"""Percentiles are those of the durations; an event is said once, however often it happens."""

import logging
import random
from types import SimpleNamespace

import numpy as np
import pytest

from drivelink._core import LatencyHistogram
from drivelink.daemon.jointwatch import JointWatch
from drivelink.daemon.status import EventLog
from drivelink.daemon.supervision import Supervisor
from drivelink.plaintext import PlainFormatter
from estimator.sample import Status


def test_percentiles_are_those_of_the_durations() -> None:
    rng = random.Random(1)
    durations_us = [rng.lognormvariate(4.0, 0.6) for _ in range(20_000)]
    meter = LatencyHistogram()
    for us in durations_us:
        meter.add(int(us * 1000))
    for name, q in (("p50_us", 50), ("p90_us", 90), ("p99_us", 99), ("p999_us", 99.9)):
        assert meter.total()[name] == pytest.approx(np.percentile(durations_us, q), abs=2.0)  # bins of 1 us
    assert meter.total()["max_us"] == pytest.approx(max(durations_us), abs=1.0)
    assert meter.count == len(durations_us)


def test_recent_is_since_the_last_look() -> None:
    meter = LatencyHistogram()
    for _ in range(100):
        meter.add(10_000)
    assert meter.recent()["p50_us"] == 11.0
    for _ in range(100):
        meter.add(500_000)
    assert meter.recent()["p50_us"] == 501.0
    assert meter.recent() == {}
    assert meter.total()["max_us"] == 500.0


def test_durations_beyond_the_range_and_below_zero_are_counted() -> None:
    meter = LatencyHistogram()
    meter.add(-5)
    meter.add(10**12)
    assert meter.count == 2
    assert meter.total()["max_us"] == 10**9


def log(clock: list[float]) -> EventLog:
    return EventLog(logging.getLogger("drivelink.test"), clock=lambda: clock[0])


def test_a_condition_is_said_when_it_begins_and_when_it_ends(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)
    events = log([0.0])
    for _ in range(1000):
        events.begin("hot", "it is hot")
    assert events.active == {"hot": "it is hot"}
    for _ in range(1000):
        events.end("hot", "it is cool again")
    assert events.active == {}
    assert [record.getMessage() for record in caplog.records] == ["it is hot", "it is cool again"]


def test_what_comes_and_goes_is_counted_not_repeated(caplog: pytest.LogCaptureFixture) -> None:
    clock = [0.0]
    events = log(clock)
    for _ in range(500):
        events.begin("flaky", "the cable is loose")
        events.end("flaky")
    assert len(caplog.records) == 1
    (event,) = events.recent()
    assert (event["text"], event["count"]) == ("the cable is loose", 500)
    clock[0] = 60.0
    events.begin("flaky", "the cable is loose")
    assert caplog.records[-1].getMessage() == "the cable is loose (logged once for 500 occurrences)"


def test_the_same_with_other_figures_is_the_same(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)
    clock = [0.0]
    events = log(clock)
    for k in range(500):
        clock[0] = 0.1 * k
        events.begin("slow", f"{k} cycles left out so far")
        events.end("slow", f"it keeps up again; {k} were left out")
        events.report(f"the counter jumped, {k} times so far", key="jumped")
    assert len(caplog.records) == 3 * 5 and len(events.recent()) == 15
    assert events.recent()[-1]["text"] == "the counter jumped, 499 times so far"
    assert sum(event["count"] for event in events.recent()) == 1500


def test_the_last_events_are_kept_and_no_more() -> None:
    events = log([0.0])
    for k in range(1000):
        events.report(f"event {k}")
    assert [event["text"] for event in events.recent()] == [f"event {k}" for k in range(984, 1000)]


def test_emergencies_with_ever_other_codes_have_a_rate(caplog: pytest.LogCaptureFixture) -> None:
    clock = [0.0]
    one = supervisor(clock)
    for k in range(4000):
        clock[0] = k * 5e-4
        one._emergency(0x081, (0x1000 + k).to_bytes(2, "little") + bytes(6))
    assert len(caplog.records) == EventLog._KINDS + 1
    assert sum(event["count"] for event in one._events.recent()) == 4000
    one._emergency(0x082, bytes.fromhex("1023000000000000"))
    assert "node 2: EMCY 0x2310" in caplog.records[-1].getMessage()  # another node is still heard


def test_every_message_has_a_rate(caplog: pytest.LogCaptureFixture) -> None:
    clock = [0.0]
    events = log(clock)
    for k in range(5000):
        clock[0] = k * 1e-3
        events.report(f"event {k}", logging.WARNING)
    assert len(caplog.records) == EventLog._LINES
    clock[0] = 20.0
    events.report("later", logging.WARNING)
    assert [r.getMessage() for r in caplog.records[-2:]] == [
        f"{5000 - EventLog._LINES} messages were not logged: too many at a time",
        "later",
    ]


def test_words_of_a_drive_are_plain_text(caplog: pytest.LogCaptureFixture) -> None:
    events = log([0.0])
    events.report("node 1: \x1b]0;owned\x07\x9b31m\u202ename\nnext", logging.WARNING)
    assert caplog.records[0].getMessage() == "node 1: ]0;owned31mname next"
    assert events.recent()[0]["text"] == "node 1: ]0;owned31mname next"
    record = logging.LogRecord("x", logging.WARNING, "", 0, "a \x1b[2J\x9bb", (), None)
    assert PlainFormatter("%(message)s").format(record) == "a [2Jb"


def supervisor(clock: list[float]) -> Supervisor:
    made = Supervisor.__new__(Supervisor)
    made._events = log(clock)
    return made


def test_a_model_alarm_that_flickers_is_counted_whatever_its_residual(
    caplog: pytest.LogCaptureFixture,
) -> None:
    caplog.set_level(logging.INFO)
    events = log([0.0])
    watch = JointWatch(events, lambda _joint: None)
    for k in range(1000):
        described = {"residual_nm": [1e-4 * k], "floor_nm": [0.03], "location": ""}
        monitor = SimpleNamespace(describe=lambda d=described: d)
        status = int(Status.VALID if k % 2 else Status.MODEL_ALARM)
        pipeline = SimpleNamespace(status=status, model_monitor=monitor)
        watch._check_model(SimpleNamespace(name="elbow", pipeline=pipeline))  # type: ignore[arg-type]
    assert len(caplog.records) == 2
    assert [event["count"] for event in events.recent()] == [500, 500]
    assert "3.3 times its baseline" in events.recent()[1]["text"]


def test_emergencies_with_other_bytes_of_the_maker_are_counted(caplog: pytest.LogCaptureFixture) -> None:
    made = supervisor([0.0])
    for k in range(1000):
        made._emergency(0x081, b"\x10\x23\x02" + k.to_bytes(5, "little"))
        made._emergency(0x082, b"\x10\x23\x02" + k.to_bytes(5, "little"))
    assert len(caplog.records) == 2
    assert [event["count"] for event in made._events.recent()] == [1000, 1000]


def test_faults_of_one_kind_in_one_place_are_counted(caplog: pytest.LogCaptureFixture) -> None:
    made = supervisor([0.0])
    for k in range(1000):
        made._report_fault("elbow", IndexError(f"index {k} is out of range"))
    assert len(caplog.records) == 1 and made._events.recent()[0]["count"] == 1000


def test_the_log_says_when_the_model_alarm_comes_and_goes_and_what_to_do(
    caplog: pytest.LogCaptureFixture,
) -> None:
    caplog.set_level(logging.INFO)
    described = {"residual_nm": [0.09, 0.01], "floor_nm": [0.03, 0.02], "location": "transmission"}
    model_monitor = SimpleNamespace(describe=lambda: described)
    watch = JointWatch(EventLog(logging.getLogger("drivelink")), lambda _joint: None)
    for status in (
        Status.VALID,
        Status.VALID | Status.MODEL_ALARM,
        Status.MODEL_ALARM,
        Status.VALID,
        Status.VALID,
    ):
        pipeline = SimpleNamespace(status=int(status), model_monitor=model_monitor)
        watch._check_model(SimpleNamespace(name="elbow", pipeline=pipeline))  # type: ignore[arg-type]
        if status == Status.MODEL_ALARM:
            described |= {"residual_nm": [0.02, 0.01], "location": ""}
    begun, over = [record.getMessage() for record in caplog.records]
    assert begun.startswith(
        "elbow: model alarm: the residual is 3 times its baseline, likely at the transmission"
    )
    assert "drivelink diagnose" in begun
    assert over == "elbow: the model alarm is over: the residual is 0.67 times its baseline"
