"""The black box: the last minute of a joint in bounded memory; what led to an event becomes a recording."""

from __future__ import annotations

import json
import logging
import re
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, NamedTuple

from drivelink.errors import RecordingError
from drivelink.jointfile import JointText
from drivelink.pubsub.wire import EstimateMessage, ExternalMessage
from drivelink.recording.sinks import McapSink, Sink
from estimator.sample import Sample, Status

_LOG = logging.getLogger("drivelink.recording")

AFTER_S = 15.0  # that is kept after an event
_QUIET_S = 60.0  # in which the same cause is not kept again
_ITEMS_PER_S = 25_000  # frames of a full bus at 1 Mbit/s, samples and estimates: bounds the memory
_BLOCK = 20_000  # items between two syncs to disk
_FLAGS = {
    Status.MODEL_ALARM: "model alarm",
    Status.CHANGED: "change",
    Status.DRIVE_FAULT: "drive fault",
}
_MASK = sum(int(bit) for bit in _FLAGS)


class _Event(NamedTuple):
    """What is to be kept: its cause, when it came (clock of the box and wall time), its file."""

    cause: str
    at_s: float
    wall: datetime
    path: Path


class BlackBox(Sink):
    """Keeps the newest of what it takes, and writes it when something happens.

    Args:
        text: the joint file; its `[recording]` section has folder and limits.
        done: called with each recording and its cause, in the writing thread.
        clock: monotonic time, s.

    Raises:
        RecordingError: the folder cannot be made.
    """

    wants = frozenset({"sample", "estimate", "external", "document", "frame"})

    def __init__(
        self,
        text: JointText,
        done: Callable[[Path, str], object] = lambda path, cause: None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.counts = dict.fromkeys(sorted(self.wants), 0)
        self._text, self._done, self._clock = text, done, clock
        self._section = text.joint.recording
        self._wish = wish_of(text)
        self._folder = self._wish.parent
        self._reach_s = self._section.keep_s + AFTER_S
        self._ring: deque[tuple[float, str, tuple[Any, ...]]] = deque(
            maxlen=int(self._reach_s * _ITEMS_PER_S)
        )
        self._mapping: tuple[dict[str, Any], int] | None = None
        self._model: tuple[str, bytes, int] | None = None
        self._holding: set[str] = set()  # causes of the last status document
        self._flags, self._contact = 0, False
        self._last_s: dict[str, float] = {}
        self._event: _Event | None = None
        self._writer: threading.Thread | None = None
        try:
            self._folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise RecordingError(f"{self._folder}: cannot be made: {error.strerror}") from error

    def sample(self, sample: Sample, stamp_ns: int) -> None:
        """Take what was measured at one SYNC."""
        self._take("sample", sample, stamp_ns)

    def estimate(self, message: EstimateMessage) -> None:
        """Take one estimate; its alarms are events."""
        self._take("estimate", message)
        flags = message.status & _MASK
        begun, self._flags = flags & ~self._flags, flags
        if begun:
            for bit, cause in _FLAGS.items():
                if begun & bit:
                    self.keep(cause)

    def external(self, message: ExternalMessage) -> None:
        """Take one external torque; a contact is an event where that is asked for."""
        self._take("external", message)
        begun, self._contact = message.contact and not self._contact, message.contact
        if begun and self._section.keep_contacts:
            self.keep("contact")

    def document(self, name: str, payload: bytes, stamp_ns: int) -> None:
        """Take a JSON document; a suspected signal, a fault or a lost bus in a status is an event."""
        self._take("document", name, payload, stamp_ns)
        if name == "model":
            self._model = (name, payload, stamp_ns)
            return
        status = json.loads(payload)
        holding = {
            cause
            for cause, holds in (
                ("suspected signal", status.get("suspected")),
                ("drive fault", status.get("drive_faults")),
                ("bus lost", status.get("state") == "bus lost"),
            )
            if holds
        }
        for cause in sorted(holding - self._holding):
            self.keep(cause)
        self._holding = holding

    def frame(self, stamp_ns: int, cob_id: int, data: bytes) -> None:
        """Take one CAN frame."""
        self._take("frame", stamp_ns, cob_id, data)

    def mapping(self, document: dict[str, Any], stamp_ns: int) -> None:
        """Take the mapping document: every recording begins with it."""
        self._mapping = (document, stamp_ns)

    def keep(self, cause: str, *, asked: bool = False) -> Path | None:
        """Keep the time before now, and what comes after it.

        Args:
            cause: what has happened.
            asked: by a person: also shortly after the same cause.

        Returns:
            The file that it will be in; None: the same cause was kept a moment ago.
        """
        now_s = self._clock()
        if self._event is not None:
            return self._event.path
        if not asked and now_s - self._last_s.get(cause, -_QUIET_S) < _QUIET_S:
            return None
        self._last_s[cause] = now_s
        wall = datetime.now(UTC)
        name = f"{self._text.joint.name}-{wall:%Y%m%dT%H%M%SZ}-{cause.replace(' ', '-')}.mcap"
        self._event = _Event(cause, now_s, wall, self._folder / name)
        return self._event.path

    def flush(self) -> None:
        """Begin to write what is complete, take a wish; called once a second."""
        if self._wish.exists():
            self._wish.unlink(missing_ok=True)
            self.keep("asked", asked=True)
        busy = self._writer is not None and self._writer.is_alive()
        if self._event is not None and not busy and self._clock() >= self._event.at_s + AFTER_S:
            self._begin(self._event)

    def close(self) -> None:
        """Write what is pending, complete or not."""
        if self._writer is not None:
            self._writer.join()
        if self._event is not None:
            self._begin(self._event).join()

    def abandon(self) -> None:
        """The same: what is in memory is worth keeping after an error, too."""
        self.close()

    def _take(self, kind: str, *values: Any) -> None:
        now_s = self._clock()
        ring, oldest_s = self._ring, now_s - self._reach_s - AFTER_S
        ring.append((now_s, kind, values))
        while ring[0][0] < oldest_s:
            ring.popleft()
        self.counts[kind] += 1

    def _begin(self, event: _Event) -> threading.Thread:
        first, last = event.at_s - self._section.keep_s, event.at_s + AFTER_S
        items = [(kind, values) for at_s, kind, values in self._ring if first <= at_s <= last]
        self._event = None
        self._writer = threading.Thread(target=self._write, args=(event, items), name="black box")
        self._writer.start()
        return self._writer

    def _write(self, event: _Event, items: Sequence[tuple[str, tuple[Any, ...]]]) -> None:
        """Write one recording; what goes wrong is one line, and no half of a file stays."""
        sink: McapSink | None = None
        try:
            sink = McapSink(event.path, self._text.joint, self._text.text)
            wall = event.wall.isoformat(timespec="milliseconds")
            sink.note("black box", {"cause": event.cause, "time": wall, "joint_file": self._text.name})
            if self._mapping is not None:
                sink.mapping(*self._mapping)
            if self._model is not None:
                sink.document(*self._model)
            for number, (kind, values) in enumerate(items, start=1):
                getattr(sink, kind)(*values)
                if number % _BLOCK == 0:
                    sink.flush()
            sink.close()
            drop_oldest(self._folder, self._text.joint.name, self._section.keep_mib)
        except (OSError, RecordingError) as error:
            _LOG.error("%s: %s is not kept: %s", self._text.joint.name, event.cause, error)
            if sink is not None:
                sink.abandon()
                event.path.unlink(missing_ok=True)
            return
        _LOG.warning("%s: %s: kept in %s", self._text.joint.name, event.cause, event.path)
        self._done(event.path, event.cause)


def wish_of(text: JointText) -> Path:
    """The file that asks the black box of a joint to keep the last minute; it removes it.

    Raises:
        RecordingError: the joint file declares no folder.
    """
    folder = text.joint.recording.folder
    if folder is None:
        raise RecordingError(f"{text.name}: recording.folder: expected the folder of the black box, got none")
    return text.folder / folder / f"{text.joint.name}.keep"


def drop_oldest(folder: Path, joint: str, keep_mib: float) -> None:
    """Remove the oldest recordings of a joint's black box beyond its budget; the newest always stays."""
    mine = re.compile(re.escape(joint) + r"-\d{8}T\d{6}Z-[a-z-]+\.mcap")
    kept = sorted(path for path in folder.iterdir() if mine.fullmatch(path.name))
    sizes = [path.stat().st_size for path in kept]
    for index in range(len(kept) - 1):
        if sum(sizes[index:]) <= keep_mib * 2**20:
            break
        kept[index].unlink()
