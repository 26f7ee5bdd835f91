"""Replaces the model of the running loop without losing a cycle.

When the text of the joint file is another one, or on SIGHUP of a service manager, another process reads and
validates it. Until it is in use, and for as long as it is not wholly so, a condition says that. A
thread builds the new estimator and steps it through the last samples, so that it starts where the old one is;
it holds neither the interpreter's lock nor one of the cycle's meanwhile. It is swapped in between two cycles.
If the thread cannot catch up with the cycle, the cycle does the rest with more steps per slack than there are
new samples, so the exchange always completes.
"""

import logging
import math
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from drivelink._core import JointPipeline
from drivelink.cycle.pipeline import Built
from drivelink.daemon.status import EventLog
from drivelink.errors import DrivelinkError
from drivelink.jointfile import JointFile, fingerprint, read_text
from drivelink.jointfile.apart import load_apart

_EVERY_S = 1.0  # minimum time between two reloads, against repeated changes
_STEPS = 500  # steps of the new estimator before the cycle may have it: some milliseconds
_PAUSE_S = 0.0005
_BEHIND = 4  # samples that the cycle can process at the exchange
_PATIENCE = 4000  # slacks until the cycle takes over; usually a few hundred suffice
_AID = 2  # steps per slack from then on


class Reloader:
    """Watches one joint file and exchanges the estimator of its pipeline.

    Args:
        known: fingerprint of the text that `joint` was read from.
        move: puts a joint file on the bus of the command line.
        build: makes estimator and model monitor of a joint file; called in a thread.
        publish: called with the new joint file after an exchange.
    """

    def __init__(
        self,
        path: Path,
        joint: JointFile,
        known: str,
        pipeline: JointPipeline,
        move: Callable[[JointFile], JointFile],
        build: Callable[[JointFile], Built],
        publish: Callable[[JointFile], None],
        events: EventLog,
    ) -> None:
        self.path = path
        self._joint, self._fixed, self._known = joint, _fixed(joint), known
        self._pipeline, self._history = pipeline, pipeline.history
        self._move, self._build = move, build
        self._publish = publish
        self._events = events
        self._seen = self._signature()
        self._requested = not self._is_as(known)  # edited since it was read
        self._text = known  # fingerprint of what is read
        self._standing = ""  # what holds of a file that is not, or not wholly, in use
        self._restart = ""  # what of the file that is read requires a restart
        self._next_s = -math.inf
        self._thread: threading.Thread | None = None
        self._turn = threading.Lock()  # serialises the steps of the new estimator
        self._ready: tuple[JointFile, Built, int] | None = None
        self._slacks = 0  # slacks since the new estimator was ready

    def request(self) -> None:
        """Reload even an unchanged file; callable from a signal handler."""
        self._requested = True

    def close(self) -> dict[str, Any]:
        """Cancel a reload that is under way; return the joint file in use, and its fingerprint."""
        self._thread = None
        self._stand("")
        return {"joint": self._joint, "fingerprint": self._known}

    def check(self) -> None:
        """Start a reload in the slack, if the file has changed."""
        if self._thread is not None or time.monotonic() < self._next_s:
            return
        signature = self._signature()
        if signature == self._seen and not self._requested:
            return
        asked, self._seen, self._requested, self._slacks = self._requested, signature, False, 0
        self._next_s = time.monotonic() + _EVERY_S
        self._thread = threading.Thread(target=self._prepare, args=(asked,), name="reload", daemon=True)
        try:
            self._thread.start()
        except RuntimeError:  # the system has no more threads: in a second again
            self._thread, self._requested = None, True
            raise

    def step(self, _now_ns: int) -> None:
        """Swap in the new estimator when it is ready, in the slack between two cycles."""
        if self._ready is None or not self._turn.acquire(blocking=False):
            return
        try:
            joint, (estimator, model_monitor), sequence = self._ready
            if self._history.behind(sequence) > _BEHIND:
                self._slacks += 1
                if self._slacks > _PATIENCE:
                    self._lead(joint, (estimator, model_monitor), _AID)
                return
            self._ready = self._thread = None
            self._pipeline.warm(estimator, sequence)
            self._pipeline.exchange(estimator, model_monitor)
        finally:
            self._turn.release()
        self._joint, self._known = joint, self._text
        self._publish(joint)
        self._stand(self._restart)
        self._events.report(f"{self.path.name}: the model in it is now in use", key=f"in use {self._text}")

    def _signature(self) -> tuple[int, int, int] | None:
        try:
            status = self.path.stat()
        except OSError:
            return None
        return status.st_ctime_ns, status.st_size, status.st_ino  # ctime: no program can set it

    def _is_as(self, known: str) -> bool:
        """Whether the file has this text; one that cannot be read has another."""
        try:
            return fingerprint(read_text(self.path)) == known
        except DrivelinkError:
            return False

    def _prepare(self, asked: bool) -> None:
        """Read the file, and make its estimator if its text is another one than that in use, or if asked."""
        try:
            self._text = fingerprint(read_text(self.path))
            if self._text == self._known and not asked:
                self._stand(self._restart, over=f"{self.path.name}: as it is in use again")
                self._next_s, self._thread = -math.inf, None
                return
            self._stand(f"{self.path.name}: edited, not in use yet", logging.DEBUG)
            joint = self._move(load_apart(self.path))
            self._refuse_changes(joint)
            built = self._build(joint)
        except Exception as error:  # noqa: BLE001 - whatever comes of a file, the next one is read
            self._stand(f"the model stays as it is: {error}", logging.ERROR)
            self._thread = None
            return
        self._follow(joint, built)

    def _stand(self, text: str, level: int = logging.WARNING, over: str = "") -> None:
        """Report what holds of the file until something else does; empty: it is in use."""
        if text != self._standing:
            self._events.end(self._standing, over)
            self._standing = text
            if text:
                self._events.begin(text, text, level)

    def _follow(self, joint: JointFile, built: Built) -> None:
        """Step the new estimator through the kept samples, and on until the loop takes over."""
        mine = threading.current_thread()
        while True:
            with self._turn:
                if self._thread is not mine or self._slacks > _PATIENCE:
                    return
                self._lead(joint, built, _STEPS)
            time.sleep(_PAUSE_S)

    def _lead(self, joint: JointFile, built: Built, steps: int) -> None:
        """Step the new estimator through the next kept samples."""
        sequence = self._ready[2] if self._ready is not None else -1
        self._ready = (joint, built, self._pipeline.warm(built[0], sequence, steps))

    def _refuse_changes(self, joint: JointFile) -> None:
        for key in ("name", "arrangement"):
            if getattr(joint, key) != (was := getattr(self._joint, key)):
                raise DrivelinkError(f"{self.path.name}: {key}: expected {was}, as it was at the start")
        changed = [key for key, value in _fixed(joint).items() if self._fixed.get(key) != value]
        needs = f"{', '.join(changed)} changed, which requires a restart of the daemon"
        self._restart = f"{self.path.name}: {needs}" if changed else ""


def _fixed(joint: JointFile) -> dict[str, object]:
    """Return what a running daemon cannot change, by key."""
    keys = ("bus", "zenoh", "recording")
    drives = {f"motor[{n}].drive": motor.drive for n, motor in enumerate(joint.motor, 1)}
    return {key: getattr(joint, key) for key in keys} | drives | {"link.encoder": joint.link.encoder}
