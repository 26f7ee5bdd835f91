"""Raw CAN recordings read by a process of its own: one core reads, the other one estimates."""

from __future__ import annotations

import logging
import multiprocessing
import signal
from collections.abc import Iterator
from contextlib import suppress
from logging.handlers import QueueHandler
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from drivelink.errors import DrivelinkError, RecordingError
from drivelink.jointfile import JointFile
from drivelink.recording.canframes import FrameLog
from drivelink.recording.cycles import Cycle, batches
from estimator.sample import Sample

__all__ = ["FrameLogAhead"]

_END_S = 5.0


class FrameLogAhead:
    """`FrameLog` in another process; arguments, `period_s`, `cycles` and errors are the same."""

    def __init__(self, path: Path, joint: JointFile, base_dir: Path, channel: str | None = None) -> None:
        self._path = path
        context = multiprocessing.get_context("spawn")
        self._connection, theirs = context.Pipe(duplex=False)
        arguments = (theirs, path, joint, base_dir, channel)
        self._process = context.Process(target=_serve, args=arguments, name="drivelink-read", daemon=True)
        self._process.start()
        theirs.close()
        self.period_s = float(self._next())

    def cycles(self) -> Iterator[Cycle]:
        """See `FrameLog.cycles`; the other process ends with it."""
        try:
            while batch := self._next():
                for sequence, stamp_ns, sample, flags in batch:
                    yield Cycle(sequence, stamp_ns, None if sample is None else Sample(*sample), flags)
        finally:
            self.close()

    def close(self) -> None:
        """End the other process; a second time does nothing."""
        self._connection.close()
        self._process.join(_END_S)

    def _next(self) -> Any:
        """What the other process has sent, warnings aside."""
        while True:
            try:
                message = self._connection.recv()
            except (EOFError, OSError):
                message = RecordingError(f"{self._path}: the process that reads it was ended")
            if isinstance(message, DrivelinkError):
                self.close()
                raise message
            if not isinstance(message, logging.LogRecord):
                return message
            logging.getLogger(message.name).handle(message)


class _Forward(QueueHandler):
    """Sends log records to the process that shows them."""

    def enqueue(self, record: logging.LogRecord) -> None:
        self.queue.send(record)  # type: ignore[attr-defined]


def _serve(connection: Connection, path: Path, joint: JointFile, base_dir: Path, channel: str | None) -> None:
    """The other process: the period, lists of cycles, an empty one at the end; or an error instead."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches both; who estimates decides
    logger = logging.getLogger("drivelink")
    logger.addHandler(_Forward(connection))  # type: ignore[arg-type]
    logger.propagate = False
    with suppress(BrokenPipeError, ConnectionResetError):  # nobody reads any more
        try:
            log = FrameLog(path, joint, base_dir, channel)
            connection.send(log.period_s)
            for batch in batches(log.cycles()):
                connection.send([_plain(cycle) for cycle in batch])
            connection.send([])
        except DrivelinkError as error:
            connection.send(error)


def _plain(cycle: Cycle) -> tuple[Any, ...]:
    """Without named tuples, which take three times as long to send."""
    sequence, stamp_ns, sample, flags = cycle
    return sequence, stamp_ns, None if sample is None else tuple(sample), flags
