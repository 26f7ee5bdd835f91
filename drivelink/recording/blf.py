"""Reads BLF files of Vector's tools: objects in packed containers, unpacked within limits.

Unlike python-can's reader it is several times as fast, its stamps are exact, and an object without a length
or without an end costs no more than its bytes. The layout is the one that python-can's reader knows.
"""

from __future__ import annotations

import os
import struct
import zlib
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import IO

from drivelink.errors import RecordingError
from drivelink.recording.limits import MAX_BLOCK_BYTES

_FILE_HEAD = struct.Struct("<4sL32x8H")  # signature, size of the head, date and time of the first stamp
_BASE = struct.Struct("<4s4xLL")  # signature, size, type
_METHOD = struct.Struct("<H14x")  # of compression
_OBJECT = struct.Struct("<6xHLLL4xQ")  # version of the head, size, type, unit of the stamp, stamp
_CLASSIC = struct.Struct("<HBBL8s")  # channel, flags, length, identifier, data
_FD = struct.Struct("<HBxL6xB5x64s")  # channel, flags, identifier, length, data
_FD64 = struct.Struct("<BxBxL4xL19xB4x")  # channel, length, identifier, flags, place of what follows the data
_CONTAINER, _DEFLATED = 10, 2
_TEN_US = 1  # unit of a stamp; else 1 ns
_EXTENDED, _REMOTE, _REMOTE_FD64 = 0x8000_0000, 0x80, 0x10
_RATIO = 32  # of unpacked bytes to those of the file: of a bus at rest they are 10
_SMALL_BYTES = 1 << 20  # that any file may unpack to

Frame = tuple[int, int, bytes, str]
"""Stamp in ns, identifier, data, channel."""


def blf_frames(file: IO[bytes], path: Path) -> Iterator[Frame | None]:
    """Yield the objects of a file in order; None: it is no data frame with a short identifier.

    Raises:
        RecordingError: a container exceeds the limits.
        ValueError: the rest is damaged.
    """
    signature, size, *start = _FILE_HEAD.unpack(file.read(_FILE_HEAD.size))
    if signature != b"LOGG":
        raise ValueError("no BLF file")
    file.seek(size)
    start_ns, data, at = _nanoseconds(start), bytearray(), 0
    for content in _contents(file, path):
        del data[:at]
        data += content  # an object may go on in the next container
        at = 0
        while len(data) - at >= 8:
            begin = data.find(b"LOBJ", at, at + 8)
            if begin < 0:
                raise ValueError("expected an object, got something else")
            if len(data) - begin < _OBJECT.size:
                break
            version, size, kind, unit, stamp = _OBJECT.unpack_from(data, begin)
            if size < _OBJECT.size:
                raise ValueError(f"expected no object of {size} bytes")
            if begin + size > len(data):
                break
            at = begin + size
            found = _frame(kind, data, begin, begin + (32 if version == 1 else 40), at)
            yield found and (start_ns + stamp * (10_000 if unit == _TEN_US else 1), *found)


def _nanoseconds(start: list[int]) -> int:
    """UNIX time of the parts of a date; 0: none."""
    year, month, _, day, hour, minute, second, milliseconds = start
    try:
        moment = datetime(year, month, day, hour, minute, second, tzinfo=UTC)
        return int(moment.timestamp()) * 10**9 + milliseconds * 10**6
    except ValueError:
        return 0


def _contents(file: IO[bytes], path: Path) -> Iterator[bytes]:
    """The containers, unpacked."""
    left = _RATIO * os.fstat(file.fileno()).st_size + _SMALL_BYTES
    while head := file.read(_BASE.size):
        signature, size, kind = _BASE.unpack(head)
        if signature != b"LOBJ" or size < _BASE.size:
            raise ValueError("expected a container, got something else")
        _require(size <= MAX_BLOCK_BYTES, path)
        body = file.read(size - _BASE.size)
        file.read(size % 4)
        if kind != _CONTAINER:
            continue
        (method,) = _METHOD.unpack_from(body)
        content = body[_METHOD.size :]
        if method == _DEFLATED:
            content = zlib.decompressobj().decompress(content, left + 1)
            left -= len(content)
            _require(left >= 0, path)
        elif method:
            raise ValueError(f"compression {method} is not known here")
        yield content


def _require(fits: bool, path: Path) -> None:
    if not fits:
        raise RecordingError(
            f"{path}: expected containers of at most {MAX_BLOCK_BYTES >> 20} MiB, "
            f"unpacked {_RATIO} times the file, got larger ones"
        )


def _frame(kind: int, data: bytearray, begin: int, at: int, end: int) -> tuple[int, bytes, str] | None:
    """Identifier, data and channel of an object; None: it is no such frame."""
    if kind in (1, 86):
        channel, flags, length, can_id, payload = _CLASSIC.unpack_from(data, at)
        remote = flags & _REMOTE
    elif kind == 100:
        channel, flags, can_id, length, payload = _FD.unpack_from(data, at)
        remote = flags & _REMOTE
    elif kind == 101:
        channel, length, can_id, flags, further = _FD64.unpack_from(data, at)
        remote, at = flags & _REMOTE_FD64, at + _FD64.size
        # Zeros that end the data may be left out.
        payload = bytes(data[at : min(at + length, begin + further if further else end)]).ljust(length, b"\0")
    else:
        return None
    return (
        None if remote or can_id & _EXTENDED else (can_id & 0x1FFF_FFFF, payload[:length], str(channel - 1))
    )
