"""Opens the bus of a joint file with any python-can interface, and runs SDO programs on one without a reader.

A failure is one line. SocketCAN gets a receive buffer sized for the bus, kernel time stamps, error frames,
CAN FD frames, and a check of the interface's state.
"""

import contextlib
import errno
import logging
import math
import socket
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Protocol, TypeVar

import can
from can.interfaces import VALID_INTERFACES

from drivelink.canopen.sdo import Program, Session
from drivelink.errors import BusError, DriveError
from drivelink.jointfile import BusSection
from estimator.errors import expected

logger = logging.getLogger(__name__)

_SO_RCVBUFFORCE = 33  # Linux, not in the socket module: beyond net.core.rmem_max, with CAP_NET_ADMIN
_BYTES_PER_FRAME = 800  # that the kernel charges for a frame (measured: 212992 bytes held 278)
_BUFFER_S = 0.5  # of a full bus; the longest stall that must lose nothing
_SHORTEST_FRAME_BITS = 55
_SOCKETCAND_PORT = 29536
_SOCKETCAND_HOST = "127.0.0.1"  # where `drivelink sim` serves one, by default
_CONNECT_S = 3.0  # for the connection, and for each answer of the greeting
_DELIVERY_S = {"virtual": 0.05, "socketcan": 0.05}  # a frame is there as soon as it is sent
_SLOWEST_DELIVERY_S = 0.5  # servers and adapters delay frames after they are opened
_SYS_NET = Path("/sys/class/net")
_IFF_UP = 1
_LAST_S = 9e9  # the last time that 64 bits of ns hold
_WITHOUT_BITRATE = frozenset({"virtual", "socketcan", "socketcand", "udp_multicast"})

_REASONS = {
    errno.ENODEV: "there is no such interface",
    errno.ENETDOWN: "the interface is down",
    errno.EPERM: "permission denied",
    errno.EACCES: "permission denied",
    errno.ENOENT: "there is no such device",
    errno.EAFNOSUPPORT: "this kernel has no SocketCAN (AF_CAN)",
    errno.EPROTONOSUPPORT: "this kernel has no raw CAN sockets",
    errno.ECONNREFUSED: "nobody listens there (drivelink sim JOINT --interface socketcand does)",
}


def open_bus(section: BusSection) -> can.BusABC:
    """Open the bus that a joint file names.

    Raises:
        BusError: unknown interface, wrong options, missing device, no permission, interface down.
    """
    where = f"{section.interface} {section.channel}"
    _check_interface(section)
    if section.interface == "socketcan":
        _check_socketcan(section)
    if section.interface == "socketcand":
        _check_socketcand(section)
    try:
        with _connecting(section):
            bus = can.Bus(ignore_config=True, **_arguments(section))
    except (can.CanError, OSError) as error:
        raise BusError(f"{where} cannot be opened: {_reason(error)}") from error
    except (TypeError, ValueError, KeyError, ImportError) as error:
        raise BusError(f"{where} cannot be opened, check bus.channel and bus.options: {error}") from error
    if section.interface == "socketcand":
        _socketcand_socket(bus).settimeout(None)
    if section.interface == "socketcan":
        _size_receive_buffer(bus, section)
    return bus


def _arguments(section: BusSection) -> dict[str, Any]:
    arguments: dict[str, Any] = {"interface": section.interface, "channel": section.channel}
    if section.interface not in _WITHOUT_BITRATE:
        arguments["bitrate"] = section.bitrate
    if section.interface == "slcan" and not section.configure and section.sync == "follow":
        arguments["listen_only"] = True  # the adapter does not even acknowledge
    if section.interface == "virtual":
        arguments["preserve_timestamps"] = True
    if section.interface == "socketcan":
        arguments["fd"] = True
    if section.interface == "socketcand":
        arguments |= {"host": _SOCKETCAND_HOST, "port": _SOCKETCAND_PORT}
    return {**arguments, **section.options}


def _check_interface(section: BusSection) -> None:
    if section.interface in VALID_INTERFACES:
        return
    wanted = expected(section.interface, sorted(VALID_INTERFACES))
    raise BusError(f'bus.interface: python-can has no "{section.interface}": {wanted}')


def _check_socketcan(section: BusSection) -> None:
    """Check the interface before python-can opens a socket."""
    name = section.channel
    try:
        socket.socket(socket.PF_CAN, socket.SOCK_RAW, socket.CAN_RAW).close()
    except (OSError, AttributeError) as error:
        raise BusError(
            f"socketcan {name} cannot be opened: {_reason(error)}; sudo modprobe can_raw"
        ) from error
    try:
        socket.if_nametoindex(name)
    except OSError as error:
        make = f"sudo ip link add {name} type vcan && " if name.startswith("vcan") else ""
        raise BusError(
            f"socketcan {name}: there is no such interface; {make or 'plug it in, then '}"
            f"sudo ip link set {name} up{'' if make else f' type can bitrate {section.bitrate}'}"
        ) from error
    if not interface_is_up(name):
        kind = "" if name.startswith("vcan") else f" type can bitrate {section.bitrate}"
        raise BusError(f"socketcan {name} is down; sudo ip link set {name} up{kind}")


def _check_socketcand(section: BusSection) -> None:
    """Check that a socketcand answers: python-can would try for ten seconds, or wait forever."""
    options = section.options
    host, port = options.get("host", _SOCKETCAND_HOST), options.get("port", _SOCKETCAND_PORT)
    if not isinstance(host, str) or not isinstance(port, int):
        raise BusError(
            'socketcand: expected bus.options = { host = "127.0.0.1", port = 29536 }, '
            f"got {options or 'none'}"
        )
    try:
        with socket.create_connection((host, port), timeout=_CONNECT_S) as connection:
            greeting = connection.recv(64)
    except TimeoutError as error:
        raise BusError(
            f"socketcand {host}:{port}: no connection, or no greeting for {_CONNECT_S:g} s: "
            "is it a socketcand?"
        ) from error
    except OSError as error:
        raise BusError(f"socketcand {host}:{port} cannot be opened: {_reason(error)}") from error
    if b"<" not in greeting:
        raise BusError(f"socketcand {host}:{port}: expected its greeting, got {greeting[:20]!r}: is it one?")


@contextlib.contextmanager
def _connecting(section: BusSection) -> Iterator[None]:
    """Limit the time to connect: python-can waits forever for a silent server."""
    if section.interface != "socketcand":
        yield
        return
    before = socket.getdefaulttimeout()
    socket.setdefaulttimeout(_CONNECT_S)
    try:
        yield
    finally:
        socket.setdefaulttimeout(before)


def _socketcand_socket(bus: can.BusABC) -> socket.socket:
    """Return the connection of python-can's client, which has no public name."""
    found: socket.socket = bus._SocketCanDaemonBus__socket  # type: ignore[attr-defined]
    return found


def server_has_gone(bus: can.BusABC) -> bool:
    """Return whether a socketcand server has closed the connection; python-can does not notice."""
    try:
        return _socketcand_socket(bus).recv(1, socket.MSG_PEEK | socket.MSG_DONTWAIT) == b""
    except BlockingIOError:
        return False
    except OSError:
        return True


def listening_s(section: BusSection) -> float:
    """Return how long to listen for periodic frames before the bus counts as silent, s."""
    return max(_DELIVERY_S.get(section.interface, _SLOWEST_DELIVERY_S), 3 * section.period_s)


def interface_is_up(name: str) -> bool:
    """Return whether a network interface exists and is up; cheap enough for repeated use in a run."""
    try:
        flags = (_SYS_NET / name / "flags").read_text(encoding="ascii")
        return bool(int(flags, 16) & _IFF_UP)
    except (OSError, ValueError):
        return False


def _size_receive_buffer(bus: can.BusABC, section: BusSection) -> None:
    """Size the receive buffer for a full bus during the longest stall."""
    frames = int(_BUFFER_S * section.bitrate / _SHORTEST_FRAME_BITS)
    wanted = frames * _BYTES_PER_FRAME
    sock: socket.socket = bus.socket  # type: ignore[attr-defined]
    try:
        sock.setsockopt(socket.SOL_SOCKET, _SO_RCVBUFFORCE, wanted // 2)  # the kernel doubles it
    except OSError:
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, wanted // 2)
    have = sock.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF) // _BYTES_PER_FRAME
    if have < frames:
        text = "%s: the receive buffer holds %d frames of %d wanted; sudo sysctl net.core.rmem_max=%d"
        logger.info(text, section.channel, have, frames, wanted // 2)


def _reason(error: BaseException) -> str:
    cause: BaseException | None = error
    while cause is not None:  # python-can wraps the system's error
        number = getattr(cause, "errno", None) or getattr(cause, "error_code", None)
        if number in _REASONS:
            return _REASONS[number]
        cause = cause.__cause__ or cause.__context__
    if "could not open bus" in str(error):  # socketcand's answer
        return "its server has no bus of this name; give this bus a server of its own by bus.options (port)"
    return one_line(str(error)) or type(error).__name__


def one_line(text: str) -> str:
    """Return a message in one line; some of python-can's contain a traceback."""
    return " ".join(text.partition("Traceback (most recent call last)")[0].split())


class OutOfTime(DriveError):  # noqa: N818 - not the drive's error
    """A program was given up; what it had not asked by then is not known."""


T = TypeVar("T")
Idle = Callable[[], object]

POLL_S = 0.005
_QUEUE_FULL = (errno.ENOBUFS, errno.EAGAIN)


class FrameBus(Protocol):
    """Required interface of a bus: python-can's `Bus`, or `BusPort`."""

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """Send a frame."""

    def recv(self, timeout: float | None = None) -> can.Message | None:
        """Return the next frame, or None after the timeout."""


def sender(bus: FrameBus) -> Callable[[int, bytes], None]:
    """`send(identifier, data)` of a bus.

    A frame is lost if the transmit queue is full; SDO retries after its timeout. If no node acknowledges, the
    queue stays full and the missing answer is the error.
    """

    def send(cob_id: int, data: bytes) -> None:
        try:
            bus.send(can.Message(arbitration_id=cob_id, data=data, is_extended_id=False))
        except can.CanError as error:
            if error.error_code in _QUEUE_FULL or "buffer full" in str(error):
                logger.debug("frame 0x%03X is lost: the transmit queue is full", cob_id)
                return
            raise BusError(f"frame 0x{cob_id:03X} cannot be sent: {one_line(str(error))}") from error
        except OSError as error:  # of an interface over TCP
            raise BusError(f"frame 0x{cob_id:03X} cannot be sent: {error.strerror or error}") from error

    return send


def run_program(
    program: Program[T],
    bus: FrameBus,
    section: BusSection | None = None,
    *,
    idle: Idle | None = None,
    end_s: float = math.inf,
) -> T:
    """Run a program to its end on a bus without another reader.

    Args:
        section: of the joint file, for SDO timeout and retries; None: the defaults.
        idle: called between receptions, e.g. the simulated devices' `poll` in lockstep.
        end_s: when it is given up (`time.monotonic`).

    Raises:
        OutOfTime: it was given up.
        DriveError: the program failed.
        BusError: the bus did.
    """
    section = section or BusSection()
    session = Session(program, sender(bus), timeout_s=section.sdo_timeout_s, retries=section.sdo_retries)
    while not session.poll(now_s := time.monotonic()):
        if now_s > end_s:
            raise OutOfTime(f"node {session.asks} was not asked further: the time for it is over")
        if idle is not None:
            idle()
        message = receive(bus, 0.0 if idle is not None else POLL_S)
        if message is not None and is_canopen(message):
            session.feed(message.arbitration_id, bytes(message.data), time.monotonic())
    return session.result


def frames(bus: FrameBus, seconds: float, idle: Idle | None = None) -> Iterator[can.Message | None]:
    """Yield the frames of so many seconds; None where there is none for a while.

    Raises:
        BusError: the bus fails.
    """
    end_s = time.monotonic() + seconds
    while (left_s := end_s - time.monotonic()) > 0:
        if idle is not None:
            idle()
        yield receive(bus, min(left_s, POLL_S))


def is_canopen(message: can.Message) -> bool:
    """Return whether it is a data frame with an 11-bit identifier."""
    return not (message.is_extended_id or message.is_error_frame or message.is_remote_frame)


def received_ns(message: can.Message) -> int:
    """Return the UNIX time of a frame in ns: the interface's, or now where it gives none that is possible."""
    seconds = message.timestamp
    return int(seconds * 1e9) if 0.0 < seconds < _LAST_S else time.time_ns()


def receive(bus: FrameBus, timeout_s: float) -> can.Message | None:
    """Return the next frame, or None after the timeout.

    Raises:
        BusError: the bus fails.
    """
    try:
        return bus.recv(timeout_s)
    except (can.CanError, OSError) as error:
        raise BusError(f"the bus cannot be read: {one_line(str(error))}") from error
