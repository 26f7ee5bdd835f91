"""Channels that are late against each other, shifted back onto one time."""

from __future__ import annotations

from collections import deque

__all__ = ["Alignment"]

_LONGEST = 12  # periods


class Alignment:
    """Delays the motor's channels (or the link's) by a fraction of periods, so that all are equally late.

    Args:
        period_s: T.
    """

    def __init__(self, period_s: float) -> None:
        self._T = period_s
        self.reset()

    def reset(self) -> None:
        """No delay, no past."""
        self.periods = 0.0
        self._past: deque[list[float]] = deque(maxlen=_LONGEST + 2)

    def shift(self, periods: float) -> float:
        """The link is `periods` later than has been assumed so far; returns how much of it is taken on."""
        new = min(max(self.periods + periods, -float(_LONGEST)), float(_LONGEST))
        taken = new - self.periods
        self.periods = new
        return taken

    def align(self, inputs: list[float], restart: bool) -> list[float]:
        """Link, then position and torque of each motor, all as of the same (past) time."""
        past = self._past
        if restart:
            past.clear()
        past.appendleft(inputs)
        lag = abs(self.periods)
        if lag == 0.0:
            return inputs
        whole = int(lag)
        share = lag - whole
        last = len(past) - 1
        newer, older = past[min(whole, last)], past[min(whole + 1, last)]
        late = [a + share * (b - a) for a, b in zip(newer, older, strict=True)]
        if self.periods > 0.0:
            late[0] = inputs[0]
        else:
            late[1:] = inputs[1:]
        return late
