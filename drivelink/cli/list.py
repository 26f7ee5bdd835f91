"""`drivelink list`: the joints whose daemons are alive."""

import argparse
import json
import sys

from drivelink.cli.monitor import add_zenoh, nobody
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
    endpoint, prefix = args.endpoint or ENDPOINT, args.prefix or "drivelink"
    names = joints(endpoint=endpoint, config=args.config, prefix=prefix)
    if args.json:
        print(json.dumps(names))
    elif names:
        print("\n".join(names))
    else:
        print(nobody(prefix, args.config or endpoint), file=sys.stderr)
    return 0 if names else ZenohError.exit_status
