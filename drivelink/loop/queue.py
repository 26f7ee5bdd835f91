"""The queue of diagnoses: one recording of the folder at a time, each in a process of its own."""

import logging
import os
import subprocess
import sys
import time
from collections.abc import Collection
from contextlib import suppress
from pathlib import Path

from drivelink.errors import DrivelinkError
from drivelink.loop import finding
from drivelink.loop.finding import DOUBTS, event_of, kept

_LOG = logging.getLogger("drivelink.loop")
_APART_S = 60.0  # events closer than this are one
_LONGEST_S = 3600.0  # that one diagnosis may take
_UNDER_WAY = "what the model may lack is being looked for"
_SAID_S = 10.0  # that a diagnosis waits for the processors before it is said, and between two such sentences


class Diagnoses:
    """Has the recordings of one folder diagnosed, one at a time; the newest first."""

    def __init__(self, folder: Path, joint: str) -> None:
        self._folder, self._joint = folder, joint
        self._seen = 0
        self._tried: set[Path] = set()
        self._recording: Path | None = None
        self._process: subprocess.Popen[bytes] | None = None
        self._since_s = 0.0
        self._before = (0.0, 0.0)  # time of the last step, and CPU time of the process then
        self._worked_s = 0.0  # when it last had half of a processor, or wanted none
        self._said_s = 0.0  # for how long it was said to wait

    def step(self) -> None:
        """End what is done and begin what is due; called once a second."""
        if self._process is not None:
            if self._process.poll() is None:
                if time.monotonic() - self._since_s > _LONGEST_S:
                    self._process.kill()
                self._watch(self._process.pid)
                return
            self._end(self._process.returncode)
        try:
            seen = self._folder.stat().st_mtime_ns
            if seen == self._seen:
                return
            due = next_due(self._folder, self._joint, self._tried)
        except OSError:
            return
        if due is None:
            self._seen = seen
            return
        self._begin(due)

    def close(self) -> None:
        """End a diagnosis that is under way; the next start makes it again."""
        if self._process is not None:
            self._process.kill()
            self._process.wait()
            self._process = None

    def _begin(self, recording: Path) -> None:
        self._tried.add(recording)
        self._recording, self._since_s = recording, time.monotonic()
        self._before, self._worked_s, self._said_s = (self._since_s, 0.0), self._since_s, 0.0
        self._say(finding.DIAGNOSING, _UNDER_WAY)
        command = [sys.executable, "-m", "drivelink.loop.diagnosing", str(recording)]
        try:
            self._process = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL)
        except OSError as error:
            self._say(finding.FAILED, f"its diagnosis cannot be started: {error.strerror}")

    def _watch(self, pid: int) -> None:
        """Log it while the processors are too busy for the diagnosis, and when it goes on."""
        now_s, (state, cpu_s) = time.monotonic(), _of_process(pid)
        before_s, had_s = self._before
        self._before = now_s, cpu_s
        if state != "R" or cpu_s - had_s > 0.5 * (now_s - before_s):
            self._worked_s = now_s
        waited_s = now_s - self._worked_s
        waited_s -= waited_s % _SAID_S
        if waited_s != self._said_s:
            self._said_s = waited_s
            waits = f"diagnosis waits: processors busy for {waited_s:.0f} s"
            self._say(finding.DIAGNOSING, waits if waited_s else _UNDER_WAY)

    def _end(self, status: int) -> None:
        recording, self._recording, self._process = self._recording, None, None
        if recording is None or not recording.exists():
            return
        found = finding.read(recording)
        if found is None or found["state"] == finding.DIAGNOSING:
            how = f"signal {-status}" if status < 0 else f"status {status}"
            text = f"its diagnosis ended with {how}: drivelink diagnose {recording} makes it by hand"
            self._recording = recording
            self._say(finding.FAILED, text)
            _LOG.error("%s: %s: %s", self._joint, recording.name, text)

    def _say(self, state: str, sentence: str) -> None:
        if self._recording is not None:
            found = finding.read(self._recording)
            if state == finding.DIAGNOSING and found is not None and found["state"] != state:
                return  # it is done: a process of idle priority takes its time to end
            with suppress(DrivelinkError):  # of a full disk: the black box says so
                finding.write(self._recording, finding.begun(self._recording, state, sentence))


def _of_process(pid: int) -> tuple[str, float]:
    """State of a process (R: runs or waits for a processor) and its CPU time, s; "", 0 where nobody says."""
    try:
        values = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
        return values[0], (int(values[11]) + int(values[12])) / os.sysconf("SC_CLK_TCK")
    except (OSError, IndexError, ValueError):
        return "", 0.0


def next_due(folder: Path, joint: str, tried: Collection[Path] = ()) -> Path | None:
    """Return the newest recording to be diagnosed: of a doubt that is no part of one diagnosed already.

    Raises:
        OSError: the folder cannot be read.
    """
    waiting, done = [], []
    for path in kept(folder, joint):
        found = finding.read(path)
        if path in tried or (found is not None and found["state"] != finding.DIAGNOSING):
            done.append(event_of(path).time)
        elif event_of(path).cause in DOUBTS:
            waiting.append(path)
    for path in reversed(waiting):
        event = event_of(path)
        near = (abs((event.time - other).total_seconds()) < _APART_S for other in done)
        if event.cause == "asked" or not any(near):
            return path
    return None
