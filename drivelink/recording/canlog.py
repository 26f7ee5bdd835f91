"""Reads raw CAN logs of other tools: variants of candump; BLF; ASC by python-can's reader.

Yields data frames with 11-bit identifiers as tuples, in file order.
"""

import logging
import re
from binascii import unhexlify
from collections.abc import Callable, Iterable, Iterator
from datetime import datetime
from functools import partial
from itertools import accumulate, chain, islice, pairwise
from pathlib import Path
from statistics import median
from typing import IO, Any, NamedTuple

import can

from drivelink.errors import RecordingError, raised_as
from drivelink.files import open_regular
from drivelink.recording.blf import Frame, blf_frames
from drivelink.recording.limits import (
    LAST_STAMP_NS,
    AscText,
    most_records,
    require_stamp,
    too_many_records,
    whole_lines,
)
from estimator.reasons import counted

_LOG = logging.getLogger("drivelink.recording")


class _BlfWriter(can.BLFWriter):
    """python-can's writer with early closing of containers."""

    def end_container(self) -> None:
        """Write the open container."""
        self._flush()


_Reader = Callable[[IO[bytes], Path], Iterator[Frame | None]]


class CanFormat(NamedTuple):
    """A format of raw frames."""

    tool: str  # that writes it
    writer: Any  # python-can's; None: not written
    # yields a file's frames, None for those that are not of CANopen; None: text as candump writes it
    reader: _Reader | None = None
    text: bool = True  # whether it has lines


NO_STAMP = -1
_EXTENDED_DIGITS = 8
_LAST_ID = 0x7FF
_LONGEST = 64  # bytes of a frame, excluding CAN XL
_LONGEST_LINE = 16 << 10  # bytes; candump's longest, of CAN XL, has 6 KiB
_HOPELESS = 20  # more unknown lines than frames: it is not a log
_FOREIGN = 20_000  # messages at the beginning without a frame of CANopen, likewise
_DISORDER_NS = 1_000_000_000  # largest disorder of stamps within a file
_GAP_NS = 1_000_000_000
_LOOK_AHEAD = 2000  # frames examined for the meaning of stamps, and for channels


class LoggedFrame(NamedTuple):
    """One frame of a log."""

    stamp_ns: int  # time by the log's clock; NO_STAMP if the log has none
    can_id: int  # its 11-bit identifier
    data: bytes  # its bytes
    channel: str  # its interface, by the log's name


logged: Callable[[Frame], LoggedFrame] = partial(tuple.__new__, LoggedFrame)  # half of its call's cost


# (1436509052.249713) vcan0 044#2A366C2BBA R          candump -L; brackets or none
#  (1436509052.249713)  vcan0  RX - -  044   [5]  2A 36 6C 2B BA   '*6l+.'
_LINE = re.compile(
    rb"^[ \t]*(?:\(?(\d{1,11})[.,](\d+)\)?[ \t]+)?(\S+)[ \t]+(?:"
    rb"([0-9A-Fa-f]{1,8})#(?:#[0-9A-Fa-f])?([0-9A-Fa-f.]*)(R?)|"
    rb"(?:[RT]X(?:[ \t]+[-BE]){0,2}[ \t]+)?"
    rb"([0-9A-Fa-f]{1,8})[ \t]+\[ ?0?(\d{1,4})\][ \t]*((?:[0-9A-Fa-f]{2}(?:[ \t]+|$))*)(.*))"
)
#  (2026-01-31 09:41:02.249713)  …                     candump -t A
_DATE = re.compile(rb"^[ \t]*\((\d{4}-\d\d-\d\d[ T]\d\d:\d\d:\d\d)\.(\d+)\)")


def read_frames(path: Path, channel: str | None = None, configured: str = "") -> Iterator[LoggedFrame]:
    """Yield the frames of one channel of a log, in order.

    Args:
        path: its ending says the format; `.log` and `.candump` are text as candump writes it.
        channel: the channel, where the log has several.
        configured: the joint file's channel, taken if the log has it among several.

    Raises:
        RecordingError: it cannot be read, has another format, or its channel is unknown.
    """
    reader = CAN_FORMATS[path.suffix.lower()].reader
    frames = _foreign_frames(path, reader) if reader else _text_frames(path)
    head = list(islice(frames, _LOOK_AHEAD))
    if not head:
        raise RecordingError(f"{path}: no CAN frame with an 11-bit identifier in it")
    chosen = channel or _channel(head, configured, path)
    whole: Iterator[LoggedFrame] = chain(head, frames)
    if chosen is not None:
        names = ", ".join(dict.fromkeys(frame.channel for frame in head))
        whole = _of(chosen, whole, f"{path}: no frame of channel {chosen}: expected one of {names}")
    return in_order(whole, path)


def _of(channel: str, frames: Iterable[LoggedFrame], absent: str) -> Iterator[LoggedFrame]:
    """Yield the frames of a channel.

    Raises:
        RecordingError: there is none; it says `absent`.
    """
    frame = None
    for frame in (one for one in frames if _same_channel(one.channel, channel)):
        yield frame
    if frame is None:
        raise RecordingError(absent)


def in_order(frames: Iterable[LoggedFrame], path: Path) -> Iterator[LoggedFrame]:
    """Make stamps continue where they jump back (a clock that was set, or two logs in one file).

    The unknown time between counts as a gap of one second; the first is reported, and how many follow.
    """
    offset = last = jumps = 0
    for frame in frames:
        stamp_ns = frame[0] + offset
        if last <= stamp_ns <= LAST_STAMP_NS:
            last = stamp_ns
            yield logged((stamp_ns, *frame[1:])) if offset else frame
            continue
        if last - stamp_ns > _DISORDER_NS and frame[0] != NO_STAMP:
            jumps += 1
            if jumps == 1:
                text = "%s: the stamps jump back by %.4g s at %.6f s: taken as a gap of %g s"
                back_s, at_s = (last - stamp_ns) * 1e-9, frame.stamp_ns * 1e-9
                _LOG.warning(text, path, back_s, at_s, _GAP_NS * 1e-9)
            offset += last + _GAP_NS - stamp_ns
            stamp_ns = last + _GAP_NS
        require_stamp(stamp_ns, path)
        last = max(last, stamp_ns)
        yield logged((stamp_ns, *frame[1:])) if offset and frame[0] != NO_STAMP else frame
    if jumps > 1:
        _LOG.warning("%s: the stamps jump back %d times more", path, jumps - 1)


def _channel(head: list[LoggedFrame], configured: str, path: Path) -> str | None:
    """Select the channel by the first frames of a log; None: there is only one.

    Raises:
        RecordingError: several channels, and none is the configured one.
    """
    found = list(dict.fromkeys(frame.channel for frame in head))
    if len(found) == 1:
        return None
    if any(_same_channel(name, configured) for name in found):
        return configured
    raise RecordingError(f"{path}: frames of channels {', '.join(found)}: say which one with --channel")


def _same_channel(name: str, wanted: str) -> bool:
    """Return whether two names mean the same channel; some formats call can0 "0"."""
    return name == wanted or (name.isdigit() and re.fullmatch(rf"\D*{name}", wanted) is not None)


def _text_frames(path: Path) -> Iterator[LoggedFrame]:
    with raised_as(RecordingError, f"{path}: cannot be read"), open_regular(path) as file:
        frames = _parsed(file, path)
        first = list(islice(frames, _LOOK_AHEAD))
        yield from _dated(first, chain(first, frames), path)


def _parsed(file: IO[bytes], path: Path) -> Iterator[LoggedFrame]:
    """The data frames with 11-bit identifiers, in both formats of candump; foreign lines are counted."""
    understood = strange = 0  # lines that are frames, also omitted ones, and others
    first_strange = ""
    for number, line in enumerate(whole_lines(file, path), start=1):
        if line.isspace() or line.lstrip().startswith((b"#", b";")):
            continue
        try:
            frame = _frame(line)
        except ValueError:
            strange += 1
            first_strange = first_strange or f"line {number}: {line.strip()[:60].decode(errors='replace')!r}"
            if strange > understood + _HOPELESS:
                break
            continue
        understood += 1
        if frame is not None:
            yield frame
    if not understood or strange > understood + _HOPELESS:
        raise RecordingError(f"{path}: expected lines as candump writes them, got {first_strange or 'none'}")
    if strange:
        text = "%s: omitted: %s without a CAN frame, first %s"
        _LOG.warning(text, path, counted(strange, "line"), first_strange)


def _frame(line: bytes) -> LoggedFrame | None:
    """Return the frame of a line; None: it is none of CANopen's.

    Raises:
        ValueError: it is no frame.
    """
    if len(line) > _LONGEST_LINE or not (match := _LINE.match(line) or _LINE.match(_undated(line))):
        raise ValueError
    seconds, fraction, channel, can_id, data, remote, spaced_id, length, spaced, rest = match.groups()
    least = 0
    if length is not None:
        least = int(length)
        remote = least > _LONGEST or rest.startswith((b"remote", b"ERRORFRAME"))
        # the characters that -a appends may look like bytes
        can_id, data = spaced_id, b"".join(spaced.split()[:least])
    if remote:
        return None
    payload, number = unhexlify(data.replace(b".", b"")), int(can_id, 16)
    if len(can_id) == _EXTENDED_DIGITS or number > _LAST_ID or len(payload) > _LONGEST:
        return None
    if len(payload) < least:
        raise ValueError
    return logged((_stamp(seconds, fraction), number, payload, channel.decode("utf-8", "replace")))


def _stamp(seconds: bytes | None, fraction: bytes) -> int:
    if seconds is None:
        return NO_STAMP
    return int(seconds) * 1_000_000_000 + int(fraction[:9].ljust(9, b"0"))


def _undated(line: bytes) -> bytes:
    """Replace date and time at the beginning of a line by seconds; empty: it has none."""
    match = _DATE.match(line)
    if match is None:
        return b""
    # As UTC: only differences matter, without daylight saving time.
    moment = datetime.fromisoformat(match[1].decode() + "+00:00")
    return b"(%d.%s)" % (int(moment.timestamp()), match[2]) + line[match.end() :]


def _dated(first: list[LoggedFrame], frames: Iterable[LoggedFrame], path: Path) -> Iterator[LoggedFrame]:
    """Frames with absolute stamps: the differences of `candump -t d` are added up.

    They fall as often as they rise, and the later ones are not larger: those of a busy recorder, which come
    in disorder, are.
    """
    stamps = [frame.stamp_ns for frame in first]
    falls = sum(b < a for a, b in pairwise(stamps))
    half = len(stamps) // 2
    if len(stamps) < 8 or falls < 0.2 * len(stamps) or median(stamps[half:]) > max(stamps[: half // 2]):
        return iter(frames)
    _LOG.warning("%s: the stamps are differences from frame to frame: added up", path)
    return accumulate(frames, lambda before, one: logged((before[0] + one[0], *one[1:])))


def _asc_frames(file: IO[bytes], path: Path) -> Iterator[Frame | None]:
    """The frames as python-can reads them; None: one without data, or with a long identifier."""
    for message in can.ASCReader(AscText(file, path)):  # type: ignore[arg-type]
        special = message.is_extended_id or message.is_error_frame or message.is_remote_frame
        stamp_ns, data = round(message.timestamp * 1e9), bytes(message.data)
        yield None if special else (stamp_ns, message.arbitration_id, data, str(message.channel))


def _foreign_frames(path: Path, reader: _Reader) -> Iterator[LoggedFrame]:
    """Those of another tool's format; a truncated file ends at its last complete frame."""
    count = foreign = most = 0
    try:
        with open_regular(path) as file:
            for frame in reader(file, path):
                if count + foreign >= most:
                    most = most_records(file.tell())
                    if count + foreign >= most:
                        raise too_many_records(path)
                if frame is None or frame[1] > _LAST_ID or len(frame[2]) > _LONGEST:
                    foreign += 1
                    if not count and foreign > _FOREIGN:
                        return
                    continue
                count += 1
                yield logged(frame)
    except OSError as error:
        raise RecordingError(f"{path}: cannot be read: {error.strerror or error}") from error
    except RecordingError:
        raise
    except Exception as error:  # python-can raises various exceptions for damaged files
        if not count:
            raise RecordingError(f"{path}: cannot be read as {path.suffix} log: {str(error)[:80]}") from error
        _LOG.warning("%s: broken after %d frames (%.80s): the rest is omitted", path, count, error)


CAN_FORMATS = {
    ".log": CanFormat("candump", can.CanutilsLogWriter),
    ".candump": CanFormat("candump", None),
    ".blf": CanFormat("Vector", _BlfWriter, blf_frames, text=False),
    ".asc": CanFormat("Vector", can.ASCWriter, _asc_frames),
}
"""Formats of raw frames, by the ending of the file's name."""

CAN_SUFFIXES = frozenset(CAN_FORMATS)
