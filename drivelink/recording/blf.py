"""Reads BLF files of Vector's tools: objects in packed containers, unpacked within limits.

Unlike python-can's reader it is several times as fast, its stamps are exact, and an object without a length
or without an end costs no more than its bytes. The layout is the one that python-can's reader knows.
"""

import os
import struct
import zlib
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import IO

from drivelink._core import BlfFrames
from drivelink.errors import RecordingError
from drivelink.recording.limits import MAX_BLOCK_BYTES

_FILE_HEAD = struct.Struct("<4sL32x8H")  # signature, size of the head, date and time of the first stamp
_BASE = struct.Struct("<4s4xLL")  # signature, size, type
_METHOD = struct.Struct("<H14x")  # of compression
_CONTAINER, _DEFLATED = 10, 2
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
    frames = BlfFrames(_nanoseconds(start))
    for content in _contents(file, path):
        yield from frames.take(content)


def _nanoseconds(start: list[int]) -> int:
    """UNIX time of the parts of a date; 0: none."""
    year, month, _, day, hour, minute, second, milliseconds = start
    try:
        moment = datetime(year, month, day, hour, minute, second, tzinfo=UTC)
        return max(0, int(moment.timestamp()) * 10**9 + milliseconds * 10**6)
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
