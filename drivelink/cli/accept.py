"""`drivelink accept JOINT`: what the newest finding proposes, shown, asked for, written, and watched."""

import argparse
import json
import sys
import time
from pathlib import Path
from typing import Any

from drivelink import jointfile
from drivelink.loop.acceptance import Trial, accept, proposal, undo
from drivelink.pubsub.client import subscribe

EPILOG = """\
A daemon whose joint file has a folder in [recording] keeps what led to an alarm and has it diagnosed. This
shows the finding, the difference of the joint file and the error before and after; asks; puts the new file in
the place of the old one, which is kept beside it with its date; and shows the residual of the running daemon,
which takes the new file without losing a cycle, until it has fallen to its baseline.

examples:
  drivelink accept elbow.toml
  drivelink accept elbow.toml --undo           put back the joint file before the last acceptance
"""
_POLL_S = 0.1
_LINE_S = 1.0


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    parser.add_argument("joint", type=Path, metavar="JOINT", help="joint file")
    parser.add_argument("--yes", action="store_true", help="accept without asking")
    parser.add_argument("--undo", action="store_true", help="put back the file before the last acceptance")
    parser.add_argument("--json", action="store_true", help="print one JSON object; accepts with --yes only")


def run(args: argparse.Namespace) -> int:
    """Run the verb; return the exit status."""
    say = (lambda _: None) if args.json else print
    if args.undo:
        old = undo(args.joint)
        say(f"{args.joint}: as it was before the acceptance ({old.name})")
        result: dict[str, Any] = {"undone": True, "old": str(old)}
    else:
        offer = proposal(args.joint)
        for text in offer.lines():
            say(text)
        result = {"finding": offer.finding, "difference": offer.difference(), "accepted": False}
        if not (args.yes or (not args.json and _asked())):
            say("not accepted: nothing is changed")
            if args.json:
                print(json.dumps(result))
            return 0
        old = accept(offer)
        say(f"{args.joint} is written; the old one is {old}")
        result |= {"accepted": True, "old": str(old)}
    trial = _watch(args.joint, undone=args.undo, quiet=args.json)
    say(trial.sentence())
    if trial.fallen is False and trial.in_use:
        say(f"drivelink accept {args.joint} --undo puts the old joint file back")
    if args.json:
        ratios = list(trial.ratios)
        print(json.dumps({**result, "in_use": trial.in_use, "fallen": trial.fallen, "ratios": ratios}))
    return 0 if trial.over and trial.fallen is not False else 1


def _asked() -> bool:
    """Return whether the person at the terminal says yes."""
    if not sys.stdin.isatty():
        return False
    try:
        return input("accept? [y/N] ").strip().lower() in ("y", "yes")
    except EOFError:
        return False


def _watch(path: Path, *, undone: bool, quiet: bool) -> Trial:
    """Follow the daemon until the residual has fallen or the old file is in use, or a minute is over."""
    source, trial, next_s = jointfile.load_text(path), Trial(path, time.monotonic(), undone=undone), 0.0
    name, zenoh = source.joint.name, source.joint.zenoh
    with subscribe(name, endpoint=zenoh.endpoint, config=source.zenoh_config, prefix=zenoh.prefix) as live:
        while not trial.over:
            now_s = time.monotonic()
            trial.update(live.status or {}, live.model or {}, now_s)
            if not quiet and now_s >= next_s:
                next_s = now_s + _LINE_S
                print(f"  {trial.sentence()}", flush=True)
            time.sleep(_POLL_S)
    return trial
