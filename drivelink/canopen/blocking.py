"""Runs an SDO program to completion on a bus without another reader: before the start, and in the doctor."""

from __future__ import annotations

import errno
import logging
import time
from collections.abc import Callable, Iterator
from typing import Protocol, TypeVar

import can

from drivelink.canopen.sdo import Program, Session
from drivelink.errors import BusError
from drivelink.jointfile import BusSection

T = TypeVar("T")
Idle = Callable[[], object]

POLL_S = 0.005
_QUEUE_FULL = (errno.ENOBUFS, errno.EAGAIN)

logger = logging.getLogger(__name__)


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
            raise BusError(f"frame 0x{cob_id:03X} cannot be sent: {error}") from error

    return send


def run_program(
    program: Program[T],
    bus: FrameBus,
    section: BusSection | None = None,
    *,
    idle: Idle | None = None,
) -> T:
    """Run a program to its end on a bus without another reader.

    Args:
        bus: where.
        section: of the joint file, for SDO timeout and retries; None: the defaults.
        idle: called between receptions, e.g. the simulated devices' `poll` in lockstep.

    Raises:
        DriveError: the program failed.
        BusError: the bus did.
    """
    section = section or BusSection()
    session = Session(program, sender(bus), timeout_s=section.sdo_timeout_s, retries=section.sdo_retries)
    while not session.poll(time.monotonic()):
        if idle is not None:
            idle()
        message = receive(bus, 0.0 if idle is not None else POLL_S)
        while message is not None:
            if is_canopen(message):
                session.feed(message.arbitration_id, bytes(message.data), time.monotonic())
            message = receive(bus, 0.0)
    return session.result


def frames(bus: FrameBus, seconds: float, idle: Idle | None = None) -> Iterator[can.Message | None]:
    """The frames of so many seconds; None where there is none for a while.

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


def receive(bus: FrameBus, timeout_s: float) -> can.Message | None:
    """Return the next frame, or None after the timeout.

    Raises:
        BusError: the bus fails.
    """
    try:
        return bus.recv(timeout_s)
    except (can.CanError, OSError) as error:
        raise BusError(f"the bus cannot be read: {error}") from error
