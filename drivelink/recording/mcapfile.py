"""Reads MCAP files, complete or truncated: records in file order, their samples one by one or as a record.

Unlike the `mcap` library's reader it is several times as fast, and accepts files without an end (after a kill
or a power loss). Record layout: mcap.dev/spec.
"""

from __future__ import annotations

import logging
import math
import os
import struct
import zlib
from array import array
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from functools import lru_cache
from pathlib import Path
from typing import IO

import lz4.frame  # type: ignore[import-untyped]
import numpy as np
import zstandard

from drivelink._core import JsonNumbers, McapMessage, McapMessages
from drivelink.errors import RecordingError, raised_as
from drivelink.files import open_regular
from drivelink.jointfile import JointFile
from drivelink.jointfile.columns import COLUMNS
from drivelink.recording.columns import record_from_columns
from drivelink.recording.cycles import Cycle
from drivelink.recording.limits import (
    MAX_BLOCK_BYTES,
    MAX_UNREAD,
    most_records,
    require_samples,
    require_stamp,
    too_many_records,
)
from drivelink.recording.messages import measured_names
from estimator.sample import Record, Sample, Status

_LOG = logging.getLogger("drivelink.recording")

_MAGIC = b"\x89MCAP0\r\n"
_HEAD = struct.Struct("<BQ")  # opcode, length of the record
_CHUNK = struct.Struct("<QQQII")  # first, last, size, CRC, length of the compression's name
_FOOTER, _CHANNEL, _MESSAGE_OP, _CHUNK_OP, _DATA_END = 0x02, 0x04, 0x05, 0x06, 0x0F
_ATTACHMENT = 0x09
SNAPSHOT = "estimator"  # name of the attachment from whose state a replay goes on
_WANTED = frozenset({_CHANNEL, _MESSAGE_OP, _CHUNK_OP})
_MOST_RATIO = 64  # of unpacked bytes to those of the file: of a joint at rest they are some 30
_SMALL_BYTES = 16 << 20  # that any file may unpack to
_ZSTD_WINDOW = 128 << 20  # memory limit of its decoder, the same as in zstd's tools


def read_messages(path: Path, topics: frozenset[str] | None = None) -> Iterator[McapMessage]:
    """Yield the messages of a file in order, up to a damaged place.

    Args:
        topics: last parts of the topics of interest (`sample` for `/elbow/sample`); None: all.

    Raises:
        RecordingError: it cannot be read, is not an MCAP file, or has a record larger than `MAX_BLOCK_BYTES`.
    """
    messages = McapMessages(topics)
    with _opened(path) as file:
        size = os.fstat(file.fileno()).st_size
        unpacked = 0
        try:
            for opcode, record in _records(file, path, _WANTED):
                records = _decompressed(record[_HEAD.size :], path) if opcode == _CHUNK_OP else record
                unpacked += len(records)
                if unpacked > _MOST_RATIO * size + _SMALL_BYTES:
                    raise RecordingError(
                        f"{path}: expected to unpack to at most {_MOST_RATIO} times its size"
                    )
                most = most_records(file.tell())
                yield from messages.take(records, most)
                if messages.count > most:
                    raise too_many_records(path)
                require_stamp(messages.stamp_ns, path)
                if messages.broken:
                    raise _BrokenError
        except _BrokenError:
            _warn_once(path.stat().st_mtime_ns, "%s: truncated or damaged: read up to the damage", path)


def read_attachment(path: Path, name: str) -> bytes | None:
    """Return the first attachment of that name; None: the file has none before a damaged place.

    Raises:
        RecordingError: the file cannot be read, or the attachment is larger than `MAX_BLOCK_BYTES`.
    """
    with _opened(path) as file, suppress(_BrokenError, struct.error):
        for _, record in _records(file, path, frozenset({_ATTACHMENT})):
            found, data = _attached(record[_HEAD.size :])
            if found == name:
                return data
    return None


@contextmanager
def _opened(path: Path) -> Iterator[IO[bytes]]:
    """The file behind its first bytes."""
    with raised_as(RecordingError, f"{path}: cannot be read"), open_regular(path) as file:
        if file.read(len(_MAGIC)) != _MAGIC:
            raise RecordingError(f"{path}: expected an MCAP file, its first bytes are not those of one")
        yield file


def _records(file: IO[bytes], path: Path, wanted: frozenset[int]) -> Iterator[tuple[int, bytes]]:
    """Yield opcode and bytes of some records, those of indexes and metadata skipped.

    Raises:
        _BrokenError: the file is truncated, or a length is damaged.
        RecordingError: one is larger than `MAX_BLOCK_BYTES`.
    """
    left = os.fstat(file.fileno()).st_size - len(_MAGIC)
    while len(head := file.read(_HEAD.size)) == _HEAD.size:
        opcode, length = _HEAD.unpack(head)
        left -= _HEAD.size + length
        if opcode in (_DATA_END, _FOOTER):
            return
        if left < 0:
            break
        if opcode in wanted:
            _require_size(length, path)
            yield opcode, head + file.read(length)
        else:
            file.seek(length, os.SEEK_CUR)
    raise _BrokenError


def _attached(body: bytes) -> tuple[str, bytes]:
    """Name and data of an attachment."""
    place, texts = 16, []  # after its times
    for _ in ("name", "media type"):
        (size,) = struct.unpack_from("<I", body, place)
        texts.append(body[place + 4 : place + 4 + size].decode(errors="replace"))
        place += 4 + size
    (size,) = struct.unpack_from("<Q", body, place)
    return texts[0], body[place + 8 : place + 8 + size]


@lru_cache(maxsize=16)
def _warn_once(_mtime_ns: int, text: str, *about: object) -> None:
    """A file is read several times: for its joint, its mapping, its samples."""
    _LOG.warning(text, *about)


def warn_of_another(path: Path, joint: str) -> None:
    """Warn if a recording is of a joint with another name than that of the joint file."""
    if message := next(read_messages(path, frozenset({"sample"})), None):
        recorded = message.topic.strip("/").rpartition("/")[0]
        if recorded != joint:
            text = '%s: recorded of "%s", while the joint file is of "%s"'
            _warn_once(0, text, path, recorded[:80], joint)


class _BrokenError(Exception):
    """The rest cannot be read."""


def _require_size(size: int, path: Path) -> None:
    if size > MAX_BLOCK_BYTES:
        raise RecordingError(
            f"{path}: expected records of at most {MAX_BLOCK_BYTES >> 20} MiB unpacked, got {size >> 20} MiB"
        )


def _decompressed(body: bytes, path: Path) -> bytes:
    """Return the records of a chunk.

    Raises:
        RecordingError: too large, larger than declared, or of unknown compression.
    """
    try:
        _, _, size, crc, name_length = _CHUNK.unpack_from(body)
        name_end = _CHUNK.size + name_length
        (packed,) = struct.unpack_from("<Q", body, name_end)
    except struct.error as error:
        raise _BrokenError from error
    _require_size(size, path)
    compression = body[_CHUNK.size : name_end].decode(errors="replace")
    data = body[name_end + 8 : name_end + 8 + packed]
    try:
        # At most one byte more than declared: longer data are damaged or malicious.
        if compression == "zstd":
            decompressor = zstandard.ZstdDecompressor(max_window_size=_ZSTD_WINDOW)
            data = decompressor.stream_reader(data).read(size + 1)
        elif compression == "lz4":
            data = lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=size + 1)
        elif compression:
            raise RecordingError(f"{path}: compression {compression[:20]!r} is not known here")
    except (zstandard.ZstdError, RuntimeError, MemoryError) as error:
        raise _BrokenError from error
    if len(data) != size or (crc and zlib.crc32(data) != crc):
        raise _BrokenError
    return data


_STALE = int(Status.STALE)
_SERVICE = Status.having("replayed")
_FEW = 128  # waiting cycles that are not worth a look for complete ones
_Number = tuple[int, int]  # of a cycle: run of the daemon, sequence
# Stamp, numbers of the sample, flags: plain numbers, which the collector of garbage need not look at.
_Waiting = tuple[int, tuple[float | None, ...] | None, int]


def recorded_cycles(path: Path, motors: int, scale: Mapping[str, float] | None = None) -> Iterator[Cycle]:
    """Yield the cycles of a recording in order.

    A sample gets the flags of its estimate; a stale estimate is a cycle without sample. Both come in batches
    that are as long as the recorder or the daemon had to wait for a processor.

    Args:
        scale: factors by column, as `[recording]` of the joint file gives them.

    Raises:
        RecordingError: no samples in it.
    """
    names, further = measured_names(motors), f"motor{motors + 1}_position_rad"
    factors = [(scale or {}).get(name, 1.0) for name in names]
    row_of, flags_of = JsonNumbers(("sequence", further, *names)), JsonNumbers(("sequence", "status"))
    waiting: dict[_Number, _Waiting] = {}
    newest: dict[str, _Number] = {}  # by topic
    most, found = _FEW, False
    for message in read_messages(path, frozenset({"sample", "estimate"})):
        row, flags, topic = None, 0, message.topic
        try:
            if topic.endswith("/sample"):
                row, found = row_of(message.data), True
                sequence = _whole(row[0])
                if row[1] is not None:
                    raise RecordingError(f"{path}: has more motors than the joint file, which has {motors}")
            else:
                sequence, status = map(_whole, flags_of(message.data))
                flags = status & (_SERVICE | _STALE)
            if not 0 <= sequence < 1 << 62:
                raise ValueError(f"expected a sequence from 0 to 2^62, got {sequence}")
        except (ValueError, OverflowError) as error:
            raise _strange(path, topic, error) from error
        run, last = newest.get(topic, (0, -1))
        number = (run + (sequence < last), sequence)  # another run: numbering began again
        newest[topic] = number
        if (before := waiting.get(number)) is not None:
            row, flags = row or before[1], flags | before[2]
        waiting[number] = message.log_time_ns, row, flags
        if len(waiting) > most:
            yield from _released(waiting, min(newest.values()) if len(newest) > 1 else (0, 0), factors)
            most = 2 * len(waiting) + _FEW
    yield from _released(waiting, None, factors)
    if not found:
        raise _empty(path)


def _whole(number: float | None) -> int:
    if number is None:
        raise ValueError("expected a sequence, and of an estimate a status")
    return int(number)


def _released(
    waiting: dict[_Number, _Waiting], until: _Number | None, factors: Sequence[float]
) -> Iterator[Cycle]:
    """Yield the cycles before `until` (None: all), and more than may wait, in order; no estimates alone."""
    for number in sorted(waiting):
        if until is not None and number >= until and len(waiting) <= MAX_UNREAD:
            break
        stamp_ns, row, flags = waiting.pop(number)
        if row is not None or flags & _STALE:
            sample = None if row is None else _sample(number[1], row[2:], factors)
            yield Cycle(number[1], stamp_ns, sample, flags & _SERVICE)


def _sample(sequence: int, row: Sequence[float | None], factors: Sequence[float]) -> Sample:
    """Return the sample of the values of `measured_names`."""
    values = tuple([math.nan if x is None else x * f for x, f in zip(row, factors, strict=True)])
    a = len(values) // 3 - 1
    return Sample(sequence, values[:a], values[a : 2 * a], values[2 * a : 3 * a], *values[3 * a :])


def read_mcap(path: Path, joint: JointFile | None, keep_nan: bool) -> Record:
    """Read the samples of an MCAP recording.

    Raises:
        RecordingError: it cannot be read, or has no or too many samples.
    """
    columns: dict[str, array[float]] = {}
    count, numbers_of = 0, JsonNumbers(sorted(COLUMNS))
    period_s, shift_s, stamp_ns = joint.bus.period_s if joint is not None else 0.0, 0.0, 0
    for message in read_messages(path, frozenset({"sample"})):
        try:
            row = numbers_of(message.data)
            if not count:
                found = [name for name, x in zip(sorted(COLUMNS), row, strict=True) if x is not None]
                numbers_of, columns = JsonNumbers(found), {name: array("d") for name in found}
                row = numbers_of(message.data)
            for values, value in zip(columns.values(), row, strict=True):
                values.append(math.nan if value is None else value)
            if "time_s" in columns:
                shift_s = _gone_on(columns["time_s"], shift_s, message.log_time_ns - stamp_ns, period_s)
            stamp_ns = message.log_time_ns
        except ValueError as error:
            raise _strange(path, message.topic, error) from error
        count += 1
        require_samples(count, str(path))
    if not count:
        raise _empty(path)
    table = {name: np.frombuffer(values, dtype=np.float64) for name, values in columns.items()}
    return record_from_columns(table, str(path), joint, keep_nan)


def _gone_on(time_s: array[float], shift_s: float, elapsed_ns: int, period_s: float) -> float:
    """Put the last time behind the others where the daemon began again; return what its run lacks."""
    time_s[-1] += shift_s
    if len(time_s) < 2 or time_s[-1] > time_s[-2] or elapsed_ns <= 0:
        return shift_s
    behind_s = time_s[-2] - time_s[-1] + 1e-9 * elapsed_ns
    behind_s = period_s * round(behind_s / period_s) if period_s else behind_s
    time_s[-1] += behind_s
    return shift_s + behind_s


def _empty(path: Path) -> RecordingError:
    return RecordingError(
        f"{path}: no samples in it (with raw frames in it: replay --frames; a bag of ROS, or another "
        "program's file: export its columns as CSV)"
    )


def _strange(path: Path, topic: str, error: Exception) -> RecordingError:
    return RecordingError(f"{path}: {topic[:80]} is no message of drivelink: {error}")
