"""Reads another master's SDO transfers from the traffic (CiA 301, 7.2.4.3).

An answer is used only if it belongs to a request that was heard: of the same object, in order, within the
time-out. Every other one is counted and ignored. Where two different answers follow one request, or a
download is given up before its answer, the object's value is not known: it is disputed until it is
transferred again.

A download counts once the node has confirmed it. Expedited and segmented transfers are followed. The object
of a block download is disputed: its bytes are not followed.
"""

from __future__ import annotations

from collections.abc import Callable

from drivelink._core import SdoTransfers

Address = tuple[int, int]

_DOWNLOAD, _BLOCK_DOWNLOAD = 1, 6  # commands of the client


class SdoSniffer(SdoTransfers):
    """Follows the SDO channel of one node: `request` and `response` take the frames."""

    def forget(self, lost: Callable[[Address], bool]) -> None:
        """Handle a restart of the node: forget written values and those that `lost` selects."""
        self.drop_transfer()
        for address in [a for a in self.values if a in self.written or lost(a)]:
            del self.values[address]
        self.written.clear()
        self.disputed.difference_update([address for address in self.disputed if lost(address)])
        self.changes += 1


def is_mapping(address: Address) -> bool:
    """Return whether an object is a parameter of a TPDO (CiA 301, 7.5.2.37 and 38)."""
    return 0x1800 <= address[0] <= 0x1BFF


def written_object(data: bytes) -> Address | None:
    """Return the object that a frame of the master begins to write."""
    begins = data and (data[0] >> 5 == _DOWNLOAD or data[0] & 0xE1 == _BLOCK_DOWNLOAD << 5)
    if not begins or len(data) > 8:
        return None
    data = data.ljust(8, b"\0")  # some masters send fewer
    return data[1] | data[2] << 8, data[3]
