"""Timers of simulated devices, on whatever clock the network keeps."""

from __future__ import annotations

import heapq
import itertools
import math
from collections.abc import Callable


class Timer:
    """One scheduled call."""

    __slots__ = ("action", "due_s")

    def __init__(self, due_s: float, action: Callable[[], None]) -> None:
        self.due_s = due_s
        self.action: Callable[[], None] | None = action

    def cancel(self) -> None:
        """Cancel the call."""
        self.action = None


class Timers:
    """Scheduled calls in order of time."""

    def __init__(self) -> None:
        self.now_s = 0.0  # the present, as last given to `run`
        self.next_s = math.inf  # when the first call is due; infinity with none
        self._heap: list[tuple[float, int, Timer]] = []
        self._count = itertools.count()

    def after(self, delay_s: float, action: Callable[[], None]) -> Timer:
        """Call `action` once, `delay_s` from now."""
        timer = Timer(self.now_s + delay_s, action)
        heapq.heappush(self._heap, (timer.due_s, next(self._count), timer))
        self.next_s = self._heap[0][0]
        return timer

    def clear(self) -> None:
        """Cancel all calls."""
        self._heap.clear()
        self.next_s = math.inf

    def run(self, now_s: float) -> None:
        """Advance to `now_s` and make all calls that are due."""
        self.now_s = now_s
        while self._heap and self._heap[0][0] <= now_s:
            _, _, timer = heapq.heappop(self._heap)
            if timer.action:
                timer.action()
        self.next_s = self._heap[0][0] if self._heap else math.inf
