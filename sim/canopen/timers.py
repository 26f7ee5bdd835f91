"""Timers of simulated devices, on whatever clock the network keeps."""

import math
from collections.abc import Callable, Hashable


class Timers:
    """Scheduled calls by key, one for each, made in order of time."""

    def __init__(self) -> None:
        self.now_s = 0.0  # the present, as last given to `run`
        self.next_s = math.inf  # when the first call is due; infinity with none
        self._due: dict[Hashable, tuple[float, Callable[[], None]]] = {}

    def __contains__(self, key: object) -> bool:
        return key in self._due

    def set(self, key: Hashable, delay_s: float, action: Callable[[], None]) -> None:
        """Call `action` once, `delay_s` from now, instead of what this key had scheduled."""
        self._due.pop(key, None)  # of calls due at the same time, the one scheduled first is made first
        self._due[key] = self.now_s + delay_s, action
        self._look()

    def cancel(self, key: Hashable) -> None:
        """Cancel the call of this key, if there is one."""
        if self._due.pop(key, None):
            self._look()

    def clear(self) -> None:
        """Cancel all calls."""
        self._due.clear()
        self._look()

    def run(self, now_s: float) -> None:
        """Advance to `now_s` and make all calls that are due."""
        self.now_s = now_s
        while self.next_s <= now_s:
            key = min(self._due, key=lambda key: self._due[key][0])
            _, action = self._due.pop(key)
            self._look()
            action()

    def _look(self) -> None:
        self.next_s = min((due_s for due_s, _ in self._due.values()), default=math.inf)
