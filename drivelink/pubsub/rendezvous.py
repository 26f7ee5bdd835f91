"""Takes over the common endpoint when the session that listened there is gone.

Zenoh can retry a listener itself, but such a session takes ten seconds to close (1.10). Therefore a daemon
that lost a connection checks whether anything answers at the endpoint; if not, it opens another session that
only listens there. Daemons and clients keep reconnecting to the endpoint. A router is not replaced: it will
restart.
"""

from __future__ import annotations

import json
import re
import socket
import threading
from typing import Any

import zenoh

_ATTEMPT_S = 0.2
_LOOKS = 3  # consecutive answers required: a killed process loses its connections before its listener
_CONNECT_S = 0.5


def answers(endpoint: str) -> bool:
    """Return whether anything accepts a TCP connection at the endpoint."""
    address = _address(endpoint)
    if address is None:
        return False
    try:
        with socket.create_connection(address, timeout=_CONNECT_S):
            return True
    except OSError:
        return False


def _address(endpoint: str) -> tuple[str, int] | None:
    match = re.fullmatch(r"(?:tcp|tls)/\[?([^\[\]#?]+?)\]?:(\d+)(?:[#?].*)?", endpoint)
    return (match[1], int(match[2])) if match else None


class Rendezvous:
    """Takes over the endpoint of a dead daemon on this machine."""

    def __init__(self, endpoint: str) -> None:
        self._endpoint = endpoint
        address = _address(endpoint)
        self._here = address is not None and (address[0] == "localhost" or address[0].startswith("127."))
        self._routed = False  # whether a router was ever there
        self._closed = threading.Event()
        self._lock = threading.Lock()
        self._thread: threading.Thread | None = None
        self._session: zenoh.Session | None = None
        self._listener: Any = None

    def watch(self, session: zenoh.Session) -> None:
        """Check the endpoint whenever this session loses a connection."""
        if self._here:
            # indirect=False: in zenoh's thread, which never keeps the process from ending
            handler = zenoh.handlers.Callback(self._changed, indirect=False)
            self._listener = session.info.declare_transport_events_listener(handler, history=True)

    def close(self) -> None:
        """Stop listening; a second time does nothing."""
        self._closed.set()
        with self._lock:
            thread, session = self._thread, self._session
            self._session = None
        if thread is not None:
            thread.join()
        if session is not None:
            session.close()  # type: ignore[no-untyped-call]

    def _changed(self, event: zenoh.TransportEvent) -> None:
        if event.transport.whatami == zenoh.WhatAmI.ROUTER:
            self._routed = True
        if event.kind != zenoh.SampleKind.DELETE or self._routed:
            return
        with self._lock:
            busy = self._thread is not None and self._thread.is_alive()
            if not busy and self._session is None and not self._closed.is_set():
                self._thread = threading.Thread(target=self._follow, name="drivelink-rendezvous", daemon=True)
                self._thread.start()

    def _follow(self) -> None:
        answered = 0
        while answered < _LOOKS and not self._closed.wait(_ATTEMPT_S if answered else 0.0):
            if answers(self._endpoint):
                answered += 1
            elif self._listen():
                return
            else:  # another daemon was quicker, or the port is not free yet
                answered = 0
                self._closed.wait(_ATTEMPT_S)

    def _listen(self) -> bool:
        config = zenoh.Config()
        settings = {
            "mode": "peer",
            "listen/endpoints": [self._endpoint],
            "scouting/multicast/enabled": False,
            "adminspace/enabled": False,
            "transport/shared_memory/enabled": False,
        }
        for key, value in settings.items():
            config.insert_json5(key, json.dumps(value))
        try:
            session = zenoh.open(config)
        except zenoh.ZError:
            return False
        with self._lock:
            if not self._closed.is_set():
                self._session = session
                return True
        session.close()  # type: ignore[no-untyped-call]
        return True
