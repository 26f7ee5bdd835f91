"""`drivelink list`: the joints whose daemons are alive."""

import argparse
import json
import sys

from drivelink.cli.monitor import add_zenoh
from drivelink.errors import ZenohError
from drivelink.pubsub.clientbase import joints
from drivelink.pubsub.session import ENDPOINT

EPILOG = """\
examples:
  drivelink list                          names of the joints on this machine
  drivelink list --endpoint tcp/cell7:7447
"""


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    add_zenoh(parser)
    parser.add_argument("--json", action="store_true", help="print one JSON array of names")


def run(args: argparse.Namespace) -> int:
    """Print the names; where there is none, that is a failure of zenoh's."""
    endpoint = args.endpoint or ENDPOINT
    names = joints(endpoint=endpoint, config=args.config, prefix=args.prefix or "drivelink")
    if args.json:
        print(json.dumps(names))
    elif names:
        print("\n".join(names))
    else:
        of = f" of prefix {args.prefix!r}" if args.prefix else ""
        print(
            f"no joint{of} at {args.config or endpoint}: drivelink run JOINT starts a daemon", file=sys.stderr
        )
    return 0 if names else ZenohError.exit_status
