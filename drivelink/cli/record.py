"""`drivelink record JOINT --out FILE`: what a running daemon and the bus say, into a file."""

from __future__ import annotations

import argparse
import signal
import sys
import threading
import time
from contextlib import ExitStack
from pathlib import Path

import zenoh

from drivelink import jointfile
from drivelink.canopen.bus import open_bus
from drivelink.errors import BusError, UsageError
from drivelink.jointfile import JointFile
from drivelink.pubsub.session import close_session, open_client
from drivelink.recording.recorder import BusTap, Gate, Recorder, ZenohTap
from drivelink.recording.sinks import Sink, open_sink

_ALIVE_S = 1.0  # in which a daemon answers
_SAY_EVERY_S = 10.0

_EPILOG = """\
The ending of FILE says the format:
  .mcap                     samples, estimates, status, model, joint file and raw CAN: replays everything,
                            opens in Foxglove and PlotJuggler
  .csv                      samples
  .mf4                      samples (needs asammdf)
  .log .blf .asc .trc       raw CAN, as candump, Vector's and PEAK's tools write it

Recording runs in this process and never holds up the daemon. A kill, a full disk or a power loss leaves a
file that can be read up to the last second.

examples:
  drivelink record elbow.toml --out elbow.mcap
  drivelink record elbow.toml --out elbow.log --seconds 60
"""


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.epilog = _EPILOG
    parser.add_argument("joint", type=Path, metavar="JOINT", help="joint file")
    parser.add_argument("--out", type=Path, required=True, metavar="FILE", help="the recording")
    parser.add_argument("--seconds", type=float, metavar="S", help="end after so long; else with Ctrl-C")
    parser.add_argument(
        "--source",
        choices=("auto", "daemon", "bus"),
        default="auto",
        help="listen to the daemon, to the bus, or to what is there (default)",
    )
    parser.add_argument("--force", action="store_true", help="replace a file that exists")


def run(args: argparse.Namespace) -> int:
    """Do the job; return the exit status."""
    joint = jointfile.load(args.joint)
    if args.out.exists() and not args.force and args.out.is_file():
        raise UsageError(f"{args.out}: exists already; --force replaces it")
    if args.seconds is not None and not args.seconds > 0:
        raise UsageError(f"--seconds: expected a number above 0, got {args.seconds:g}")
    stopped = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stopped.set())
    with ExitStack() as stack:
        folder = args.joint.absolute().parent
        sink = open_sink(args.out, joint, args.joint.read_text(encoding="utf-8"), str(folder))
        recorder = stack.enter_context(Recorder(sink, []))
        _add_taps(recorder, args.source, joint, folder, stack)
        end = time.monotonic() + args.seconds if args.seconds else float("inf")
        say = _Teller(args.out, recorder)
        recorder.run(lambda: stopped.is_set() or time.monotonic() >= end, say.tick)
    print(f"{args.out}: {say.text()}")
    return 0


def _add_taps(recorder: Recorder, source: str, joint: JointFile, folder: Path, stack: ExitStack) -> None:
    """Listen to what there is: the daemon for samples and estimates, the bus for frames.

    Raises:
        BusError: the bus is needed and cannot be opened.
        UsageError: raw frames of a bus that lives inside another process.
    """
    sink = recorder.sink
    alive = False
    gate = Gate(sink)
    if source != "bus" and sink.wants - {"frame"}:
        session = open_client(
            joint.zenoh.endpoint, folder / joint.zenoh.config if joint.zenoh.config else None
        )
        stack.callback(close_session, session)
        alive = source == "daemon" or _alive(session, joint)
        tap = ZenohTap(session, joint, sink, gate)
        stack.callback(tap.close)
        recorder.taps.append(tap)
        if not alive and joint.bus.interface == "virtual":
            _say(f"no daemon serves {joint.name} yet: waiting for it")
    if source == "daemon" or not _bus_wanted(sink, source, alive, joint):
        return
    try:
        bus = open_bus(joint.bus)
    except BusError as error:
        if source == "bus" or not alive:
            raise
        _say(f"without raw CAN: {error}")
        return
    stack.callback(bus.shutdown)
    tap_bus = BusTap(bus, joint, sink, None if alive or "sample" not in sink.wants else folder, gate)
    recorder.taps.append(tap_bus)
    if tap_bus.missing:
        _say(f"no samples until the mapping is heard on the bus: {tap_bus.missing}")


def _bus_wanted(sink: Sink, source: str, alive: bool, joint: JointFile) -> bool:
    needed = source == "bus" or sink.wants == {"frame"}
    if joint.bus.interface == "virtual":
        if needed:
            raise UsageError(
                'bus.interface = "virtual" lives inside one process, where nobody else can listen'
                ": record samples (.mcap, .csv) from the daemon"
            )
        return False
    return needed or not alive or "frame" in sink.wants


def _alive(session: zenoh.Session, joint: JointFile) -> bool:
    """Whether a daemon serves the joint now."""
    key = f"{joint.zenoh.prefix}/{joint.name}/alive"
    end = time.monotonic() + _ALIVE_S
    while time.monotonic() < end:
        if any(reply.ok for reply in session.liveliness().get(key, timeout=_ALIVE_S)):
            return True
        time.sleep(0.05)
    return False


class _Teller:
    """Says how the recording goes."""

    def __init__(self, path: Path, recorder: Recorder) -> None:
        self._path = path
        self._recorder = recorder
        self._begin = time.monotonic()
        self._next = self._begin + _SAY_EVERY_S

    def text(self) -> str:
        """What has been recorded."""
        counts = [f"{n} {kind}s" for kind, n in self._recorder.sink.counts.items() if n] or ["nothing yet"]
        missed = sum(tap.missed for tap in self._recorder.taps if isinstance(tap, ZenohTap))
        lost = f", {missed} cycles without sample" if missed else ""
        why = next(
            (tap.missing for tap in self._recorder.taps if isinstance(tap, BusTap) and tap.missing), ""
        )
        lost += f", no samples: {why}" if why else ""
        return f"{', '.join(counts)} in {time.monotonic() - self._begin:.0f} s{lost}"

    def tick(self) -> None:
        """After each second: one line that is written over on a terminal, one now and then elsewhere."""
        if sys.stderr.isatty():
            print(f"\r\x1b[K{self._path}: {self.text()}, Ctrl-C ends ", end="", file=sys.stderr, flush=True)
        elif time.monotonic() >= self._next:
            self._next += _SAY_EVERY_S
            _say(f"{self._path}: {self.text()}")


def _say(text: str) -> None:
    print(text, file=sys.stderr)
