"""python-can's socketcand client, which waits forever when its server is gone: here that is a lost bus."""

from __future__ import annotations

import socket
from typing import Any

from drivelink.cycle.framesource import BusLostError, BusSource

__all__ = ["SocketcandSource"]


class SocketcandSource(BusSource):
    """A socketcand connection."""

    def __init__(self, bus: Any) -> None:
        super().__init__(bus)
        # The only way to it; a client that merely listens would notice nothing otherwise.
        self._socket: socket.socket = bus._SocketCanDaemonBus__socket

    def wait(self, timeout_s: float) -> bool:
        """See FrameSource."""
        if super().wait(timeout_s):
            return True
        try:
            closed = self._socket.recv(1, socket.MSG_PEEK | socket.MSG_DONTWAIT) == b""
        except BlockingIOError:
            return False
        except OSError as error:
            raise BusLostError(str(error)) from error
        if closed:
            raise BusLostError("the server has closed the connection")
        return False
