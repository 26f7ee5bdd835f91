"""The loop's interface to a bus: wait, take received frames, send. The seam to hardware is `can.Bus`.

python-can makes a Message of every frame, which costs more than the whole cycle. Therefore the socket of
SocketCAN is read directly (with the kernel's stamps); other interfaces through `recv`.
"""

import errno
import select
import socket
import struct
import sys
import time
from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

import can

from drivelink.canopen.bus import one_line, received_ns, server_has_gone

OVERFLOW = "receive overflow"  # key of `FrameSource.errors`: frames lost because they were not read in time
MOST_FRAMES = 256  # limit per call, so that a babbling node cannot block the loop


_ERROR_KINDS = (  # by bit: linux/can/error.h, also used by python-can
    "transmit timeout", "arbitration lost", "controller", "protocol violation", "transceiver",
    "no acknowledgement", "bus-off", "bus error", "restarted",
)  # fmt: skip


class CanFrame(NamedTuple):
    """One frame: identifier, bytes, UNIX time in ns."""

    cob_id: int
    data: bytes
    stamp_ns: int


class BusLostError(Exception):
    """The bus is lost: interface down or removed, connection closed. The reason is one line.

    Args:
        reason: message of python-can or the system; some of python-can's contain a traceback.
    """

    def __init__(self, reason: str) -> None:
        super().__init__(one_line(reason))


class FrameSource:
    """Interface of a bus for the loop; by itself, a bus on which nothing comes."""

    def __init__(self) -> None:
        self.lost_sends = 0  # frames that could not be sent because the transmit queue was full
        self.errors: dict[str, int] = {}  # error frames, by kind

    def wait(self, timeout_s: float) -> bool:
        """Wait for a frame; return whether there is one."""
        time.sleep(max(timeout_s, 0.0))
        return False

    def receive(self) -> list[CanFrame]:
        """Return the received data frames with 11-bit identifiers, in order."""
        return []

    def send(self, cob_id: int, data: bytes) -> None:
        """Send a frame; a full transmit queue is counted, not raised."""

    def narrow(self, cob_ids: Iterable[int]) -> None:
        """Receive these identifiers only, if the kernel can filter."""


class LostSource(FrameSource):
    """Stands in for a lost bus."""


def note_error(errors: dict[str, int], can_id: int, data: bytes) -> None:
    """Count an error frame by its kinds, which are bits of its identifier."""
    kinds = [kind for bit, kind in enumerate(_ERROR_KINDS) if can_id >> bit & 1] or ["other"]
    if can_id & 0x004 and data[1:2] and data[1] & 0x01:
        kinds.append(OVERFLOW)
    for kind in kinds:
        errors[kind] = errors.get(kind, 0) + 1


class BusSource(FrameSource):
    """Any python-can interface, by `recv` and `send`; python-can filters after reception.

    Args:
        devices: simulated ones in this thread; lets them handle sent frames and due timers.
    """

    def __init__(self, bus: can.BusABC, devices: Callable[[], object] = lambda: None) -> None:
        super().__init__()
        self._bus, self._devices = bus, devices
        self._waiting: list[can.Message] = []

    def wait(self, timeout_s: float) -> bool:
        """See FrameSource."""
        if self._waiting:
            return True
        message = self._receive(timeout_s)
        if message is None:
            return False
        self._waiting.append(message)
        return True

    def receive(self) -> list[CanFrame]:
        """See FrameSource."""
        self._devices()
        messages, self._waiting = self._waiting, []
        while len(messages) < MOST_FRAMES and (message := self._receive(0.0)) is not None:
            messages.append(message)
        frames = []
        for message in messages:
            if message.is_error_frame:
                note_error(self.errors, message.arbitration_id, bytes(message.data))
            elif not (message.is_extended_id or message.is_remote_frame):
                frames.append(CanFrame(message.arbitration_id, bytes(message.data), received_ns(message)))
        return frames

    def send(self, cob_id: int, data: bytes) -> None:
        """See FrameSource."""
        try:
            self._bus.send(
                can.Message(timestamp=time.time(), arbitration_id=cob_id, data=data, is_extended_id=False)
            )
        except can.CanError as error:
            if error.error_code != errno.ENOBUFS and "buffer full" not in str(error).lower():
                raise BusLostError(str(error)) from error
            self.lost_sends += 1
        except OSError as error:
            raise BusLostError(str(error)) from error
        self._devices()

    def _receive(self, timeout_s: float) -> can.Message | None:
        try:
            return self._bus.recv(timeout_s)
        except Exception as error:  # python-can's interfaces raise various exceptions
            raise BusLostError(str(error) or type(error).__name__) from error


_SO_RXQ_OVFL = 40  # socket(7): number of dropped frames; not in the socket module


class SocketCanSource(FrameSource):
    """A SocketCAN socket, read without python-can's Message."""

    _FRAME = struct.Struct("=IB3x8s")
    _FD_FRAME = struct.Struct("=IBB2x64s")
    _TIME = struct.Struct("@qq")
    _FLAGS = 0xE0000000  # extended, remote, error
    _ERROR = 0x20000000

    def __init__(self, bus: Any) -> None:
        super().__init__()
        self._bus = bus
        self._socket: socket.socket = bus.socket
        self._socket.setblocking(False)
        self._socket.setsockopt(socket.SOL_SOCKET, _SO_RXQ_OVFL, 1)
        self._dropped = 0
        self._buffer = bytearray(72)
        self._sent: dict[tuple[int, bytes], bytes] = {}

    def wait(self, timeout_s: float) -> bool:
        """See FrameSource."""
        try:
            return bool(select.select([self._socket], (), (), max(timeout_s, 0.0))[0])
        except (OSError, ValueError) as error:
            raise BusLostError(_reason(error)) from error

    def receive(self) -> list[CanFrame]:
        """See FrameSource."""
        frames: list[CanFrame] = []
        receive, buffer = self._socket.recvmsg_into, self._buffer
        try:
            while len(frames) < MOST_FRAMES:
                size, ancillary, _flags, _address = receive([buffer], 128)
                layout = self._FRAME if size == 16 else self._FD_FRAME
                can_id, length, *_, data = layout.unpack_from(buffer)
                if can_id & self._FLAGS:
                    if can_id & self._ERROR:
                        note_error(self.errors, can_id, data)
                    continue
                seconds = nanoseconds = 0
                for _level, kind, content in ancillary:
                    if kind == _SO_RXQ_OVFL:
                        self._note_dropped(content)
                    elif len(content) >= self._TIME.size:
                        seconds, nanoseconds = self._TIME.unpack_from(content)
                stamp = seconds * 1_000_000_000 + nanoseconds or time.time_ns()
                frames.append(CanFrame(can_id, data[:length], stamp))
        except BlockingIOError:
            pass
        except (OSError, ValueError) as error:
            raise BusLostError(_reason(error)) from error
        return frames

    def _note_dropped(self, content: bytes) -> None:
        """Count the frames that the kernel has dropped."""
        dropped = int.from_bytes(content[:4], sys.byteorder)
        if dropped != self._dropped:
            self.errors[OVERFLOW] = self.errors.get(OVERFLOW, 0) + (dropped - self._dropped) % (1 << 32)
            self._dropped = dropped

    def send(self, cob_id: int, data: bytes) -> None:
        """See FrameSource."""
        frame = self._sent.get((cob_id, data))
        if frame is None:
            frame = self._FRAME.pack(cob_id, len(data), data)
            if len(data) <= 1:
                self._sent[cob_id, data] = frame  # cached: SYNC with its counters
        try:
            self._socket.send(frame)
        except OSError as error:
            if error.errno not in (errno.ENOBUFS, errno.EAGAIN):
                raise BusLostError(_reason(error)) from error
            self.lost_sends += 1

    def narrow(self, cob_ids: Iterable[int]) -> None:
        """See FrameSource."""
        self._bus.set_filters(
            [{"can_id": cob_id, "can_mask": 0x7FF, "extended": False} for cob_id in sorted(set(cob_ids))]
        )


def _reason(error: OSError | ValueError) -> str:
    return str(getattr(error, "strerror", None) or error)


class SocketcandSource(BusSource):
    """A socketcand connection."""

    def wait(self, timeout_s: float) -> bool:
        """See FrameSource."""
        if super().wait(timeout_s):
            return True
        if server_has_gone(self._bus):
            raise BusLostError("the server has closed the connection")
        return False


_FASTER: dict[str, Callable[[Any], FrameSource]] = {
    "SocketcanBus": SocketCanSource,
    "SocketCanDaemonBus": SocketcandSource,
}


def open_source(bus: can.BusABC, devices: Callable[[], object] | None = None) -> FrameSource:
    """Open the fastest source for this bus, also with devices in this thread."""
    return BusSource(bus, devices) if devices else _FASTER.get(type(bus).__name__, BusSource)(bus)
