"""`drivelink demo`: everything without hardware, watched from a process of its own."""

from __future__ import annotations

import argparse
import json
import math
import multiprocessing
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib import resources
from multiprocessing.connection import Connection
from pathlib import Path
from typing import NamedTuple

from rich.console import Console
from rich.live import Live

from drivelink import jointfile
from drivelink.demo.closing import as_json, closing_table
from drivelink.demo.comparison import Comparison
from drivelink.demo.rig import Failure, RunSummary, serve
from drivelink.errors import DrivelinkError
from drivelink.jointfile import JointFile
from drivelink.monitor.history import TruePoint
from drivelink.monitor.view import JointView
from drivelink.pubsub.client import Subscription, subscribe

CASES = ("constant", "quadratic", "vsa-ii")
_PATIENCE_S = 20.0  # for the other process to start, and to end
_LINE_S = 1.0

EPILOG = """\
examples:
  drivelink demo                                   watch the estimates beside the truth
  drivelink demo --case constant --seconds 30 --json
"""


def configure(parser: argparse.ArgumentParser) -> None:
    """Arguments of `demo`."""
    parser.add_argument("--case", choices=CASES, default="vsa-ii", help="one of the paper's three cases")
    parser.add_argument(
        "--seconds", type=_seconds, default=10.0, metavar="S", help="of the run (default: 10)"
    )
    parser.add_argument("--headless", action="store_true", help="plain lines instead of the live view")
    parser.add_argument("--json", action="store_true", help="print one line of JSON and nothing else")


def _seconds(text: str) -> float:
    value = float(text)
    if not (math.isfinite(value) and value > 0.0):
        raise argparse.ArgumentTypeError(f"expected a number of seconds > 0, got {text}")
    return value


def run(args: argparse.Namespace) -> int:
    """Run one case and compare truth and estimate."""
    console = Console()
    live = console.is_terminal and not args.headless and not args.json
    with resources.as_file(resources.files("drivelink") / "joints" / f"{args.case}.toml") as path:
        joint = jointfile.load(path)
        shown = DemoRun(joint, console, live=live)
        with _rig(path, args.seconds) as rig, subscribe(joint.name) as subscription:
            interrupted = shown.follow(rig, subscription)
    summary = shown.summary
    if summary is None:
        raise DrivelinkError("the simulated drive and the daemon ended unexpectedly")
    if not args.json:
        console.print(closing_table(args.case, shown.comparison, summary, shown.received, joint.bus.period_s))
    else:
        print(json.dumps(as_json(args.case, shown.comparison, summary, shown.received)))
    return 130 if interrupted else 0


class RigProcess(NamedTuple):
    """The other process: its messages, and its early end."""

    connection: Connection
    stop: Callable[[], None]


@contextmanager
def _rig(path: Path, seconds: float) -> Iterator[RigProcess]:
    """Run simulation and daemon in another process; end it on exit."""
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe(duplex=False)
    process = context.Process(target=serve, args=(path, seconds, theirs), name="drivelink-demo")
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
    """Follows a run to its end, on a terminal or in plain lines.

    Attributes:
        comparison: truth beside estimate.
        received: estimates that came in.
        summary: the daemon's own; None until it ended.
    """

    def __init__(self, joint: JointFile, console: Console, *, live: bool) -> None:
        self.comparison = Comparison()
        self.received = 0
        self.summary: RunSummary | None = None
        self._view = JointView(joint.name, subtitle="simulated, on the virtual bus")
        self._view.footer = "Ctrl-C ends"
        self._console = console
        self._live = live
        self._period_s = joint.bus.period_s
        self._next_line_s = 0.0

    def follow(self, rig: RigProcess, subscription: Subscription) -> bool:
        """Follow the rig to its end; return whether Ctrl-C ended it early.

        Raises:
            DrivelinkError: the rig could not run.
        """
        if not self._live:
            return self._to_the_end(rig, subscription)
        with Live(self._view, console=self._console, refresh_per_second=8, screen=False, transient=True):
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
        message: list[TruePoint] | RunSummary | Failure = connection.recv()
        if isinstance(message, RunSummary):
            self.summary = message
        elif isinstance(message, Failure):
            error = DrivelinkError(message.text)
            error.exit_status = message.exit_status
            raise error
        else:
            for point in message:
                self.comparison.known(point)

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
        if not self._live and time.monotonic() >= self._next_line_s:
            self._next_line_s = time.monotonic() + _LINE_S
            print(self._view.line(), file=sys.stderr, flush=True)
