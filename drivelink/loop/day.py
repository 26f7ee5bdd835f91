"""The last day of a joint: stiffness and friction, a row a second, in two files of bounded size."""

import logging
import math
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from drivelink.errors import RecordingError
from drivelink.files import read_regular
from drivelink.loop import finding
from drivelink.loop.finding import event_of, finding_file, kept, open_own, page_file
from drivelink.pubsub.wire import EstimateMessage
from estimator.sample import FloatArray, Status

_LOG = logging.getLogger("drivelink.recording")

COLUMNS = ("time_s", "stiffness_nm_rad", "stiffness_std_nm_rad", "valid", "friction_nm", "friction_std_nm")
DAY_S = 86_400.0
_ROW_BYTES = 128  # at most
_MOST = int(DAY_S) * _ROW_BYTES
_EVENTS = 500


def day_files(folder: Path, joint: str) -> tuple[Path, Path]:
    """Return the file that is written, and the one before it."""
    return folder / f"{joint}.day.csv", folder / f"{joint}.day-before.csv"


class Day:
    """Writes a row a second; begins a new file after a day, and drops the one before the last.

    Args:
        clock: UNIX time, s.
    """

    def __init__(self, folder: Path, joint: str, clock: Callable[[], float] = time.time) -> None:
        self._path, self._before = day_files(folder, joint)
        self._clock = clock
        self._newest: EstimateMessage | None = None
        self._friction: tuple[float, float] = (math.nan, math.nan)
        self._valid = self._all = 0
        self._failed = False

    def estimate(self, message: EstimateMessage) -> None:
        """Add one estimate."""
        self._newest = message
        self._all += 1
        self._valid += bool(message.status & (Status.VALID | Status.STIFFNESS_VALID))

    def status(self, document: Mapping[str, Any]) -> None:
        """Add the friction of a status document: that of all motors together."""
        found = document.get("friction")
        known = [one for one in found if isinstance(one, Mapping)] if isinstance(found, list) else []
        if known and len(known) == len(found or ()):
            with suppress(KeyError, TypeError):  # anybody may say that he is the daemon
                torque = sum(one["torque_nm"] for one in known)
                self._friction = torque, math.hypot(*(one["std_nm"] for one in known))

    def row(self) -> None:
        """Write the second that ends now, if there was an estimate; what goes wrong is one line."""
        message, self._newest = self._newest, None
        if message is None:
            return
        valid, self._valid, self._all = self._valid / self._all, 0, 0
        values = message.stiffness_nm_rad, message.stiffness_std_nm_rad, valid, *self._friction
        line = f"{self._clock():.3f}," + ",".join(f"{value:.6g}" for value in values) + "\n"
        try:
            self._append(line)
            self._failed = False
        except OSError as error:
            if not self._failed:
                _LOG.error("%s: rows of the day are not kept: %s", self._path, error.strerror)
            self._failed = True

    def _append(self, line: str) -> None:
        """Add a line; a file of a day's rows gives way to a new one, and a removed folder is made."""
        self._path.parent.mkdir(parents=True, exist_ok=True)
        if self._path.exists() and self._path.stat().st_size >= _MOST // 2:
            self._path.replace(self._before)
        with open(self._path, "a", encoding="ascii", opener=open_own) as file:
            file.write(line if file.tell() else ",".join(COLUMNS) + "\n" + line)


def rows(folder: Path, joint: str) -> FloatArray:
    """Return the (n, 6) rows of a joint's last day, oldest first; a damaged line is left out."""
    found: list[list[float]] = []
    for path in reversed(day_files(folder, joint)):
        try:
            text = read_regular(path, _MOST).decode("ascii", "replace")
        except OSError:
            continue
        for line in text.splitlines()[1:]:
            with suppress(ValueError):  # a damaged line
                row = [float(value) for value in line.split(",")]
                found += [row] if len(row) == len(COLUMNS) else []
    table = np.reshape(np.array(found, dtype=np.float64), (-1, len(COLUMNS)))
    now_s = table[-1, 0] if len(table) else 0.0  # a later row is of a clock that was wrong
    table = table[(table[:, 0] > now_s - DAY_S) & (table[:, 0] <= now_s)]
    return np.asarray(table[np.argsort(table[:, 0], kind="stable")])


def thinned(table: FloatArray, begin_s: float, end_s: float, most: int) -> list[list[float | None]]:
    """Return what lies between two times as at most so many rows: medians, null where not known."""
    part = table[(table[:, 0] >= begin_s) & (table[:, 0] <= end_s)]
    if len(part) > most:
        span = max(end_s - begin_s, 1e-9) / most
        places = ((part[:, 0] - begin_s) // span).astype(int)
        pieces = np.split(part, np.flatnonzero(np.diff(places)) + 1)
        part = np.array([_middle(piece) for piece in pieces])
    return [[float(value) if math.isfinite(value) else None for value in row] for row in part]


def _middle(rows_of: FloatArray) -> FloatArray:
    """Medians of the columns, of what is known; the rows of which most are not valid do not count."""
    good = rows_of[rows_of[:, 3] >= 0.5] if np.any(rows_of[:, 3] >= 0.5) else rows_of
    made = np.array([np.median(x[np.isfinite(x)]) if np.any(np.isfinite(x)) else np.nan for x in good.T])
    made[3] = np.mean(rows_of[:, 3])
    return made


def events(folder: Path, joint: str, begin_s: float) -> list[dict[str, Any]]:
    """Return what was kept since a time, oldest first: time, cause, recording and diagnosis."""
    try:
        recordings = kept(folder, joint)[-_EVENTS:]
    except OSError:
        return []
    made = []
    for recording in recordings:
        try:
            event = event_of(recording)
        except RecordingError:
            continue
        if event.time.timestamp() < begin_s:
            continue
        found = finding.read(recording) or {}
        page, plain = page_file(recording), finding_file(recording)
        said = page if page.exists() else plain if found else None
        made.append({
            "time": event.time.timestamp(), "cause": event.cause, "recording": recording.name,
            "finding": None if said is None else said.name,
            "state": str(found.get("state") or ""), "sentence": str(found.get("sentence") or ""),
        })  # fmt: skip
    return made
