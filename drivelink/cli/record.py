"""`drivelink record JOINT --out FILE`: records a running daemon and the bus."""

import argparse
import json
import sys
import threading
import time
from collections.abc import Sequence
from contextlib import ExitStack, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import zenoh

from drivelink import jointfile
from drivelink.canopen.bus import open_bus
from drivelink.canopen.layout import NodeLayout
from drivelink.canopen.passive import PassiveConfigurator
from drivelink.cli import add_bus, add_seconds, handling, moved
from drivelink.errors import BusError, DrivelinkError, RecordingError, UsageError, ZenohError
from drivelink.files import check_target
from drivelink.jointfile import JointFile, JointText
from drivelink.pubsub.session import close_session, open_client
from drivelink.recording.formats import FORMATS, open_sink
from drivelink.recording.foxglove import write_layouts
from drivelink.recording.mapping import mapping_document, side_file
from drivelink.recording.recorder import BusTap, FirstSource, Recorder, ZenohTap, daemon_layouts
from drivelink.recording.sinks import Sink

_ALIVE_S = 1.0  # in which a daemon answers
_SAY_EVERY_S = 10.0
_PLURAL = {
    "sample": "samples", "estimate": "estimates", "external": "external torques", "document": "documents",
    "frame": "frames",
}  # fmt: skip

EPILOG = f"""\
The ending of FILE selects the format:
{"".join(f"  {ending:8}{kind.holds}{chr(10)}" for ending, kind in FORMATS.items() if kind.sink)}
An MCAP file replays everything, and opens in Foxglove and PlotJuggler. A raw CAN log gets FILE.mapping.json
beside it: how the daemon has the frames mapped, and the joint file.

Recording runs in this process and never holds up the daemon. A kill, a full disk or a power loss leaves a
file that can be read up to the last second.

examples:
  drivelink record elbow.toml --out elbow.mcap
  drivelink record elbow.toml --out elbow.log --seconds 60
  drivelink record elbow.toml --out elbow.mcap --layouts views/
"""


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    parser.add_argument("joint", type=Path, metavar="JOINT", help="joint file")
    parser.add_argument("--out", type=Path, required=True, metavar="FILE", help="the recording")
    add_seconds(parser)
    about = "listen to the daemon, to the bus, or to what is there (default)"
    parser.add_argument("--source", choices=("auto", "daemon", "bus"), default="auto", help=about)
    add_bus(parser)
    parser.add_argument("--force", action="store_true", help="replace a file that exists")
    about = "write layouts of Foxglove and PlotJuggler there"
    parser.add_argument("--layouts", type=Path, metavar="DIR", help=about)
    parser.add_argument("--json", action="store_true", help="print what was recorded as one JSON object")


def run(args: argparse.Namespace) -> int:
    """Run the verb; return the exit status."""
    source = jointfile.load_text(args.joint)
    source = replace(source, joint=moved(source.joint, args))
    joint = source.joint
    check_target(args.out, [args.joint], force=args.force)
    if args.layouts is not None:
        write_layouts(joint, args.layouts)
    stopped = threading.Event()
    with ExitStack() as stack:
        stack.enter_context(handling(lambda *_: stopped.set()))
        sink = open_sink(args.out, joint, source.text, force=args.force)
        recorder = stack.enter_context(Recorder(sink, []))
        add_taps(recorder, args.source, source, stack)
        end = time.monotonic() + args.seconds if args.seconds else float("inf")
        say = _Summary(args.out, recorder)
        recorder.run(lambda: stopped.is_set() or time.monotonic() >= end, say.tick)
        say.clear()
    empty = not any(recorder.sink.counts.get(kind) for kind in ("sample", "estimate", "frame"))
    if args.json or not empty:
        print(json.dumps(say.document()) if args.json else f"{args.out}: {say.text()}")
    if empty:
        for path in (args.out, side_file(args.out)):
            if path.is_file():
                path.unlink()
        raise RecordingError(
            f"{args.out}: nothing was recorded; expected a daemon that serves {joint.name} "
            f"at {joint.zenoh.endpoint}, or its bus"
        )
    return 0


def add_taps(recorder: Recorder, source: str, text: JointText, stack: ExitStack) -> None:
    """Subscribe to the daemon for samples and estimates, listen to the bus for frames.

    Raises:
        BusError: the bus is needed and cannot be opened.
        UsageError: the bus exists inside another process only.
    """
    sink, joint, folder = recorder.sink, text.joint, text.folder
    gate = FirstSource(sink)
    needed = source == "daemon" or (source == "auto" and sink.wants != {"frame"})
    session, alive, known = _daemon(text, stack, needed=needed)
    layouts = known or _declared_layouts(joint, folder)
    document = mapping_document(joint.name, layouts, text.text, daemon=bool(known))
    sink.mapping(document, time.time_ns())
    alive = source == "daemon" or (alive and source == "auto")
    if session is not None and source != "bus" and sink.wants - {"frame"}:
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
    no_samples = alive or "sample" not in sink.wants
    tap_bus = BusTap(bus, joint, sink, None if no_samples else folder, gate, known)
    stack.callback(tap_bus.close)
    recorder.taps.append(tap_bus)
    if tap_bus.missing:
        _say(f"no samples until the mapping is heard on the bus: {tap_bus.missing}")


def _bus_wanted(sink: Sink, source: str, alive: bool, joint: JointFile) -> bool:
    needed = source == "bus" or sink.wants == {"frame"}
    if joint.bus.interface == "virtual":
        if needed:
            raise UsageError(
                'bus.interface = "virtual" exists inside one process only: nothing else can listen'
                ": record samples (.mcap, .csv) from the daemon, or give the --interface it was given"
            )
        return False
    return needed or not alive or "frame" in sink.wants


def _alive(session: zenoh.Session, joint: JointFile) -> bool:
    """Return whether a daemon serves the joint now."""
    key = f"{joint.zenoh.prefix}/{joint.name}/alive"
    end = time.monotonic() + _ALIVE_S
    while time.monotonic() < end:
        if any(reply.ok for reply in session.liveliness().get(key, timeout=_ALIVE_S)):
            return True
        time.sleep(0.05)
    return False


def _daemon(
    source: JointText, stack: ExitStack, *, needed: bool
) -> tuple[zenoh.Session | None, bool, Sequence[NodeLayout]]:
    """Return a session that ends with the stack, whether a daemon serves the joint, and its nodes' mapping.

    Raises:
        ZenohError: there is no session, and it is needed.
    """
    try:
        session = open_client(source.joint.zenoh.endpoint, source.zenoh_config)
    except ZenohError as error:
        if needed:
            raise
        _say(f"without the mapping that a daemon knows: {error}")
        return None, False, ()
    stack.callback(close_session, session)
    alive = _alive(session, source.joint)
    return session, alive, daemon_layouts(session, source.joint, _say) if alive else ()


def known_layouts(source: JointText) -> Sequence[NodeLayout]:
    """Return the mapping of the joint's nodes by a running daemon, else by the joint file; () if unknown."""
    with ExitStack() as stack:
        *_, known = _daemon(source, stack, needed=False)
    return known or _declared_layouts(source.joint, source.folder)


def _declared_layouts(joint: JointFile, folder: Path) -> Sequence[NodeLayout]:
    """Mapping by the joint file or a data sheet; () if unknown."""
    with suppress(DrivelinkError):  # no drives or EDS file: unknown
        listener = PassiveConfigurator([joint], [folder])
        if not listener.busy:
            return tuple(listener.layouts.values())
    return ()


class _Summary:
    """Prints the progress of the recording."""

    def __init__(self, path: Path, recorder: Recorder) -> None:
        self._path = path
        self._recorder = recorder
        self._begin = time.monotonic()
        self._next = self._begin + _SAY_EVERY_S

    def document(self) -> dict[str, Any]:
        return {
            "file": str(self._path),
            "seconds": round(time.monotonic() - self._begin, 3),
            "recorded": dict(self._recorder.sink.counts),
            **{f"cycles_without_{kind}": n for kind, n in self._missed().items()},
            "no_samples_because": self._why() or None,
        }

    def text(self) -> str:
        counts = [f"{n} {_PLURAL[kind]}" for kind, n in self._recorder.sink.counts.items() if n]
        missed = [(n, "s" * (n > 1), kind) for kind, n in self._missed().items() if n]
        lost = "".join(f", {n} cycle{s} without {kind}" for n, s, kind in missed)
        taps = [tap for tap in self._recorder.taps if isinstance(tap, ZenohTap)]
        silent_s, refused = sum(tap.silent_s for tap in taps), sum(tap.refused for tap in taps)
        lost += f", nothing from the daemon for {silent_s:.0f} s" if silent_s else ""
        lost += f", {refused} messages of others ignored" if refused else ""
        lost += f", no samples: {why}" if (why := self._why()) else ""
        return f"{', '.join(counts) or 'nothing yet'} in {time.monotonic() - self._begin:.0f} s{lost}"

    def _missed(self) -> dict[str, int]:
        taps = [tap for tap in self._recorder.taps if isinstance(tap, ZenohTap)]
        return {kind: sum(tap.missed[kind] for tap in taps) for kind in ("sample", "estimate")}

    def _why(self) -> str:
        taps = self._recorder.taps
        return next((tap.missing for tap in taps if isinstance(tap, BusTap) and tap.missing), "")

    def tick(self) -> None:
        """Rewrite one line each second on a terminal, print an occasional line elsewhere."""
        if sys.stderr.isatty():
            print(f"\r\x1b[K{self._path}: {self.text()}, Ctrl-C ends ", end="", file=sys.stderr, flush=True)
        elif time.monotonic() >= self._next:
            self._next += _SAY_EVERY_S
            _say(f"{self._path}: {self.text()}")

    def clear(self) -> None:
        """Erase the line that was rewritten on a terminal."""
        if sys.stderr.isatty():
            print("\r\x1b[K", end="", file=sys.stderr, flush=True)


def _say(text: str) -> None:
    print(text, file=sys.stderr)
