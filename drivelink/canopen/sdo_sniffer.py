"""Reads another master's SDO transfers from the traffic (CiA 301, 7.2.4.3).

A download counts once the node has confirmed it. Expedited and segmented transfers are followed; block
transfers are not used for objects of a few bytes.
"""

from __future__ import annotations

from collections.abc import Callable

__all__ = ["SdoSniffer"]

Address = tuple[int, int]

_MAX_BYTES = 8  # no object of interest is longer


class SdoSniffer:
    """Follows the SDO channel of one node.

    Args:
        interesting: whether to keep the value of an object.

    Attributes:
        values: confirmed unsigned values by (index, subindex).
        written: those of them that were written, not read.
        changes: number of new, changed and forgotten values.
    """

    def __init__(self, interesting: Callable[[int, int], bool]) -> None:
        self._interesting = interesting
        self.values: dict[Address, int] = {}
        self.written: set[Address] = set()
        self.changes = 0
        self._address: Address | None = None
        self._writing = False
        self._segments: bytearray | None = None
        self._expedited: bytes | None = None
        self._last = False

    @property
    def pending(self) -> Address | None:
        """The object being written, not yet confirmed."""
        return self._address if self._writing else None

    def forget(self, lost: Callable[[Address], bool]) -> None:
        """Handle a restart of the node: forget written values and those that `lost` selects."""
        self._forget()
        for address in [a for a in self.values if a in self.written or lost(a)]:
            del self.values[address]
        self.written.clear()
        self.changes += 1

    def request(self, data: bytes) -> None:
        """A frame of the master, 0x600 + node."""
        if len(data) != 8:
            return
        command = data[0] >> 5
        if command in (1, 2):
            self._address = (data[1] | data[2] << 8, data[3])
            self._writing = command == 1
            self._segments = self._expedited = None
            self._last = False
            if command == 1:
                if data[0] & 0x02:
                    self._expedited = _expedited(data)
                else:
                    self._segments = bytearray()
        elif command == 0 and self._writing and self._segments is not None:
            self._segment(self._segments, data)
        elif command in (4, 5, 6):
            self._forget()

    def response(self, data: bytes) -> None:
        """A frame of the node, 0x580 + node."""
        if len(data) != 8 or self._address is None:
            return
        command = data[0] >> 5
        if command == 4:
            self._forget()
            return
        if self._segments is not None and command in (0, 1):
            self._confirm_segment(self._segments, command, data)
            return
        if (data[1] | data[2] << 8, data[3]) != self._address:
            return
        if command == 3 and self._writing and self._expedited is not None:
            self._keep(self._expedited)
        elif command == 2 and not self._writing:
            if data[0] & 0x02:
                self._keep(_expedited(data))
            else:
                self._segments = bytearray()

    def _segment(self, segments: bytearray, data: bytes) -> None:
        segments += data[1 : 8 - (data[0] >> 1 & 7)]
        self._last = bool(data[0] & 0x01)
        if len(segments) > _MAX_BYTES:
            self._forget()

    def _confirm_segment(self, segments: bytearray, command: int, data: bytes) -> None:
        """A segment of an upload, or the answer to one of a download."""
        if command == 0 and not self._writing:
            self._segment(segments, data)
        elif command != 1 or not self._writing:
            return
        if self._last and self._segments is not None:
            self._keep(bytes(self._segments))

    def _forget(self) -> None:
        self._address = self._segments = self._expedited = None

    def _keep(self, data: bytes) -> None:
        address = self._address
        self._forget()
        if address is not None and self._writing:
            self.written.add(address) if self._interesting(*address) else None
        if address is None or not self._interesting(*address):
            return
        value = int.from_bytes(data, "little")
        if self.values.get(address) != value:
            self.values[address] = value
            self.changes += 1


def _expedited(data: bytes) -> bytes:
    unused = data[0] >> 2 & 3 if data[0] & 0x01 else 0
    return bytes(data[4 : 8 - unused])
