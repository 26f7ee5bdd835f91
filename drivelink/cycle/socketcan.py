"""Reads SocketCAN directly, with the kernel's stamps; python-can's Message costs more than a cycle."""

from __future__ import annotations

import errno
import select
import socket
import struct
import sys
import time
from collections.abc import Iterable
from typing import Any

from drivelink.cycle.framesource import MOST_FRAMES, OVERFLOW, BusLostError, CanFrame, note_error

_SO_RXQ_OVFL = 40  # socket(7): number of dropped frames; not in the socket module


class SocketCanSource:
    """A SocketCAN socket, read without python-can's Message."""

    _FRAME = struct.Struct("=IB3x8s")
    _FD_FRAME = struct.Struct("=IBB2x64s")
    _TIME = struct.Struct("@qq")
    _FLAGS = 0xE0000000  # extended, remote, error
    _ERROR = 0x20000000

    def __init__(self, bus: Any) -> None:
        self._bus = bus
        self._socket: socket.socket = bus.socket
        self._socket.setblocking(False)
        self._socket.setsockopt(socket.SOL_SOCKET, _SO_RXQ_OVFL, 1)
        self._dropped = 0
        self._buffer = bytearray(72)
        self._sent: dict[tuple[int, bytes], bytes] = {}
        self.lost_sends = 0
        self.errors: dict[str, int] = {}

    def wait(self, timeout_s: float) -> bool:
        """See FrameSource."""
        try:
            return bool(select.select([self._socket], (), (), max(timeout_s, 0.0))[0])
        except (OSError, ValueError) as error:
            raise BusLostError(_reason(error)) from error

    def take(self) -> list[CanFrame]:
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
