"""The loop's interface to a bus: wait, take received frames, send. The seam to hardware is `can.Bus`.

python-can makes a Message of every frame, which costs more than the whole cycle. Therefore the socket of
SocketCAN and the queue of the virtual bus are read directly; other interfaces through `recv`.
"""

from __future__ import annotations

import errno
import queue
import time
from collections.abc import Callable, Iterable
from typing import Any, NamedTuple, Protocol

import can

OVERFLOW = "receive overflow"  # key of `FrameSource.errors`: frames lost because they were not read in time
MOST_FRAMES = 256  # limit per call, so that a babbling node cannot block the loop


_ERROR_KINDS = {  # linux/can/error.h, also used by python-can
    0x001: "transmit timeout",
    0x002: "arbitration lost",
    0x004: "controller",
    0x008: "protocol violation",
    0x010: "transceiver",
    0x020: "no acknowledgement",
    0x040: "bus-off",
    0x080: "bus error",
    0x100: "restarted",
}


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
        super().__init__(" ".join(reason.partition("Traceback (most recent call last)")[0].split()))


class FrameSource(Protocol):
    """Interface of a bus for the loop."""

    lost_sends: int  # frames that could not be sent because the transmit queue was full
    errors: dict[str, int]  # error frames, by kind

    def wait(self, timeout_s: float) -> bool:
        """Wait for a frame; return whether there is one."""

    def take(self) -> list[CanFrame]:
        """Return the received data frames with 11-bit identifiers, in order."""

    def send(self, cob_id: int, data: bytes) -> None:
        """Send a frame; a full transmit queue is counted, not raised."""

    def narrow(self, cob_ids: Iterable[int]) -> None:
        """Receive these identifiers only, if the kernel can filter."""


def note_error(errors: dict[str, int], can_id: int, data: bytes) -> None:
    """Count an error frame by its kinds, which are bits of its identifier."""
    kinds = [kind for bit, kind in _ERROR_KINDS.items() if can_id & bit] or ["other"]
    if can_id & 0x004 and data[1:2] and data[1] & 0x01:
        kinds.append(OVERFLOW)
    for kind in kinds:
        errors[kind] = errors.get(kind, 0) + 1


class BusSource:
    """Any python-can interface, by `recv` and `send`."""

    def __init__(self, bus: can.BusABC) -> None:
        self._bus = bus
        self._waiting: list[can.Message] = []
        self.lost_sends = 0
        self.errors: dict[str, int] = {}

    @property
    def waiting(self) -> bool:
        """Whether a frame is known to be there."""
        return bool(self._waiting)

    def wait(self, timeout_s: float) -> bool:
        """See FrameSource."""
        if self._waiting:
            return True
        message = self._receive(timeout_s)
        if message is None:
            return False
        self._waiting.append(message)
        return True

    def take(self) -> list[CanFrame]:
        """See FrameSource."""
        messages, self._waiting = self._waiting, []
        while len(messages) < MOST_FRAMES and (message := self._receive(0.0)) is not None:
            messages.append(message)
        return self._frames(messages)

    def send(self, cob_id: int, data: bytes) -> None:
        """See FrameSource."""
        try:
            self._bus.send(
                can.Message(timestamp=time.time(), arbitration_id=cob_id, data=data, is_extended_id=False)
            )
        except can.CanError as error:
            if not _is_full(error):
                raise BusLostError(str(error)) from error
            self.lost_sends += 1
        except OSError as error:
            raise BusLostError(str(error)) from error

    def narrow(self, cob_ids: Iterable[int]) -> None:
        """Do nothing: python-can filters after reception."""

    def _frames(self, messages: list[can.Message]) -> list[CanFrame]:
        frames = []
        for message in messages:
            if message.is_error_frame:
                note_error(self.errors, message.arbitration_id, bytes(message.data))
            elif not (message.is_extended_id or message.is_remote_frame):
                stamp_ns = int(message.timestamp * 1e9) or time.time_ns()
                frames.append(CanFrame(message.arbitration_id, bytes(message.data), stamp_ns))
        return frames

    def _receive(self, timeout_s: float) -> can.Message | None:
        try:
            return self._bus.recv(timeout_s)
        except Exception as error:  # python-can's interfaces raise various exceptions
            raise BusLostError(str(error) or type(error).__name__) from error


def _is_full(error: can.CanError) -> bool:
    return getattr(error, "error_code", None) == errno.ENOBUFS or "buffer full" in str(error).lower()


class VirtualSource(BusSource):
    """python-can's virtual bus, by its queue."""

    def __init__(self, bus: Any) -> None:
        super().__init__(bus)
        self._queue: queue.Queue[can.Message] = bus.queue
        # The virtual bus has no other way to know.
        self._is_open: Callable[[], bool] = lambda: bool(bus._open)
        self._channel: list[queue.Queue[can.Message]] = bus.channel  # of all buses on it
        self._channel_id = bus.channel_id
        self._pending = bus.queue.queue  # the deque inside: its popleft is atomic, and needs no lock

    @property
    def waiting(self) -> bool:
        """Whether a frame is known to be there."""
        return bool(self._pending or self._waiting)

    def wait(self, timeout_s: float) -> bool:
        """See FrameSource."""
        self._check()
        if self.waiting:
            return True
        if timeout_s <= 0:
            return False
        try:
            self._waiting.append(self._queue.get(timeout=timeout_s))
        except queue.Empty:
            return False
        return True

    def take(self) -> list[CanFrame]:
        """See FrameSource."""
        if not self.waiting:
            self._check()
            return []
        messages, self._waiting = self._waiting, []
        while self._pending and len(messages) < MOST_FRAMES:
            messages.append(self._pending.popleft())
        return self._frames(messages)

    def send(self, cob_id: int, data: bytes) -> None:
        """Give every other bus of the channel its own message: python-can would deep-copy."""
        self._check()
        stamp_s = time.time()
        for receiver in self._channel:
            if receiver is not self._queue:
                receiver.put(
                    can.Message(
                        timestamp=stamp_s,
                        arbitration_id=cob_id,
                        data=data,
                        channel=self._channel_id,
                        is_extended_id=False,
                    )
                )

    def _check(self) -> None:
        if not self._is_open():
            raise BusLostError("the virtual bus is closed")


class Pumped:
    """A bus with simulated devices in this thread, which answer immediately.

    Args:
        devices: lets them handle sent frames and due timers.
    """

    def __init__(self, source: BusSource, devices: Callable[[], object]) -> None:
        self._source, self._devices = source, devices
        self.lost_sends = 0
        self.errors = source.errors
        self.wait, self.narrow = source.wait, source.narrow

    def take(self) -> list[CanFrame]:
        """See FrameSource."""
        if not self._source.waiting:
            self._devices()
        return self._source.take()

    def send(self, cob_id: int, data: bytes) -> None:
        """See FrameSource."""
        self._source.send(cob_id, data)
        self.lost_sends = self._source.lost_sends
        self._devices()


class LostSource:
    """Stands in for a lost bus: receives and sends nothing."""

    def __init__(self) -> None:
        self.lost_sends = 0
        self.errors: dict[str, int] = {}

    def wait(self, timeout_s: float) -> bool:
        """See FrameSource."""
        time.sleep(max(timeout_s, 0.0))
        return False

    def take(self) -> list[CanFrame]:
        """See FrameSource."""
        return []

    def send(self, cob_id: int, data: bytes) -> None:
        """Nothing."""

    def narrow(self, cob_ids: Iterable[int]) -> None:
        """Nothing."""
