"""The black box: the last minute of a joint in bounded memory; what led to an event becomes a recording."""

import fcntl
import json
import logging
import math
import os
import pickle
import threading
import time
import zlib
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any, NamedTuple

from drivelink.errors import JointFileError, RecordingError, raised_as
from drivelink.jointfile import JointText, load_text
from drivelink.loop.day import Day
from drivelink.loop.finding import (
    DOUBTS,
    UNFINISHED,
    drop_oldest,
    kept,
    open_own,
    recording_name,
    taken,
    wish_of,
)
from drivelink.pubsub.wire import EstimateMessage, ExternalMessage
from drivelink.recording.sinks import McapSink, Sink
from estimator.sample import Sample, Status

_BLOCK_S = 1.0
_BLOCK_ITEMS = 25_000  # of a full bus at 1 Mbit/s in that time, samples and estimates: bounds the memory

Item = tuple[float, str, tuple[Any, ...]]
"""When it came in s, its kind, its values."""


class _Block(NamedTuple):
    first_s: float
    last_s: float
    packed: bytes


class Ring:
    """Keeps the items of some time, packed second by second: objects take ten times the memory and more.

    Args:
        reach_s: how far back, at least.
    """

    def __init__(self, reach_s: float) -> None:
        self._reach_s = reach_s
        self._open: list[Item] = []  # of the block that is not complete
        self._blocks: deque[_Block] = deque(maxlen=int(reach_s / _BLOCK_S) + 1)

    def take(self, item: Item) -> None:
        """Add the newest item; forget what is too old."""
        if self._open and (item[0] - self._open[0][0] >= _BLOCK_S or len(self._open) == _BLOCK_ITEMS):
            self._blocks.append(_pack(self._open))
            self._open = []
            while self._blocks[0].last_s < item[0] - self._reach_s:
                self._blocks.popleft()
        self._open.append(item)

    def between(self, first_s: float, last_s: float) -> Iterator[Item]:
        """Return the items of a time; those that are taken later are not among them."""
        blocks = [block for block in self._blocks if block.last_s >= first_s and block.first_s <= last_s]
        if self._open:
            blocks.append(_pack(self._open))
        return (
            item
            for block in blocks
            for item in pickle.loads(zlib.decompress(block.packed))
            if first_s <= item[0] <= last_s
        )


def _pack(items: list[Item]) -> _Block:
    packed = zlib.compress(pickle.dumps(items, pickle.HIGHEST_PROTOCOL), level=1)
    return _Block(items[0][0], items[-1][0], packed)


_LOG = logging.getLogger("drivelink.recording")

AFTER_S = 15.0  # that is kept after an event
_QUIET_S = 60.0  # in which the same cause is not kept again
_STATE_S = 12.0  # between two states of the estimator, at most
_LATE_S = 1.0  # that a state may come after its sample
_BLOCK = 20_000  # items between two syncs to disk
_FLAGS = {Status.MODEL_ALARM: "model alarm", Status.CHANGED: "change", Status.DRIVE_FAULT: "drive fault"}
_MASK = sum(int(bit) for bit in _FLAGS)


class _Event(NamedTuple):
    """What is to be kept: its causes; when the first came, and the joint file and model of that time."""

    causes: list[str]
    at_s: float  # by the clock of the box
    wall: datetime
    text: JointText
    model: tuple[str, bytes, int] | None

    @property
    def cause(self) -> str:
        """The leading one: a doubt of the model before anything else."""
        return next((cause for cause in DOUBTS if cause in self.causes), self.causes[0])


class BlackBox(Sink):
    """Keeps the newest of what it takes, and writes it when something happens.

    Args:
        text: the joint file; its `[recording]` section has folder and limits.

    Raises:
        RecordingError: the folder cannot be made.
    """

    wants = frozenset({"sample", "estimate", "external", "document", "frame", "snapshot"})

    def __init__(self, text: JointText, clock: Callable[[], float] = time.monotonic) -> None:
        self.counts = dict.fromkeys(sorted(self.wants), 0)
        self._text, self._clock = text, clock
        self._section = text.joint.recording
        self._wish = wish_of(text)
        self._folder = self._wish.parent
        self._day = Day(self._folder, text.joint.name)
        self._reach_s = self._section.keep_s + _STATE_S + 2 * AFTER_S  # until it is written
        self._ring = Ring(self._reach_s)
        self._states: deque[tuple[float, bytes]] = deque()
        self._mapping: tuple[dict[str, Any], int] | None = None
        self._model: tuple[str, bytes, int] | None = None
        self._model_s = -math.inf  # when it took the place of another
        self._holding: set[str] = set()  # causes of the last status document
        self._flags, self._contact = 0, False
        self._last_s: dict[str, float] = {}
        self._event: _Event | None = None
        self._writer: threading.Thread | None = None
        with raised_as(RecordingError, f"{self._folder}: cannot be written"):
            self._folder.mkdir(parents=True, exist_ok=True)
            for left in kept(self._folder, text.joint.name, UNFINISHED):  # by a kill
                if (lock := _locked(left)) is not None:
                    left.unlink()
                    os.close(lock)
            taken(self._wish).unlink(missing_ok=True)

    def sample(self, sample: Sample, stamp_ns: int) -> None:
        """Store what was measured at one SYNC."""
        self._take("sample", sample, stamp_ns)

    def estimate(self, message: EstimateMessage) -> None:
        """Store one estimate; its alarms are events."""
        self._take("estimate", message)
        self._day.estimate(message)
        flags = message.status & _MASK
        begun, self._flags = flags & ~self._flags, flags
        if begun:
            for bit, cause in _FLAGS.items():
                if begun & bit:
                    self.keep(cause)

    def external(self, message: ExternalMessage) -> None:
        """Store one external torque; a contact is an event where that is asked for."""
        self._take("external", message)
        begun, self._contact = message.contact and not self._contact, message.contact
        if begun and self._section.keep_contacts:
            self.keep("contact")

    def document(self, name: str, payload: bytes, stamp_ns: int) -> None:
        """Store a JSON document; a suspected signal, a fault or a lost bus in a status is an event."""
        self._take("document", name, payload, stamp_ns)
        if name == "model":
            if self._model is not None and self._model[1] != payload:
                self._model_s = self._clock()
            self._model = (name, payload, stamp_ns)
            if self._text.path is not None:
                try:  # anew: the daemon has it in use when it publishes another model
                    self._text = load_text(self._text.path)
                except JointFileError as error:
                    _LOG.error("%s: the black box goes on with the joint file before it", error)
            return
        status = json.loads(payload)
        self._day.status(status)
        states = {
            "suspected signal": (status.get("suspected") or {}).get("reason", "late") != "late",
            "drive fault": status.get("drive_faults"),
            "bus lost": status.get("state") == "bus lost",
        }
        holding = {cause for cause, holds in states.items() if holds}
        for cause in sorted(holding - self._holding):
            self.keep(cause)
        self._holding = holding

    def frame(self, stamp_ns: int, cob_id: int, data: bytes) -> None:
        """Store one CAN frame."""
        self._take("frame", stamp_ns, cob_id, data)

    def snapshot(self, state: bytes) -> None:
        """Store the estimator's state, with which a recording begins: a replay goes on from it."""
        now_s = self._clock()
        self._states.append((now_s, state))
        while self._states[0][0] < now_s - self._reach_s:
            self._states.popleft()
        self.counts["snapshot"] += 1

    def mapping(self, document: dict[str, Any], stamp_ns: int) -> None:
        """Store the mapping document: every recording begins with it."""
        self._mapping = (document, stamp_ns)

    def keep(self, cause: str, *, asked: bool = False) -> None:
        """Keep the time before now, and what comes after it; not if the same cause was kept a moment ago.

        Args:
            asked: by a person: also shortly after the same cause.
        """
        now_s = self._clock()
        if self._event is not None:
            if cause not in self._event.causes:
                self._event.causes.append(cause)
            return
        if not asked and now_s - self._last_s.get(cause, -_QUIET_S) < _QUIET_S:
            return
        self._last_s[cause] = now_s
        self._event = _Event([cause], now_s, datetime.now(UTC), self._text, self._model)

    def flush(self) -> None:
        """Begin to write what is complete, take a wish, add a row to the day; called once a second."""
        self._day.row()
        if self._wish.exists():
            with suppress(OSError):  # taken back
                self._wish.replace(taken(self._wish))
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
        """Write what is in memory: it is worth keeping after an error, too."""
        self.close()

    def _take(self, kind: str, *values: Any) -> None:
        self._ring.take((self._clock(), kind, values))
        self.counts[kind] += 1

    def _begin(self, event: _Event) -> threading.Thread:
        first, last = event.at_s - self._section.keep_s, event.at_s + AFTER_S
        states = [one for one in self._states if self._model_s <= one[0] <= event.at_s]
        state: bytes | None = None
        if states:
            at_s, state = next((one for one in reversed(states) if one[0] <= first), states[0])
            first = min(first, at_s - _LATE_S)
        items = self._ring.between(first, last)
        self._event = None
        self._writer = threading.Thread(target=self._write, args=(event, state, items), name="black box")
        self._writer.start()
        return self._writer

    def _write(self, event: _Event, state: bytes | None, items: Iterable[Item]) -> None:
        """Write one recording; what goes wrong is one line, and no half of a file stays."""
        sink: McapSink | None = None
        text, name, wall = event.text, event.text.joint.name, event.wall
        while (path := self._folder / recording_name(name, event.cause, wall)).exists():
            wall += timedelta(seconds=1)  # of a clock that was set back, or begins with each start
        unfinished, lock = path.with_suffix(UNFINISHED), None
        try:
            sink = McapSink(unfinished, text.joint, text.text, force=True)
            sink.flush()  # it has its name: what a kill leaves is found at the next start
            lock = _locked(unfinished)  # which may be that of another daemon, while this one ends
            time_text = event.wall.isoformat(timespec="milliseconds")
            about = {"cause": event.cause, "causes": ", ".join(event.causes), "time": time_text}
            sink.note("black box", {**about, "joint_file": text.name})
            if self._mapping is not None:
                sink.mapping(*self._mapping)
            if event.model is not None:
                sink.document(*event.model)
            if state is not None:
                sink.snapshot(state)
            for number, (_, kind, values) in enumerate(items, start=1):
                getattr(sink, kind)(*values)
                if number % _BLOCK == 0:
                    sink.flush()
            sink.close()
            unfinished.replace(path)
            drop_oldest(self._folder, name, self._section.keep_mib)
        except (OSError, RecordingError) as error:
            cause = error.__cause__ if isinstance(error.__cause__, OSError) else error
            why = f"{path}: nothing is kept: {getattr(cause, 'strerror', None) or cause}"
            _LOG.error("%s: %s: %s", name, event.cause, why)
            if sink is not None:
                sink.abandon()
                unfinished.unlink(missing_ok=True)
            self._answer(event, why)
            return
        finally:
            if lock is not None:
                os.close(lock)
        _LOG.warning("%s: %s: kept in %s", name, event.cause, path)
        self._answer(event, path.name)

    def _answer(self, event: _Event, text: str) -> None:
        """Tell who asked, if anybody did, what became of it."""
        if "asked" not in event.causes:
            return
        try:
            with open(taken(self._wish), "r+b", opener=open_own) as file:
                file.write(text.encode())
        except OSError:  # the file is gone, or there is no room even for that
            with suppress(OSError):
                taken(self._wish).unlink(missing_ok=True)


def _locked(path: Path) -> int | None:
    """Lock a file as long as the returned descriptor is open; None: another process or box has it locked."""
    fd = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    try:
        fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        os.close(fd)
        return None
    return fd
