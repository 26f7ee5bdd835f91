"""A publisher of the cycle, which knows whether anybody subscribes."""

from __future__ import annotations

from typing import Any

import zenoh


class Stream:
    """Puts bytes with the identity of the writing session."""

    __slots__ = ("_listener", "_publisher", "_source", "wanted")

    def __init__(self, publisher: zenoh.Publisher) -> None:
        self._publisher = publisher
        self._source = zenoh.SourceInfo(publisher.id, 0)
        self.wanted = False  # whether there is a subscriber; set by zenoh's thread
        # indirect=False: in zenoh's thread, which never keeps the process from ending
        heard = zenoh.handlers.Callback(self._match, indirect=False)
        self._listener = publisher.declare_matching_listener(heard)
        before: Any = publisher.matching_status  # its stub says bool
        self.wanted = self.wanted or before.matching

    def _match(self, status: zenoh.MatchingStatus) -> None:
        self.wanted = status.matching

    def put(self, payload: bytes, attachment: bytes | None = None) -> None:
        """Put a message; a full queue drops it unless the publisher waits."""
        self._publisher.put(payload, attachment=attachment, source_info=self._source)
