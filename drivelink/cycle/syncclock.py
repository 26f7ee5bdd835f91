"""From the stamps of SYNC to the periods between them: time enters here, and only as whole periods."""

from __future__ import annotations

__all__ = ["SyncClock"]

_CLOCK_STEP_NS = 50_000_000  # stamps and receptions differ by less, unless one clock was set


class SyncClock:
    """How many periods lie between one SYNC and the next, from their stamps.

    It follows the drift between the two clocks, so that a stamp is always compared with where this SYNC
    was due, not with the jitter of the one before.

    Args:
        period_s: the communication cycle.
    """

    _FOLLOW = 0.05  # of the deviation, per SYNC: a drift of 100 ppm stays below 0.2 % of a period

    def __init__(self, period_s: float) -> None:
        self._period_ns = period_s * 1e9
        self._due_ns: float | None = None
        self._last = (0, 0)

    def jump(self, stamp_ns: int, monotonic_ns: int | None = None) -> int:
        """Periods since the SYNC before: 1 is normal, more is a gap, 0 is a SYNC that was not due.

        Args:
            stamp_ns: when the SYNC was on the bus, by any clock, even one that is set from time to time.
            monotonic_ns: when it was received, by one that is not; tells a step of the other from a gap.
        """
        if self._due_ns is None:
            self._due_ns = float(stamp_ns)
            self._last = (stamp_ns, monotonic_ns or 0)
            return 1
        elapsed = stamp_ns - self._last[0]
        if monotonic_ns is not None:
            seen = monotonic_ns - self._last[1]
            if not -_CLOCK_STEP_NS < elapsed < seen + _CLOCK_STEP_NS:
                self._due_ns += elapsed - seen
        self._last = (stamp_ns, monotonic_ns or 0)
        deviation = (stamp_ns - self._due_ns) / self._period_ns
        periods = round(deviation)
        if periods < 0:  # the clock was set back, and nothing tells by how much
            self._due_ns = float(stamp_ns)
            return 1
        if periods:
            self._due_ns += (periods + self._FOLLOW * (deviation - periods)) * self._period_ns
        return periods
