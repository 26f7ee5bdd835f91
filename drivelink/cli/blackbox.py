"""The process of a joint's black box, beside its daemon: `python -m drivelink.cli.blackbox JOINT`."""

from __future__ import annotations

import argparse
import logging
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path

from drivelink import jointfile
from drivelink.cli import add_bus, moved
from drivelink.cli.record import add_taps
from drivelink.errors import BusError, DrivelinkError
from drivelink.jointfile import JointFile
from drivelink.recording.blackbox import BlackBox
from drivelink.recording.recorder import BusTap, Recorder

_LOG = logging.getLogger("drivelink.recording")
_NICE = 5  # the daemon goes first
_END_S = 60.0  # in which it writes what is pending


@contextmanager
def black_box(joint: JointFile, path: Path | None) -> Iterator[None]:
    """The black box of a joint in a process, if its joint file asks for one; it ends with this process.

    Args:
        joint: with the bus in use.
        path: its joint file.
    """
    if joint.recording.folder is None or path is None:
        yield
        return
    where = ["--interface", joint.bus.interface, "--channel", joint.bus.channel]
    process = subprocess.Popen(
        [sys.executable, "-m", "drivelink.cli.blackbox", str(path), *where],
        stdin=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
    )
    try:
        yield
    finally:
        try:
            process.communicate(timeout=_END_S)
        except subprocess.TimeoutExpired:
            process.kill()


def main() -> int:
    """Keep until standard input ends."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):  # for the daemon; its end ends this
        signal.signal(number, signal.SIG_IGN)
    parser = argparse.ArgumentParser()
    parser.add_argument("joint", type=Path)
    add_bus(parser)
    args = parser.parse_args()
    logging.basicConfig(level=logging.INFO, stream=sys.stderr, format="%(levelname).1s %(message)s")
    os.nice(_NICE)
    ended = threading.Event()
    threading.Thread(target=_wait, args=(ended,), daemon=True).start()
    try:
        source = jointfile.load_text(args.joint)
        _serve(replace(source, joint=moved(source.joint, args)), ended)
    except DrivelinkError as error:
        _LOG.error("%s: no black box: %s", args.joint.name, error)
        return error.exit_status
    return 0


def _wait(ended: threading.Event) -> None:
    sys.stdin.read()
    ended.set()


def _serve(source: jointfile.JointText, ended: threading.Event) -> None:
    joint = source.joint
    with ExitStack() as stack:
        box = BlackBox(source)
        recorder = stack.enter_context(Recorder(box, []))
        add_taps(recorder, "auto", source, stack)
        while not ended.is_set():
            try:
                recorder.run(ended.is_set)
            except BusError as error:
                _LOG.error("%s: the black box goes on without raw CAN: %s", joint.name, error)
                recorder.taps = [tap for tap in recorder.taps if not isinstance(tap, BusTap)]
                box.keep("bus lost")


if __name__ == "__main__":
    sys.exit(main())
