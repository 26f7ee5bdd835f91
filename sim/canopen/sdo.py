"""The SDO server of a simulated device: canopen's, as strict as known devices, with timeout and faults.

Expedited and segmented transfers (CiA 301, 7.2.4). A block upload is answered by an ordinary one, which a
server may do, and a block download is aborted.
"""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING

from canopen.sdo.server import SdoServer as CanopenServer

from sim.canopen.dictionary import LONGEST_STRING, Abort, SdoAbortedError

if TYPE_CHECKING:
    from sim.canopen.node import Node

_TIMEOUT_S = 1.0  # between two frames of a transfer
_DOWNLOAD_SEGMENT, _DOWNLOAD, _UPLOAD, _UPLOAD_SEGMENT, _ABORT = range(5)  # command specifiers
_EXPEDITED, _SIZED, _LAST = 2, 1, 1


class SdoServer(CanopenServer):
    """One server on the default pair of identifiers."""

    def __init__(self, node: Node) -> None:
        super().__init__(0x600 + node.node_id, 0x580 + node.node_id, node.dictionary)
        self.ignored = 0  # requests that it will not answer, for tests
        self.refused = 0  # requests that it will abort, with `refusal`, for tests
        self.refusal = int(Abort.DATA_TRANSFER)  # the abort code
        # for tests: bytes in each segment of an upload that never ends; -1: normal operation
        self.endless = -1
        self._device = node
        self._index = self._subindex = 0
        self.reset()

    def reset(self) -> None:
        """Forget any transfer under way."""
        self._buffer: bytearray | None = None
        self._uploading = False
        self._watch()

    def send_response(self, response: bytes) -> None:
        """Send eight bytes."""
        self._device.send(self.tx_cobid, bytes(response))

    def abort(self, abort_code: int = 0x08000000) -> None:
        """End the transfer, telling the client why."""
        self.reset()
        super().abort(abort_code)

    def receive(self, data: bytes) -> None:
        """Handle one request; frames of other than eight bytes are ignored."""
        command = data[0] >> 5 if len(data) == 8 else _ABORT
        if self.ignored and len(data) == 8:
            self.ignored -= 1
        elif command == _ABORT:
            if len(data) == 8:
                self.reset()
        elif self.refused:
            self.refused -= 1
            self._index, self._subindex = struct.unpack_from("<HB", data, 1)
            self.abort(self.refusal)
        elif self.endless >= 0 and command in (_UPLOAD, _UPLOAD_SEGMENT):
            self.send_response(self._endless(data))
        elif command in (_DOWNLOAD_SEGMENT, _UPLOAD_SEGMENT):
            self._segment(data, command == _UPLOAD_SEGMENT)
        else:
            self.reset()  # a new request ends whatever transfer was under way
            self.on_request(self.rx_cobid, data, 0.0)
            self._uploading = command != _DOWNLOAD
            self._watch()

    def _segment(self, data: bytes, uploading: bool) -> None:
        buffer = self._buffer
        if buffer is None or uploading != self._uploading:
            self.abort(Abort.COMMAND)
            return
        if len(buffer) > LONGEST_STRING and not uploading:
            self.abort(Abort.TOO_LONG)
            return
        self.on_request(self.rx_cobid, data, 0.0)
        if not buffer if uploading else data[0] & _LAST:
            self.reset()
        self._watch()

    def init_download(self, request: bytes) -> None:
        """Refuse at once what the last segment would refuse; without a size the object's own counts."""
        command, index, subindex = struct.unpack_from("<BHB", request)
        self._index, self._subindex = index, subindex
        entry = self._device.dictionary.find(index, subindex)
        entry.writable()
        size = entry.bits // 8
        if command & _EXPEDITED and not command & _SIZED:
            request = bytes([command | _SIZED | (4 - min(4, size or 4)) << 2]) + request[1:]
        elif not command & _EXPEDITED and command & _SIZED and size:
            announced = struct.unpack_from("<I", request, 4)[0]
            if announced != size:
                raise SdoAbortedError(Abort.TOO_LONG if announced > size else Abort.TOO_SHORT)
        super().init_download(request)

    def _endless(self, data: bytes) -> bytes:
        """Declare four bytes, then send segments without end."""
        if data[0] >> 5 == _UPLOAD:
            return bytes([0x41]) + data[1:4] + struct.pack("<I", 4)
        return bytes([data[0] & 0x10 | (7 - self.endless) << 1]) + b"\xff" * 7

    def _watch(self) -> None:
        self._device.timers.cancel("sdo")
        if self._buffer is not None:
            self._device.timers.set("sdo", _TIMEOUT_S, lambda: self.abort(Abort.TIMEOUT))
