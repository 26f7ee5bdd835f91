"""Bookkeeping of a subscriber: arrivals, sources and gaps of estimates.

Shared by the blocking and the asyncio client, without waiting. It processes zenoh's queue when the user calls
a method, so that nothing runs while the user computes.
"""

from __future__ import annotations

from collections import deque
from enum import StrEnum

from drivelink.errors import ZenohError
from drivelink.pubsub.identity import DaemonIdentity
from drivelink.pubsub.inbound import DECODERS
from drivelink.pubsub.wire import EstimateMessage
from estimator.sample import Status

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
        if self._offset_ns is None:
            self._offset_ns = difference
        else:
            drift = int((now_ns - self._read_ns) * _DRIFT)
            self._offset_ns = min(self._offset_ns + drift, difference)
        self._read_ns = now_ns
        self._arrival_ns = min(max(stamp_ns + self._offset_ns, self._empty_ns), now_ns)

    def empty(self, now_ns: int) -> None:
        """Note that the queue is empty now."""
        self._empty_ns = now_ns

    def age_ns(self, now_ns: int) -> int:
        """Return the time since the arrival of the latest estimate."""
        return now_ns - self._arrival_ns


class Feed:
    """Estimates of one joint.

    Attributes:
        latest: the newest estimate, or None.
        unread: decoded and not yet handed to the user, oldest first.
        received: estimates admitted.
        gaps: cycles lost in transport or by the daemon.
        skipped: cycles dropped here because they were not read in time.
        unusable: messages of the daemon that are malformed, or valid with impossible values.
        identity: whose messages are taken.
    """

    def __init__(self, depth: int, stale_after_s: float | None, now_ns: int) -> None:
        self.latest: EstimateMessage | None = None
        self.unread: deque[tuple[bytes, EstimateMessage]] = deque(maxlen=depth)
        self.received = self.gaps = self.skipped = self.unusable = 0
        self.arrivals = Arrivals(now_ns)
        self.identity = DaemonIdentity()
        self._depth = depth
        self._stale_after_ns = None if stale_after_s is None else int(stale_after_s * 1e9)
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
        if before is None:
            return
        step = message.sequence - before.sequence
        if step == 1 and self._period_ns:
            return
        if step < 1:  # the daemon restarted
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
