"""Decides which session's messages of a joint are accepted.

A daemon names its zenoh session in the liveliness token `<prefix>/<joint>/alive/<zid>`, and every message
carries the session that wrote it. `DaemonIdentity` accepts one session with a token until the token is gone.
Without tokens (a plain publisher, or access control) it accepts the session that writes first, until that is
stale.

A session can forge its identity. What stops that is TLS and access control: docs/how-to/secure-zenoh.md.
"""

from __future__ import annotations

import re

import zenoh

MAX_CLAIMS = (
    4096  # limit on tokens of one joint; beyond it tokens are ignored, so that a flood locks nobody out
)
_ZID = re.compile(r"[0-9a-f]{1,32}")


def source_of(sample: zenoh.Sample) -> str:
    """Return the session that wrote a sample, or ""."""
    info = sample.source_info
    return str(info.source_id.zid) if info else ""


class DaemonIdentity:
    """The daemon of one joint, as seen by a subscriber.

    `token` may be called from zenoh's thread, all else from the subscriber's.
    """

    def __init__(self) -> None:
        self.bound: str | None = None  # the accepted session, or None
        self.refused = 0  # messages of other sessions
        self._vouched = False  # whether the bound session ever had a token
        self._claims: set[str] = set()
        self._plain = False  # whether the token without a session is there
        self._overflow = False
        self._seen = False

    @property
    def claims(self) -> frozenset[str]:
        """Sessions that claim to be this joint's daemon."""
        return frozenset(self._claims)

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
        """Take a liveliness token that appeared or vanished."""
        session = str(token.key_expr).rpartition("/alive")[2].lstrip("/")
        self.token(session, token.kind == zenoh.SampleKind.PUT)

    def token(self, session: str, there: bool) -> None:
        """A liveliness token appeared or vanished.

        Args:
            session: what follows `alive/` in its key; "" for the joint's own token.
            there: whether it appeared.
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
                self._overflow = True

    def accepts(self, source: str, stale: bool) -> bool:
        """Return whether to accept a message of this session; the first accepted one binds to its session.

        Args:
            stale: whether the bound session is stale.
        """
        claims = self._claims
        if source == self.bound and (self._vouched or source in claims or not claims):
            self._vouched = self._vouched or source in claims
            return True
        free = self.bound is None or (self.bound not in claims if self._vouched else bool(claims) or stale)
        vouched = source in claims or not claims or (self._overflow and stale)
        if not (free and vouched):
            self.refused += 1
            return False
        self.bound = source
        self._vouched = source in claims
        return True
