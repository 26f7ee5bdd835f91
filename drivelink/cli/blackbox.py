"""The process of a joint's black box, beside its daemon: `python -m drivelink.cli.blackbox JOINT`."""

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
from drivelink.errors import DrivelinkError
from drivelink.jointfile import JointFile
from drivelink.loop.blackbox import BlackBox
from drivelink.loop.finding import folder_of
from drivelink.loop.queue import Diagnoses
from drivelink.plaintext import log_to_stderr
from drivelink.recording.recorder import Recorder
from drivelink.systemd.unit import notify

_LOG = logging.getLogger("drivelink.recording")
_NICE = 5  # the daemon goes first
_END_S = 60.0  # in which it writes what is pending
_AGAIN_S = 5.0  # after which one that was killed is started again


@contextmanager
def black_box(joint: JointFile, path: Path | None, *, quiet: bool = False) -> Iterator[None]:
    """Start the black box of a joint in a process, if its joint file asks for one; it ends with this one."""
    if joint.recording.folder is None or path is None:
        yield
        return
    where = ["--interface", joint.bus.interface, "--channel", joint.bus.channel]
    command = [sys.executable, "-m", "drivelink.cli.blackbox", str(path), *where]
    ended, running = threading.Event(), [_start(command, quiet=quiet)]
    keeper = threading.Thread(
        target=_keep_running, args=(command, joint.name, running, ended, quiet), daemon=True
    )
    keeper.start()
    try:
        yield
    finally:
        ended.set()
        keeper.join()
        notify(f"EXTEND_TIMEOUT_USEC={_END_S * 1e6:.0f}")  # the daemon itself has ended
        process = running[-1]
        try:
            process.communicate(timeout=_END_S)
        except subprocess.TimeoutExpired:
            process.kill()


def _start(command: list[str], *, quiet: bool) -> subprocess.Popen[bytes]:
    says = subprocess.DEVNULL if quiet else None
    return subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=says)


def _keep_running(
    command: list[str],
    joint: str,
    running: list[subprocess.Popen[bytes]],
    ended: threading.Event,
    quiet: bool,
) -> None:
    """Start a black box that was killed again; one that ends by itself has said why."""
    while not ended.wait(_AGAIN_S):
        status = running[-1].poll()
        if status is not None and status < 0:
            _LOG.error("%s: the black box ended with signal %d: started again, empty", joint, -status)
            running.append(_start(command, quiet=quiet))


def main() -> int:
    """Keep until standard input ends."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):  # for the daemon; its end ends this
        signal.signal(number, signal.SIG_IGN)
    parser = argparse.ArgumentParser()
    parser.add_argument("joint", type=Path)
    add_bus(parser)
    args = parser.parse_args()
    log_to_stderr(logging.INFO)
    for name in ("can", "drivelink.jointfile", "drivelink.recording.bus"):  # for the daemon to say
        logging.getLogger(name).setLevel(logging.CRITICAL)
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
        diagnoses = Diagnoses(folder_of(source), joint.name)
        stack.callback(diagnoses.close)
        recorder = stack.enter_context(Recorder(box, []))
        add_taps(recorder, "auto", source, stack)
        recorder.run(ended.is_set, diagnoses.step)


if __name__ == "__main__":
    sys.exit(main())
