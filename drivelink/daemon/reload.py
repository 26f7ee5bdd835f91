"""Replaces the model of the running loop without losing a cycle.

When the joint file is rewritten, or on SIGHUP, a new estimator is built beside the cycle, led through the
last samples so that it starts where the old one is, and put in its place between two cycles. A thread leads
it; where that thread gets too little time to catch up with the cycle, the cycle itself does the rest, more
steps in each slack than there are new samples: the exchange comes, however slow the machine.
"""

from __future__ import annotations

import logging
import math
import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path

from drivelink._core import JointPipeline
from drivelink.cycle.pipeline import Built
from drivelink.daemon.status import EventLog
from drivelink.errors import DrivelinkError
from drivelink.jointfile import JointFile, load
from estimator.errors import EstimatorError
from estimator.sample import Sample

__all__ = ["Reloader"]

_EVERY_S = 1.0  # between the beginnings of two reloads: a file or a signal that flaps costs little
_STEPS = 5  # of the new estimator in one go; then the cycle gets its turn
_PAUSE_S = 0.0005
_BEHIND = 4  # samples that the cycle itself may catch up with at the exchange
_PATIENCE = 4000  # slacks that the thread is given for it; usually it takes a few hundred
_AID = 2  # steps in one slack from then on
_FIXED = ("name", "arrangement", "bus", "zenoh")  # what a running daemon does not change


class Reloader:
    """Watches one joint file, and exchanges the estimator of its pipeline.

    Args:
        path: the joint file.
        joint: as it is in use.
        pipeline: whose estimator is exchanged.
        build: makes estimator and model monitor of a joint file; called in a thread.
        publish: called with the joint file in use after an exchange.
        events: where it is said.
    """

    def __init__(
        self,
        path: Path,
        joint: JointFile,
        pipeline: JointPipeline,
        build: Callable[[JointFile], Built],
        publish: Callable[[JointFile], None],
        events: EventLog,
    ) -> None:
        self._path = path
        self._joint = joint
        self._pipeline, self._history = pipeline, pipeline.history
        self._build = build
        self._publish = publish
        self._events = events
        self._seen = self._signature()
        self._requested = False
        self._next_s = -math.inf
        self._thread: threading.Thread | None = None
        self._turn = threading.Lock()  # the new estimator is stepped by one thread at a time
        self._ready: tuple[JointFile, Built, int] | None = None
        self._slacks = 0  # since it was ready to be followed

    def request(self) -> None:
        """Read the file again even if it looks the same; from a signal handler."""
        self._requested = True

    def check(self) -> None:
        """In the slack: begin to reload when the file has changed."""
        if self._thread is not None or time.monotonic() < self._next_s:
            return
        signature = self._signature()
        if (signature == self._seen or signature is None) and not self._requested:
            return
        self._seen, self._requested, self._slacks = signature, False, 0
        self._next_s = time.monotonic() + _EVERY_S
        self._thread = threading.Thread(target=self._prepare, name="reload", daemon=True)
        self._thread.start()

    def step(self, _now_ns: int) -> None:
        """In the slack, between two cycles: put the new estimator in place when it is ready."""
        if self._ready is None or not self._turn.acquire(blocking=False):
            return
        try:
            joint, (estimator, model_monitor), sequence = self._ready
            if self._history.behind(sequence) > _BEHIND:
                self._slacks += 1
                if self._slacks > _PATIENCE:
                    self._lead(joint, (estimator, model_monitor), self._history.after(sequence, _AID))
                return
            self._ready = self._thread = None
            self._pipeline.exchange(estimator, model_monitor, self._history.after(sequence))
        finally:
            self._turn.release()
        self._joint = joint
        self._publish(joint)
        self._events.say(f"{self._path.name}: the model in it is now in use")

    def _signature(self) -> tuple[int, int, int] | None:
        try:
            status = self._path.stat()
        except OSError:
            return None
        return status.st_mtime_ns, status.st_size, status.st_ino

    def _prepare(self) -> None:
        try:
            joint = load(self._path)
            self._refuse_changes(joint)
            built = self._build(joint)
        except (DrivelinkError, EstimatorError) as error:
            self._events.say(f"the model stays as it is: {error}", logging.ERROR)
            self._thread = None
            return
        self._follow(joint, built)

    def _follow(self, joint: JointFile, built: Built) -> None:
        """Lead the new estimator through the kept samples, and on until the loop takes or leads it."""
        mine = threading.current_thread()
        sequence = -1
        while True:
            with self._turn:
                if self._thread is not mine or self._slacks > _PATIENCE:
                    return
                sequence = self._lead(joint, built, self._history.after(sequence, _STEPS))
            time.sleep(_PAUSE_S)

    def _lead(self, joint: JointFile, built: Built, samples: Sequence[Sample]) -> int:
        """Step the new estimator; the number of the last sample it has seen."""
        sequence = self._ready[2] if self._ready is not None else -1
        for sample in samples:
            built[0].step(sample)
            sequence = sample.sequence
        self._ready = (joint, built, sequence)
        return sequence

    def _refuse_changes(self, joint: JointFile) -> None:
        changed = [key for key in _FIXED if getattr(joint, key) != getattr(self._joint, key)]
        changed += [
            f"motor[{n}].drive"
            for n, (new, old) in enumerate(zip(joint.motor, self._joint.motor, strict=False), 1)
            if new.drive != old.drive
        ]
        if changed:
            self._events.say(
                f"{self._path.name}: {', '.join(changed)} changed, which takes a restart of the daemon",
                logging.WARNING,
            )
        if joint.arrangement != self._joint.arrangement:
            raise DrivelinkError(f"arrangement: expected {self._joint.arrangement}, as it was at the start")
