"""Filters every outgoing frame: nothing that could move a drive is sent.

`check_frame` permits SYNC, the NMT commands *start* and *enter pre-operational*, SDO uploads, and SDO
downloads to communication objects (0x1005 to 0x1019, 0x1800 to 0x1BFF of CiA 301). It refuses everything
else, such as controlword, modes of operation and targets.
"""

import can

from drivelink._core import SYNC_COB_ID
from drivelink.errors import BusError

_NMT_START = 0x01
_NMT_PRE_OPERATIONAL = 0x80
_WRITABLE = frozenset({0x1005, 0x1006, 0x1016, 0x1017, 0x1019})


class ForbiddenFrameError(Exception):
    """A frame that this program must never send: an internal error."""


def check_frame(cob_id: int, data: bytes) -> None:
    """Refuse frames that may not be sent.

    Raises:
        ForbiddenFrameError: the frame is not SYNC, NMT start or pre-operational, or a permitted SDO.
    """
    if cob_id == SYNC_COB_ID and len(data) <= 1:
        return
    if cob_id == 0 and len(data) == 2 and data[0] in (_NMT_START, _NMT_PRE_OPERATIONAL):
        return
    if 0x601 <= cob_id <= 0x67F and len(data) == 8:
        command = data[0] >> 5
        if command in (2, 3, 4):  # upload, upload segment, abort
            return
        index = data[1] | data[2] << 8
        communication = index in _WRITABLE or 0x1800 <= index <= 0x1BFF  # SYNC, heartbeat, TPDOs
        if command == 1 and data[0] & 0x02 and communication:  # expedited download
            return
    raise ForbiddenFrameError(f"frame 0x{cob_id:03X} [{data.hex(' ')}] may not be sent to a drive")


class SilentBus:
    """A bus that only listens: `send` raises. For `configure = false` with `sync = "follow"`."""

    def __init__(self, bus: can.BusABC) -> None:
        self.inner = bus
        self.recv = bus.recv
        self.shutdown = bus.shutdown

    def send(self, message: can.Message, timeout: float | None = None) -> None:
        """Refuse every frame.

        Raises:
            BusError: always.
        """
        raise BusError(f"passive: no frame may be sent, not even 0x{message.arbitration_id:03X}")
