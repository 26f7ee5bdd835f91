"""The bus of simulated devices: opened or served, and joined where another process serves it."""

from __future__ import annotations

import errno
from collections.abc import Callable, Sequence

import can

from drivelink.canopen.bus import open_bus, server_has_gone
from drivelink.canopen.scan import scan
from drivelink.demo.socketcand import DEFAULT_PORT, SocketcandServer
from drivelink.errors import BusError
from drivelink.jointfile import BusSection

_LOCAL = ("127.0.0.1", "localhost", "::1")


def open_sim_bus(section: BusSection) -> can.BusABC:
    """Open the bus of a joint file from the devices' side.

    For `interface = "socketcand"` at an unused address of this machine, serve it: the daemon, or a second
    simulation, then connects to it. If it is already served, return a `JoinedBus`.

    Raises:
        BusError: it cannot be opened.
    """
    host = str(section.options.get("host", "127.0.0.1"))
    if section.interface == "socketcand" and host in _LOCAL:
        port = section.options.get("port", DEFAULT_PORT)
        if not (isinstance(port, int) and 0 <= port <= 0xFFFF):
            raise BusError(f"bus.options.port: expected 0 to 65535, got {port!r}")
        try:
            return SocketcandServer(section.channel, host, port)
        except OSError as error:
            if error.errno != errno.EADDRINUSE:
                raise BusError(f"socketcand at {host}:{port} cannot be served: {error.strerror}") from error
    bus = open_bus(section)
    return JoinedBus(bus) if section.interface == "socketcand" else bus


class JoinedBus(can.BusABC):
    """A socketcand bus that another process serves; detects its end.

    python-can's client then returns immediately without a frame, forever.

    Args:
        bus: python-can's client.
    """

    def __init__(self, bus: can.BusABC) -> None:
        self._is_shutdown = False
        self._bus = bus
        self.lost = False  # whether the server has closed the connection
        self.on_lost: Callable[[], object] = lambda: None  # called then
        self.channel_info = bus.channel_info
        super().__init__(channel=bus.channel_info)

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """Send a frame."""
        self._bus.send(msg, timeout)

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        found = self._bus._recv_internal(timeout)
        if found[0] is None and server_has_gone(self._bus):
            self.lost = True
            self.on_lost()
            raise can.CanOperationError("the server has closed the connection")
        return found

    def shutdown(self) -> None:
        """Close the connection."""
        super().shutdown()
        self._bus.shutdown()


def require_free(bus: can.BusABC, node_ids: Sequence[int], section: BusSection) -> None:
    """Check that no other device uses a simulated device's node id.

    Raises:
        BusError: another simulation of the joint, or a real drive, does.
    """
    if section.interface == "virtual" or isinstance(bus, SocketcandServer):
        return  # no other process can be there
    there, _ = scan(bus, node_ids)
    taken = sorted(set(node_ids).intersection(there))
    if taken:
        nodes = ", ".join(f"node {node}" for node in taken)
        raise BusError(
            f"{section.interface} {section.channel}: {nodes}: on the bus already: another `drivelink sim`, "
            "or real drives; end it, or use another --channel"
        )
