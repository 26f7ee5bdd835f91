"""`drivelink keep JOINT`: the black box of a running daemon keeps the last minute."""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path

from drivelink import jointfile
from drivelink.errors import RecordingError
from drivelink.loop.blackbox import AFTER_S
from drivelink.loop.finding import wish_of

EPILOG = """\
The daemon of a joint file with a folder in [recording] keeps the last minute in memory. On an alarm, a
change, a suspected signal, a drive fault, a lost bus, or this command, it becomes an MCAP file in that
folder, with the 15 s that follow.

example:
  drivelink keep elbow.toml
"""
_ANSWER_S = 5.0
_POLL_S = 0.05


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    parser.add_argument("joint", type=Path, metavar="JOINT", help="joint file")
    parser.add_argument("--json", action="store_true", help="print the folder as one JSON object")


def run(args: argparse.Namespace) -> int:
    """Do the job; return the exit status."""
    source = jointfile.load_text(args.joint)
    wish = wish_of(source)
    try:
        wish.touch()
        end = time.monotonic() + _ANSWER_S
        while wish.exists():
            if time.monotonic() > end:
                wish.unlink(missing_ok=True)
                raise RecordingError(f"{wish.parent}: no black box answers: expected a running daemon")
            time.sleep(_POLL_S)
    except OSError as error:
        raise RecordingError(
            f"{wish.parent}: no black box writes there: expected a daemon that was started since the joint "
            f"file has [recording] ({error.strerror})"
        ) from error
    found = {"folder": str(wish.parent), "after_s": AFTER_S}
    print(json.dumps(found) if args.json else f"{wish.parent}: written in {AFTER_S:g} s")
    return 0
