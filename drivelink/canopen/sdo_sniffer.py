"""Reads another master's SDO transfers from the traffic (CiA 301, 7.2.4.3).

An answer is used only if it belongs to a request that was heard: of the same object, in order, within the
time-out. Every other one is counted and ignored. Where two different answers follow one request, or a
download is given up before its answer, the object's value is not known: it is disputed until it is
transferred again.

A download counts once the node has confirmed it. Expedited and segmented transfers are followed. The object
of a block download is disputed: its bytes are not followed.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

Address = tuple[int, int]

_MAX_BYTES = 8  # no object of interest is longer
# Commands of the client; 5 is a block upload.
_DOWNLOAD_SEGMENT, _DOWNLOAD, _UPLOAD, _UPLOAD_SEGMENT, _ABORT, _, _BLOCK_DOWNLOAD = range(7)
_SEGMENT_SENT, _SEGMENT_TAKEN, _UPLOADED, _DOWNLOADED = range(4)  # commands of the server; it aborts with 4
_TOGGLE = 0x10


@dataclass(slots=True)
class _Transfer:
    """One transfer."""

    address: Address
    writing: bool
    asked_s: float  # time of the present request
    due: int | None  # the command that answers it; None: it has been answered
    segmented: bool = False
    data: bytes = b""  # to or from the node so far
    answer: bytes = b""  # the last one accepted
    toggle: int = _TOGGLE  # of the present segment
    last: bool = False  # the present segment is the last one
    ended: bool = False  # complete, aborted or disputed


class SdoSniffer:
    """Follows the SDO channel of one node.

    Args:
        interesting: whether to keep the value of an object.
    """

    def __init__(self, interesting: Callable[[int, int], bool], timeout_s: float) -> None:
        self._interesting = interesting
        self._timeout_s = timeout_s
        self.values: dict[Address, int] = {}  # confirmed unsigned values by (index, subindex)
        self.written: set[Address] = set()  # those of them that were written, not read
        # objects with two different answers to one request, or a download that was given up
        self.disputed: set[Address] = set()
        self.unasked = 0  # answers that belong to no request
        self.changes = 0  # number of new, changed, forgotten and disputed values
        self._transfer: _Transfer | None = None
        self._blocks = False  # a block transfer
        self._block_s = -math.inf  # time of the last segment of a block download
        self._last_segment = False

    @property
    def pending(self) -> Address | None:
        """The object being written, not yet confirmed."""
        transfer = self._transfer
        return transfer.address if transfer is not None and transfer.writing and not transfer.ended else None

    def forget(self, lost: Callable[[Address], bool]) -> None:
        """Handle a restart of the node: forget written values and those that `lost` selects."""
        self._transfer = None
        for address in [a for a in self.values if a in self.written or lost(a)]:
            del self.values[address]
        self.written.clear()
        self.disputed = {address for address in self.disputed if not lost(address)}
        self.changes += 1

    def request(self, data: bytes, now_s: float) -> None:
        """Process a frame of the master, 0x600 + node."""
        data = _padded(data)
        if not data or self._goes_on(data, now_s):
            return
        command, transfer = data[0] >> 5, self._transfer
        self._blocks = command > _ABORT
        if command == _BLOCK_DOWNLOAD:
            self._block_s, self._last_segment = now_s, False
            self._dispute(_address(data))
        if command in (_DOWNLOAD, _UPLOAD):
            self._transfer = _begun(data, now_s)
        elif transfer is not None and _may_follow(transfer, data):
            transfer.asked_s, transfer.toggle = now_s, data[0] & _TOGGLE
            transfer.due = _SEGMENT_TAKEN if transfer.writing else _SEGMENT_SENT
            if transfer.writing:
                _add_segment(transfer, data)
            return
        else:  # an abort, a block transfer, or out of order
            self._transfer = None
        if transfer is not None and transfer.writing and not transfer.ended:
            self._dispute(transfer.address)

    def response(self, data: bytes, now_s: float) -> tuple[Address, bytes] | None:
        """Process a frame of the node, 0x580 + node; return the object of interest that it ends to read."""
        transfer, data = self._transfer, _padded(data)
        if data and data[0] >> 5 == _ABORT:
            self._block_s = -math.inf  # the node refuses a block download, or gives it up
        if not data or self._blocks:
            return None
        if transfer is None or now_s - transfer.asked_s > self._timeout_s or not _names(transfer, data):
            self.unasked += 1
        elif transfer.due is None:
            self._repeated(transfer, data)
        elif data[0] >> 5 in (transfer.due, _ABORT):
            return self._accept(transfer, data)
        else:
            self.unasked += 1
        return None

    def _goes_on(self, data: bytes, now_s: float) -> bool:
        """Return whether the master's frame belongs to a block download: its segments look like requests."""
        if now_s - self._block_s > self._timeout_s:
            return False
        ended = data[0] == _ABORT << 5 or (self._last_segment and data[0] & 0xE3 == 0xC1)
        self._block_s = -math.inf if ended else now_s
        self._last_segment = bool(data[0] & 0x80)
        return True

    def _accept(self, transfer: _Transfer, data: bytes) -> tuple[Address, bytes] | None:
        """Accept the answer that is due."""
        command = data[0] >> 5
        transfer.due, transfer.answer = None, data
        if command == _ABORT:
            transfer.ended = True
        elif command == _UPLOADED:
            transfer.segmented = not data[0] & 0x02
            transfer.data += b"" if transfer.segmented else _expedited(data)
        elif command == _SEGMENT_SENT:
            _add_segment(transfer, data)
        if not transfer.ended and (transfer.last or not transfer.segmented):
            return self._complete(transfer)
        return None

    def _repeated(self, transfer: _Transfer, data: bytes) -> None:
        """Compare a further answer to a request."""
        if data == transfer.answer:
            return
        self.unasked += 1
        transfer.ended = True
        self._dispute(transfer.address)

    def _dispute(self, address: Address) -> None:
        if self._interesting(*address) and address not in self.disputed:
            self.disputed.add(address)
            self.changes += 1

    def _complete(self, transfer: _Transfer) -> tuple[Address, bytes] | None:
        transfer.ended = True
        address = transfer.address
        if not self._interesting(*address) or len(transfer.data) > _MAX_BYTES:
            return None
        if transfer.writing:
            self.written.add(address)
        value = int.from_bytes(transfer.data, "little")
        if self.values.get(address) != value or address in self.disputed:
            self.values[address] = value
            self.disputed.discard(address)
            self.changes += 1
        return None if transfer.writing else (address, transfer.data)


def is_mapping(address: Address) -> bool:
    """Return whether an object is a parameter of a TPDO (CiA 301, 7.5.2.37 and 38)."""
    return 0x1800 <= address[0] <= 0x1BFF


def written_object(data: bytes) -> Address | None:
    """Return the object that a frame of the master begins to write."""
    begins = data and (data[0] >> 5 == _DOWNLOAD or data[0] & 0xE1 == _BLOCK_DOWNLOAD << 5)
    return _address(padded) if begins and (padded := _padded(data)) else None


def _padded(data: bytes) -> bytes:
    """The eight bytes of a frame, of which some nodes take fewer; empty: it is none of SDO."""
    if len(data) == 8:
        return data
    return data.ljust(8, b"\0") if 0 < len(data) < 8 else b""


def _begun(data: bytes, now_s: float) -> _Transfer:
    if data[0] >> 5 == _UPLOAD:
        return _Transfer(_address(data), False, now_s, _UPLOADED)
    if data[0] & 0x02:
        return _Transfer(_address(data), True, now_s, _DOWNLOADED, False, _expedited(data))
    return _Transfer(_address(data), True, now_s, _DOWNLOADED, True)


def _may_follow(transfer: _Transfer, data: bytes) -> bool:
    """Return whether a request is the next segment: answered before, and with the other toggle bit."""
    wanted = _DOWNLOAD_SEGMENT if transfer.writing else _UPLOAD_SEGMENT
    ready = transfer.segmented and transfer.due is None and not transfer.ended
    return ready and data[0] >> 5 == wanted and data[0] & _TOGGLE != transfer.toggle


def _names(transfer: _Transfer, data: bytes) -> bool:
    """Return whether an answer names the object, or the segment, of the present request."""
    if data[0] >> 5 in (_SEGMENT_SENT, _SEGMENT_TAKEN):
        return transfer.segmented and data[0] & _TOGGLE == transfer.toggle
    return _address(data) == transfer.address


def _add_segment(transfer: _Transfer, data: bytes) -> None:
    if len(transfer.data) <= _MAX_BYTES:  # else the value is not kept
        transfer.data += data[1 : 8 - (data[0] >> 1 & 7)]
    transfer.last = bool(data[0] & 0x01)


def _address(data: bytes) -> Address:
    return data[1] | data[2] << 8, data[3]


def _expedited(data: bytes) -> bytes:
    unused = data[0] >> 2 & 3 if data[0] & 0x01 else 0
    return bytes(data[4 : 8 - unused])
