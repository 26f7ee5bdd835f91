"""Common part of the blocking and the asyncio client: everything that does not wait; which joints are alive.

Estimates queue in zenoh, outside the interpreter, until a method is called.
"""

import difflib
import logging
import math
import re
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from numbers import Integral, Real
from pathlib import Path
from typing import Any

import numpy as np
import zenoh
from numpy.typing import NDArray

from drivelink.errors import ZenohError, require
from drivelink.plaintext import clean_text, natural
from drivelink.pubsub.feed import DECODERS, DOCUMENTS, WAKE, Feed, State, follow_document, source_of
from drivelink.pubsub.session import ENDPOINT, close_session, connected, one_line, open_client
from drivelink.pubsub.wire import ESTIMATE, EstimateMessage, ExternalMessage
from estimator.sample import Status

PATIENCE_S = 3.0  # without a sign of the daemon, until something is said
_MOST = 64  # names that are kept, also against invented ones
_SHOWN = 12
_ANSWER_S = 1.0


def joints(
    *, endpoint: str = ENDPOINT, config: str | Path | None = None, prefix: str = "drivelink"
) -> list[str]:
    """List the joints whose daemons are alive.

    Args:
        endpoint: where a daemon or a router listens.
        config: a zenoh configuration file (JSON5) instead.

    Raises:
        ZenohError: no session can be opened.
        ArgumentError: an argument is wrong.
    """
    _require_place(endpoint, config, prefix)
    session = open_client(endpoint, config)
    try:
        if not connected(session):
            return []
        names: set[str] = set()
        for reply in session.liveliness().get(f"{prefix}/*/alive/**", timeout=_ANSWER_S):
            _enter(names, reply, prefix)
        return sorted(names, key=natural)
    finally:
        close_session(session)


def ask(session: zenoh.Session, prefix: str, answer: Callable[[list[str]], None]) -> None:
    """Call `answer` in zenoh's thread with the names; never waits."""
    names: set[str] = set()
    handler: zenoh.handlers.Callback[zenoh.Reply] = zenoh.handlers.Callback(
        lambda reply: _enter(names, reply, prefix),
        drop=lambda: answer(sorted(names, key=natural)),
        indirect=False,
    )
    with suppress(zenoh.ZError):
        session.liveliness().get(f"{prefix}/*/alive/**", handler, timeout=_ANSWER_S)


def absent(joint: str, names: Sequence[str]) -> str:
    """Report that a joint has no daemon, and which others have one."""
    if not names:
        none = f'no daemon of "{joint}" answers, nor of any other joint'
        return f"{none}: drivelink run JOINT starts one; or a router is missing"
    near = difflib.get_close_matches(joint, names, n=1, cutoff=0.5)
    guess = f'; did you mean "{clean_text(near[0], _MOST)}"?' if near else ""
    shown = ", ".join(clean_text(name, _MOST) for name in names[:_SHOWN])
    others = f", only of {shown}{', …' if len(names) > _SHOWN else ''}" if names[1:] or not near else ""
    return f'no daemon of "{joint}"{others}{guess}'


def _enter(names: set[str], reply: zenoh.Reply, prefix: str) -> None:
    if reply.ok is not None and len(names) < _MOST:
        names.add(str(reply.ok.key_expr).removeprefix(f"{prefix}/").split("/alive", 1)[0])


_LOG = logging.getLogger("drivelink.client")
_TOGETHER = 5  # largest distance in cycles between estimate and external torque, as either may be lost
_MOST_UNREAD = 1 << 20  # zenoh reserves a queue's memory at once, 256 MB for so many
_NAME = re.compile(r"[^*$#?\s/]+(/[^*$#?\s/]+)*")


def _require_name(argument: str, value: object) -> None:
    good = isinstance(value, str) and _NAME.fullmatch(value) is not None
    require(argument, value, good, "a name without wildcards or spaces")


def _require_place(endpoint: object, config: object, prefix: object) -> None:
    _require_name("prefix", prefix)
    require("endpoint", endpoint, isinstance(endpoint, str), f"text like {ENDPOINT!r}")
    good = config is None or (isinstance(config, str | Path) and str(config) not in ("", "."))
    require("config", config, good, "the path of a zenoh configuration file")


def require_timeout(timeout_s: object) -> None:
    """Refuse what is no time to wait; one that is over is none to wait.

    Raises:
        ArgumentError: it is neither None nor a number.
    """
    good = timeout_s is None or (isinstance(timeout_s, Real) and timeout_s == timeout_s)
    require("timeout_s", timeout_s, good, "seconds, or None to wait forever")


class Client:
    """Methods of both clients that do not wait."""

    def __init__(
        self,
        joint: str,
        *,
        endpoint: str = ENDPOINT,
        config: str | Path | None = None,
        prefix: str = "drivelink",
        session: zenoh.Session | None = None,
        depth: int = 1024,
        stale_after_s: float | None = None,
    ) -> None:
        _require_name("joint", joint)
        _require_place(endpoint, config, prefix)
        good = session is None or (isinstance(session, zenoh.Session) and not session.is_closed())
        require("session", session, good, "an open zenoh session")
        good = isinstance(depth, Integral) and 1 <= depth <= _MOST_UNREAD
        require("depth", depth, good, f"a whole number from 1 to {_MOST_UNREAD}")
        good = stale_after_s is None or (isinstance(stale_after_s, Real) and stale_after_s > 0.0)
        require("stale_after_s", stale_after_s, good, "seconds above 0")
        self.joint = joint
        self.key = f"{prefix}/{joint}"
        self._depth = depth
        self._owned = session is None
        self._session = open_client(endpoint, config) if session is None else session
        self._feed = Feed(depth, stale_after_s, time.monotonic_ns())
        self._messages: dict[str, tuple[str | None, Any]] = {}  # the newest of each key: who wrote it, what
        self._closed = False
        self._leaving = threading.RLock()  # who closes second waits until the first is done
        self._prefix = prefix
        self._hint_s = time.monotonic() + PATIENCE_S  # when to say that there is no daemon
        try:
            self._declare()
        except zenoh.ZError as error:
            self.close()
            raise ZenohError(f"{self.key}: {one_line(error)}") from error

    def _declare(self) -> None:
        liveliness = self._session.liveliness()
        # In zenoh's thread (indirect=False), which does not block the process's end; no token is dropped.
        heard = zenoh.handlers.Callback(self._feed.identity.heard, indirect=False)
        self._tokens = liveliness.declare_subscriber(f"{self.key}/alive/**", heard, history=True)
        self._estimates = self._declare_estimates(self.key + "/estimate")
        external = self._session.declare_subscriber(self.key + "/external", zenoh.handlers.RingChannel(1))
        self._newest_of = {"external": external} | {
            name: follow_document(self._session, f"{self.key}/{name}", 4) for name in DOCUMENTS
        }

    def _declare_estimates(self, key: str) -> zenoh.Subscriber[Any]:
        raise NotImplementedError

    def _pop(self) -> zenoh.Sample | None:
        raise NotImplementedError

    @property
    def _fed(self) -> Feed:
        """The feed, with all messages that are queued in zenoh."""
        self._drain()
        return self._feed

    def latest(self) -> EstimateMessage | None:
        """Return the newest estimate, without waiting; None until the first one came."""
        return self._fed.latest

    def take(self) -> NDArray[np.void]:
        """Return every estimate not yet read, oldest first, as one numpy record array; never waits.

        Fields are those of the wire (`drivelink.pubsub.wire.ESTIMATE`): `a["stiffness_nm_rad"]` is (n,),
        `a["transmissions"]["deflection_rad"]` is (n, transmissions).
        """
        unread = self._fed.unread
        count = len(unread[-1][1].transmissions) if unread else 1
        dtype = ESTIMATE.dtype(count)
        joined = b"".join(payload for payload, _ in unread if len(payload) == dtype.itemsize)
        unread.clear()
        return np.frombuffer(joined, dtype)

    @property
    def state(self) -> State:
        """waiting, live, stale or gone."""
        return self._fed.state(time.monotonic_ns())

    @property
    def age_s(self) -> float:
        """Time since the latest estimate arrived, by the local clock, s; infinite before the first."""
        if self._fed.latest is None:
            return math.inf
        return self._feed.arrivals.age_ns(time.monotonic_ns()) / 1e9

    @property
    def stale(self) -> bool:
        """Whether the latest estimate is too old to act on, or missing."""
        return self._fed.stale(time.monotonic_ns())

    @property
    def usable(self) -> bool:
        """Whether the newest estimate, that of `latest()`, is usable and fresh.

        An estimate in hand answers for itself: `estimate.usable`.
        """
        latest = self.latest()
        return latest is not None and latest.usable and not self.stale

    @property
    def valid(self) -> bool:
        """Whether the newest estimate, that of `latest()`, is fresh and valid."""
        return self._fresh(Status.VALID)

    @property
    def observable(self) -> bool:
        """Whether the newest estimate, that of `latest()`, is fresh and observable."""
        return self._fresh(Status.OBSERVABLE)

    @property
    def external(self) -> ExternalMessage | None:
        """External torque on the link by the newest message, without waiting.

        None: none belongs to the latest estimates; link dynamics may not be declared.
        """
        newest: ExternalMessage | None = self._message("external")
        estimate = self._feed.latest
        if newest is None or estimate is None or self.stale:
            return None
        return newest if abs(estimate.sequence - newest.sequence) <= _TOGETHER else None

    @property
    def contact(self) -> bool:
        """Whether a fresh and valid message reports a contact."""
        external = self.external
        return external is not None and external.contact

    @property
    def gaps(self) -> int:
        """Missing cycles, by sequence numbers."""
        return self._fed.gaps

    @property
    def skipped(self) -> int:
        """Cycles dropped because more than `depth` were unread."""
        return self._fed.skipped

    @property
    def received(self) -> int:
        """Number of received estimates."""
        return self._fed.received

    @property
    def foreign(self) -> int:
        """Unused messages on the joint's keys: of other sessions, or invalid."""
        return self._fed.identity.refused + self._feed.unusable

    @property
    def daemon(self) -> str | None:
        """The zenoh session whose messages are used, or None."""
        return self._fed.identity.bound

    @property
    def rivals(self) -> int:
        """Other sessions that claim to be the daemon of this joint; their messages are ignored."""
        return self._feed.identity.rivals

    @property
    def status(self) -> dict[str, Any] | None:
        """The daemon's last status, or None."""
        return self._message("status")  # type: ignore[no-any-return]

    @property
    def model(self) -> dict[str, Any] | None:
        """The model in use, or None."""
        return self._message("model")  # type: ignore[no-any-return]

    @property
    def finding(self) -> dict[str, Any] | None:
        """What the newest diagnosis of a kept recording found, or None."""
        return self._message("finding")  # type: ignore[no-any-return]

    def close(self) -> None:
        """Close the session; a second time does nothing."""
        self._closed = True
        with self._leaving:
            entities = [getattr(self, name, None) for name in ("_estimates", "_tokens")]
            for entity in (*entities, *getattr(self, "_newest_of", {}).values()):
                with suppress(zenoh.ZError, AttributeError):
                    entity.undeclare()
            if self._owned:
                close_session(self._session)

    def _fresh(self, bit: Status) -> bool:
        latest = self._fed.latest
        return latest is not None and bool(latest.status & bit) and not self.stale

    def _message(self, name: str) -> Any:
        """Return the newest message of a key that the daemon wrote, or None."""
        identity = self._fed.identity
        with suppress(zenoh.ZError):
            while (sample := self._newest_of[name].try_recv()) is not None:
                if self._feed.trusts(source_of(sample), time.monotonic_ns()):
                    try:
                        self._messages[name] = identity.bound, DECODERS[name](sample.payload.to_bytes())
                    except ZenohError:
                        self._feed.unusable += 1
        writer, message = self._messages.get(name, (None, None))
        return message if writer == identity.bound else None

    def _hint(self) -> None:
        """Report once that there is no daemon of this name, and which others there are; never waits."""
        if time.monotonic() < self._hint_s:
            return
        self._hint_s = math.inf
        if not self._feed.identity.seen:
            ask(self._session, self._prefix, lambda names: _LOG.warning("%s", absent(self.joint, names)))

    def _drain(self) -> None:
        """Process all messages queued in zenoh."""
        if self._closed:
            return
        self._hint()
        with suppress(zenoh.ZError):  # closed meanwhile by another thread
            samples: list[zenoh.Sample] = []
            while len(samples) < self._depth and (sample := self._pop()) is not None:
                samples.append(sample)
            now_ns = time.monotonic_ns()
            overrun = len(samples) == self._depth
            for sample in samples:
                self._admit(sample, now_ns, overrun)
                overrun = False
            if len(samples) < self._depth:
                self._feed.arrivals.empty(now_ns)

    def _admit(self, sample: zenoh.Sample, now_ns: int, overrun: bool = False) -> None:
        payload = sample.payload.to_bytes()
        if not payload and (attachment := sample.attachment) and attachment.to_bytes() == WAKE:
            return
        if self._feed.trusts(source_of(sample), now_ns):
            self._feed.admit(payload, now_ns, overrun)

    def _newest(self) -> EstimateMessage | None:
        unread = self._feed.unread
        if not unread:
            return None
        message = unread[-1][1]
        unread.clear()
        return message

    def _oldest(self) -> EstimateMessage | None:
        unread = self._feed.unread
        return unread.popleft()[1] if unread else None
