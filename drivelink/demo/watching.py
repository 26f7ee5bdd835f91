"""Follows the rig's process: truth beside estimate, on a terminal or in plain lines."""

import math
import multiprocessing
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

from rich.console import Console
from rich.live import Live

from drivelink.demo.rig import Change, Failure, RunSummary, serve
from drivelink.errors import DrivelinkError
from drivelink.jointfile import JointFile
from drivelink.monitor.history import TruePoint
from drivelink.monitor.terminal import Keys
from drivelink.monitor.view import JointView
from drivelink.output.document import Grid, Paragraph, Rows, Section
from drivelink.output.numbers import number, value_and_interval
from drivelink.plaintext import stamped
from drivelink.pubsub.client import Subscription
from drivelink.pubsub.publisher import finite
from drivelink.pubsub.wire import EstimateMessage
from estimator.sample import SIGMA_95, Status

T = TypeVar("T")

_UNMATCHED = 5_000  # sequence numbers kept while waiting for the other side


class RmsErrors(NamedTuple):
    """Root-mean-square errors over the cycles whose estimate is valid, relative to the truth's rms."""

    cycles: int  # number of compared cycles
    stiffness: float  # relative error of the stiffness
    flexibility_torque: float  # relative error of the flexibility torque
    covered: float  # fraction of the cycles whose 95 % interval of the stiffness holds the truth


class Comparison:
    """Pairs received estimates with the truth."""

    def __init__(self) -> None:
        self.latest: tuple[EstimateMessage, TruePoint] | None = None  # the last pair, for a view
        self._estimates: dict[int, EstimateMessage] = {}
        self._truth: dict[int, TruePoint] = {}
        self._cycles = self._covered = 0
        self._sums = [0.0, 0.0, 0.0, 0.0]  # squared errors and squared truths: stiffness, torque

    def received(self, estimate: EstimateMessage) -> None:
        """Enter a received estimate."""
        if (truth := self._truth.pop(estimate.sequence, None)) is not None:
            self._pair(estimate, truth)
        else:
            _keep(self._estimates, estimate.sequence, estimate)

    def known(self, truth: TruePoint) -> None:
        """Enter the truth at one SYNC."""
        if (estimate := self._estimates.pop(truth.sequence, None)) is not None:
            self._pair(estimate, truth)
        else:
            _keep(self._truth, truth.sequence, truth)

    def errors(self) -> RmsErrors:
        """Return errors over all pairs so far; NaN before the first valid estimate."""
        if self._cycles == 0:
            return RmsErrors(0, math.nan, math.nan, math.nan)
        stiffness, true_stiffness, torque, true_torque = self._sums
        of_stiffness = math.sqrt(stiffness / true_stiffness) if true_stiffness else math.nan
        of_torque = math.sqrt(torque / true_torque) if true_torque else math.nan
        return RmsErrors(self._cycles, of_stiffness, of_torque, self._covered / self._cycles)

    def _pair(self, estimate: EstimateMessage, truth: TruePoint) -> None:
        self.latest = estimate, truth
        if not estimate.status & Status.VALID:
            return
        off = estimate.stiffness_nm_rad - truth.stiffness_nm_rad
        self._cycles += 1
        self._covered += abs(off) <= SIGMA_95 * estimate.stiffness_std_nm_rad
        sums = self._sums
        sums[0] += off**2
        sums[1] += truth.stiffness_nm_rad**2
        sums[2] += (estimate.flexibility_torque_nm - truth.flexibility_torque_nm) ** 2
        sums[3] += truth.flexibility_torque_nm**2


def _keep(waiting: dict[int, T], sequence: int, item: T) -> None:
    waiting[sequence] = item
    if len(waiting) > _UNMATCHED:
        del waiting[next(iter(waiting))]


def closing(
    case: str, comparison: Comparison, summary: RunSummary, received: int, period_s: float
) -> Section:
    """Return the last pair of truth and estimate, the errors of the whole run, and the cycle's figures."""
    errors = comparison.errors()
    rows: Rows = []
    lines: list[str] = []
    if comparison.latest is not None:
        estimate, truth = comparison.latest
        for name, true, found, std, error in (
            ("stiffness / N·m/rad", truth.stiffness_nm_rad, estimate.stiffness_nm_rad,
             estimate.stiffness_std_nm_rad, errors.stiffness),
            ("flexibility torque / N·m", truth.flexibility_torque_nm, estimate.flexibility_torque_nm,
             summary.torque_std_nm, errors.flexibility_torque),
        ):  # fmt: skip
            value, half = value_and_interval(found, SIGMA_95 * std)
            rows.append((name, number(true, 5), value, f"± {half}" if half else "", _percent(error)))
        doubt = "" if estimate.status & Status.VALID else ", which is not valid"
        lines.append(f"truth, estimate and its 95 % interval: of the last cycle{doubt}")
    if errors.cycles:
        over = f"rms error: over all {errors.cycles} valid cycles ({errors.cycles * period_s:.1f} s), "
        lines.append(f"{over}relative to the truth's rms")
    elif not received:
        lines.append("no estimate came over zenoh: is there no loopback interface?")
    else:
        lines.append("no valid cycle, so no error: an estimate is valid after some seconds of motion")
    lines += [
        f"{summary.cycles} cycles, {summary.missed_cycles} missed, {received} estimates received over zenoh",
        f"a cycle's work p99 {summary.work_p99_us:.0f} µs, SYNC late by p99 {summary.lateness_p99_us:.0f} µs",
    ]
    if errors.cycles:
        held = f"the stiffness's 95 % interval held the truth in {_percent(errors.covered)}"
        lines.append(f"{held} of {errors.cycles} valid cycles")
    grid = Grid(("", "truth", "estimate", "95 %", "rms error"), rows)
    return Section(f"{case}: truth beside estimate", [*([grid] if rows else []), *map(Paragraph, lines)])


def as_json(case: str, comparison: Comparison, summary: RunSummary, received: int) -> dict[str, Any]:
    """Return the same as a JSON object; missing numbers are null."""
    errors = comparison.errors()
    document: dict[str, Any] = finite(
        {
            "case": case,
            "cycles": summary.cycles,
            "missed_cycles": summary.missed_cycles,
            "received": received,
            "valid_cycles": errors.cycles,
            "stiffness_error_relative": errors.stiffness,
            "flexibility_torque_error_relative": errors.flexibility_torque,
            "stiffness_interval_coverage": errors.covered,
            "work_p99_us": summary.work_p99_us,
            "lateness_p99_us": summary.lateness_p99_us,
        }
    )
    return document


def _percent(value: float) -> str:
    return f"{100 * value:.3g} %" if math.isfinite(value) else "–"


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
        self._next_line_s, self._said = 0.0, ""
        self._keys = Keys()  # none is echoed into the view
        self._pressed = ""  # since the last look

    def follow(self, rig: RigProcess, subscription: Subscription) -> bool:
        """Follow the rig to its end; return whether Ctrl-C ended it early.

        Raises:
            DrivelinkError: the rig could not run.
        """
        with ExitStack() as stack:
            stack.enter_context(self._keys)
            if (
                self._live
            ):  # drawn by this thread alone: the history must not grow under the one that draws it
                live = Live(self._view, console=self._console, auto_refresh=False, transient=True)
                self._screen = stack.enter_context(live)
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
        self._pressed = self._keys.pressed()
        for estimate in subscription.cycles(0.0):
            if estimate is None:
                break
            self.received += 1
            self.comparison.received(estimate)
        if status := subscription.status:
            self._view.status = status
        if self.comparison.latest is not None:
            last, truth = self.comparison.latest
            self._view.update(last, last.sequence * self._period_s, truth)
            self._view.errors = self.comparison.errors()[1:3]
        if time.monotonic() >= self._next_line_s:
            self._next_line_s = time.monotonic() + (_FRAME_S if self._live else _LINE_S)
            if self._screen is not None:
                self._screen.refresh()
            elif (line := self._view.line()) != self._said:
                sys.stderr.write(f"{stamped(line, sys.stderr)}\n")
                self._said = line
