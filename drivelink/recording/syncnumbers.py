"""Numbers the SYNCs of a recording; later stamps distinguish a late stamp from a lost SYNC.

Recorded stamps are often arrival times, which come in bursts. After a late SYNC others catch up; after a lost
one all stay behind. `SyncClock` has to decide at once and cannot distinguish them.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator

from drivelink._core import SYNC_COB_ID
from drivelink.cycle.syncclock import SyncClock, measure_period
from drivelink.recording.canlog import NO_STAMP, LoggedFrame

_AHEAD = 64  # later SYNCs used to number one
_EXTRA = -0.5  # periods too early: a SYNC of another master
_FOLLOW = 0.05  # of the deviation, per SYNC: the two clocks drift


def numbered_at_once(frames: Iterable[LoggedFrame], period_s: float) -> Iterator[tuple[LoggedFrame, int]]:
    """Each frame with the jump of its SYNC, decided as in the live loop."""
    clock = SyncClock(period_s)
    for frame in frames:
        if frame.can_id == SYNC_COB_ID and frame.stamp_ns != NO_STAMP:
            yield frame, clock.jump(frame.stamp_ns)
        else:
            yield frame, 1


def numbered_ahead(frames: Iterable[LoggedFrame], period_s: float) -> Iterator[tuple[LoggedFrame, int]]:
    """Each frame with the jump of its SYNC: periods since the previous one, 0 if not due."""
    numbering = SyncNumbering(period_s)
    for frame in frames:
        yield from numbering.push(frame)
    yield from numbering.rest()


class SyncNumbering:
    """Numbers the SYNCs of a stream once enough others have followed.

    Args:
        measure: use the period of the first SYNCs if it differs.
    """

    def __init__(self, period_s: float, *, measure: bool = False) -> None:
        self.period_s = period_s  # in use
        self._measure = measure
        self._last: int | None = None
        self._due_ns: float | None = None
        self._cycles: deque[list[LoggedFrame]] = deque()  # each waiting SYNC and its frames
        self._stamps: deque[int] = deque()  # of these SYNCs

    def push(self, frame: LoggedFrame) -> list[tuple[LoggedFrame, int]]:
        """Take a frame; return the frames decided now, each with its jump."""
        if frame.can_id == SYNC_COB_ID:
            self._cycles.append([frame])
            self._stamps.append(frame.stamp_ns)
            return self._released() if len(self._cycles) > _AHEAD else []
        if self._cycles:
            self._cycles[-1].append(frame)
            return []
        return [(frame, 1)]

    def rest(self) -> list[tuple[LoggedFrame, int]]:
        """End the stream; return all waiting frames."""
        return [numbered for _ in range(len(self._cycles)) for numbered in self._released()]

    def _released(self) -> list[tuple[LoggedFrame, int]]:
        """Release the first waiting cycle."""
        sync, *others = self._cycles.popleft()
        return [(sync, self._jump()), *[(frame, 1) for frame in others]]

    def _jump(self) -> int:
        """The jump of the first waiting SYNC."""
        stamps = self._stamps
        if self._measure:
            self._measure = False
            measured = measure_period(list(stamps), self.period_s) if NO_STAMP not in stamps else None
            self.period_s = self.period_s if measured is None else measured.period_s
        period_ns = self.period_s * 1e9
        stamp = stamps.popleft()
        if stamp == NO_STAMP:
            return 1
        due, last, self._last = self._due_ns, self._last, stamp
        if due is None or (last is not None and stamp < last - period_ns):  # the clock was set back
            earliest = min([float(stamp), *(s - (k + 1) * period_ns for k, s in enumerate(stamps))])
            self._due_ns = earliest + period_ns
            return 1
        late = (stamp - due) / period_ns
        if late < _EXTRA:
            return 0
        lost = 0
        if late > 0.5:
            lost = max(
                0, round(min([late, *((s - due) / period_ns - (k + 1) for k, s in enumerate(stamps))]))
            )
        left = late - lost
        self._due_ns = due + (1 + lost + (_FOLLOW * left if abs(left) < 0.5 else 0.0)) * period_ns
        return 1 + lost
