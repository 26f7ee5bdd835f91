"""`drivelink demo`: everything without hardware, watched from a process of its own."""

import argparse
import json
import logging
import shutil
import tempfile
from importlib import resources
from pathlib import Path

from rich.console import Console

from drivelink import jointfile
from drivelink.cli import add_number
from drivelink.cli.blackbox import black_box
from drivelink.demo import closedloop
from drivelink.demo.watching import DemoRun, as_json, closing, rig_process
from drivelink.errors import DrivelinkError
from drivelink.monitor.terminal import can_draw
from drivelink.output.document import show
from drivelink.pubsub.client import subscribe

CASES = ("constant", "quadratic", "vsa-ii", *closedloop.CASES)
_SECONDS = 10.0
_LOOP_SECONDS = 180.0

EPILOG = """\
cases: constant, quadratic and vsa-ii are the paper's. In the others something happens to the joint after
10 s, and the loop closes: alarm, recording, finding, acceptance, residual after it.

examples:
  drivelink demo                                   watch the estimates beside the truth
  drivelink demo --case friction                   watch the loop close; it asks before it accepts
  drivelink demo --case constant --seconds 30 --json
"""


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `demo`."""
    about = f"{', '.join(CASES)} (default: %(default)s)"
    parser.add_argument("--case", choices=CASES, default="vsa-ii", metavar="CASE", help=about)
    about = "of the run (default: 10; where the loop closes, at most 180)"
    add_number(parser, "--seconds", metavar="S", help=about)
    parser.add_argument("--yes", action="store_true", help="accept without asking, where the loop closes")
    parser.add_argument("--headless", action="store_true", help="plain lines instead of the live view")
    parser.add_argument("--json", action="store_true", help="print one line of JSON and nothing else")


def run(args: argparse.Namespace) -> int:
    """Run one case and compare truth and estimate."""
    logging.getLogger("drivelink.client").setLevel(logging.ERROR)  # its daemon comes, however late
    console = Console()
    live = can_draw(console) and not args.headless and not args.json
    if args.case in closedloop.CASES:
        return _closed_loop(args, console, live=live)
    seconds = args.seconds or _SECONDS
    with resources.as_file(resources.files("drivelink") / "joints" / f"{args.case}.toml") as path:
        joint = jointfile.load(path)
        shown = DemoRun(joint, console, live=live)
        with rig_process(path, seconds) as rig, subscribe(joint.name) as subscription:
            interrupted = shown.follow(rig, subscription)
    summary = shown.summary
    if summary is None:
        if interrupted:
            return 130
        raise DrivelinkError("the simulated drive and the daemon ended unexpectedly")
    if not args.json:
        show([closing(args.case, shown.comparison, summary, shown.received, joint.bus.period_s)], console)
    else:
        print(json.dumps(as_json(args.case, shown.comparison, summary, shown.received)))
    return 130 if interrupted else 0


def _closed_loop(args: argparse.Namespace, console: Console, *, live: bool) -> int:
    """Run one case in which the loop closes; its files are removed at the end."""
    case, limit_s = closedloop.CASES[args.case], args.seconds or _LOOP_SECONDS
    with tempfile.TemporaryDirectory(prefix="drivelink-demo-") as folder:
        path = Path(folder) / "elbow.toml"
        with resources.as_file(resources.files("drivelink") / "joints" / "elbow.toml") as shipped:
            shutil.copyfile(shipped, path)
        joint = jointfile.load(path)
        told = Console(stderr=True) if args.json else console
        run = closedloop.ClosedLoop(joint, path, case, told, live=live, yes=args.yes, limit_s=limit_s)
        with (
            rig_process(path, None, case.change) as rig,
            black_box(joint, path, quiet=True),
            subscribe(joint.name, endpoint=joint.zenoh.endpoint) as subscription,
        ):
            interrupted = run.follow(rig, subscription)
    if run.summary is None:
        if interrupted or run.over:
            return 130 if interrupted else 1
        raise DrivelinkError("the simulated drive and the daemon ended unexpectedly")
    document = closedloop.result(args.case, run, run.summary)
    if args.json:
        print(json.dumps(document))
    else:
        show([closedloop.closing(document)], console)
    if interrupted:
        return 130
    return 0 if "fallen" in run.times else 1
