"""The keys of one joint: latched documents, queries, bytes and quality of service, and no influence from others."""

import itertools
import json
import math
import signal
import threading
from pathlib import Path

import numpy as np
import pytest
import zenoh
import zenoh.ext
from zenohkit import (
    LIMIT_S,
    Cycle,
    free_endpoint,
    make_estimate,
    make_external,
    make_joint,
    make_sample,
    put_estimate,
    put_external,
    put_sample,
    ready,
    script,
    until,
)

from drivelink._core import encode_estimate, encode_external, encode_sample
from drivelink.pubsub import wire
from drivelink.pubsub.publisher import _QUERIES, JointPublisher, describe_model, schema, to_json
from drivelink.pubsub.session import close_session, open_client, open_session
from estimator.sample import Status


@pytest.fixture
def endpoint():
    return free_endpoint()


@pytest.fixture
def joint(endpoint):
    return make_joint("elbow", endpoint)


@pytest.fixture
def publisher(joint):
    session = open_session(joint.zenoh, Path())
    yield JointPublisher(session, joint)
    close_session(session)


@pytest.fixture
def client(publisher, endpoint):
    session = open_client(endpoint)
    until(lambda: session.info.peers_zid())
    yield session
    close_session(session)


def ask(session, key):
    """The only answer to a query."""
    (reply,) = list(session.get(key, timeout=LIMIT_S))
    assert reply.ok is not None
    assert str(reply.ok.encoding) == "application/json"
    return json.loads(reply.ok.payload.to_bytes())


def number(sample):
    return wire.decode_estimate(sample.payload.to_bytes()).sequence


def received(subscriber):
    return until(subscriber.try_recv)


def test_every_stream_arrives_as_the_contract_says(publisher, client):
    sent = {
        "estimate": encode_estimate(make_estimate(7), 123),
        "sample": encode_sample(make_sample(7), 123),
        "external": encode_external(make_external(7, status=3), 123),
    }
    for name, payload in sent.items():
        subscriber = client.declare_subscriber(f"drivelink/elbow/{name}", zenoh.handlers.RingChannel(4))

        def put(subscriber=subscriber):
            put_estimate(publisher, make_estimate(7), 123)
            put_sample(publisher, make_sample(7), 123)
            put_external(publisher, make_external(7, status=3), 123)
            return subscriber.try_recv()

        message = until(put)
        assert message.payload.to_bytes() == payload
        assert str(message.encoding) == f"zenoh/serialized;drivelink.{name}/1"
        if name != "sample":  # which nobody controls by
            assert message.express
            assert message.priority == zenoh.Priority.REAL_TIME
            assert message.congestion_control == zenoh.CongestionControl.DROP
        assert message.source_info.source_id.zid == client.info.peers_zid()[0]


def test_what_nobody_subscribes_to_is_not_put_and_a_late_subscriber_gets_the_next_cycle(publisher, client):
    streams = {"estimate": publisher._estimate, "sample": publisher._sample, "external": publisher._external}
    for name, stream in streams.items():
        assert not stream.wanted
        publisher.put(Unread())  # nor are the bytes of any message made
        subscriber = client.declare_subscriber(f"drivelink/elbow/{name}", zenoh.handlers.RingChannel(4))
        until(lambda s=stream: s.wanted)
        publisher.put(Cycle(make_estimate(7), make_sample(7), make_external(7)))
        received(subscriber)
        subscriber.undeclare()
        until(lambda s=stream: not s.wanted)


class Unread(Cycle):
    """A cycle whose bytes nobody may ask for."""

    def __init__(self) -> None:
        super().__init__(make_estimate(1))

    estimate_payload = sample_payload = external_payload = property(lambda _: pytest.fail("bytes for nobody"))


def test_a_new_subscriber_gets_the_last_status_and_model_at_once(publisher, client):
    publisher.put_status({"state": "starting"})
    publisher.put_status({"state": "running"})
    history = zenoh.ext.HistoryConfig(max_samples=1, detect_late_publishers=True)
    for name, expected in (("status", "running"), ("model", "elbow")):
        subscriber = zenoh.ext.declare_advanced_subscriber(
            client, f"drivelink/elbow/{name}", zenoh.handlers.RingChannel(4), history=history
        )
        until(lambda s=subscriber, e=expected: e.encode() in received(s).payload.to_bytes())


@pytest.fixture
def answering(publisher):
    """Answers as the daemon's housekeeping does."""
    over = threading.Event()

    def answer():
        while not over.wait(0.05):
            publisher.answer()

    thread = threading.Thread(target=answer)
    thread.start()
    yield
    over.set()
    thread.join()


def test_a_flood_of_queries_waits_for_the_slack_and_most_of_it_is_dropped(publisher, client):
    """Nothing is answered but by `answer`, which takes one query of each key."""
    last = publisher._session.declare_subscriber("last", zenoh.handlers.RingChannel(1))
    answers = [client.get("drivelink/elbow/model", timeout=LIMIT_S) for _ in range(500)]
    until(lambda: client.put("last", b"") or last.try_recv())  # all of them have come
    for _ in range(20):
        publisher.answer()
    answered = [reply for answer in answers for reply in answer if reply.ok]
    assert 1 <= len(answered) <= _QUERIES
    assert json.loads(answered[-1].ok.payload.to_bytes())["joint"] == "elbow"


def test_model_status_and_schema_answer_queries_with_json(publisher, client, joint, answering):
    publisher.put_status({"state": "running"})
    assert ask(client, "drivelink/elbow/model") == json.loads(to_json(describe_model(joint)))
    assert ask(client, "drivelink/elbow/status") == {"state": "running"}
    assert ask(client, "drivelink/elbow/schema") == schema()
    changed = make_joint("elbow", joint.zenoh.endpoint, '[provenance]\nfitted = "2026-01-01"\n')
    publisher.put_joint(changed)
    assert ask(client, "drivelink/elbow/model")["provenance"] == {"fitted": "2026-01-01"}


def test_the_model_says_its_effects_and_where_it_comes_from(endpoint):
    joint = make_joint("elbow", endpoint, '[provenance]\nfitted = "2026-01-01"\n')
    model = describe_model(joint)
    assert model["motors"][0]["transmission"] == {
        "model": "linear",
        "order": None,
        "parameters": {"k_nm_rad": 700.0},
    }
    assert model["motors"][0]["effects"] == []
    assert model["provenance"] == {"fitted": "2026-01-01"}
    json.loads(to_json(model))


def test_the_schema_describes_the_bytes():
    document = schema()
    assert [field["name"] for field in document["estimate"]["fields"]] == list(
        wire.EstimateMessage._fields[:6]
    )
    assert {bit["name"]: bit["bit"] for bit in document["status_bits"]}["observable"] == 1
    assert [1 << bit["bit"] for bit in document["status_bits"]] == [int(bit) for bit in Status]


def test_numbers_that_are_not_finite_become_null():
    document = {
        "a": math.nan,
        "b": [1.0, -math.inf],
        "c": {"d": np.float64(2.5), "e": np.array([1.0, np.nan])},
    }
    assert json.loads(to_json(document)) == {"a": None, "b": [1.0, None], "c": {"d": 2.5, "e": [1.0, None]}}


def test_the_liveliness_token_comes_and_goes_with_the_publisher(publisher, client):
    def alive():
        return [str(reply.ok.key_expr) for reply in client.liveliness().get("drivelink/*/alive", timeout=1.0)]

    assert until(alive) == ["drivelink/elbow/alive"]
    publisher.close()
    publisher.close()
    until(lambda: not alive())


def test_nothing_that_others_write_changes_what_the_daemon_says(publisher, client, answering):
    """No key is read: writing into them changes neither the answers nor the daemon's own stream."""
    publisher.put_status({"state": "running"})
    before = {name: ask(client, f"drivelink/elbow/{name}") for name in ("status", "model", "schema")}
    for name in ("estimate", "sample", "status", "model", "schema", "alive", "config", "command"):
        client.put(f"drivelink/elbow/{name}", b'{"state": "stop"}')
        client.delete(f"drivelink/elbow/{name}")
    client.put("@/**/config/mode", b"client")
    assert {name: ask(client, f"drivelink/elbow/{name}") for name in before} == before
    answered = [str(reply.ok.key_expr) for reply in client.get("@/**", timeout=0.5) if reply.ok]
    assert not [key for key in answered if key.split("/")[1] != str(client.zid())]  # no admin space either


def test_a_subscriber_that_stopped_does_not_stop_the_publisher(publisher, endpoint):
    """Far more than every buffer on the way holds; a put that waited for the subscriber would never end."""
    with script(endpoint, name="zenoh_reader.py") as process:
        ready(process)
        process.send_signal(signal.SIGSTOP)
        estimate = make_estimate(1, motors=8)
        for _ in range(60_000):  # 300 bytes each: 18 MB
            put_estimate(publisher, estimate, 0)
        process.send_signal(signal.SIGCONT)


def test_a_subscriber_that_dies_does_not_disturb_the_others(publisher, client, endpoint):
    subscriber = client.declare_subscriber("drivelink/elbow/estimate", zenoh.handlers.RingChannel(4096))
    with script(endpoint, name="zenoh_reader.py") as process:
        ready(process)
        until(lambda: put_estimate(publisher, make_estimate(0), 0) or subscriber.try_recv())
        process.kill()
        process.wait()
    sequence = itertools.count(1)
    later = set()

    def hundred():
        """A hundred estimates after the death have come, whichever a busy machine has dropped."""
        put_estimate(publisher, make_estimate(next(sequence)), 0)
        while (sample := subscriber.try_recv()) is not None:
            later.add(number(sample))
        return len(later) > 100

    until(hundred)


def test_what_is_faster_than_real_time_is_published_without_loss_documents_too(endpoint):
    joint = make_joint("elbow", endpoint)
    session = open_session(joint.zenoh, Path())
    client = open_client(endpoint)
    try:
        publisher = JointPublisher(session, joint, lossless=True)
        ring = zenoh.handlers.RingChannel
        subscriber = client.declare_subscriber("drivelink/elbow/estimate", ring(8192))
        documents = client.declare_subscriber("drivelink/elbow/status", ring(1024))
        until(lambda: put_estimate(publisher, make_estimate(0), 0) or subscriber.try_recv())
        until(lambda: publisher.put_status({"cycles": 0}) or documents.try_recv())
        for sequence in range(1, 2001):
            put_estimate(publisher, make_estimate(sequence), 0)
            if not sequence % 10:
                publisher.put_status({"cycles": sequence})
        numbers, cycles = [], []
        while not numbers or numbers[-1] != 2000:
            numbers.append(number(subscriber.recv()))
        while not cycles or cycles[-1] != 2000:
            cycles.append(json.loads(documents.recv().payload.to_bytes())["cycles"])
        assert [n for n in numbers if n] == list(range(1, 2001))
        assert [n for n in cycles if n] == list(range(10, 2001, 10))
    finally:
        close_session(client)
        close_session(session)


def test_of_several_joints_the_last_one_s_message_takes_along_what_the_others_have_put(endpoint):
    first, last = (make_joint(name, endpoint) for name in ("elbow", "knee"))
    session = open_session(first.zenoh, Path())
    client = open_client(endpoint)
    try:
        publishers = [JointPublisher(session, first, express=False), JointPublisher(session, last)]
        ring = client.declare_subscriber("drivelink/*/estimate", zenoh.handlers.RingChannel(1024))

        seen = {}

        def cycle():
            for publisher in publishers:
                put_estimate(publisher, make_estimate(0), 0)
            while (sample := ring.try_recv()) is not None:
                seen[str(sample.key_expr)] = sample.express
            return len(seen) == 2

        until(cycle)
        assert seen == {"drivelink/elbow/estimate": False, "drivelink/knee/estimate": True}
    finally:
        close_session(client)
        close_session(session)
