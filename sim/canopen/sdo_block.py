"""Block transfers of the SDO server (CiA 301, 7.2.4.2.9 to 7.2.4.2.14), one object a transfer."""

from __future__ import annotations

import binascii
import struct

from sim.canopen.aborts import Abort, SdoAbortError
from sim.canopen.dictionary import Entry

_LARGEST_BLOCK = 127  # segments
_LARGEST_DOWNLOAD = 1 << 16  # bytes a client may send before the server stops it


class BlockUpload:
    """Server side of a block upload.

    Args:
        content: bytes to send.
        blksize: segments per block that the client asks for, 1 to 127.
        crc: whether the client checks the CRC.
    """

    def __init__(self, content: bytes, *, blksize: int, crc: bool) -> None:
        self._content = content
        self._crc = binascii.crc_hqx(content, 0) if crc else 0
        self._blksize = self._checked(blksize)
        self._position = 0  # bytes acknowledged
        self._started = self._ending = False
        self.done = False

    @staticmethod
    def _checked(blksize: int) -> int:
        if not 1 <= blksize <= _LARGEST_BLOCK:
            raise SdoAbortError(Abort.BLOCK_SIZE)
        return blksize

    def receive(self, data: bytes) -> list[bytes]:
        """Answer start, acknowledge and end."""
        command, step = data[0] >> 5, data[0] & 3
        if command != 5:
            raise SdoAbortError(Abort.COMMAND)
        if step == 3 and not self._started:
            self._started = True
            return self._segments()
        if step == 2 and self._started and not self._ending:
            return self._acknowledged(data[1], data[2])
        if step == 1 and self._ending:
            self.done = True
            return []
        raise SdoAbortError(Abort.COMMAND)

    def _acknowledged(self, sequence: int, blksize: int) -> list[bytes]:
        if sequence > self._blksize:
            raise SdoAbortError(Abort.SEQUENCE)
        self._position = min(self._position + 7 * sequence, len(self._content))
        self._blksize = self._checked(blksize)
        if self._position < len(self._content):
            return self._segments()
        self._ending = True
        unused = -len(self._content) % 7
        return [struct.pack("<BH5x", 0xC1 | unused << 2, self._crc)]

    def _segments(self) -> list[bytes]:
        frames = []
        for number in range(1, self._blksize + 1):
            start = self._position + 7 * (number - 1)
            last = start + 7 >= len(self._content)
            frames.append(bytes([last << 7 | number]) + self._content[start : start + 7].ljust(7, b"\0"))
            if last:
                break
        return frames


class BlockDownload:
    """Server side of a block download.

    Args:
        entry: where the bytes go.
        size: how many the client announces, if it does.
        crc: whether the client sends a CRC.
    """

    def __init__(self, entry: Entry, size: int | None, *, crc: bool) -> None:
        self.blksize = _LARGEST_BLOCK
        self.done = False
        self._entry = entry
        self._size = size
        self._crc = crc
        self._data = bytearray()
        self._sequence = 0
        self._last = False

    def receive(self, data: bytes) -> list[bytes]:
        """Take a segment, or the end of the transfer."""
        return self._end(data) if self._last else self._segment(data)

    def _segment(self, data: bytes) -> list[bytes]:
        number = data[0] & 0x7F
        if number == 0:
            raise SdoAbortError(Abort.SEQUENCE)
        in_order = number == self._sequence + 1
        if in_order:
            self._sequence = number
            self._data += data[1:8]
            if len(self._data) > _LARGEST_DOWNLOAD:
                raise SdoAbortError(Abort.TOO_LONG)
        last = bool(data[0] & 0x80)
        if not last and number < self.blksize:
            return []
        self._last = last and in_order
        acknowledge = bytes([0xA2, self._sequence, self.blksize]) + bytes(5)
        self._sequence = 0
        return [acknowledge]

    def _end(self, data: bytes) -> list[bytes]:
        if data[0] & 0xE1 != 0xC1:
            raise SdoAbortError(Abort.COMMAND)
        unused = (data[0] >> 2) & 7
        content = bytes(self._data[: len(self._data) - unused])
        if self._size is not None and len(content) != self._size:
            raise SdoAbortError(Abort.TOO_LONG if len(content) > self._size else Abort.TOO_SHORT)
        if self._crc and binascii.crc_hqx(content, 0) != struct.unpack_from("<H", data, 1)[0]:
            raise SdoAbortError(Abort.CRC)
        self._entry.download(content)
        self.done = True
        return [bytes([0xA1]) + bytes(7)]
