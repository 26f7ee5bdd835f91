"""What a subscriber receives: validation of all input, whose messages count, and gaps of the estimates.

Everything from the network passes here before a client, view or recorder uses it. Binary messages have the
length of their layout. JSON documents are limited in bytes, depth, elements and text; their numbers are
finite, and their texts contain no control or direction characters and no half surrogates.

A daemon names its zenoh session in the liveliness token `<prefix>/<joint>/alive/<zid>`, and every message
carries the session that wrote it. `DaemonIdentity` accepts one session with a token until the token is gone.
Without tokens (a plain publisher, or access control) it accepts the session that writes first, until that is
stale. A session can forge its identity. What stops that is TLS and access control:
docs/how-to/secure-zenoh.md.
"""

import json
import math
import re
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from enum import StrEnum
from itertools import islice
from types import MappingProxyType
from typing import Any

import zenoh
import zenoh.ext

from drivelink.errors import ZenohError
from drivelink.plaintext import clean_text
from drivelink.pubsub.wire import EstimateMessage, decode_estimate, decode_external, decode_sample
from estimator.sample import Status

MAX_BYTES = 1 << 20  # of a document; a status has some 3 kB, a model with its nodes some 10 kB
MAX_DEPTH = 16
MAX_ELEMENTS = 20_000  # numbers, texts and containers of a document
MAX_KEY = 256  # characters of a name
_LARGEST_INTEGER = 1 << 64
_TOO_DEEP = f"document: expected at most {MAX_DEPTH} levels"


def decode_document(payload: bytes) -> dict[str, Any]:
    """Read a JSON document: `status`, `model`, `finding`.

    Non-finite numbers and integers beyond 64 bits become None.

    Raises:
        ZenohError: it is too large, too deep, or not a JSON object.
    """
    if len(payload) > MAX_BYTES:
        raise ZenohError(f"document: expected at most {MAX_BYTES} bytes, got {len(payload)}")
    try:
        document = json.loads(payload.decode("utf-8"))
    except RecursionError:
        raise ZenohError(_TOO_DEEP) from None
    except ValueError as error:
        raise ZenohError("document: expected JSON in UTF-8") from error
    if not isinstance(document, dict):
        raise ZenohError("document: expected a JSON object")
    cleaned: dict[str, Any] = _cleaned(document, iter(range(MAX_ELEMENTS)))
    return cleaned


def _cleaned(value: Any, left: Iterator[int], depth: int = 0) -> Any:
    """Return a parsed value made safe.

    Args:
        left: yields once for each element that there may still be.

    Raises:
        ZenohError: it has too many elements or levels.
    """
    if next(left, None) is None:
        raise ZenohError(f"document: expected at most {MAX_ELEMENTS} elements")
    if isinstance(value, str):
        return clean_text(value)
    if isinstance(value, bool) or value is None:
        return value
    if isinstance(value, int):
        return value if abs(value) <= _LARGEST_INTEGER else None
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if depth == MAX_DEPTH:
        raise ZenohError(_TOO_DEEP)
    if isinstance(value, list):
        return [_cleaned(item, left, depth + 1) for item in value]
    return {clean_text(key, MAX_KEY): _cleaned(item, left, depth + 1) for key, item in value.items()}


# The payloads of a joint's keys, by the last part of the key.
DECODERS: Mapping[str, Callable[[bytes], Any]] = MappingProxyType(
    {
        "estimate": decode_estimate,
        "external": decode_external,
        "sample": decode_sample,
        "status": decode_document,
        "model": decode_document,
        "finding": decode_document,
    }
)


DOCUMENTS = ("status", "model", "finding")  # the keys whose last message a new subscriber gets at once


def follow_document(session: zenoh.Session, key: str, depth: int) -> Any:
    """Subscribe to a key of `DOCUMENTS`: its last message, then each new one, `depth` of them kept unread.

    Raises:
        zenoh.ZError: it cannot be subscribed to.
    """
    history = zenoh.ext.HistoryConfig(max_samples=1, detect_late_publishers=True)
    ring: Any = zenoh.handlers.RingChannel(depth)
    return zenoh.ext.declare_advanced_subscriber(session, key, ring, history=history)


def waiting(subscriber: Any, most: int) -> Iterator[zenoh.Sample]:
    """Yield what waits in a queue, at most so much: on a busy machine more comes meanwhile, without end."""
    return islice(iter(subscriber.try_recv, None), most)


MAX_CLAIMS = 4096  # tokens of one joint; further ones are ignored, so that a flood locks nobody out
_ZID = re.compile(r"[0-9a-f]{1,32}")


def source_of(sample: zenoh.Sample) -> str:
    """Return the session that wrote a sample, or ""."""
    info = sample.source_info
    return str(info.source_id.zid) if info else ""


class DaemonIdentity:
    """The daemon of one joint, as seen by a subscriber.

    `token` may be called from zenoh's thread, all else from the subscriber's.

    Args:
        incomplete: whether tokens may be there that are not known here.
    """

    def __init__(self, incomplete: bool = False) -> None:
        self.bound: str | None = None  # the accepted session, or None
        self.refused = 0  # messages of other sessions
        self._vouched = False  # whether the bound session ever had a token
        self._claims: set[str] = set()
        self._plain = False  # whether the token without a session is there
        self._incomplete = incomplete
        self._seen = False

    @property
    def rivals(self) -> int:
        """Number of other sessions that claim to be this joint's daemon."""
        claims = self._claims
        return max(0, len(claims) - (1 if self.bound in claims or self.bound is None else 0))

    @property
    def alive(self) -> bool:
        """Whether the accepted session, or else any session, has a token."""
        if self._vouched:
            return self.bound in self._claims
        return self._plain or bool(self._claims)

    @property
    def seen(self) -> bool:
        """Whether a daemon was ever seen."""
        return self._seen or self.bound is not None

    def heard(self, token: zenoh.Sample) -> None:
        """Note that a liveliness token appeared or vanished."""
        session = str(token.key_expr).rpartition("/alive")[2].lstrip("/")
        self.token(session, token.kind == zenoh.SampleKind.PUT)

    def token(self, session: str, there: bool) -> None:
        """Note that a liveliness token appeared or vanished.

        Args:
            session: what follows `alive/` in its key; "" for the joint's own token.
        """
        self._seen = self._seen or there
        if not session:
            self._plain = there
        elif not there:
            self._claims.discard(session)
        elif _ZID.fullmatch(session):
            if len(self._claims) < MAX_CLAIMS:
                self._claims.add(session)
            else:
                self._incomplete = True

    def accepts(self, source: str, stale: bool) -> bool:
        """Return whether to accept a message of this session; the first accepted one binds to its session.

        Args:
            stale: whether the bound session is stale.
        """
        claims = self._claims
        if source == self.bound and (self._vouched or self._incomplete or source in claims or not claims):
            self._vouched = self._vouched or source in claims
            return True
        free = self.bound is None or (self.bound not in claims if self._vouched else bool(claims) or stale)
        vouched = source in claims or not claims or (self._incomplete and stale)
        if not (free and vouched):
            self.refused += 1
            return False
        self.bound = source
        self._vouched = source in claims
        return True


WAKE = b"drivelink.wake"  # attachment of a local message that ends a blocking receive
_DRIFT = 1e-4  # drift between two clocks: 100 ppm
_STALE_PERIODS = 5
_STALE_AT_LEAST_NS = 20_000_000
_STALE_UNKNOWN_NS = 500_000_000  # until two estimates have shown the period
_LONGEST_PERIOD_NS = 1_000_000_000  # upper limit of a period, against stamps that jump


class State(StrEnum):
    """State of the daemon as seen by a subscriber."""

    WAITING = "waiting"  # nothing received yet
    LIVE = "live"  # fresh estimates arrive
    STALE = "stale"  # alive, but nothing fresh arrives
    GONE = "gone"  # ended or died; may come back


class Arrivals:
    """Arrival time of the latest estimate on the local monotonic clock, without a callback per estimate.

    It lies between the last time the queue was empty and the time of reading. Within these bounds it is the
    sender's stamp plus the smallest difference of both clocks so far, which may grow by their drift.
    """

    __slots__ = ("_arrival_ns", "_empty_ns", "_offset_ns", "_read_ns")

    def __init__(self, now_ns: int) -> None:
        self._empty_ns = now_ns
        self._read_ns = now_ns
        self._arrival_ns = now_ns
        self._offset_ns: int | None = None

    def came(self, stamp_ns: int, now_ns: int) -> None:
        """Note an estimate with this stamp read from the queue now."""
        difference = now_ns - stamp_ns
        if self._offset_ns is not None:
            drift = int((now_ns - self._read_ns) * _DRIFT)
            difference = min(self._offset_ns + drift, difference)
        self._offset_ns = difference
        self._read_ns = now_ns
        self._arrival_ns = min(max(stamp_ns + self._offset_ns, self._empty_ns), now_ns)

    def empty(self, now_ns: int) -> None:
        """Note that the queue is empty now."""
        self._empty_ns = now_ns

    def age_ns(self, now_ns: int) -> int:
        """Return the time since the arrival of the latest estimate."""
        return now_ns - self._arrival_ns


class Feed:
    """Estimates of one joint."""

    def __init__(self, depth: int, stale_after_s: float | None, now_ns: int) -> None:
        self.latest: EstimateMessage | None = None  # the newest estimate, or None
        # decoded and not yet handed to the user, oldest first
        self.unread: deque[tuple[bytes, EstimateMessage]] = deque(maxlen=depth)
        self.received = 0  # estimates admitted
        self.gaps = 0  # cycles lost in transport or by the daemon
        self.skipped = 0  # cycles dropped here because they were not read in time
        self.unusable = 0  # messages of the daemon that are malformed, or valid with impossible values
        self.arrivals = Arrivals(now_ns)
        self.identity = DaemonIdentity()  # whose messages are taken
        self._depth = depth
        self._stale_after_ns = None if stale_after_s is None else stale_after_s * 1e9
        self._period_ns = 0
        self._source: str | None = None  # session that wrote the latest estimate

    def trusts(self, source: str, now_ns: int) -> bool:
        """Return whether a message of this session is from the daemon; see `DaemonIdentity.accepts`."""
        identity = self.identity
        return identity.accepts(source, source != identity.bound and self.stale(now_ns))

    def admit(self, payload: bytes, now_ns: int, overrun: bool) -> EstimateMessage | None:
        """Decode one message of a trusted source; None: not an estimate.

        Args:
            now_ns: local monotonic clock.
            overrun: whether older messages were dropped here, unread, before this one.
        """
        try:
            message: EstimateMessage = DECODERS["estimate"](payload)
        except ZenohError:
            self.unusable += 1
            return None
        if self._source == self.identity.bound:
            self._count(message, overrun)
        self._source = self.identity.bound
        self.arrivals.came(message.stamp_ns, now_ns)
        self.received += 1
        if len(self.unread) == self._depth:
            self.skipped += 1
        self.unread.append((payload, message))
        self.latest = message
        return message

    def _count(self, message: EstimateMessage, overrun: bool) -> None:
        before = self.latest
        step = 0 if before is None else message.sequence - before.sequence
        if before is None or step < 1 or (step == 1 and self._period_ns):  # below 1: the daemon restarted
            return
        if overrun:
            self.skipped += step - 1
        else:
            self.gaps += step - 1
        elapsed_ns = message.stamp_ns - before.stamp_ns
        if elapsed_ns > 0:
            self._period_ns = min(elapsed_ns // step, _LONGEST_PERIOD_NS)

    def stale(self, now_ns: int) -> bool:
        """Return whether the latest estimate is too old to act on, or marked stale."""
        if self.latest is None or self.latest.status & Status.STALE:
            return True
        limit_ns = self._stale_after_ns
        if limit_ns is None:
            known = max(_STALE_PERIODS * self._period_ns, _STALE_AT_LEAST_NS)
            limit_ns = known if self._period_ns else _STALE_UNKNOWN_NS
        return self.arrivals.age_ns(now_ns) > limit_ns

    def state(self, now_ns: int) -> State:
        """Return the daemon's state, seen from here."""
        if not self.stale(now_ns):
            return State.LIVE
        if self.identity.alive:
            return State.STALE if self.latest is not None else State.WAITING
        return State.GONE if self.identity.seen else State.WAITING
