"""The keys of one joint: latched documents, queries, bytes and quality of service, and no influence from others."""

import json
import math
import signal

import numpy as np
import pytest
import zenoh
import zenoh.ext
from zenohkit import (
    LIMIT_S,
    Cycle,
    make_estimate,
    make_external,
    make_joint,
    make_sample,
    put_estimate,
    ready,
    repeated,
    script,
    until,
)

from drivelink._core import encode_estimate, encode_external, encode_sample
from drivelink.pubsub import wire
from drivelink.pubsub.publisher import _QUERIES, describe_model, schema, to_json
from drivelink.pubsub.session import close_session, open_client
from estimator.sample import Status


@pytest.fixture
def joint(endpoint):
    return make_joint("elbow", endpoint)


@pytest.fixture
def client(publisher, endpoint):
    session = open_client(endpoint)
    until(lambda: session.info.peers_zid())
    yield session
    close_session(session)


RING = zenoh.handlers.RingChannel
CYCLE = Cycle(make_estimate(7), make_sample(7), make_external(7, status=3), 123)
SENT = {  # stream: (bytes, whether a controller waits for it)
    "estimate": (encode_estimate(CYCLE.estimate, 123), True),
    "sample": (encode_sample(CYCLE.sample, 123), False),
    "external": (encode_external(make_external(7, status=3), 123), True),
}


@pytest.mark.parametrize("name", SENT)
def test_a_stream_arrives_as_the_contract_says_and_only_what_is_subscribed_to_is_put(name, publisher, client):
    class Unread(Cycle):
        """A cycle whose bytes nobody may ask for."""

        estimate_payload = sample_payload = external_payload = property(
            lambda _: pytest.fail("bytes for nobody")
        )

    payload, urgent = SENT[name]
    stream = getattr(publisher, f"_{name}")
    assert not stream.wanted
    publisher.put(Unread(make_estimate(1)))
    subscriber = client.declare_subscriber(f"drivelink/elbow/{name}", RING(4))
    until(lambda: stream.wanted)
    publisher.put(CYCLE)  # a late subscriber gets the next cycle
    message = until(subscriber.try_recv)
    assert message.payload.to_bytes() == payload
    assert str(message.encoding) == f"zenoh/serialized;drivelink.{name}/1"
    assert message.source_info.source_id.zid == client.info.peers_zid()[0]
    assert not urgent or (message.express and message.priority == zenoh.Priority.REAL_TIME)
    assert not urgent or message.congestion_control == zenoh.CongestionControl.DROP
    subscriber.undeclare()
    until(lambda: not stream.wanted)


def test_a_new_subscriber_gets_the_last_status_and_model_at_once(publisher, client):
    publisher.put_status({"state": "starting"})
    publisher.put_status({"state": "running"})
    history = zenoh.ext.HistoryConfig(max_samples=1, detect_late_publishers=True)
    for name, expected in (("status", b"running"), ("model", b"elbow")):
        key = f"drivelink/elbow/{name}"
        subscriber = zenoh.ext.declare_advanced_subscriber(client, key, RING(4), history=history)
        until(lambda s=subscriber, e=expected: (got := s.try_recv()) and e in got.payload.to_bytes())


@pytest.fixture
def answering(publisher):
    with repeated(publisher.answer, 0.05):
        yield


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


def ask(session, key):
    (reply,) = list(session.get(f"drivelink/elbow/{key}", timeout=LIMIT_S))
    assert reply.ok is not None and str(reply.ok.encoding) == "application/json"
    return json.loads(reply.ok.payload.to_bytes())


def test_model_status_and_schema_answer_queries_with_json(publisher, client, joint, answering):
    publisher.put_status(
        {"state": "running", "a": [1.0, -math.inf], "b": np.array([np.float64(2.5), np.nan])}
    )
    assert ask(client, "model") == json.loads(to_json(describe_model(joint)))
    assert ask(client, "status") == {"state": "running", "a": [1.0, None], "b": [2.5, None]}
    document = ask(client, "schema")
    assert document == schema()
    assert [field["name"] for field in document["estimate"]["fields"]] == list(
        wire.EstimateMessage._fields[:6]
    )
    assert {bit["name"]: bit["bit"] for bit in document["status_bits"]}["observable"] == 1
    assert [1 << bit["bit"] for bit in document["status_bits"]] == [int(bit) for bit in Status]
    publisher.put_joint(make_joint("elbow", joint.zenoh.endpoint, '[provenance]\nfitted = "2026-01-01"\n'))
    model = ask(client, "model")
    assert model["provenance"] == {"fitted": "2026-01-01"} and model["motors"][0]["effects"] == []
    spring = {"model": "linear", "order": None, "parameters": {"k_nm_rad": 700.0}}
    assert model["motors"][0]["transmission"] == spring


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
    before = {name: ask(client, name) for name in ("status", "model", "schema")}
    for name in ("estimate", "sample", "status", "model", "schema", "alive", "config", "command"):
        client.put(f"drivelink/elbow/{name}", b'{"state": "stop"}')
        client.delete(f"drivelink/elbow/{name}")
    client.put("@/**/config/mode", b"client")
    assert {name: ask(client, name) for name in before} == before
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
