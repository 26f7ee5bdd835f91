"""`drivelink run`: the daemon of one or several joints on one bus."""

from __future__ import annotations

import argparse
import json
import logging
import os
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from functools import partial
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING

from drivelink.cli import ALONE, add_bus, add_seconds, handling, moved
from drivelink.jointfile import BusSection, fingerprint, load_text
from drivelink.plaintext import log_to_stderr, stamped

if TYPE_CHECKING:
    from drivelink.daemon.service import Daemon

EPILOG = """\
examples:
  drivelink run elbow.toml                          until Ctrl-C or SIGTERM
  drivelink run left.toml right.toml                two joints on one bus, with one SYNC
  drivelink run elbow.toml --interface socketcand   beside `drivelink sim elbow.toml --interface socketcand`
  drivelink run elbow.toml --channel vcan0 --seconds 60 --no-realtime

It reads: no controlword, mode or target is ever written. `drivelink doctor` says beforehand what would keep
it from working, `drivelink monitor` shows what it publishes, a rewritten joint file changes the model.
"""
_LINE_S = 5.0  # between two lines of state on a terminal
_LEVELS = ("debug", "info", "warning", "error")


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `run`."""
    about = "joint files; several share one bus"
    parser.add_argument("joints", nargs="+", type=Path, metavar="JOINT", help=about)
    add_seconds(parser, "run until stopped")
    add_bus(parser)
    parser.add_argument("--no-publish", action="store_true", help="compute, but publish nothing")
    about = "do not ask for real-time scheduling and locked memory"
    parser.add_argument("--no-realtime", action="store_true", help=about)
    about = f"least severe messages that go to stderr: {', '.join(_LEVELS)}"
    parser.add_argument("--log-level", choices=_LEVELS, default="info", metavar="LEVEL", help=about)
    about = "print one JSON object when it is ready, and one at the end: the joints' last status"
    parser.add_argument("--json", action="store_true", help=about)


def run(args: argparse.Namespace) -> int:
    """Serve the joints until stopped."""
    log_to_stderr(getattr(logging, args.log_level.upper()))
    logging.getLogger("canopen").setLevel(logging.ERROR)
    move = partial(moved, args=args)
    sources = [load_text(path) for path in args.joints]
    loaded = [move(source.joint) for source in sources]
    if loaded[0].bus.interface == "virtual":
        logging.getLogger(__name__).warning(ALONE)
    from drivelink.cli.blackbox import black_box
    from drivelink.daemon.service import Daemon, ServedJoint  # takes a second: after the joint files
    from drivelink.pubsub.publisher import to_json

    joints = [
        ServedJoint(joint=joint, path=source.path, fingerprint=fingerprint(source.text), move=move)
        for joint, source in zip(loaded, sources, strict=True)
    ]
    with (
        _stopped_by_signals() as stopped,
        ExitStack() as stack,
        Daemon(joints, publish=not args.no_publish, real_time=not args.no_realtime) as daemon,
    ):
        stopped.append(daemon)
        section = joints[0].joint.bus
        for served in joints:
            stack.enter_context(black_box(served.joint, served.path))
        with suppress(OSError):  # a full disk under what is printed: said at the end, and ends no daemon
            _say_ready([served.joint.name for served in joints], section, args)
        ended = threading.Event()
        if sys.stdout.isatty() and not args.json:
            threading.Thread(target=_show, args=(daemon, ended), daemon=True).start()
        try:
            daemon.run(args.seconds)
        finally:
            ended.set()
        last = daemon.documents() if args.json else []
        summary = daemon.summary()
    if args.json:
        print(to_json({"event": "end", "joints": last}).decode(), flush=True)
    else:
        _say(summary)
    return 0


def _say_ready(names: list[str], bus: BusSection, args: argparse.Namespace) -> None:
    rate_hz = 1 / bus.period_s
    if args.json:
        where = {"interface": bus.interface, "channel": bus.channel, "rate_hz": rate_hz}
        print(json.dumps({"event": "ready", "joints": names, **where}), flush=True)
        return
    where_text = f"{bus.interface} {bus.channel}, {rate_hz:g} Hz"
    _say(f"drivelink run: {', '.join(names)} on {where_text}, ready")


def _show(daemon: Daemon, ended: threading.Event) -> None:
    while not ended.wait(_LINE_S):
        _say(daemon.summary())


def _say(text: str) -> None:
    for line in text.splitlines():
        print(stamped(line, sys.stdout), flush=True)


@contextmanager
def _stopped_by_signals() -> Iterator[list[Daemon]]:
    """SIGINT and SIGTERM end the daemon, or the process before it exists.

    SIGHUP reloads where a service manager waits for it, and ends the daemon of a terminal that was closed.
    """
    running: list[Daemon] = []

    def stop(_number: int, _frame: FrameType | None) -> None:
        if not running:
            raise KeyboardInterrupt
        running[0].stop()

    def reload(_number: int, _frame: FrameType | None) -> None:
        for daemon in running:
            daemon.reload()

    hang_up = reload if os.environ.get("NOTIFY_SOCKET") else stop
    with handling(stop), handling(hang_up, (signal.SIGHUP,)):
        yield running
