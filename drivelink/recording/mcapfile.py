"""Reading MCAP files, whole or cut off: records in order, straight from the bytes.

The `mcap` library reads them too; this reader is here because it is several times as fast, and because a
file without its end (a kill, a power loss) is an ordinary file to it. Record layout: mcap.dev/spec.
"""

from __future__ import annotations

import logging
import struct
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import lz4.frame  # type: ignore[import-untyped]
import zstandard

from drivelink.errors import RecordingError

__all__ = ["McapMessage", "is_mcap", "read_messages"]

_LOG = logging.getLogger("drivelink.recording")

_MAGIC = b"\x89MCAP0\r\n"
_HEAD = struct.Struct("<BQ")  # opcode, length of the record
_MESSAGE = struct.Struct("<HIQQ")  # channel, sequence, log time, publish time
_CHUNK = struct.Struct("<QQQII")  # first, last, size, CRC, length of the compression's name
_FOOTER, _SCHEMA, _CHANNEL, _MESSAGE_OP, _CHUNK_OP, _DATA_END = 0x02, 0x03, 0x04, 0x05, 0x06, 0x0F


class McapMessage(NamedTuple):
    """One message: where it belongs, when it was, what it says."""

    topic: str
    log_time_ns: int
    data: bytes


def is_mcap(path: Path) -> bool:
    """Whether the file begins as MCAP files do."""
    with path.open("rb") as file:
        return file.read(len(_MAGIC)) == _MAGIC


def read_messages(path: Path, topics: frozenset[str] | None = None) -> Iterator[McapMessage]:
    """The messages of a file in its order.

    Args:
        path: the file.
        topics: last parts of the topics of interest (`sample` for `/elbow/sample`); None: all.

    Raises:
        RecordingError: it cannot be read, or is no MCAP file.
    """
    channels: dict[int, str | None] = {}
    try:
        with path.open("rb") as file:
            if file.read(len(_MAGIC)) != _MAGIC:
                raise RecordingError(f"{path}: expected an MCAP file, its first bytes are others")
            while len(head := file.read(_HEAD.size)) == _HEAD.size:
                opcode, length = _HEAD.unpack(head)
                if opcode in (_DATA_END, _FOOTER):
                    return
                body = file.read(length)
                if len(body) < length:
                    break
                if opcode == _CHUNK_OP:
                    chunk = _decompressed(body, path)
                    if chunk is None:
                        break
                    yield from _messages(chunk, channels, topics)
                else:
                    yield from _messages(head + body, channels, topics)
    except OSError as error:
        raise RecordingError(f"{path}: cannot be read: {error.strerror}") from error
    _LOG.warning("%s: the end is missing: read up to where it is whole", path)


def _decompressed(body: bytes, path: Path) -> bytes | None:
    """The records of a chunk, or None where it is broken."""
    _, _, size, crc, name_length = _CHUNK.unpack_from(body)
    name_end = _CHUNK.size + name_length
    compression = body[_CHUNK.size : name_end].decode(errors="replace")
    data = body[name_end + 8 :]
    try:
        if compression == "zstd":
            data = zstandard.decompress(data, max_output_size=size)
        elif compression == "lz4":
            data = lz4.frame.decompress(data)
        elif compression:
            raise RecordingError(f"{path}: compression {compression!r} is not known here")
    except (zstandard.ZstdError, RuntimeError):
        return None
    return data if not crc or zlib.crc32(data) == crc else None


def _messages(
    data: bytes, channels: dict[int, str | None], topics: frozenset[str] | None
) -> Iterator[McapMessage]:
    """The messages among some records; `channels` learns those that are declared on the way."""
    at, end = 0, len(data)
    unpack_head, unpack_message, head_size = _HEAD.unpack_from, _MESSAGE.unpack_from, _HEAD.size
    while at + head_size <= end:
        opcode, length = unpack_head(data, at)
        at += head_size
        if opcode == _MESSAGE_OP:
            channel, _, log_time, _ = unpack_message(data, at)
            topic = channels.get(channel)
            if topic is not None:
                yield McapMessage(topic, log_time, data[at + _MESSAGE.size : at + length])
        elif opcode == _CHANNEL:
            number, _, name_length = struct.unpack_from("<HHI", data, at)
            name = data[at + 8 : at + 8 + name_length].decode(errors="replace")
            wanted = topics is None or name.rsplit("/", 1)[-1] in topics
            channels[number] = name if wanted else None
        at += length
