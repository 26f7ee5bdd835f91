"""The bus of simulated devices: opened or served between processes by the socketcand protocol over TCP.

Every client (such as python-can's `socketcand` interface) is a node on this bus, and so is the serving
process: `SocketcandServer` is itself a python-can bus. Raw mode only, no CAN FD. See
https://github.com/linux-can/socketcand/blob/master/doc/protocol.md.
"""

import errno
import selectors
import socket
import struct
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from statistics import median
from typing import Any

import can

from drivelink.canopen.bus import open_bus, server_has_gone
from drivelink.canopen.scan import scan
from drivelink.errors import BusError
from drivelink.jointfile import BusSection

DEFAULT_PORT = 29536

_LARGEST_BACKLOG = 1 << 20  # unread bytes at which a client is dropped
_LONGEST_COMMAND = 1 << 12
_READS = 15  # whose median is the usual step, though some have frames between two SYNCs
_SETTLE_S = 0.05  # python-can's client takes its greeting for one whole read: no frame may follow at once
_CHUNK = 1 << 16
_SO_TIMESTAMPNS = 35  # socket(7): the kernel stamps what arrives; Linux
_STAMP = struct.Struct("@qq")  # s, ns


@dataclass(slots=True, eq=False)
class _Client:
    """One connection: protocol state and unsent bytes."""

    socket: socket.socket
    received: str = ""
    stamp_s: float = field(default_factory=time.time)  # of what was received last
    # between what was received: of the last reads
    steps_s: deque[float] = field(default_factory=lambda: deque(maxlen=_READS))
    unsent: bytearray = field(default_factory=bytearray)
    open: bool = False
    raw: bool = False
    hold_until_s: float = 0.0
    pending: list[bytes] = field(default_factory=list)


class SocketcandServer(can.BusABC):
    """Serves one CAN channel to any number of clients; frames pass between all of them and this process.

    Args:
        channel: name that clients have to open; empty: any name.
        port: TCP port; 0 takes a free one.

    Raises:
        OSError: the address cannot be used.
    """

    def __init__(
        self, channel: str = "", host: str = "127.0.0.1", port: int = DEFAULT_PORT, **kwargs: Any
    ) -> None:
        self._is_shutdown = True  # nothing to close yet, python-can, if the next line fails
        self._writing = threading.RLock()  # one thread may send while another one receives
        self._listener = socket.create_server((host, port))
        self._is_shutdown = False
        self._selector = selectors.DefaultSelector()
        self._clients: list[_Client] = []
        self._frames: deque[can.Message] = deque()
        self._listener.setblocking(False)
        self._selector.register(self._listener, selectors.EVENT_READ, None)
        self.port: int = self._listener.getsockname()[1]  # the port in use
        self.channel = channel
        self.channel_info = f"socketcand server for {channel or 'any channel'} at {host}:{self.port}"
        super().__init__(channel=channel, **kwargs)

    # The bus

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """Send a frame to every client; `timeout` is not needed, nothing blocks."""
        if msg.is_fd:
            raise can.CanOperationError("socketcand carries no CAN FD frames")
        self._broadcast(_frame(msg, time.time()), None)

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        if not self._frames:
            self._serve(timeout)
        return (self._frames.popleft() if self._frames else None), False

    def shutdown(self) -> None:
        """Close every connection."""
        super().shutdown()
        for client in list(self._clients):
            self._drop(client)
        self._selector.close()
        self._listener.close()

    # The clients

    def _serve(self, timeout: float | None) -> None:
        if timeout is not None and any(client.pending for client in self._clients):
            timeout = min(timeout, _SETTLE_S)
        for key, events in self._selector.select(timeout):
            client = key.data
            if client is None:
                self._accept()
                continue
            if events & selectors.EVENT_READ:
                self._read(client)
            if events & selectors.EVENT_WRITE and client in self._clients:
                self._flush(client)
        now_s = time.monotonic()
        for client in list(self._clients):
            if client.pending and now_s >= client.hold_until_s:  # held back after a greeting
                waiting, client.pending = b"".join(client.pending), []
                self._write(client, waiting)

    def _accept(self) -> None:
        connection, _ = self._listener.accept()
        connection.setblocking(False)
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        if sys.platform == "linux":
            connection.setsockopt(socket.SOL_SOCKET, _SO_TIMESTAMPNS, 1)
        client = _Client(connection)
        self._clients.append(client)
        self._selector.register(connection, selectors.EVENT_READ, client)
        self._write(client, b"< hi >")

    def _drop(self, client: _Client) -> None:
        with self._writing:
            if client in self._clients:
                self._clients.remove(client)
                self._selector.unregister(client.socket)
                client.socket.close()

    def _read(self, client: _Client) -> None:
        ancillary: list[tuple[int, int, bytes]] = []
        try:
            data, ancillary, _, _ = client.socket.recvmsg(_CHUNK, socket.CMSG_SPACE(_STAMP.size))
        except BlockingIOError:
            return
        except OSError:
            data = b""
        if not data:
            self._drop(client)
            return
        *commands, rest = (client.received + data.decode("ascii", "replace")).split(">")
        client.received = rest
        if len(rest) > _LONGEST_COMMAND:
            self._drop(client)
            return
        # The stamp is that of the last one. Those before it came since the last read, as far apart as usual:
        # a client that has paused did so before the first one, while this process stood still, too.
        before_s, client.stamp_s = client.stamp_s, _stamp_s(ancillary)
        client.steps_s.append((client.stamp_s - before_s) / max(len(commands), 1))
        step_s = min(client.steps_s[-1], median(client.steps_s))
        for behind, command in zip(reversed(range(len(commands))), commands, strict=True):
            stamp_s = client.stamp_s - behind * step_s
            self._obey(client, command.strip().removeprefix("<").split(), stamp_s)

    def _obey(self, client: _Client, words: list[str], stamp_s: float) -> None:
        if words[:1] == ["send"] and client.open:
            self._forward(client, words[1:], stamp_s)
        elif words[:1] == ["open"] and len(words) == 2:
            client.open = not self.channel or words[1] == self.channel
            self._write(client, b"< ok >" if client.open else b"< error could not open bus >")
        elif words == ["rawmode"] and client.open:
            self._write(client, b"< ok >")
            client.raw = True
            client.hold_until_s = time.monotonic() + _SETTLE_S
        elif words == ["echo"]:
            self._write(client, b"< echo >")
        else:
            self._write(client, b"< error unknown command >")

    def _forward(self, client: _Client, words: list[str], stamp_s: float) -> None:
        try:
            message = _message(words, stamp_s)
        except ValueError:
            self._write(client, b"< error could not parse frame >")
            return
        self._frames.append(message)
        if len(self._clients) > 1:
            self._broadcast(_frame(message, message.timestamp), client)

    def _broadcast(self, text: bytes, sender: _Client | None) -> None:
        for client in list(self._clients):
            if client is sender or not client.raw:
                continue
            if client.pending or time.monotonic() < client.hold_until_s:
                client.pending.append(text)
            else:
                self._write(client, text)

    def _write(self, client: _Client, text: bytes) -> None:
        with self._writing:
            client.unsent += text
            self._flush(client)

    def _flush(self, client: _Client) -> None:
        with self._writing:
            if client not in self._clients:  # the other thread has just dropped it
                return
            try:
                sent = client.socket.send(client.unsent)
                del client.unsent[:sent]
            except BlockingIOError:
                pass
            except OSError:
                self._drop(client)
                return
            if len(client.unsent) > _LARGEST_BACKLOG:
                self._drop(client)
                return
            wanted = selectors.EVENT_READ | (selectors.EVENT_WRITE if client.unsent else 0)
            if self._selector.get_key(client.socket).events != wanted:
                self._selector.modify(client.socket, wanted, client)


def _frame(message: can.Message, stamp_s: float) -> bytes:
    width = 8 if message.is_extended_id else 3
    data = bytes(message.data).hex().upper()
    return f"< frame {message.arbitration_id:0{width}X} {stamp_s:.6f} {data} >".encode("ascii")


def _stamp_s(ancillary: list[tuple[int, int, bytes]]) -> float:
    """UNIX time at which the kernel received it: this process may run much later."""
    for level, kind, data in ancillary:
        if (level, kind) == (socket.SOL_SOCKET, _SO_TIMESTAMPNS) and len(data) == _STAMP.size:
            seconds, nanoseconds = _STAMP.unpack(data)
            return float(seconds + nanoseconds * 1e-9)
    return time.time()


def _message(words: list[str], stamp_s: float) -> can.Message:
    identifier, length, *data = words
    if len(data) != int(length) or len(data) > 8:
        raise ValueError("length")
    content, extended = bytes(int(byte, 16) for byte in data), len(identifier) > 3
    return can.Message(stamp_s, int(identifier, 16), extended, data=content, check=True)


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
    if nodes := ", ".join(f"node {node}" for node in sorted(set(node_ids).intersection(there))):
        said = "on the bus already: another `drivelink sim`, or real drives; end it, or use another --channel"
        raise BusError(f"{section.interface} {section.channel}: {nodes}: {said}")
