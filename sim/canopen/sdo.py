"""The SDO server of a simulated device: expedited, segmented and block transfers (CiA 301, 7.2.4).

canopen's server has no block transfers.
"""

from __future__ import annotations

import struct
from collections.abc import Callable

from sim.canopen.aborts import Abort, SdoAbortError
from sim.canopen.dictionary import Dictionary, Entry
from sim.canopen.sdo_block import BlockDownload, BlockUpload
from sim.canopen.timers import Timer, Timers

_TIMEOUT_S = 1.0  # timeout between two frames of a transfer

_DOWNLOAD_SEGMENT, _DOWNLOAD, _UPLOAD, _UPLOAD_SEGMENT = 0, 1, 2, 3
_ABORT, _BLOCK_UPLOAD, _BLOCK_DOWNLOAD = 4, 5, 6


class _Segments:
    """A segmented transfer under way."""

    def __init__(self, entry: Entry, data: bytes, size: int | None) -> None:
        self.entry = entry
        self.data = bytearray(data)
        self.size = size
        self.toggle = 0


class SdoServer:
    """One server on one pair of identifiers.

    Args:
        dictionary: what it serves.
        timers: for timeouts.
        send: puts the eight bytes of a response on the bus.

    Attributes:
        ignored: requests that it will not answer, for tests.
        refused: requests that it will abort, with `refusal`, for tests.
        refusal: the abort code.
        endless: for tests: bytes in each segment of an upload that never ends; -1: normal operation.
    """

    def __init__(self, dictionary: Dictionary, timers: Timers, send: Callable[[bytes], None]) -> None:
        self.ignored = self.refused = 0
        self.refusal = int(Abort.DATA_TRANSFER)
        self.endless = -1
        self._dictionary = dictionary
        self._timers = timers
        self._send = send
        self._upload: _Segments | None = None
        self._download: _Segments | None = None
        self._block: BlockUpload | BlockDownload | None = None
        self._timer: Timer | None = None
        self._multiplexer = (0, 0)

    def reset(self) -> None:
        """Forget any transfer under way."""
        self._upload = self._download = self._block = None
        if self._timer:
            self._timer.cancel()
            self._timer = None

    def receive(self, data: bytes) -> None:
        """Handle one request; frames of other than eight bytes are ignored."""
        if len(data) != 8:
            return
        if self.ignored:
            self.ignored -= 1
            return
        if self.refused and data[0] != _ABORT << 5:
            self.refused -= 1
            self.reset()
            self._multiplexer = struct.unpack_from("<HB", data, 1)
            self._abort(self.refusal)
            return
        if self.endless >= 0 and data[0] >> 5 in (_UPLOAD, _UPLOAD_SEGMENT):
            self._send(self._endless(data))
            return
        try:
            response = self._answer(data)
        except SdoAbortError as abort:
            self.reset()
            self._abort(abort.code)
            return
        if response is not None:
            self._send(response)
        self._watch()

    def _endless(self, data: bytes) -> bytes:
        """Declare four bytes, then send segments without end."""
        if data[0] >> 5 == _UPLOAD:
            return bytes([0x41]) + data[1:4] + struct.pack("<I", 4)
        return bytes([data[0] & 0x10 | (7 - self.endless) << 1]) + b"\xff" * 7

    def _answer(self, data: bytes) -> bytes | None:
        if data[0] == _ABORT << 5:
            self.reset()
            return None
        if self._block is not None:
            return self._answer_block(self._block, data)
        command = data[0] >> 5
        if command == _DOWNLOAD_SEGMENT:
            return self._download_segment(data)
        if command == _UPLOAD_SEGMENT:
            return self._upload_segment(data)
        if command in (_DOWNLOAD, _UPLOAD, _BLOCK_UPLOAD, _BLOCK_DOWNLOAD):
            self.reset()  # a new request ends whatever transfer was under way
            self._multiplexer = struct.unpack_from("<HB", data, 1)
            entry = self._dictionary.find
            if command == _DOWNLOAD:
                return self._initiate_download(entry(*self._multiplexer), data)
            if command == _UPLOAD:
                return self._initiate_upload(entry(*self._multiplexer), data)
            if command == _BLOCK_UPLOAD:
                return self._initiate_block_upload(entry(*self._multiplexer), data)
            return self._initiate_block_download(entry(*self._multiplexer), data)
        raise SdoAbortError(Abort.COMMAND)

    def _initiate_download(self, entry: Entry, data: bytes) -> bytes:
        expedited, sized = data[0] & 2, data[0] & 1
        entry.writable()
        if expedited:
            size = 4 - ((data[0] >> 2) & 3) if sized else min(4, entry.bits // 8 or 4)
            entry.download(data[4 : 4 + size])
        else:
            announced: int | None = struct.unpack_from("<I", data, 4)[0] if sized else None
            if announced is not None and entry.bits and announced * 8 != entry.bits:
                raise SdoAbortError(Abort.TOO_LONG if announced * 8 > entry.bits else Abort.TOO_SHORT)
            self._download = _Segments(entry, b"", announced)
        return struct.pack("<BHB4x", 0x60, *self._multiplexer)

    def _download_segment(self, data: bytes) -> bytes:
        transfer = self._download
        if transfer is None:
            raise SdoAbortError(Abort.COMMAND)
        if data[0] & 0x10 != transfer.toggle:
            raise SdoAbortError(Abort.TOGGLE)
        transfer.data += data[1 : 8 - ((data[0] >> 1) & 7)]
        response = bytes([0x20 | transfer.toggle]) + bytes(7)
        transfer.toggle ^= 0x10
        if data[0] & 1:
            if transfer.size is not None and len(transfer.data) != transfer.size:
                longer = len(transfer.data) > transfer.size
                raise SdoAbortError(Abort.TOO_LONG if longer else Abort.TOO_SHORT)
            self.reset()
            transfer.entry.download(bytes(transfer.data))
        elif len(transfer.data) > (transfer.size or 1 << 16):
            raise SdoAbortError(Abort.TOO_LONG)
        return response

    def _initiate_upload(self, entry: Entry, data: bytes) -> bytes:
        content = entry.upload()
        if 1 <= len(content) <= 4:
            command = 0x43 | (4 - len(content)) << 2
            return struct.pack("<BHB", command, *self._multiplexer) + content.ljust(4, b"\0")
        self._upload = _Segments(entry, content, len(content))
        return struct.pack("<BHBI", 0x41, *self._multiplexer, len(content))

    def _upload_segment(self, data: bytes) -> bytes:
        transfer = self._upload
        if transfer is None:
            raise SdoAbortError(Abort.COMMAND)
        if data[0] & 0x10 != transfer.toggle:
            raise SdoAbortError(Abort.TOGGLE)
        segment = bytes(transfer.data[:7])
        del transfer.data[:7]
        last = not transfer.data
        command = transfer.toggle | (7 - len(segment)) << 1 | last
        transfer.toggle ^= 0x10
        if last:
            self.reset()
        return bytes([command]) + segment.ljust(7, b"\0")

    def _initiate_block_upload(self, entry: Entry, data: bytes) -> bytes | None:
        if data[0] & 3:  # start, end or acknowledge of a transfer that was never initiated
            raise SdoAbortError(Abort.COMMAND)
        content = entry.upload()
        if 0 < len(content) <= data[5]:  # protocol switch: no more bytes than the client's threshold
            return self._initiate_upload(entry, data)
        self._block = BlockUpload(content, blksize=data[4], crc=bool(data[0] & 4))
        return struct.pack("<BHBI", 0xC6, *self._multiplexer, len(content))

    def _initiate_block_download(self, entry: Entry, data: bytes) -> bytes:
        if data[0] & 1:
            raise SdoAbortError(Abort.COMMAND)
        entry.writable()
        size = struct.unpack_from("<I", data, 4)[0] if data[0] & 2 else None
        self._block = BlockDownload(entry, size, crc=bool(data[0] & 4))
        return struct.pack("<BHBB3x", 0xA4, *self._multiplexer, self._block.blksize)

    def _answer_block(self, block: BlockUpload | BlockDownload, data: bytes) -> bytes | None:
        frames = block.receive(data)
        if block.done:
            self.reset()
        for frame in frames:
            self._send(frame)
        return None

    def _watch(self) -> None:
        if self._timer:
            self._timer.cancel()
            self._timer = None
        if self._upload or self._download or self._block:
            self._timer = self._timers.after(_TIMEOUT_S, self._timed_out)

    def _timed_out(self) -> None:
        self.reset()
        self._abort(Abort.TIMEOUT)

    def _abort(self, code: int) -> None:
        self._send(struct.pack("<BHBI", 0x80, *self._multiplexer, code))
