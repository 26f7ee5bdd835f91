"""`drivelink sim JOINT…`: the simulated drives alone, on the bus of the joint file."""

import argparse
import json
import os
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from drivelink.cli import ALONE, add_bus, add_number, add_seconds, handling
from drivelink.cycle.realtime import PRIORITY, acquire, release
from drivelink.demo.simbus import JoinedBus, open_sim_bus, require_free
from drivelink.demo.simulate import assumptions, bench_from_joints
from drivelink.errors import BusError, UsageError
from drivelink.files import write_whole
from drivelink.jointfile import BusSection, JointFile, load
from drivelink.jointfile.schema import SimSection

EPILOG = """\
examples:
  drivelink sim elbow.toml                             on the bus of the joint file
  drivelink sim elbow.toml --interface socketcand      over TCP, without SocketCAN; `drivelink run` likewise
  drivelink sim elbow.toml --motion next.csv           play what `drivelink diagnose --motion` designed
  drivelink sim elbow.toml --channel vcan0 --effect coulomb_friction=0.3 --quirks epos4
"""


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    parser.add_argument("joints", nargs="+", type=Path, metavar="JOINT", help="joint files on one bus")
    parser.add_argument(
        "--effect",
        action="append",
        default=[],
        metavar="NAME=VALUE",
        help="switch an effect on in the world, e.g. coulomb_friction=0.25; further parameters follow after "
        "commas (cogging=0.1,periods_per_rev=12,motor=2); may be repeated",
    )
    about = "the motors follow this motion, over and over: a CSV file of `diagnose --motion`"
    parser.add_argument("--motion", type=Path, metavar="FILE", help=about)
    about = "drives that behave like a vendor's, e.g. epos4; see the reference"
    parser.add_argument("--quirks", metavar="NAME", help=about)
    add_bus(parser)
    add_seconds(parser)
    add_number(parser, "--seed", least=0, whole=True, help="seed of the sensor noise")
    about = "also write the EDS file of every simulated node"
    parser.add_argument("--write-eds", type=Path, metavar="DIR", help=about)
    parser.add_argument("--json", action="store_true", help="print one JSON object when ready")


def run(args: argparse.Namespace) -> int:
    """Serve the devices until SIGINT, SIGTERM or the end of `--seconds`."""
    joints = [load(path) for path in args.joints]
    if args.motion is not None:
        joints = [_moving(joint, args.motion) for joint in joints]
    section = _bus_section(joints, args)
    bench = bench_from_joints(
        joints, effects=args.effect, quirks=args.quirks, seed=args.seed, files=args.joints
    )
    for joint, path in zip(joints, args.joints, strict=True):
        for line in assumptions(joint):
            print(f"drivelink sim: {path}: {line}", file=sys.stderr)
    if args.write_eds:
        args.write_eds.mkdir(parents=True, exist_ok=True)
        for file, text in bench.eds().items():
            write_whole(args.write_eds / file, text, force=True)
    if section.interface == "virtual":
        print(ALONE, file=sys.stderr)
    stop = threading.Event()
    with handling(lambda *_: stop.set()), open_sim_bus(section) as bus, _ending(stop, args.seconds):
        if isinstance(bus, JoinedBus):
            print(f"drivelink sim: {bus.channel_info}: served by another process, joined", file=sys.stderr)
            bus.on_lost = stop.set
        require_free(bus, [node.node_id for node in bench.nodes], section)
        where = f"{section.interface} {section.channel}"
        if args.json:
            about = {"interface": section.interface, "channel": section.channel, "devices": bench.devices()}
            print(json.dumps({"event": "ready", **about}), flush=True)
        else:
            print(f"drivelink sim: ready on {where}: {bench.describe()}; Ctrl-C ends it", flush=True)
        with _prompt():
            bench.serve(bus, stop)
        if isinstance(bus, JoinedBus) and bus.lost:
            raise BusError(f"{bus.channel_info}: the process that served it has ended")
    return 0


def _moving(joint: JointFile, motion: Path) -> JointFile:
    """Return the joint with a simulation whose motors follow a motion."""
    if not motion.is_file():
        raise UsageError(f"--motion: {motion}: no such file: diagnose --motion writes one")
    table = {"kind": "motion", "file": str(motion.absolute())}
    section = (joint.sim or SimSection()).model_copy(update={"excitation": table})
    return joint.model_copy(update={"sim": section})


def _bus_section(joints: list[JointFile], args: argparse.Namespace) -> BusSection:
    first = joints[0].bus
    for joint in joints[1:]:
        for key in ("interface", "channel", "period_s"):
            if getattr(joint.bus, key) != getattr(first, key):
                raise UsageError(
                    f"{joints[0].name}, {joint.name}: expected the same bus.{key}, "
                    f"got {getattr(first, key)!r} and {getattr(joint.bus, key)!r}"
                )
    return first.moved(args.interface, args.channel)


@contextmanager
def _prompt() -> Iterator[None]:
    """Run at higher priority than the daemon, if permitted: a real drive has its own processor."""
    obtained = acquire()
    if obtained.scheduling:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(PRIORITY + 1))
    try:
        yield
    finally:
        release(obtained)


@contextmanager
def _ending(stop: threading.Event, seconds: float | None) -> Iterator[None]:
    """Set `stop` after so many seconds, if given."""
    timer = threading.Timer(seconds or 0.0, stop.set)
    if seconds is not None:
        timer.start()
    try:
        yield
    finally:
        timer.cancel()
