"""`drivelink doctor`."""

from __future__ import annotations

import argparse
import json
from pathlib import Path

from rich.console import Console

from drivelink.doctor import examine, examine_eds
from drivelink.errors import UsageError
from drivelink.finding import Severity
from drivelink.jointfile import load

__all__ = ["configure", "run"]

_EPILOG = """\
examples:
  drivelink doctor                     this machine: real time, memory, CAN, zenoh
  drivelink doctor elbow.toml          also the bus, nodes, mappings, units, signs of positions; moves nothing
  drivelink doctor --eds drive.eds     before buying: what a drive can give
"""


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.epilog = _EPILOG
    parser.add_argument(
        "joint", nargs="?", type=Path, metavar="JOINT", help="joint file; without: the machine"
    )
    parser.add_argument("--eds", type=Path, metavar="FILE", help="what the drive of this EDS or DCF can give")
    parser.add_argument(
        "--seconds", type=float, default=3.0, metavar="S", help="for each measurement (default: %(default)s)"
    )
    parser.add_argument("--json", action="store_true", help="print one JSON object")


def run(args: argparse.Namespace) -> int:
    """Examine, print, and return 1 where something prevents the job."""
    if not 0 < args.seconds <= 3600:
        raise UsageError(f"--seconds: expected more than 0 and at most 3600, got {args.seconds:g}")
    if args.eds is not None:
        if args.joint is not None:
            raise UsageError("expected either JOINT or --eds FILE")
        report = examine_eds(args.eds)
    else:
        joint = load(args.joint) if args.joint is not None else None
        report = examine(joint, args.joint.parent if args.joint else Path(), args.seconds)
    if args.json:
        print(json.dumps(report.as_dict(), ensure_ascii=False))
    else:
        report.show(Console())
    return 1 if report.worst is Severity.ERROR else 0
