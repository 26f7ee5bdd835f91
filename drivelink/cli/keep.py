"""`drivelink keep JOINT`: the black box of a running daemon keeps the last minute."""

import argparse
import json
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from drivelink import jointfile
from drivelink.errors import RecordingError
from drivelink.files import read_regular
from drivelink.loop.blackbox import AFTER_S
from drivelink.loop.finding import open_own, taken, wish_of

EPILOG = """\
The daemon of a joint file with a folder in [recording] keeps the last minute in memory. On an alarm, a
change, a suspected signal, a drive fault, a lost bus, or this command, it becomes an MCAP file in that
folder, with the 15 s that follow. The command waits for it.

example:
  drivelink keep elbow.toml
"""
_ANSWER_S = 5.0
_WRITE_S = 60.0  # in which a black box writes, also at its end
_POLL_S = 0.05
_ROOM = 1024  # bytes for the answer


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    parser.add_argument("joint", type=Path, metavar="JOINT", help="joint file")
    parser.add_argument("--json", action="store_true", help="print folder and recording as one JSON object")


def run(args: argparse.Namespace) -> int:
    """Run the verb; return the exit status."""
    wish = wish_of(jointfile.load_text(args.joint))
    folder = wish.parent
    try:
        with open(wish, "wb", opener=open_own) as file:
            file.write(b" " * _ROOM)
        if not _until(lambda: not wish.exists(), _ANSWER_S):
            raise RecordingError(f"{folder}: no black box answers: expected a running daemon")
    except FileNotFoundError as error:
        raise RecordingError(
            f"{folder}: no black box writes there: expected a daemon that was started since the joint "
            f"file has [recording] ({error.strerror})"
        ) from error
    except OSError as error:
        raise RecordingError(f"{folder}: cannot be written: {error.strerror}") from error
    finally:
        with suppress(OSError):
            wish.unlink(missing_ok=True)
    if not args.json:
        print(f"{folder}: the black box has heard it: it writes after {AFTER_S:g} s more", flush=True)
    _until(lambda: _answer(wish) != "", AFTER_S + _WRITE_S)
    answer = _answer(wish) or f"{folder}: nothing was kept: expected a daemon that goes on"
    if not answer.endswith(".mcap"):
        raise RecordingError(answer)
    recording = folder / answer
    found = {"folder": str(folder), "after_s": AFTER_S, "recording": str(recording)}
    print(json.dumps(found) if args.json else f"{recording}: kept")
    return 0


def _until(condition: Callable[[], bool], limit_s: float) -> bool:
    """Wait until the condition holds; return whether it does in time."""
    end_s = time.monotonic() + limit_s
    while not condition():
        if time.monotonic() > end_s:
            return False
        time.sleep(_POLL_S)
    return True


def _answer(wish: Path) -> str | None:
    """Return the black box's answer to a wish; empty: not yet; None: it ended, or had no room."""
    try:
        return read_regular(taken(wish), 16 * _ROOM).decode(errors="replace").strip()
    except OSError:
        return None
