"""The command line: `drivelink VERB …`, one module per verb.

A verb's module has `configure(parser)`, which adds its arguments, `run(args)`, which does the job and returns
the exit status, and `EPILOG`, the end of its help. Only the requested verb's module is imported. Every error
that a user can cause ends here as one line on stderr and its exit status.
"""

from __future__ import annotations

import argparse
import errno
import importlib
import json
import logging
import math
import os
import re
import signal
import sys
import textwrap
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from difflib import get_close_matches
from itertools import groupby
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any

from drivelink.errors import DrivelinkError, JointFileError, UsageError
from drivelink.plaintext import PlainFormatter, clean_text, spell_out
from drivelink.version import __version__
from estimator.errors import EstimatorError, expected

if TYPE_CHECKING:
    from drivelink.jointfile import JointFile
    from drivelink.output.document import Section

VERBS = {
    "demo": "everything without hardware: simulated drives, daemon, subscriber, live view",
    "run": "the daemon: one or several joints on one bus",
    "sim": "the simulated drives alone, on the bus of the joint file",
    "monitor": "live view of any daemon",
    "list": "the joints whose daemons are alive",
    "record": "record a running daemon or a bus",
    "keep": "have a running daemon's black box keep the last minute",
    "accept": "accept what the newest finding proposes, and see whether the residual falls",
    "dbc": "describe the joint's frames as a DBC database for other CAN tools",
    "replay": "run a recording through the same code as live data",
    "fit": "fit the transmission to a recording (model-based estimation)",
    "compare": "two models, two recordings, or a model beside a machine: free run, residual, curves",
    "diagnose": "find the physical effect that the model lacks, and add it",
    "fleet": "fit and diagnose many recordings of many joints, here or on a cluster: table, trends, report",
    "doctor": "check machine, bus and drives, and name the fix for each problem",
    "service": "run the daemon of a joint as a systemd service, from boot on",
    "new": "write a commented joint file, from a few questions or from what is on the bus",
    "completion": "print the script that completes verbs, options and files in a shell",
}

ALONE = (
    'bus.interface = "virtual" exists inside this process only; '
    "with --interface socketcand, `drivelink sim` and `drivelink run` meet over TCP"
)
_INTERRUPTED = 130
# As errors name them.
_OPTIONS = {"force=True": "--force", "joint=FILE": "--joint FILE", "names: ": "--map: "}


_EPILOG = """\
first steps:
  drivelink demo                   everything at once, without hardware
  drivelink new elbow.toml         a joint file for your own joint
  drivelink doctor elbow.toml      what is still in the way, and the fix
  drivelink run elbow.toml         the daemon
  drivelink monitor elbow          what it publishes, in another terminal

`drivelink VERB --help` explains a verb, with examples.
"""


class _Help(argparse.HelpFormatter):
    """Folds an epilog: prose, and examples with their explanations, beside them where all have room."""

    def _fill_text(self, text: str, width: int, indent: str) -> str:
        lines: list[str] = []
        for example, block in groupby(
            text.splitlines(), lambda line: line.startswith("  ") if line else None
        ):
            if example:
                pairs = [(*re.split(" {2,}", line.strip(), maxsplit=1), "")[:2] for line in block]
                column = 5 + max(len(command) for command, _ in pairs)
                if all(column + len(about) <= width for _, about in pairs):
                    lines += [f"  {command:{column - 2}}{about}".rstrip() for command, about in pairs]
                    continue
                for command, about in pairs:
                    parts = textwrap.wrap(
                        command, width - 4, subsequent_indent=" " * 4, break_on_hyphens=False
                    )
                    lines.append(" \\\n".join(f"  {part}" for part in parts))
                    lines += textwrap.wrap(about, width, initial_indent=" " * 6, subsequent_indent=" " * 6)
            elif example is None:
                lines += block
            else:
                lines += textwrap.wrap(" ".join(block), width, break_on_hyphens=False)
        return "\n".join(lines)


class _Parser(argparse.ArgumentParser):
    """Says what a misspelt verb or choice may mean, in one line."""

    def _check_value(self, action: argparse.Action, value: Any) -> None:
        if action.choices is not None and value not in action.choices:
            name = "/".join(action.option_strings) or action.metavar or action.dest
            raise UsageError(f'{name} "{value}": {expected(str(value), [*action.choices])}')


def make_parser(verbs: list[str]) -> argparse.ArgumentParser:
    """Return the parser; only the modules of the given verbs are imported and configured."""
    parser = _Parser(
        prog="drivelink",
        description=(sys.modules["drivelink"].__doc__ or "").partition("\n")[0],
        epilog=_EPILOG,
        formatter_class=_Help,
    )
    parser.add_argument("--version", action="version", version=f"drivelink {__version__}")
    subparsers = parser.add_subparsers(dest="verb", metavar="VERB", required=True)
    for name, summary in VERBS.items():
        subparser = subparsers.add_parser(
            name, help=summary, description=summary[0].upper() + summary[1:] + ".", formatter_class=_Help
        )
        if name in verbs:
            module: Any = importlib.import_module(f"drivelink.cli.{name}")
            subparser.epilog = module.EPILOG
            module.configure(subparser)
            subparser.set_defaults(run=module.run, parser=subparser)
    return parser


def main(argv: list[str] | None = None) -> int:
    """Run one command and return its exit status."""
    for name in ("stdout", "stderr"):  # closed by whoever started it: no file may get its descriptor
        if getattr(sys, name) is None:
            setattr(sys, name, os.fdopen(os.open(os.devnull, os.O_WRONLY), "w", encoding="utf-8"))
    try:
        status = _main(argv)
    except KeyboardInterrupt:  # also while an error is being said
        status = _INTERRUPTED
    except SystemExit:  # of --help
        if not _written(0):
            return 1
        raise
    return status if _written(status) else 1


def _written(status: int) -> bool:
    """Return whether all output has been written; say so if not, where that has not ended the verb yet."""
    try:
        sys.stdout.flush()
    except OSError as error:
        _discard()
        if status == 0 and not isinstance(error, BrokenPipeError):
            _fail("", f"standard output: {error.strerror}", 1)
        return False
    return True


def _discard() -> None:
    """Let standard output go nowhere from now on."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _main(argv: list[str] | None) -> int:
    argv = sys.argv[1:] if argv is None else argv
    verb = argv[0] if argv and argv[0] in VERBS else ""
    # Interfaces log every partial read, or a traceback for what they also raise; the bridge each client lost.
    for name in ("can", "foxglove"):
        logging.getLogger(name).setLevel(logging.CRITICAL)
    if logging.lastResort is not None:
        logging.lastResort.setFormatter(PlainFormatter())
    spell_out()
    # Before numpy is imported: threads do not help on small matrices.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    try:
        if not argv:
            make_parser([]).print_help(sys.stderr)
            return UsageError.exit_status
        parser = make_parser([verb])
        args, unknown = parser.parse_known_args(argv)
        if unknown:  # argparse itself would show the usage of the whole program
            own = getattr(args, "parser", parser)
            options = {option.strip("-"): option for option in own._option_string_actions}
            like = get_close_matches(unknown[0].partition("=")[0].strip("-"), options, 1)
            guess = f" (did you mean {options[like[0]]}?)" if like else ""
            own.error(f"unrecognized arguments: {' '.join(unknown)}{guess}")
        return int(args.run(args))
    except DrivelinkError as error:
        said = str(error)
        for in_python, option in _OPTIONS.items():
            said = said.replace(in_python, option)
        return _fail(verb, f"{said}{_instead_of_a_name(error)}", error.exit_status)
    except EstimatorError as error:
        return _fail(verb, error, 1)
    except BrokenPipeError:
        _discard()
        return 1
    except OSError as error:
        # What is written to a file names it: without a name it is what was printed.
        place = error.filename or ("standard output" if error.errno == errno.ENOSPC else "")
        where = f"{place}: " if place else ""
        return _fail(verb, f"{where}{error.strerror or error}", 1)


def add_map(parser: argparse.ArgumentParser) -> None:
    """Add `--map`, for the verbs that read recordings."""
    parser.add_argument(
        "--map",
        action="append",
        default=[],
        metavar="SOURCE=COLUMN[:UNIT]",
        help="use a column of a CSV file as one of drivelink's, e.g. q_link=link_position_rad:deg; "
        "a factor may stand for UNIT, e.g. tau=motor1_torque_nm:-0.05; may be repeated",
    )


def recording_path(text: str) -> Path:
    """Return the path of a recording: a joint file in its place is the user's slip.

    Raises:
        argparse.ArgumentTypeError: it is a joint file's.
    """
    path = Path(text)
    if path.suffix.lower() == ".toml":
        raise argparse.ArgumentTypeError(f"{path} is a joint file: expected a recording (and --joint {path})")
    return path


def add_recordings(parser: argparse.ArgumentParser) -> None:
    """Add RECORDING, `--joint`, `--bandwidth-hz`, `--strict` and `--map`, for the verbs that fit."""
    parser.add_argument(
        "recording",
        type=recording_path,
        nargs="+",
        metavar="RECORDING",
        help="recordings of one joint: CSV, MCAP, CAN log; each of several is validated by the others",
    )
    parser.add_argument(
        "--joint", type=Path, metavar="JOINT", help="joint file (default: the one in the recording)"
    )
    add_number(
        parser,
        "--bandwidth-hz",
        metavar="F",
        help="bandwidth of the filter that all channels share (default: chosen from the data)",
    )
    parser.add_argument(
        "--strict", action="store_true", help="refuse what has wrong units, signs or gears; else only warn"
    )
    add_map(parser)


def require_distinct(paths: Sequence[Path]) -> None:
    """Require distinct recordings: none may validate a fit that it took part in.

    Raises:
        UsageError: one is given twice.
    """
    seen: set[str] = set()
    for path in paths:
        if (place := os.path.realpath(path)) in seen:
            raise UsageError(
                f"{path}: given twice: expected another recording, which takes no part in the fit"
            )
        seen.add(place)


def warn(path: Path, lines: Sequence[str]) -> None:
    """Print what the gate says of a recording, on stderr."""
    for line in lines:
        print(clean_text(f"{path}: warning: {line}"), file=sys.stderr)


def conclude(as_json: bool, content: Mapping[str, Any], sections: Iterable[Section]) -> None:
    """Print a verb's result: JSON alone, or tables; a reader that has gone ends no verb that writes files."""
    try:
        if as_json:
            print(json.dumps(content), flush=True)
        else:
            from rich.console import Console

            from drivelink.output.document import show

            show(sections, Console())
    except (BrokenPipeError, SystemExit):  # the latter is rich's
        _discard()


def wrote(as_json: bool, paths: Iterable[Path]) -> None:
    """Name the files that were written."""
    for path in () if as_json else paths:
        print(f"wrote {path}")


def add_number(
    parser: argparse.ArgumentParser,
    option: str,
    *,
    least: float | None = None,
    most: float = math.inf,
    whole: bool = False,
    **how: Any,
) -> None:
    """Add an option that takes a finite number; what is none, or out of range, is one line.

    Args:
        least: smallest value; None: above 0.
        most: largest value.
        whole: take whole numbers only.
        how: further arguments of `add_argument`.
    """
    lower = "above 0" if least is None else f"from {least:g}" if most < math.inf else f"of {least:g} or more"
    upper = "" if most == math.inf else f"{' and at most' if least is None else ' to'} {most:g}"
    expected = f"expected a {'whole ' if whole else ''}number {lower}{upper}"

    def number(text: str) -> float:
        try:
            value = int(text) if whole else float(text)
        except ValueError:
            value = math.nan
        enough = value > 0.0 if least is None else value >= least
        if not (enough and value <= most and value < math.inf):
            raise UsageError(f"{option}: {expected}, got {text}")
        return value

    parser.add_argument(option, type=number, **how)


def add_seconds(parser: argparse.ArgumentParser, ends: str = "with Ctrl-C") -> None:
    """Add `--seconds`, for the verbs that run until they are stopped."""
    add_number(parser, "--seconds", metavar="S", help=f"end after S seconds (default: {ends})")


def add_bus(parser: argparse.ArgumentParser) -> None:
    """Add `--interface` and `--channel`, for the verbs that use a bus."""
    parser.add_argument("--interface", metavar="I", help="python-can interface instead of the joint file's")
    parser.add_argument("--channel", metavar="C", help="channel instead of the joint file's, e.g. can0")


def moved(joint: JointFile, args: argparse.Namespace) -> JointFile:
    """Return the joint on the interface and channel of the command line."""
    return joint.model_copy(update={"bus": joint.bus.moved(args.interface, args.channel)})


@contextmanager
def handling(
    handler: Callable[[int, FrameType | None], object],
    numbers: Iterable[int] = (signal.SIGINT, signal.SIGTERM),
) -> Iterator[None]:
    """Handle signals while a block runs, and as before after it."""
    before = {number: signal.signal(number, handler) for number in numbers}
    try:
        yield
    finally:
        for number, old in before.items():
            signal.signal(number, old)


def _instead_of_a_name(error: DrivelinkError) -> str:
    """Return what to give instead of a joint's name where its file is expected; empty: no name was given."""
    cause = error.__cause__
    if not (isinstance(error, JointFileError) and isinstance(cause, FileNotFoundError)):
        return ""
    name = str(cause.filename)
    if "/" in name or Path(name).suffix:
        return ""
    from drivelink.pubsub.clientbase import joints

    with suppress(DrivelinkError):
        if name in joints():
            return f'; a daemon serves "{name}": expected the joint file that it was started with'
    return "; expected a joint file, such as elbow.toml"


def _fail(verb: str, error: object, status: int) -> int:
    print(f"{f'drivelink {verb}'.rstrip()}: {clean_text(' '.join(str(error).split()))}", file=sys.stderr)
    return status
