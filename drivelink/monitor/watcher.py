"""Collects the daemons' messages for the live views.

Each joint follows one daemon, as a controller's subscription does. Everything passes
`drivelink.pubsub.feed`, so no network input ends a view or fills its memory.
"""

import time
from collections import deque
from typing import Any

import zenoh

from drivelink.errors import ZenohError, raised_as
from drivelink.monitor.view import JointView
from drivelink.plaintext import clean_text, natural
from drivelink.pubsub.clientbase import PATIENCE_S, absent, ask
from drivelink.pubsub.feed import (
    DECODERS,
    DOCUMENTS,
    MAX_CLAIMS,
    DaemonIdentity,
    follow_document,
    source_of,
    waiting,
)

MAX_JOINTS = 64  # limit on joints shown, also against invented names
_QUEUE = 8192
_NAME = 64  # characters of a joint's name that are shown
_STALE_S = 1.0  # after which another session may take over without a liveliness token


class _Joint:
    """One joint: its accepted session and its view."""

    def __init__(self, name: str, incomplete: bool) -> None:
        self.identity = DaemonIdentity(incomplete)
        self.view = JointView(clean_text(name, _NAME))
        self.heard_s = -float("inf")
        self.estimate_s = -float("inf")


class Watcher:
    """Follows one joint or all of them.

    Args:
        session: an open session; it stays open.
        joint: only this one; None: all joints, up to MAX_JOINTS.
    """

    def __init__(self, session: zenoh.Session, prefix: str = "drivelink", joint: str | None = None) -> None:
        self.received = 0  # number of estimates
        self.refused = 0  # messages of other sessions, or invalid ones
        self._prefix = prefix + "/"
        self._session, self._asked = session, joint
        self._hint_s = time.monotonic() + PATIENCE_S
        self._hint = ""
        self._joints: dict[str, _Joint] = {}
        self._crowded = False  # whether a joint, with its tokens, has made room for another
        self._samples: Any = None
        self._claims: deque[zenoh.Sample] = deque()  # tokens that came since the last poll
        ring = zenoh.handlers.RingChannel
        key = self._key = f"{prefix}/{joint or '*'}"
        with raised_as(ZenohError, f"{key}: cannot be subscribed to", zenoh.ZError):
            self._streams: list[tuple[str, Any]] = [
                (name, session.declare_subscriber(f"{key}/{name}", ring(_QUEUE)))
                for name in ("estimate", "external")
            ]
            self._streams += [(name, follow_document(session, f"{key}/{name}", 256)) for name in DOCUMENTS]
            heard = zenoh.handlers.Callback(self._token, indirect=False)
            self._tokens: Any = session.liveliness().declare_subscriber(
                f"{key}/alive/**", heard, history=True
            )
        if joint is not None:
            self._joint(joint)

    @property
    def views(self) -> dict[str, JointView]:
        """Views by joint name, elbow-2 before elbow-10."""
        named = {joint.view.name: joint.view for joint in self._joints.values()}
        return {name: named[name] for name in sorted(named, key=natural)}

    @property
    def alive(self) -> set[str]:
        """Names of the joints with a live daemon."""
        return {joint.view.name for joint in self._joints.values() if joint.identity.alive}

    def poll(self) -> None:
        """Process all new messages."""
        while self._claims:
            token = self._claims.popleft()
            if (joint := self._joint(self._name(token))) is not None:
                joint.identity.heard(token)
        now_s = time.monotonic()
        if now_s > self._hint_s and self._asked is not None:
            self._hint_s = now_s + PATIENCE_S
            ask(self._session, self._prefix[:-1], self._say)
        for kind, subscriber in self._streams:
            for sample in waiting(subscriber, _QUEUE):
                self._take(kind, sample, now_s)
        for joint in self._joints.values():
            view = joint.view
            view.hint = "" if joint.identity.seen else self._hint
            view.gone = not joint.identity.alive and view.history.latest is not None
            view.silent_s = now_s - joint.estimate_s if view.history.latest is not None else 0.0

    def follow_signals(self, wanted: bool) -> None:
        """Subscribe to the samples only while somebody looks at them: else no daemon sends any."""
        if wanted and self._samples is None:
            ring: Any = zenoh.handlers.RingChannel(_QUEUE)
            self._samples = self._session.declare_subscriber(f"{self._key}/sample", ring)
            self._streams.append(("sample", self._samples))
        elif not wanted and self._samples is not None:
            self._streams.remove(("sample", self._samples))
            self._samples.undeclare()
            self._samples = None
            for joint in self._joints.values():
                joint.view.history.signals.clear()

    def close(self) -> None:
        """Stop following."""
        for subscriber in (self._tokens, *(subscriber for _, subscriber in self._streams)):
            subscriber.undeclare()

    def _say(self, names: list[str]) -> None:
        """In zenoh's thread."""
        self._hint = absent(self._asked or "", names)

    def _take(self, kind: str, sample: zenoh.Sample, now_s: float) -> None:
        joint = self._joint(self._name(sample))
        if joint is None or not joint.identity.accepts(source_of(sample), now_s - joint.heard_s > _STALE_S):
            self.refused += 1
            return
        joint.heard_s = now_s
        try:
            message = DECODERS[kind](sample.payload.to_bytes())
        except ZenohError:
            self.refused += 1
            return
        if kind in DOCUMENTS:
            setattr(joint.view, kind, message)
        elif kind == "sample":
            joint.view.history.add_sample(message.sample, message.stamp_ns * 1e-9)
        elif kind == "external":
            joint.view.update_external(message, message.stamp_ns * 1e-9)
        else:
            self.received += 1
            joint.estimate_s = now_s
            joint.view.update(message, message.stamp_ns * 1e-9)

    def _token(self, token: zenoh.Sample) -> None:
        """In zenoh's thread."""
        if len(self._claims) < 4 * MAX_CLAIMS:
            self._claims.append(token)

    def _name(self, sample: zenoh.Sample) -> str:
        """Return the joint's name from the key."""
        return str(sample.key_expr).removeprefix(self._prefix).split("/", 1)[0]

    def _joint(self, name: str) -> _Joint | None:
        """Return the joint of that name; None if there are too many."""
        joint = self._joints.get(name)
        if joint is None:
            if len(self._joints) >= MAX_JOINTS:
                known = self._joints.items()  # of some no daemon has sent anything that is alive
                idle = next((k for k, one in known if not (one.identity.bound and one.identity.alive)), None)
                if idle is None:
                    return None
                del self._joints[idle]
                self._crowded = True
            joint = self._joints[name] = _Joint(name, self._crowded)
        return joint
