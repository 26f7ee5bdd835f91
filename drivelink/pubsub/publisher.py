"""Publishes one joint on zenoh.

The 1 kHz keys are plain publishers that put nothing while nobody subscribes, and drop rather than wait: the
estimate with real-time priority, the sample in a separate queue. `status`, `model` and `finding` are latched:
an advanced subscriber with history and a query get the last one at once; `schema` is answered by query. Of
the joints of one daemon only the last one's messages are express: they flush the queues, so that a cycle of
many joints leaves in one batch. Nothing else is received: no key changes what the daemon does. Queries wait
in zenoh until they are answered in the slack, a few at a time; of a flood the oldest are dropped.
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

import zenoh
import zenoh.ext

from drivelink._core import Tick
from drivelink.canopen.layout import NodeLayout, layout_document
from drivelink.errors import ZenohError
from drivelink.jointfile import JointFile, MotorSection, effect_entry, plain_parameters
from drivelink.pubsub.feed import DOCUMENTS
from drivelink.pubsub.session import Stream, one_line
from drivelink.pubsub.wire import ESTIMATE, EXTERNAL, SAMPLE
from drivelink.version import __version__
from estimator.sample import Bits, ExternalStatus, Status
from estimator.transmissions import RIGID

if TYPE_CHECKING:
    from drivelink.pubsub.ros2 import Ros2Publisher

_CLAIM_TIMEOUT_S = 1.0
_QUERIES = 8  # waiting queries per key; zenoh drops the oldest beyond
_PARTIAL = int(Status.PARTIAL)
_JSON = zenoh.Encoding.APPLICATION_JSON


class JointPublisher:
    """The keys `<prefix>/<joint>/…` of one joint.

    Args:
        session: an open session; it stays open.
        joint: gives the name, the prefix and the model as declared.
        lossless: wait for slow subscribers rather than drop: for replays, never for a bus.
        express: flush the queues: for the last joint of a session's cycle.

    Raises:
        ZenohError: another daemon serves a joint of this name.
    """

    def __init__(
        self, session: zenoh.Session, joint: JointFile, *, lossless: bool = False, express: bool = True
    ) -> None:
        self.key = f"{joint.zenoh.prefix}/{joint.name}"
        self._session = session
        control = zenoh.CongestionControl
        self._congestion_control = control.BLOCK if lossless else control.DROP
        self._express = express
        self._documents: dict[str, bytes] = {}
        self._questions: list[tuple[str, Any]] = []
        self._partial = False
        self._entities: list[Any] = []
        self._ros2: Ros2Publisher | None = None
        try:
            self._claim(joint.name)
            self._estimate = self._stream("estimate", ESTIMATE.schema, zenoh.Priority.REAL_TIME)
            self._external = self._stream("external", EXTERNAL.schema, zenoh.Priority.REAL_TIME)
            self._sample = self._stream("sample", SAMPLE.schema, zenoh.Priority.INTERACTIVE_HIGH)
            self._snapshot = self._stream("snapshot", "", zenoh.Priority.BACKGROUND)
            self._latched = {name: self._latch(name) for name in DOCUMENTS}
            self._answer("schema", to_json(schema()))
            self.put_joint(joint)
            if joint.ros2 is not None and joint.ros2.enabled:
                from drivelink.pubsub.ros2 import Ros2Publisher  # loaded where it is asked for

                self._ros2 = Ros2Publisher(session, joint)
            self._alive(self.key + "/alive")
        except zenoh.ZError as error:
            self.close()
            raise ZenohError(f"joint {joint.name}: {one_line(error)}") from error
        except ZenohError:
            self.close()
            raise

    @property
    def subscribed(self) -> bool:
        """Whether anybody subscribes to the estimate."""
        return self._estimate.wanted

    def put(self, tick: Tick) -> None:
        """Publish one cycle to its subscribers: estimate, external torque, sample; never waits for them."""
        if self._partial:
            tick = tick.flagged(_PARTIAL)
        if self._estimate.wanted:
            self._estimate.put(tick.estimate_payload)
        if self._external.wanted and (payload := tick.external_payload) is not None:
            self._external.put(payload)
        if self._sample.wanted and (payload := tick.sample_payload) is not None:
            self._sample.put(payload)
        if self._ros2 is not None:
            self._ros2.put_cycle(tick)

    @property
    def snapshot_wanted(self) -> bool:
        """Whether anybody subscribes to the estimator's state."""
        return self._snapshot.wanted

    def put_snapshot(self, sequence: int, state: bytes) -> None:
        """Publish the estimator's state after a sample (`JointPipeline.snapshot`); waits for who is slow."""
        self._snapshot.put(sequence.to_bytes(8, "little") + state)

    def put_status(self, status: Mapping[str, Any]) -> None:
        """Publish the daemon's status; non-finite values become null."""
        self._put_document("status", status)
        self.answer()
        if self._ros2 is not None:
            self._ros2.put_status(status, time.time_ns())

    def put_finding(self, finding: Mapping[str, Any]) -> None:
        """Publish what the newest diagnosis of a kept recording found, on every change."""
        self._put_document("finding", finding)
        if self._ros2 is not None:
            self._ros2.finding = finding

    def put_joint(self, joint: JointFile, layouts: Sequence[NodeLayout] = ()) -> None:
        """Publish the model in use, on every change."""
        rigid = any(motor.transmission.model == RIGID for motor in joint.motor)
        self._partial = rigid or joint.estimator.mode == "paper"
        self._put_document("model", describe_model(joint, layouts))

    def answer(self) -> None:
        """Answer one waiting query of each key; called in the slack, some twenty times a second."""
        for name, queryable in self._questions:
            with suppress(zenoh.ZError):
                if (query := queryable.try_recv()) is not None:
                    with query:
                        query.reply(f"{self.key}/{name}", self._documents[name], encoding=_JSON, express=True)

    def watch_rivals(self, tell: Callable[[bool], object]) -> None:
        """Call `tell` in zenoh's thread when another daemon serves this joint (True), or no more (False).

        None does when this one starts, but a router that comes later may join two.
        """
        own, rivals = str(self._session.zid()), set[str]()

        def changed(sample: zenoh.Sample) -> None:
            there = sample.kind == zenoh.SampleKind.PUT
            if (zid := str(sample.key_expr).rpartition("/")[2]) != own:
                (rivals.add if there else rivals.discard)(zid)
                tell(bool(rivals))

        handler = zenoh.handlers.Callback(changed, indirect=False)  # as in `watch_router`
        tokens = self._session.liveliness().declare_subscriber(f"{self.key}/alive/*", handler, history=True)
        self._entities.append(tokens)

    def close(self) -> None:
        """Undeclare the keys, the liveliness token first; may be called twice."""
        if self._ros2 is not None:
            self._ros2.close()
        while self._entities:
            with suppress(zenoh.ZError):
                self._entities.pop().undeclare()

    def _claim(self, name: str) -> None:
        """Check that no other daemon serves this joint; of two that start at once the smaller id stays."""
        own = f"{self.key}/alive/{self._session.zid()}"
        taken = f"another daemon already serves a joint named {name} ({self.key}): end it, or rename this one"
        if self._served():
            raise ZenohError(taken)
        self._alive(own)
        if any(other < own for other in self._served() if other != self.key + "/alive"):
            raise ZenohError(taken)

    def _served(self) -> list[str]:
        replies = self._session.liveliness().get(f"{self.key}/alive/**", timeout=_CLAIM_TIMEOUT_S)
        return [str(reply.ok.key_expr) for reply in replies if reply.ok]

    def _alive(self, key: str) -> None:
        self._entities.append(self._session.liveliness().declare_token(key))

    def _stream(self, name: str, schema_name: str, priority: zenoh.Priority) -> Stream:
        background = priority == zenoh.Priority.BACKGROUND
        plain, serialized = zenoh.Encoding.APPLICATION_OCTET_STREAM, zenoh.Encoding.ZENOH_SERIALIZED
        publisher = self._session.declare_publisher(
            f"{self.key}/{name}",
            encoding=serialized.with_schema(schema_name) if schema_name else plain,
            congestion_control=zenoh.CongestionControl.BLOCK if background else self._congestion_control,
            priority=priority,
            express=self._express and not background,
        )
        self._entities.append(publisher)
        return Stream(publisher)

    def _latch(self, name: str) -> zenoh.ext.AdvancedPublisher:
        publisher = zenoh.ext.declare_advanced_publisher(
            self._session,
            f"{self.key}/{name}",
            encoding=_JSON,
            congestion_control=self._congestion_control,
            express=True,
            cache=zenoh.ext.CacheConfig(max_samples=1),
            sample_miss_detection=zenoh.ext.MissDetectionConfig(heartbeat=None, sporadic_heartbeat=None),
            publisher_detection=True,
        )
        self._entities.append(publisher)
        self._answer(name, to_json({}))
        return publisher

    def _answer(self, name: str, document: bytes) -> None:
        """Answer queries of a key with its document, from `answer`."""
        self._documents[name] = document
        ring: Any = zenoh.handlers.RingChannel(_QUERIES)
        queryable = self._session.declare_queryable(f"{self.key}/{name}", ring, complete=True)
        self._entities.append(queryable)
        self._questions.append((name, queryable))

    def _put_document(self, name: str, document: Mapping[str, Any]) -> None:
        payload = to_json(document)
        self._documents[name] = payload
        self._latched[name].put(payload)


def describe_model(joint: JointFile, layouts: Sequence[NodeLayout] = ()) -> dict[str, Any]:
    """Return the model in use, with its effects and provenance.

    Args:
        layouts: of its nodes, if known; they make recorded frames decodable.
    """
    return {
        "schema": "drivelink.model/1",
        "joint": joint.name,
        "arrangement": joint.arrangement,
        "estimator": asdict(joint.estimator),
        "motors": [_describe_motor(motor) for motor in joint.motor],
        "link": {
            "dynamics": asdict(joint.link.dynamics) if joint.link.dynamics else None,
            "effects": [effect_entry(effect) for effect in joint.link.effect],
        },
        "provenance": joint.provenance,
        "nodes": [layout_document(layout) for layout in layouts],
    }


def _describe_motor(motor: MotorSection) -> dict[str, Any]:
    own = motor.transmission
    parameters = plain_parameters(own.parameters)
    return {
        "inertia_kg_m2": motor.inertia_kg_m2,
        "viscous_damping_nm_s_rad": motor.viscous_damping_nm_s_rad,
        "transmission": {"model": own.model, "order": own.order, "parameters": parameters},
        "effects": [effect_entry(effect) for effect in motor.effect],
    }


def schema() -> dict[str, Any]:
    """Answer to `<prefix>/<joint>/schema`: all layouts and status bits."""
    return {
        "schema": "drivelink.schema/1",
        "version": __version__,
        "estimate": ESTIMATE.describe(),
        "external": EXTERNAL.describe(),
        "sample": SAMPLE.describe(),
        "status_bits": _bits(Status),
        "external_bits": _bits(ExternalStatus),
    }


def _bits(flags: type[Bits]) -> list[dict[str, Any]]:
    return [
        {"bit": bit.bit_length() - 1, "name": str(bit.name).lower(), "meaning": bit.meaning} for bit in flags
    ]


def to_json(document: Mapping[str, Any]) -> bytes:
    """Return portable JSON: non-finite numbers become null."""
    try:
        text = json.dumps(document, allow_nan=False, default=_plain)
    except ValueError:
        text = json.dumps(finite(document), allow_nan=False, default=_plain)
    return text.encode()


def finite(value: Any) -> Any:
    """Return a value, or what it consists of, with None for every number that is not finite."""
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {key: finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [finite(item) for item in value]
    return value


def _plain(value: Any) -> Any:
    """Convert numpy numbers and arrays to plain values, anything else to text."""
    return finite(value.tolist()) if hasattr(value, "tolist") else str(value)
