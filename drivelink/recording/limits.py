"""Limits of recordings, checked before allocation, and bounded input of python-can's reader of ASC files.

A file declares the lengths of its parts and may declare anything. Real recordings are far below these limits
(docs/reference/recordings.md). python-can's reader accepts lines of any length, and ignores relative stamps.
"""

import io
import logging
import re
from collections.abc import Iterator
from pathlib import Path
from typing import IO

from drivelink.errors import RecordingError

MAX_SAMPLES = 10_000_000  # periods from first to last sample of a recording in memory: 2.7 h at 1 kHz
MAX_COLUMNS = 4096  # columns of a CSV file; unknown ones are not kept in memory
MAX_LINE_BYTES = 1 << 20  # of a line of text
MAX_BLOCK_BYTES = 64 << 20  # an MCAP chunk or a BLF container, unpacked; tools write up to 8 MiB
MAX_UNREAD = 30_000  # messages of one key that wait for a recorder: half a minute at 1 kHz
_RECORD_BYTES = 3.5  # of a file for each record: a frame of a bus at rest takes 4 in MCAP, 4.8 in BLF
_FEW_RECORDS = 5000  # that any file may have
LAST_STAMP_NS = (1 << 63) - 1  # of the year 2262


def require_samples(count: int, where: str) -> None:
    """Refuse more samples, or periods including gaps, than fit into memory.

    Raises:
        RecordingError: the limit is exceeded.
    """
    if count > MAX_SAMPLES:
        raise RecordingError(
            f"{where}: expected at most {MAX_SAMPLES} periods from the first sample to the last, "
            f"got {count}: split it, at a gap if there is one"
        )


def most_records(size: int) -> int:
    """Return how many records, frames for instance, so many bytes of a file may have, packed as can be."""
    return _FEW_RECORDS + int(size / _RECORD_BYTES)


def too_many_records(path: Path) -> RecordingError:
    """Return the error of a file with more than `most_records`."""
    return RecordingError(f"{path}: expected at most one record for each {_RECORD_BYTES} bytes of the file")


def require_stamp(stamp_ns: int, path: Path) -> None:
    """Check that a stamp has 64 bits.

    Raises:
        RecordingError: it has not.
    """
    if stamp_ns > LAST_STAMP_NS:
        raise RecordingError(f"{path}: expected stamps below 2^63 ns, got {stamp_ns:.3g}")


_LOG = logging.getLogger("drivelink.recording")

_STAMP = re.compile(r"^[ \t]*(\d{1,12}\.\d{1,12})(?=[ \t])")
_RELATIVE = re.compile(r"^\s*base\s+\w+\s+timestamps\s+relative", re.IGNORECASE)
# time CANFD channel Rx identifier [name] BRS ESI DLC length duration bits flags …, of a frame without data
_EMPTY_FD = re.compile(
    r"^\s*(\S+)\s+CANFD\s+(\d+)\s+(\w+)\s+(\w+)(?:\s+(?![01]\s)\w+)?\s+[01]\s+[01]\s+0\s+0"
    r"\s+\d+\s+\d+\s+([0-9A-Fa-f]+)(?:\s|$)"
)
_REMOTE = 0x10  # among these flags
_NEWLINE = ord("\n")
# what python-can looks at in an ASC file; a megabyte of other lines costs it more than a second
_OF_ASC = re.compile(rb"\s*(?:\d+\.\d+\s+\S|(?:date|base|begin|internal|no)\s)", re.IGNORECASE)


def whole_lines(file: IO[bytes], path: Path, number: int = 1) -> Iterator[bytes]:
    """Yield the lines of a text from a number on, without a last one that has no end, and padding after it.

    Raises:
        RecordingError: a line is too long, or ends with no line feed.
    """
    padded = False  # after a power loss
    while line := file.readline(MAX_LINE_BYTES + 1):
        if line[-1] == _NEWLINE and not padded:
            number += 1
            yield line
        elif not line.strip(b"\0"):
            padded = True
        elif b"\r" in line.rstrip():
            raise RecordingError(
                f"{path}: line {number}: expected a line feed at its end, got carriage returns alone"
            )
        elif padded or len(line) > MAX_LINE_BYTES:
            raise RecordingError(f"{path}: line {number}: expected at most {MAX_LINE_BYTES >> 10} KiB")
        elif line.strip(b" \t\r\0"):
            _LOG.warning("%s: the last line has no end and is omitted: it may be truncated", path)


class AscText(io.TextIOBase):
    """An ASC file with relative stamps converted to absolute ones; an incomplete last line is omitted."""

    def __init__(self, file: IO[bytes], path: Path) -> None:
        super().__init__()
        self._lines = filter(_OF_ASC.match, whole_lines(file, path))
        self._relative = False
        self._total = 0.0

    def readline(self, size: int = -1, /) -> str:  # type: ignore[override]
        """Return the next line in the reader's form; "" at the end.

        Raises:
            RecordingError: it is too long.
        """
        line = next(self._lines, b"").decode(errors="replace")
        if _RELATIVE.match(line):
            self._relative = True
        elif self._relative and (stamp := _STAMP.match(line)):
            self._total += float(stamp[1])
            line = f"{self._total:.9f}{line[stamp.end() :]}"
        if (empty := _EMPTY_FD.match(line)) and not int(empty[5], 16) & _REMOTE:
            return f"{empty[1]} {empty[2]} {empty[4]} {empty[3]} d 0\n"  # else it is read as a remote frame
        return line
