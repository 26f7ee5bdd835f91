"""Follows the rig's process: truth beside estimate, on a terminal or in plain lines."""

from __future__ import annotations

import multiprocessing
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, NamedTuple

from rich.console import Console
from rich.live import Live

from drivelink.demo.closing import Comparison
from drivelink.demo.rig import Change, Failure, RunSummary, serve
from drivelink.errors import DrivelinkError
from drivelink.jointfile import JointFile
from drivelink.monitor.view import JointView
from drivelink.pubsub.client import Subscription

_PATIENCE_S = 20.0  # for the other process to start, and to end
_LINE_S, _FRAME_S = 1.0, 0.125  # between plain lines, and pictures on a terminal


class RigProcess(NamedTuple):
    """The other process: its messages, and its early end."""

    connection: Connection
    stop: Callable[[], None]


@contextmanager
def rig_process(path: Path, seconds: float | None, change: Change | None = None) -> Iterator[RigProcess]:
    """Run simulation and daemon in another process; end it on exit."""
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe(duplex=False)
    process = context.Process(target=serve, args=(path, seconds, theirs, change), name="drivelink-demo")
    process.start()
    theirs.close()
    try:
        yield RigProcess(ours, process.terminate)
    finally:
        if process.is_alive():
            process.terminate()
        process.join(_PATIENCE_S)
        if process.is_alive():
            process.kill()
            process.join()
        ours.close()


class DemoRun:
    """Follows a run to its end, on a terminal or in plain lines."""

    def __init__(self, joint: JointFile, console: Console, *, live: bool, height: int | None = None) -> None:
        self.comparison = Comparison()  # truth beside estimate
        self.received = 0  # estimates that came in
        self.summary: RunSummary | None = None  # the daemon's own; None until it ended
        self._view = JointView(joint.name, subtitle="simulated, on the virtual bus", height=height)
        self._view.footer = "Ctrl-C ends"
        self._console = console
        self._live = live
        self._screen: Live | None = None
        self._period_s = joint.bus.period_s
        self._next_line_s = 0.0

    def follow(self, rig: RigProcess, subscription: Subscription) -> bool:
        """Follow the rig to its end; return whether Ctrl-C ended it early.

        Raises:
            DrivelinkError: the rig could not run.
        """
        if not self._live:
            return self._to_the_end(rig, subscription)
        # Drawn by this thread alone: the history must not grow under the one that draws it.
        with Live(self._view, console=self._console, auto_refresh=False, transient=True) as self._screen:
            return self._to_the_end(rig, subscription)

    def _to_the_end(self, rig: RigProcess, subscription: Subscription) -> bool:
        interrupted = False
        while self.summary is None:
            try:
                if rig.connection.poll(0.02):
                    self._receive(rig.connection)
                self._take(subscription)
            except EOFError:
                break
            except KeyboardInterrupt:
                if interrupted:
                    raise
                interrupted = True
                rig.stop()  # let it end cleanly and send its summary
        return interrupted

    def _receive(self, connection: Connection) -> None:
        message: Any = connection.recv()
        if isinstance(message, RunSummary):
            self.summary = message
        elif isinstance(message, Failure):
            error = DrivelinkError(message.text)
            error.exit_status = message.exit_status
            raise error
        elif isinstance(message, list):
            for point in message:
                self.comparison.known(point)
        else:
            self._other(message)

    def _other(self, message: Any) -> None:
        """Process what a rig says besides."""

    def _take(self, subscription: Subscription) -> None:
        for estimate in subscription.cycles(0.0):
            if estimate is None:
                break
            self.received += 1
            self.comparison.received(estimate)
        status = subscription.status
        if status:
            self._view.status = status
        if self.comparison.latest is not None:
            last, truth = self.comparison.latest
            self._view.update(last, last.sequence * self._period_s, truth)
            self._view.errors = self.comparison.errors()[1:3]
        if time.monotonic() >= self._next_line_s:
            self._next_line_s = time.monotonic() + (_FRAME_S if self._live else _LINE_S)
            if self._screen is not None:
                self._screen.refresh()
            else:
                sys.stderr.write(f"{self._view.line()}\n")
