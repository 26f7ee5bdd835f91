"""What daemons say on zenoh, gathered for the live views: joints come and go, views are kept up to date."""

from __future__ import annotations

import json
from typing import Any

import zenoh
import zenoh.ext

from drivelink.errors import ZenohError
from drivelink.monitor.view import JointView
from drivelink.pubsub.wire import decode_estimate

__all__ = ["Watcher"]

_QUEUE = 8192


class Watcher:
    """Follows one joint or all of them.

    Args:
        session: an open session; it stays open.
        prefix: first part of every key.
        joint: only this one; None: every joint that there is.

    Attributes:
        views: by the joint's name, those seen so far.
        alive: names of the joints whose daemon is there.
        received: estimates taken in.
    """

    def __init__(self, session: zenoh.Session, prefix: str = "drivelink", joint: str | None = None) -> None:
        self.views: dict[str, JointView] = {}
        self.alive: set[str] = set()
        self.received = 0
        ring = zenoh.handlers.RingChannel
        key = f"{prefix}/{joint or '*'}"
        history = zenoh.ext.HistoryConfig(max_samples=1, detect_late_publishers=True)
        try:
            self._estimates: Any = session.declare_subscriber(f"{key}/estimate", ring(_QUEUE))
            self._status: Any = zenoh.ext.declare_advanced_subscriber(
                session, f"{key}/status", ring(256), history=history
            )
            self._tokens: Any = session.liveliness().declare_subscriber(
                f"{key}/alive", ring(256), history=True
            )
        except zenoh.ZError as error:
            raise ZenohError(f"{key}: cannot be subscribed to: {error}") from error
        if joint is not None:
            self._view(joint)

    def poll(self) -> None:
        """Take in everything that has come since."""
        while (token := self._tokens.try_recv()) is not None:
            name = _joint(token)
            if token.kind == zenoh.SampleKind.PUT:
                self.alive.add(name)
                self._view(name)
            else:
                self.alive.discard(name)
        while (document := self._status.try_recv()) is not None:
            try:
                status: Any = json.loads(document.payload.to_bytes())
            except ValueError:
                continue
            if isinstance(status, dict):
                self._view(_joint(document)).status = status
        while (message := self._estimates.try_recv()) is not None:
            try:
                estimate = decode_estimate(message.payload.to_bytes())
            except ZenohError:
                continue
            self.received += 1
            self._view(_joint(message)).update(estimate, estimate.stamp_ns * 1e-9)
        for name, view in self.views.items():
            view.gone = name not in self.alive and view.history.latest is not None

    def close(self) -> None:
        """Stop following."""
        for subscriber in (self._estimates, self._status, self._tokens):
            subscriber.undeclare()

    def _view(self, name: str) -> JointView:
        view = self.views.get(name)
        if view is None:
            view = self.views[name] = JointView(name)
        return view


def _joint(sample: zenoh.Sample) -> str:
    """The joint's name, the part of the key before the last."""
    return str(sample.key_expr).split("/")[-2]
