"""`drivelink doctor`."""

import argparse
import json
import select
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TextIO

from rich.console import Console

from drivelink.canopen.newfile import left_open
from drivelink.canopen.scan import ASKED_S
from drivelink.cli import add_bus, add_number, moved
from drivelink.doctor import examine, examine_eds
from drivelink.doctor.livevalues import live_values
from drivelink.doctor.manualcheck import check_by_hand
from drivelink.errors import UsageError
from drivelink.jointfile import JointFile, load
from drivelink.notice import Severity

_EXAMINED_S = 3.0
_AT_REST_S = 0.3  # a person waits for each of these

EPILOG = f"""\
examples:
  drivelink doctor                     this machine: real time, memory, CAN, zenoh
  drivelink doctor elbow.toml          also bus, nodes, mappings, units; moves nothing
  drivelink doctor elbow.toml --move   you move the joint, it says how, and ticks each sign and scale off
  drivelink doctor --eds drive.eds     before buying: what a drive can give

Nodes are asked for {ASKED_S:g} s at most, however they answer; what was not asked by then is said.
Units and signs of positions and torque are checked while the joint moves under its controller.
"""


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    about = "joint file; without: the machine"
    parser.add_argument("joint", nargs="?", type=Path, metavar="JOINT", help=about)
    parser.add_argument("--eds", type=Path, metavar="FILE", help="what the drive of this EDS or DCF can send")
    about = f"for each measurement (default: {_EXAMINED_S:g}, with --move {_AT_REST_S:g})"
    add_number(parser, "--seconds", most=3600.0, metavar="S", help=about)
    about = "check each sign and scale with a person who moves the joint"
    parser.add_argument("--move", action="store_true", help=about)
    add_bus(parser)
    parser.add_argument("--json", action="store_true", help="print one JSON object")


def run(args: argparse.Namespace) -> int:
    """Examine, print, and return 1 if a problem prevents operation."""
    seconds = args.seconds if args.seconds is not None else _AT_REST_S if args.move else _EXAMINED_S
    if args.joint is None and (args.interface or args.channel):
        raise UsageError("--interface and --channel: expected a joint file, whose bus they replace")
    if args.eds is not None:
        if args.joint is not None or args.move:
            raise UsageError("expected either JOINT or --eds FILE")
        report = examine_eds(args.eds)
    else:
        joint = moved(load(args.joint), args) if args.joint is not None else None
        if args.move:
            return _by_hand(joint, args, seconds)
        report = examine(joint, args.joint.parent if args.joint else Path(), seconds)
        if joint is not None and left_open(joint, args.joint.read_text(encoding="utf-8")):
            text, fix = "inertia_kg_m2 is the placeholder of drivelink new", "put in your motor's, joint side"
            report.section("Joint file").warn("motor", text, fix)
    if args.json:
        print(json.dumps(report.as_dict()))
    else:
        report.show(Console())
    return 1 if report.worst is Severity.ERROR else 0


def _by_hand(joint: JointFile | None, args: argparse.Namespace, seconds: float) -> int:
    """Guide through the checks; return 1 if a sign or scale is wrong or nothing was checked."""
    if joint is None:
        raise UsageError("--move: expected a joint file")
    with live_values(joint, args.joint.parent) as read:
        done = check_by_hand(joint, read, _Terminal(sys.stderr if args.json else sys.stdout), seconds)
    if args.json:
        print(json.dumps(done.as_dict()))
        return 0 if done.good else 1
    if done.paste:
        print(f"Put into {args.joint}:")
    for line in done.paste:
        print(f"  {line}")
    if done.good is not False:
        checked = sum(mark.good is True for mark in done.marks)
        print(f"{checked} checked and right, {len(done.marks) - checked} not checked")
    return 0 if done.good else 1


class _Terminal:
    """The person at the terminal."""

    def __init__(self, out: TextIO) -> None:
        self._out = Console(file=out, highlight=False, markup=False)

    def show(self, text: str) -> None:
        """Print a line; on a terminal it is folded between words."""
        self._out.print(text, soft_wrap=not self._out.is_terminal)

    def ask(self, text: str, meanwhile: Callable[[], object]) -> str:
        """Print a question, and read a line without waiting for it.

        Raises:
            UsageError: there is nobody to answer.
        """
        self.show(f"> {text}")
        while not select.select([sys.stdin], [], [], 0)[0]:
            meanwhile()
        line = sys.stdin.readline()
        if not line:
            raise UsageError("--move: nobody answers: run it in a terminal")
        return line.strip()
