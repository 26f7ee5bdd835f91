"""What others put on the network: nobody but a joint's daemon speaks for it, and no message ends anything."""

import io
import json
import math
import time
from contextlib import contextmanager
from functools import reduce
from struct import pack
from types import SimpleNamespace

import pytest
import zenoh
from rich.console import Console
from zenohkit import make_estimate, make_joint, make_sample, put_estimate, put_sample, until

import drivelink
from drivelink._core import encode_estimate, encode_sample
from drivelink.errors import ZenohError
from drivelink.monitor.statuslines import shape, status_lines, status_text
from drivelink.monitor.terminal import joints_table
from drivelink.monitor.view import JointView
from drivelink.monitor.watcher import MAX_JOINTS, Watcher
from drivelink.monitor.web import snapshot
from drivelink.pubsub import feed
from drivelink.pubsub.feed import MAX_CLAIMS, DaemonIdentity
from drivelink.pubsub.publisher import to_json
from drivelink.pubsub.session import close_session, daemon_config, open_client
from drivelink.recording.formats import open_sink
from drivelink.recording.mcapfile import read_messages
from drivelink.recording.recorder import ZenohTap
from estimator.sample import Estimate, Sample, Status, TransmissionEstimate

GOOD = int(Status.VALID | Status.OBSERVABLE)

DOCUMENTS = {
    "deep": b'{"a":' * 100_000 + b"1" + b"}" * 100_000,
    "deep lists": b"[" * 200_000,
    "no object": b"[1, 2]",
    "no JSON": b"\xff\xfe{",
    "NaN": b'{"residual_nm": NaN, "rate_hz": Infinity, "cpu_fraction": 1e999, "cycles": -Infinity}',
    "huge integers": b'{"missed_cycles": 1' + b"0" * 4000 + b', "rate_hz": 1' + b"0" * 400 + b"}",
    "integer too long": b'{"a": ' + b"9" * 100_000 + b"}",
    "lone surrogates": b'{"state": "\\ud800", "conditions": ["\\udfff\\ud83d"], "\\ud800": 1}',
    "escapes": b'{"state": "\\u001b[2J\\u001b]0;owned\\u0007", "conditions": ["\\u009b31m\\u202e"]}',
    "markup": b'{"state": "[/bold][link=x]", "conditions": ["[/]"], "nodes": {"[red": {"state": "[/red]"}}}',
    "wrong types": b'{"state": 3, "nodes": [1], "bus": 7, "latency": "x", "conditions": 5, "events": {"a": 1},'
    b' "drive_faults": {"x": 1}, "residual_alarm": [], "transmissions": 9, "missed_cycles": "many"}',
    "wrong types inside": b'{"nodes": {"1": null, "2": {"state": [], "emergency": {}}}, "conditions": [[], {}, 1],'
    b' "events": [1, null, {"time": "x"}, {"time": 1e300, "text": 1}, {"time": 1, "text": [], "count": "a"}],'
    b' "residual_alarm": {"active": 1, "residual_nm": ["x", null], "floor_nm": [0, -1]}}',
    "many": json.dumps(
        {"conditions": ["x" * 5000] * 200, "nodes": dict.fromkeys(range(15_000), "up")}
    ).encode(),
    "too many": json.dumps({"a": [0] * 30_000}).encode(),
    "too large": b'{"a": "' + b"x" * (1 << 20) + b'"}',
    "nothing": b"{}",
    "another version": b'{"nodes": {"1": "up"}, "latency": null, "rate_hz": "fast", "conditions": null}',
    "booleans": b'{"rate_hz": true, "missed_cycles": false, "residual_nm": true}',
}


def raw_estimate(*numbers, status=GOOD, sequence=1, stamp_ns=1):
    return pack("<QQI3dB" + "4d" * ((len(numbers) - 3) // 4), sequence, stamp_ns, status, *numbers[:3],
                (len(numbers) - 3) // 4, *numbers[3:])  # fmt: skip


ESTIMATES = {
    "another motor count": raw_estimate(*[1.0] * 11),
    "none": raw_estimate(1.0, 1.0, 1.0),
    "eight": raw_estimate(*[1.0] * 35),
    "far away": raw_estimate(1.0, 700.0, 1.0, 1.0, 700.0, 1.0, 1e308),
    "far away, the other side": raw_estimate(-1e308, 1e308, 1e308, 1e308, 1e308, 1e308, -1e308),
    "of another time": raw_estimate(*[1.0] * 7, stamp_ns=2**64 - 1, sequence=2**64 - 1),
    "called valid": raw_estimate(*[math.nan] * 7),
    "NaN": raw_estimate(*[math.nan] * 7, status=0),
    "infinite": raw_estimate(*[math.inf] * 7, status=2),
    "all bits": raw_estimate(*[1.0] * 7, status=2**32 - 1),
    "a length": bytes(44) + b"\xff" * 9,
}


@contextmanager
def rogue(endpoint):
    """A session like a daemon's: it listens, so that everybody connects to it."""
    with zenoh.open(daemon_config(endpoint, listen=False)) as session:
        until(lambda: session.info.peers_zid())
        yield session


def publish(publisher, sequence=[0]):  # noqa: B006  (counts through the test)
    sequence[0] += 1
    put_estimate(publisher, make_estimate(sequence[0]), time.time_ns())
    put_sample(publisher, make_sample(sequence[0]), time.time_ns())
    time.sleep(0.002)
    return True


def source(session, key):
    """A publisher of the session, and what says so in its messages, as drivelink's own do."""
    entity = session.declare_publisher(key)
    return entity, zenoh.SourceInfo(entity.id, 0)


# The documents and numbers by themselves


@pytest.mark.parametrize("name", DOCUMENTS)
def test_whatever_a_document_holds_it_is_refused_in_a_line_or_made_safe(name):
    try:
        document = feed.decode_document(DOCUMENTS[name])
    except ZenohError as error:
        assert "\n" not in str(error) and len(str(error)) < 100
        return
    text = json.dumps(document, allow_nan=False, ensure_ascii=False)
    text.encode("utf-8")  # no half characters
    assert not any(c in text for c in "\x1b\x07\x9b‮\x00")
    view = JointView("elbow")
    view.status = document
    view.update(make_estimate(1), 1.0)
    for width in (20, 80, 200):
        console = Console(width=width, height=24, file=io.StringIO(), force_terminal=True)
        with console.capture() as shown:
            console.print(view)
            console.print(joints_table({"elbow": view}, width))
        assert "owned\x07" not in shown.get()
        assert all(len(line.plain) <= width for line in status_lines(document, width))
    assert json.dumps(snapshot(view, True, {}), allow_nan=False)
    assert len(status_text(document)) < 2000 and shape(document)


@pytest.mark.parametrize(
    ("document", "said"),
    [
        ({"a": "x" * feed.MAX_BYTES}, "bytes"),
        (reduce(lambda inner, _: {"a": inner}, range(feed.MAX_DEPTH + 1), {}), "levels"),
        ({"a": [0] * feed.MAX_ELEMENTS}, "elements"),
    ],
)
def test_each_limit_of_a_document_is_its_own(document, said):
    with pytest.raises(ZenohError, match=said):
        feed.decode_document(json.dumps(document).encode())


def test_what_is_well_formed_stays_as_it_is():
    document = {
        "state": "running",
        "rate_hz": 999.5,
        "missed": 0,
        "deep": [{"a": [None, True, -1.5]}],
        "e": "φ · N·m",
    }
    assert feed.decode_document(to_json(document)) == document


# Who says so


def test_tokens_of_others_lock_nobody_out_fill_no_memory_and_reach_no_terminal(publisher, endpoint):
    """200 sessions that say they are the daemon, and write nothing; then a new subscriber. And joints made up."""
    session = open_client(endpoint)
    watcher = Watcher(session)
    with rogue(endpoint) as intruder:
        names = [f"drivelink/elbow/alive/{k:032x}" for k in range(200)]
        names += [f"drivelink/\x1b[2J[bold]{k}/alive" for k in range(300)]
        tokens = [intruder.liveliness().declare_token(name) for name in names]
        time.sleep(0.3)
        with drivelink.subscribe("elbow", endpoint=endpoint) as joint:
            until(lambda: publish(publisher) and joint.valid)
            assert joint.daemon == str(publisher._session.zid())
            until(lambda: publish(publisher) and joint.rivals == 200)

        def polled():
            publish(publisher)
            watcher.poll()
            return len(watcher.views) == MAX_JOINTS and watcher.views.get("elbow")

        until(lambda: (view := polled()) and view.history.latest)
        assert not any("\x1b" in name for name in watcher.views)
        assert len(tokens) == 500
    watcher.close()
    close_session(session)


def test_a_joint_that_made_room_for_invented_ones_is_shown_though_its_token_was_seen_before_them(
    publisher, endpoint
):
    """The history of tokens comes in any order: the daemon's, invented joints, then others' for the same joint."""
    session = open_client(endpoint)
    watcher = Watcher(session)
    until(lambda: watcher.poll() or "elbow" in watcher.views)
    names = [*(f"drivelink/made-up-{k}/alive" for k in range(MAX_JOINTS)), f"drivelink/elbow/alive/{7:032x}"]
    watcher._claims.extend(SimpleNamespace(key_expr=name, kind=zenoh.SampleKind.PUT) for name in names)
    until(lambda: publish(publisher) and not watcher.poll() and watcher.views["elbow"].history.latest)
    seen = watcher.received
    until(lambda: publish(publisher) and not watcher.poll() and watcher.received > seen + 10)
    watcher.close()
    close_session(session)


FORGED = {
    "estimate": encode_estimate(make_estimate(999_999), 1),
    "sample": encode_sample(Sample(999_999, (9.0,), (9.0,), (9.0,), 9.0), 1),
    "status": b'{"state": "forged"}',
    "model": b'{"joint": "forged"}',
}


def forger(intruder):
    """A function that puts all of it, as a publisher of drivelink's own would."""
    writers = {name: source(intruder, f"drivelink/elbow/{name}") for name in FORGED}

    def forge():
        for name, (writer, info) in writers.items():
            writer.put(FORGED[name], source_info=info)

    return forge


# What is told of tokens that come (+) or go (-), then of messages: from whom, whether the last one was long ago,
# and whether it is taken. "" has no token of its own.
IDENTITY = {
    "another daemon follows when the token of the first is gone": (
        "+", "+a1", "+b2", ("a1", False, True), ("b2", True, False), "-a1", ("b2", False, True), ("a1", True, False),
        ("c3", True, False),
    ),
    "without tokens the first writer is taken until it is stale, then a token decides": (
        ("", True, True), ("b2", False, False), ("b2", True, True), "+c3", ("b2", False, False), ("c3", False, True),
    ),
    "a token that names no session counts for nothing": ("+", "+no session", "+" + 33 * "f", ("", True, True)),
    "more tokens than are remembered lock nobody out": (
        *(f"+{number:x}" for number in range(MAX_CLAIMS + 10)), "+abcdef0123456789", ("abcdef0123456789", True, True),
        ("abcdef0123456789", False, True), ("1", False, True), ("abcdef0123456789", False, False),
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", IDENTITY)
def test_who_speaks_for_a_joint(name):
    identity = DaemonIdentity()
    for step in IDENTITY[name]:
        if isinstance(step, str):
            identity.token(step[1:], step[0] == "+")
            assert identity.alive or step[0] == "-"
        else:
            assert identity.accepts(step[0], stale=step[1]) is step[2], step
    assert len(identity._claims) <= MAX_CLAIMS


@contextmanager
def watching(endpoint, folder):
    """A subscriber, a monitor and recorders of the joint elbow, and what polls them."""
    joint, session = make_joint("elbow", endpoint), open_client(endpoint)
    sinks = [open_sink(folder / name, joint) for name in ("r.mcap", "r.csv")]
    watcher, taps = Watcher(session), [ZenohTap(session, joint, sink) for sink in sinks]

    def poll():
        watcher.poll()
        for tap in taps:
            tap.poll()
        return watcher.views.get("elbow")

    with drivelink.subscribe("elbow", endpoint=endpoint, stale_after_s=10.0) as client:
        yield client, watcher, taps, poll
    for tap, sink in zip(taps, sinks, strict=True):
        tap.close()
        sink.close()
    watcher.close()
    close_session(session)


@pytest.mark.parametrize("claims", [False, True])
def test_everybody_stays_with_the_daemon_whatever_another_session_writes(
    publisher, endpoint, claims, tmp_path
):
    """Estimates, samples, status and model of a session that claims to be the daemon, or does not: none is used."""
    publisher.put_status({"state": "running"})
    with watching(endpoint, tmp_path) as (client, watcher, taps, poll):
        until(lambda: publish(publisher) and client.valid and client.status and client.model)
        until(lambda: publish(publisher) and (view := poll()) and view.history.latest and view.status)
        with rogue(endpoint) as intruder:
            until(lambda: len(client._session.info.peers_zid()) > 1)
            alive = f"drivelink/elbow/alive/{intruder.zid()}"
            token, forge = intruder.liveliness().declare_token(alive) if claims else None, forger(intruder)

            def attacked():
                publish(publisher)
                forge()
                view = poll()
                assert client.latest().sequence != 999_999 != view.history.latest.sequence
                assert (
                    client.status == view.status == {"state": "running"} and client.model["joint"] == "elbow"
                )
                return min(client.foreign, watcher.refused, *(tap.refused for tap in taps)) > 50

            until(attacked)
            assert client.rivals == int(claims) and client.daemon == str(publisher._session.zid())
            assert all(max(tap.missed.values()) < 999_000 for tap in taps)
            del token
    told = [message.data for message in read_messages(tmp_path / "r.mcap", frozenset({"status", "model"}))]
    assert any(b"running" in one for one in told) and not any(b"forged" in one for one in told)


def test_nothing_that_a_daemon_publishes_ends_the_monitor_the_recorder_or_a_client(
    publisher, endpoint, tmp_path
):
    """Its every message may be an attack."""
    eight = Estimate(1, GOOD, 1.0, 1.0, 1.0, (TransmissionEstimate(1.0, 1.0, 1.0, 0.1),) * 8)
    samples = [pack(f"<QQ3dB{3 * n}d", 1, 1, *[1.0] * 3, n, *[1.0] * 3 * n) for n in (0, 1, 2, 8)]
    never = pack("<QQ3dB3d", 2**64 - 1, 2**64 - 1, *[math.inf] * 3, 1, *[math.nan] * 3)
    attacks = {
        "estimate": [*ESTIMATES.values(), encode_estimate(eight, 1)],
        "sample": [*samples, b"", b"\xff" * 41, never],
        **dict.fromkeys(("status", "model"), DOCUMENTS.values()),
    }
    publishers = {name: source(publisher._session, f"drivelink/elbow/{name}") for name in attacks}
    console = Console(width=80, height=24)
    with watching(endpoint, tmp_path) as (client, _, taps, poll):
        until(lambda: publish(publisher) and client.valid and poll() and all(tap._sequence for tap in taps))
        for name, payloads in attacks.items():
            entity, info = publishers[name]
            for payload in payloads:
                entity.put(payload, source_info=info)
                time.sleep(0.002)
                view = poll()
                with console.capture():
                    console.print(view)
                assert "nan" not in view.line() and json.dumps(snapshot(view, True, {}), allow_nan=False)
                assert client.latest() and (client.status, client.model)
        until(lambda: publish(publisher) and client.valid and not poll().silent_s and client.foreign >= 4)
        assert all(tap.refused >= 4 for tap in taps)
    rows = (tmp_path / "r.csv").read_text().splitlines()
    assert len(rows) >= 2 and len({row.count(",") for row in rows}) == 1


def test_a_snapshot_that_no_reader_takes_is_not_kept(publisher, endpoint, monkeypatch):
    monkeypatch.setattr("drivelink.recording.recorder.MAX_BLOCK_BYTES", 1 << 10)
    session, states = open_client(endpoint), []
    sink = SimpleNamespace(wants={"snapshot"}, snapshot=states.append)
    tap = ZenohTap(session, make_joint("elbow", endpoint), sink)
    until(lambda: publisher.snapshot_wanted)
    for refused, state in enumerate((b"", bytes(1 << 10)), start=1):
        publisher.put_snapshot(1, state)
        until(lambda refused=refused: tap.poll() or tap.refused == refused)
    publisher.put_snapshot(1, b"state")
    until(lambda: tap.poll() or states)
    assert states == [b"state"]
    tap.close()
    close_session(session)
