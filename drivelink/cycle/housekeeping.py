"""Runs periodic tasks in the slack of the cycle, one short task at a time.

A task that is too long for one cycle is a generator: each `yield` leaves the rest to the next slack.
"""

from collections.abc import Callable, Generator
from dataclasses import dataclass

Task = Callable[[], object]

_ENOUGH_NS = 250_000  # upper limit of a task, or a part of one
_PATIENCE_NS = 1_000_000_000  # a task that has waited so long runs even without slack


def _raise(error: Exception) -> None:
    raise error


@dataclass(slots=True)
class _Periodic:
    period_ns: int
    action: Task
    due_ns: int


class Housekeeping:
    """Periodic tasks; the loop runs one at a time if there is time.

    An exception ends only this run of the task that raised it.
    """

    def __init__(self) -> None:
        self._tasks: list[_Periodic] = []
        self._next_ns = 0
        self._parts: Generator[None] | None = None
        self.urgent: list[Callable[[int], None]] = []  # called in every cycle with slack, for stepwise work
        self.on_fault: Callable[[Exception], None] = _raise  # called with an exception

    def every(self, period_s: float, action: Task) -> None:
        """Call `action` periodically; it, or each part of it, must take less than 0.2 ms."""
        self._tasks.append(_Periodic(round(period_s * 1e9), action, self._next_ns))

    def run(self, now_ns: int, slack_ns: int) -> None:
        """Run due tasks within `slack_ns` of monotonic time."""
        if slack_ns >= _ENOUGH_NS:
            for step in self.urgent:
                try:
                    step(now_ns)
                except Exception as error:  # noqa: BLE001 - the cycle goes on
                    self.on_fault(error)
            if self._parts is not None:
                self._go_on(self._parts)
                return
        if now_ns < self._next_ns:
            return
        task = min(self._tasks, key=lambda task: task.due_ns, default=None)
        if task is None:
            return
        if slack_ns >= _ENOUGH_NS or now_ns - task.due_ns > _PATIENCE_NS > task.due_ns - now_ns:
            task.due_ns = max(task.due_ns + task.period_ns, now_ns)
            while self._parts is not None:  # without slack for so long that another task cannot wait
                self._go_on(self._parts)
            try:
                parts = task.action()
            except Exception as error:  # noqa: BLE001 - as above
                self.on_fault(error)
                parts = None
            if isinstance(parts, Generator):
                self._parts = parts
                self._go_on(parts)
        self._next_ns = min(task.due_ns for task in self._tasks)

    def _go_on(self, parts: Generator[None]) -> None:
        try:
            next(parts)
        except StopIteration:
            self._parts = None
        except Exception as error:  # noqa: BLE001 - as above
            self._parts = None
            self.on_fault(error)
