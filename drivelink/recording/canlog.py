"""Raw CAN logs as they are found: candump in its variants, BLF, ASC, PCAN .trc, whatever python-can reads.

Frames come out as plain tuples in the order of the file. Only data frames with 11-bit identifiers are
CANopen: all others are left out.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Callable, Iterable, Iterator
from datetime import datetime
from io import BytesIO
from itertools import chain, islice, pairwise
from pathlib import Path
from typing import IO, Any, NamedTuple

import can

from drivelink.errors import RecordingError

__all__ = ["CAN_SUFFIXES", "NO_STAMP", "Frame", "read_frames"]

_LOG = logging.getLogger("drivelink.recording")

_READERS: dict[str, Any] = {".blf": can.BLFReader, ".asc": can.ASCReader, ".trc": can.TRCReader}
CAN_SUFFIXES = frozenset({".log", ".candump", *_READERS})
NO_STAMP = -1
_EXTENDED_DIGITS = 8
_BLOCK = 1 << 18  # bytes read at once
_HOPELESS = 20  # strange lines at the beginning: it is no log
_LOOK_AHEAD = 2000  # frames that decide what the stamps mean, and which channels there are


class Frame(NamedTuple):
    """One frame of a log.

    Attributes:
        stamp_ns: when it was on the bus, by the log's clock; NO_STAMP where the log has none.
        can_id: its 11-bit identifier.
        data: its bytes.
        channel: the interface it was on, as the log calls it.
    """

    stamp_ns: int
    can_id: int
    data: bytes
    channel: str


# (1436509052.249713) vcan0 044#2A366C2BBA R          candump -L, to the letter
_PLAIN = re.compile(r"^\((\d+)\.(\d{6})\) (\S+) ([0-9A-F]{3})#((?:[0-9A-F]{2})*)(?: [RT])?\n", re.MULTILINE)
# … brackets or none
_COMPACT = re.compile(
    rb"^[ \t]*(?:\(?(\d+)[.,](\d+)\)?[ \t]+)?(\S+)[ \t]+([0-9A-Fa-f]+)#(#[0-9A-Fa-f])?([0-9A-Fa-f.]*)(R?)"
)
#  (1436509052.249713)  vcan0  RX - -  044   [5]  2A 36 6C 2B BA   '*6l+.'
_SPACED = re.compile(
    rb"^[ \t]*(?:\(?(\d+)[.,](\d+)\)?[ \t]+)?(\S+)[ \t]+(?:[RT]X[ \t]+[-BE ]+[ \t]+)?([0-9A-Fa-f]+)[ \t]+"
    rb"\[ ?0?(\d+)\][ \t]*((?:[0-9A-Fa-f]{2}(?:[ \t]+|$))*)(.*)"
)
#  (2026-01-31 09:41:02.249713)  …                     candump -t A
_DATE = re.compile(rb"^[ \t]*\((\d{4}-\d\d-\d\d[ T]\d\d:\d\d:\d\d)\.(\d+)\)")


def read_frames(path: Path, channel: str | None = None, configured: str = "") -> Iterator[Frame]:
    """The frames of a log, in its order, all of one channel.

    Args:
        path: its ending says the format; `.log` and `.candump` are text as candump writes it.
        channel: the channel, where the log has several.
        configured: the joint file's channel, taken if the log has it among several.

    Raises:
        RecordingError: it cannot be read, is not what its name says, or nothing tells the channel.
    """
    frames = _text_frames(path) if path.suffix.lower() in (".log", ".candump") else _library_frames(path)
    head = list(islice(frames, _LOOK_AHEAD))
    chosen = channel or _channel(head, configured, path)
    whole = chain(head, frames)
    if chosen is None:
        return whole
    return (frame for frame in whole if _same_channel(frame.channel, chosen))


def _channel(head: list[Frame], configured: str, path: Path) -> str | None:
    """Which channel to use, by the first frames of a log; None: there is only one.

    Raises:
        RecordingError: no frame at all, or several channels and none is the configured one.
    """
    if not head:
        raise RecordingError(f"{path}: no CAN frame with an 11-bit identifier in it")
    found = list(dict.fromkeys(frame.channel for frame in head))
    if len(found) == 1:
        return None
    if any(_same_channel(name, configured) for name in found):
        return configured
    raise RecordingError(f"{path}: frames of channels {', '.join(found)}: say which one with --channel")


def _same_channel(name: str, wanted: str) -> bool:
    """Whether names mean one channel; formats that number them call can0 "0"."""
    return name == wanted or (name.isdigit() and re.fullmatch(rf"\D*{name}", wanted) is not None)


def _text_frames(path: Path) -> Iterator[Frame]:
    try:
        with path.open("rb") as file:
            frames = _parsed(file, path)
            first = list(islice(frames, _LOOK_AHEAD))
            yield from _dated(first, chain(first, frames), path)
    except OSError as error:
        raise RecordingError(f"{path}: cannot be read: {error.strerror}") from error


def _parsed(file: IO[bytes], path: Path) -> Iterator[Frame]:
    """The lines that are data frames with 11-bit identifiers; what is no frame at all is counted."""
    tolerant = _Lines()
    while block := file.read(_BLOCK):
        block += file.readline()
        plain = _PLAIN.findall(block.decode("latin-1"))
        if len(plain) == block.count(b"\n"):
            tolerant.skip(len(plain))
            yield from _plain_frames(plain)
        else:
            yield from tolerant.frames(block)
            if tolerant.hopeless:
                break
    if not tolerant.understood:
        raise RecordingError(
            f"{path}: expected lines as candump writes them, got {tolerant.first_strange or 'none'}"
        )
    if tolerant.strange:
        _LOG.warning(
            "%s: %d line(s) are no CAN frame and are left out, first %s",
            path,
            tolerant.strange,
            tolerant.first_strange,
        )


def _plain_frames(lines: list[tuple[str, ...]]) -> Iterator[Frame]:
    """The frames of a block in which every line is as candump -L writes it: much quicker than one by one."""
    seconds, micros, channels, ids, data = zip(*lines, strict=True)
    stamps = [int(s + us) * 1000 for s, us in zip(seconds, micros, strict=True)]
    return map(Frame, stamps, [int(i, 16) for i in ids], map(bytes.fromhex, data), channels)


class _Lines:
    """Lines read one by one, in either of candump's ways and with whatever a log file picks up.

    Attributes:
        understood: lines that are frames, also such that are left out.
        strange: lines that are none.
        first_strange: the first of them, as a warning shows it.
    """

    def __init__(self) -> None:
        self.understood = self.strange = self._number = 0
        self.first_strange = ""
        self._parse: Callable[[bytes], Frame | None] = _compact

    @property
    def hopeless(self) -> bool:
        """Whether this is no log at all."""
        return not self.understood and self.strange > _HOPELESS

    def skip(self, lines: int) -> None:
        """So many lines were understood by somebody else."""
        self._number += lines
        self.understood += lines

    def frames(self, block: bytes) -> Iterator[Frame]:
        """The data frames with 11-bit identifiers among the lines of a block."""
        for line in BytesIO(block):
            self._number += 1
            if line.isspace() or line.lstrip().startswith((b"#", b";")):
                continue
            try:
                frame = self._either(line)
            except ValueError:
                self.strange += 1
                shown = repr(line.strip()[:60].decode(errors="replace"))
                self.first_strange = self.first_strange or f"line {self._number}: {shown}"
                if self.hopeless:
                    return
                continue
            self.understood += 1
            if frame is not None:
                yield frame

    def _either(self, line: bytes) -> Frame | None:
        """The frame, in the way of the line before, or in the other."""
        try:
            return self._parse(line)
        except ValueError:
            self._parse = _spaced if self._parse is _compact else _compact
            return self._parse(line)


def _compact(line: bytes) -> Frame | None:
    match = _COMPACT.match(line) or _COMPACT.match(_undated(line))
    if match is None:
        raise ValueError
    seconds, fraction, channel, can_id, _fd_flags, data, remote = match.groups()
    if len(can_id) == _EXTENDED_DIGITS or remote:
        return None
    payload = bytes.fromhex(data.replace(b".", b"").decode())
    return Frame(_stamp(seconds, fraction), int(can_id, 16), payload, channel.decode(errors="replace"))


def _spaced(line: bytes) -> Frame | None:
    match = _SPACED.match(line) or _SPACED.match(_undated(line))
    if match is None:
        raise ValueError
    seconds, fraction, channel, can_id, length, data, rest = match.groups()
    if len(can_id) == _EXTENDED_DIGITS or rest.startswith((b"remote", b"ERRORFRAME")):
        return None
    payload = bytes.fromhex(data.decode())
    if len(payload) < int(length):
        raise ValueError
    # The characters that -a appends may look like bytes.
    payload = payload[: int(length)]
    return Frame(_stamp(seconds, fraction), int(can_id, 16), payload, channel.decode(errors="replace"))


def _stamp(seconds: bytes | None, fraction: bytes) -> int:
    if seconds is None:
        return NO_STAMP
    return int(seconds) * 1_000_000_000 + int(fraction[:9].ljust(9, b"0"))


def _undated(line: bytes) -> bytes:
    """A line that begins with date and time, with seconds instead."""
    match = _DATE.match(line)
    if match is None:
        raise ValueError
    # As UTC: only differences matter, and these do not jump in spring.
    moment = datetime.fromisoformat(match[1].decode() + "+00:00")
    return b"(%d.%s)" % (int(moment.timestamp()), match[2]) + line[match.end() :]


def _dated(first: list[Frame], frames: Iterable[Frame], path: Path) -> Iterator[Frame]:
    """Frames with stamps that increase: those of `candump -t d` are differences and are added up."""
    stamps = [frame.stamp_ns for frame in first]
    falls = sum(b < a for a, b in pairwise(stamps))
    if len(stamps) < 8 or falls < 0.2 * len(stamps):
        return iter(frames)
    _LOG.warning("%s: the stamps are differences from frame to frame: added up", path)
    return _added_up(frames)


def _added_up(frames: Iterable[Frame]) -> Iterator[Frame]:
    total = 0
    for frame in frames:
        total += frame.stamp_ns
        yield frame._replace(stamp_ns=total)


def _library_frames(path: Path) -> Iterator[Frame]:
    """By python-can's reader of the file's ending; a file that a crash cut off ends where it is whole."""
    kind = _READERS[path.suffix.lower()]
    count = 0
    try:
        # Opened here: a reader that finds the file strange would leave it open.
        with path.open("rb") if kind is can.BLFReader else path.open(errors="replace") as file:
            for message in kind(file):
                if message.is_extended_id or message.is_error_frame or message.is_remote_frame:
                    continue
                count += 1
                stamp_ns = round(message.timestamp * 1e9)
                yield Frame(stamp_ns, message.arbitration_id, bytes(message.data), str(message.channel))
    except OSError as error:
        raise RecordingError(f"{path}: cannot be read: {error.strerror or error}") from error
    except Exception as error:  # readers raise whatever a broken byte leads them to
        if not count:
            raise RecordingError(f"{path}: cannot be read as {path.suffix} log: {error}") from error
        _LOG.warning("%s: broken after %d frames (%s): what follows is left out", path, count, error)
