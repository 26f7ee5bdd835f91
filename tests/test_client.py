"""The client: values, waiting, gaps, age, sources, and the daemon's comings and goings as states."""

import asyncio
import inspect
import math
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
from zenohkit import (
    LIMIT_S,
    connected,
    free_endpoint,
    make_estimate,
    make_external,
    make_joint,
    put_estimate,
    put_external,
    ready,
    script,
    until,
)

import drivelink
from drivelink import cli
from drivelink._core import encode_estimate
from drivelink.jointfile import parse
from drivelink.pubsub import wire
from drivelink.pubsub.clientbase import absent
from drivelink.pubsub.feed import Arrivals, Feed
from drivelink.pubsub.publisher import JointPublisher
from drivelink.pubsub.session import close_session, open_client, open_session
from estimator.sample import Estimate, Status, TransmissionEstimate

STALE_S = 0.05  # for the tests of what is stale
NEVER_S = 3600.0  # for all others


@pytest.fixture
def publisher(endpoint):
    joint = make_joint("elbow", endpoint)
    session = open_session(joint.zenoh, Path())
    yield JointPublisher(session, joint, lossless=True)
    close_session(session)


@pytest.fixture
def joint(publisher, endpoint):
    with drivelink.subscribe("elbow", endpoint=endpoint, stale_after_s=NEVER_S, depth=64) as joint:
        connected(publisher, joint)
        yield joint


@pytest.fixture
def impatient(publisher, endpoint):
    with drivelink.subscribe("elbow", endpoint=endpoint, stale_after_s=STALE_S) as joint:
        connected(publisher, joint)
        yield joint


def publish(publisher, *sequences, status=Status.VALID | Status.OBSERVABLE):
    for sequence in sequences:
        put_estimate(publisher, make_estimate(sequence, status), time.time_ns())


def test_the_latest_value_comes_without_waiting_and_the_unread_ones_as_numpy_records(publisher, joint):
    assert joint.latest() is None and not joint.valid and joint.stale and joint.age_s == math.inf
    publish(publisher, 1, 2, 3)
    until(lambda: joint.received == 3)
    assert joint.latest() == wire.decode_estimate(encode_estimate(make_estimate(3), joint.latest().stamp_ns))
    assert joint.valid and joint.observable and not joint.stale and joint.state == "live"
    records = joint.take()
    assert records["sequence"].tolist() == [1, 2, 3]
    assert np.mean(records["stiffness_nm_rad"]) == 700.0
    assert records["transmissions"]["deflection_rad"][:, 0].tolist() == [0.001, 0.002, 0.003]
    assert len(joint.take()) == 0


GOOD = Status.VALID | Status.OBSERVABLE
AGAINST = ["MODEL_ALARM", "DRIVE_FAULT", "UNTIMED", "RESTARTED", "NODE_RESTARTED"]


def test_each_estimate_answers_for_itself_and_what_its_status_speaks_against_is_not_usable(publisher, joint):
    statuses = [GOOD, Status.OBSERVABLE, *(GOOD | Status[bit] for bit in AGAINST), GOOD]
    for number, status in enumerate(statuses, start=1):
        publish(publisher, number, status=status)
        until(lambda n=number: joint.received == n)
        assert (joint.usable, joint.valid) == (status == GOOD, bool(status & Status.VALID))
        assert joint.observable
    got = [message for _, message in zip(statuses, joint, strict=False)]
    assert [one.sequence for one in got] == list(range(1, len(statuses) + 1))  # every cycle, in order
    assert [one.usable for one in got] == [status == GOOD for status in statuses]
    assert [one.valid for one in got] == [bool(status & Status.VALID) for status in statuses]
    publish(publisher, 20, status=Status.VALID | Status.STALE)
    until(lambda: joint.received == len(statuses) + 1)
    assert joint.stale and not joint.valid  # by its own word


def test_a_rigid_joint_says_that_its_stiffness_is_not_given(endpoint):
    """Valid for its torque: without the bit a client refuses NaN that is called valid."""
    text = f'name = "elbow"\n[[motor]]\ninertia_kg_m2 = 0.125\n[motor.transmission]\nmodel = "none"\n[zenoh]\nendpoint = "{endpoint}"'
    session = open_session(parse(text).zenoh, Path())
    try:
        publisher = JointPublisher(session, parse(text))
        with drivelink.subscribe("elbow", endpoint=endpoint) as joint:
            connected(publisher, joint)
            nan = math.nan
            rigid = Estimate(1, int(Status.VALID), 2.0, nan, nan, (TransmissionEstimate(2.0, nan, nan, nan),))
            until(lambda: put_estimate(publisher, rigid, time.time_ns()) or joint.valid)
            assert joint.latest().status & Status.PARTIAL and math.isnan(joint.latest().stiffness_nm_rad)
    finally:
        close_session(session)


def test_the_external_torque_comes_with_the_estimate_of_its_cycles_and_of_no_others(publisher, joint):
    assert joint.external is None and not joint.contact
    publish(publisher, 1)
    put_external(publisher, make_external(1, status=3), time.time_ns())
    external = until(lambda: joint.external)
    given = (external.sequence, external.external_torque_nm, external.external_torque_std_nm)
    assert given == (1, 0.01, 0.25) and external.valid and joint.contact
    publish(publisher, 3)
    put_external(publisher, make_external(3, status=1), time.time_ns())
    until(lambda: joint.external.sequence == 3)
    assert not joint.contact
    publish(publisher, 40)
    until(lambda: joint.latest().sequence == 40)
    assert joint.external is None and not joint.contact
    put_external(publisher, make_external(40, status=3), time.time_ns())
    until(lambda: joint.contact)
    joint._feed.identity.bound = (
        "a successor"  # which has said nothing yet: what its predecessor said is not its word
    )
    assert joint.external is None and joint.model is None


def test_iteration_ends_when_the_subscription_is_closed_meanwhile(publisher, joint):
    threading.Timer(0.1, joint.close).start()
    assert list(joint) == []
    with ThreadPoolExecutor(8) as threads:  # several at once: as one
        assert list(threads.map(lambda _: joint.close(), range(8))) == [None] * 8
    assert joint.wait() is None
    assert joint.latest() is None


def test_missing_numbers_are_gaps_and_what_the_reader_left_unread_is_counted_apart(publisher, joint):
    publish(publisher, 1, 2, 5, 6, 10)
    until(lambda: joint.received == 5)
    assert (joint.gaps, joint.skipped) == (2 + 3, 0)
    with drivelink.subscribe("elbow", session=joint._session) as other:  # says that all of them have come
        publish(publisher, *range(11, 201))
        until(lambda: (e := other.latest()) and e.sequence == 200)
    until(lambda: joint.latest().sequence == 200)
    assert joint.gaps == 5 and joint.skipped > 0
    assert len(joint.take()) <= 64


def test_the_age_grows_until_it_is_stale_and_a_daemon_that_hangs_is_not_gone(publisher, impatient):
    put_external(publisher, make_external(1, status=3), time.time_ns())
    until(lambda: publish(publisher, 1) or (impatient.state == "live" and impatient.contact))
    first = impatient.age_s
    until(lambda: impatient.age_s > first)  # one that was put may still have come
    until(lambda: impatient.state == "stale")  # the daemon is there, but says nothing new
    assert impatient.stale and impatient.age_s > STALE_S
    assert impatient.external is None and not impatient.contact
    publisher.close()
    until(lambda: impatient.state == "gone")


def test_arrival_is_the_stamp_moved_by_the_smallest_difference_seen():
    """Estimates made each 1 ms, 0.2 ms under way, read each 10 ms: the age is exact to the clocks' drift."""
    offset_ns, way_ns = 123_456_789, 200_000
    arrivals = Arrivals(0)
    for read in range(1, 2000):
        now_ns = read * 10_000_000
        made_ns = now_ns - read % 11 * 100_000 - way_ns  # how long before the read the last one was made
        arrivals.came(made_ns + offset_ns, now_ns)
        arrivals.empty(now_ns)
    assert arrivals.age_ns(now_ns) == pytest.approx(read % 11 * 100_000, abs=way_ns)
    for stamp_ns in (0, 10**19):  # whatever the stamp: between the queue seen empty and the read
        arrivals = Arrivals(0)
        arrivals.came(1_000_000_000, 10)
        arrivals.empty(1_000)
        arrivals.came(stamp_ns, 2_000)
        assert 0 <= arrivals.age_ns(2_000) <= 1_000


def test_after_a_stamp_that_jumps_an_estimate_is_stale_in_time_all_the_same():
    feed = Feed(8, None, 0)
    for number, stamp_ns in enumerate((1, 3_600_000_000_000), start=1):
        feed.admit(encode_estimate(make_estimate(number), stamp_ns), number, False)
    assert not feed.stale(1_000_000_000) and feed.stale(10_000_000_000)


def test_the_daemons_death_and_return_are_states(endpoint):
    with drivelink.subscribe("elbow", endpoint=endpoint, stale_after_s=STALE_S) as joint:
        assert joint.state == "waiting"
        assert joint.wait(0.01) is None
        for _ in range(2):
            with script("elbow", endpoint) as daemon:
                ready(daemon)
                until(lambda: joint.valid and joint.state == "live")
                received = joint.received
                until(lambda: joint.status)
                daemon.kill()
                until(lambda: joint.state == "gone")
                assert not joint.valid
                assert joint.latest() is not None  # the last word stays readable
            assert joint.received >= received
        assert (joint.gaps, joint.foreign) == (0, 0)


def test_no_thread_and_no_session_is_left_behind_but_one_that_was_lent(endpoint, publisher):
    before = set(threading.enumerate())
    with drivelink.subscribe("elbow", endpoint=endpoint) as joint:
        joint.wait(0.01)
        own = joint._session
    assert set(threading.enumerate()) == before
    assert own.is_closed()
    joint.close()  # a second time does nothing
    session = open_client(endpoint)
    try:
        with (
            drivelink.subscribe("elbow", session=session) as one,
            drivelink.subscribe("elbow", session=session) as two,
        ):
            connected(publisher, one)
            publish(publisher, 1)
            assert one.wait(LIMIT_S).sequence == two.wait(LIMIT_S).sequence == 1
            assert one.wait(0.05) is two.wait(0.05) is None
            assert one.foreign == two.foreign == 0  # their own wake-ups are nobody's estimates
        assert not session.is_closed()
    finally:
        close_session(session)


@pytest.mark.parametrize(
    ("argument", "value", "expected"),
    [
        *(("joint", name, "a name") for name in ("", "*", "a b", "elbow?x", "el/**", None, 5)),
        ("prefix", "", "a name"),
        ("endpoint", 7447, "text like"),
        ("config", "", "the path of"),
        ("session", "elbow", "an open zenoh session"),
        *(("depth", depth, "a whole number from 1 to") for depth in (0, -3, 1.5, "8", 10**9)),
        *(("stale_after_s", age_s, "seconds above 0") for age_s in (-1, 0, math.nan, "1")),
    ],
)
def test_an_argument_that_cannot_be_is_one_line(argument, value, expected):
    for make in (drivelink.subscribe, drivelink.subscribe_async):
        with pytest.raises(ValueError, match=f"^{argument}: expected {expected}.*, got ") as caught:
            make(**({"joint": "elbow"} | {argument: value}))
        assert "\n" not in str(caught.value)
    if argument in inspect.signature(drivelink.joints).parameters:
        with pytest.raises(ValueError, match=f"^{argument}: expected {expected}"):
            drivelink.joints(**{argument: value})


@pytest.mark.parametrize("timeout_s", [math.nan, "1"])
def test_a_time_to_wait_that_is_none_is_one_line(endpoint, timeout_s):
    """NaN waited forever."""

    async def controller():
        async with drivelink.subscribe_async("elbow", endpoint=endpoint) as joint:
            assert await joint.wait(-1.0) is None
            await joint.wait(timeout_s)

    with drivelink.subscribe("elbow", endpoint=endpoint, stale_after_s=math.inf) as joint:
        assert joint.wait(-1.0) is None and next(joint.cycles(-1.0)) is None  # a deadline that is over
        for wait in (lambda: joint.wait(timeout_s), lambda: asyncio.run(controller())):
            with pytest.raises(ValueError, match=r"^timeout_s: expected seconds, or None"):
                wait()


def test_asyncio_waits_iterates_and_times_out(publisher, endpoint):
    async def controller():
        async with drivelink.subscribe_async("elbow", endpoint=endpoint, stale_after_s=NEVER_S) as joint:
            assert await joint.wait(0.01) is None
            await asyncio.to_thread(connected, publisher, joint)
            asyncio.get_running_loop().call_later(0.05, publish, publisher, 1)
            assert (await joint.wait(LIMIT_S)).sequence == 1
            publish(publisher, 2, 3, 5)
            seen = []
            async for estimate in joint:
                seen.append(estimate.sequence)
                if estimate.sequence == 5:
                    break
            assert seen == [2, 3, 5]
            assert joint.gaps == 1
            assert joint.valid
            async for nothing in joint.cycles(timeout_s=0.02):
                assert nothing is None
                break
            asyncio.get_running_loop().call_later(0.05, joint.close)
            assert [estimate async for estimate in joint] == []

    before = set(threading.enumerate())
    asyncio.run(controller())
    assert set(threading.enumerate()) == before


# A name that does not exist


@pytest.fixture
def hasty(monkeypatch):
    for module in ("clientbase", "client"):
        monkeypatch.setattr(f"drivelink.pubsub.{module}.PATIENCE_S", 0.3)


@pytest.mark.parametrize("how", ["wait", "latest", "async"])
def test_a_name_without_daemon_is_said_once_with_the_nearest_one(publisher, endpoint, hasty, caplog, how):
    async def waits():
        async with drivelink.subscribe_async("elbwo", endpoint=endpoint) as joint:
            await joint.wait(timeout_s=0.5)

    if how == "async":
        asyncio.run(waits())
    else:
        with drivelink.subscribe("elbwo", endpoint=endpoint) as joint:
            end = time.monotonic() + LIMIT_S
            while not caplog.messages and time.monotonic() < end:
                joint.wait(timeout_s=0.4) if how == "wait" else (joint.latest(), time.sleep(0.01))
            joint.wait(timeout_s=0.1)
    assert caplog.messages == ['no daemon of "elbwo"; did you mean "elbow"?']


def test_of_several_daemons_all_are_named():
    assert (
        absent("elbwo", ["elbow", "knee"])
        == 'no daemon of "elbwo", only of elbow, knee; did you mean "elbow"?'
    )
    assert absent("toe", []).endswith(
        "nor of any other joint: drivelink run JOINT starts one; or a router is missing"
    )
    assert absent("toe", ["knee"]) == 'no daemon of "toe", only of knee'


def test_a_daemon_that_is_there_is_listed_and_not_missed(
    publisher, endpoint, hasty, caplog, capsys, monkeypatch
):
    with drivelink.subscribe("elbow", endpoint=endpoint) as joint:
        joint.wait(timeout_s=0.5)
    assert not caplog.messages
    assert cli.main(["list", "--endpoint", endpoint]) == 0 and capsys.readouterr().out == "elbow\n"
    monkeypatch.setattr("drivelink.pubsub.session._MEETING_S", 0.3)
    there = free_endpoint()
    assert cli.main(["list", "--endpoint", there]) == 6
    said = f"nothing answers at {there}: drivelink run JOINT starts a daemon; or a router is missing\n"
    assert capsys.readouterr().err == said
    assert cli.main(["list", "--endpoint", endpoint, "--prefix", "other"]) == 6
    assert "no joint of prefix 'other' at" in capsys.readouterr().err
