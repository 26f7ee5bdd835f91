"""python-can's socketcand client with detection of a closed connection, for which it would wait forever."""

from __future__ import annotations

from drivelink.canopen.bus import server_has_gone
from drivelink.cycle.framesource import BusLostError, BusSource


class SocketcandSource(BusSource):
    """A socketcand connection."""

    def wait(self, timeout_s: float) -> bool:
        """See FrameSource."""
        if super().wait(timeout_s):
            return True
        if server_has_gone(self._bus):
            raise BusLostError("the server has closed the connection")
        return False
