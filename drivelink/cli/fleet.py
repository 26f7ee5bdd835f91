"""`drivelink fleet RECORDINGS --joints DIR`: many recordings of many joints, here or on a Dask cluster."""

from __future__ import annotations

import argparse
import importlib.util
import json
import sys
from dataclasses import fields
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import TYPE_CHECKING

from drivelink.cli import add_number
from drivelink.errors import UsageError
from drivelink.output.progress import Meter
from drivelink.plaintext import clean_text

if TYPE_CHECKING:
    from drivelink.fleet.runner import Counts, Settings

_NEEDS = ("cryptography", "distributed", "fsspec", "pyarrow")
_REPORT = "report"
_WARNINGS = 20  # shown lines about single recordings; the table has all
_FALSE_SHARE = 0.05  # of all changes that a report names, expected to be chance
_SPANS = {"d": 1, "w": 7}

EPILOG = """\
examples:
  drivelink fleet night/ --joints joints/ --out fleet/
  drivelink fleet 's3://plant/2026-11-*/*.mcap' --joints joints/ --scheduler tls://10.0.0.5:8786
  drivelink fleet report fleet/                    make the page again from the table

RECORDINGS are files, globs, folders or URLs of fsspec (file:, sftp:, s3:, http:). The joint of a
recording is the one whose file it contains (MCAP), else the one of --joints whose name is in the recording's
name or folder. Its date is that of its stamps, else that in its name, else that of the file.

Writes a table with a row for each recording and transmission (DIR/table/*.parquet), each diagnosis,
fleet.html and fleet.json. Recordings that are in the table are skipped: run the same command every night.
"""


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    parser.usage = "drivelink fleet --joints DIR [options] RECORDINGS ...\n       drivelink fleet report DIR"
    about = "measured data; or `report` and the folder of results"
    parser.add_argument("recordings", nargs="+", metavar="RECORDINGS", help=about)
    parser.add_argument("--joints", type=Path, metavar="DIR", help="folder of joint files, one per joint")
    about = "folder or URL of the results (default: fleet)"
    parser.add_argument("--out", default="fleet", metavar="DIR", help=about)
    about = "omit earlier recordings: 2026-11-22, or 30d, 4w for days, weeks"
    parser.add_argument("--since", metavar="DATE", help=about)
    about = "a running Dask scheduler, e.g. tls://10.0.0.5:8786"
    parser.add_argument("--scheduler", metavar="ADDRESS", help=about)
    about = "accept a scheduler without TLS: anybody who reaches it runs code on its workers"
    parser.add_argument("--insecure", action="store_true", help=about)
    about = "processes on this machine (default: one per CPU core)"
    add_number(parser, "--workers", whole=True, metavar="N", help=about)
    about = "limit of each worker, e.g. 2GiB; a larger recording is split"
    parser.add_argument("--memory", metavar="SIZE", help=about)
    about = "validate on the joint's previous recording instead of held-out blocks"
    parser.add_argument("--validate", choices=["previous"], help=about)
    parser.add_argument("--again", action="store_true", help="repeat recordings that are in the table")
    about = "print the content of fleet.json and nothing else"
    parser.add_argument("--json", action="store_true", help=about)


def run(args: argparse.Namespace) -> int:
    """Run the verb; return the exit status."""
    if missing := [name for name in _NEEDS if importlib.util.find_spec(name) is None]:
        raise UsageError(f"needs {', '.join(missing)}: install the extra, pip install 'drivelink-vsa[fleet]'")
    if args.recordings[0] == _REPORT and args.joints is None:
        if len(args.recordings) != 2:
            raise UsageError("report: expected one folder of results")
        _report(args.recordings[1], as_json=args.json)
        return 0
    return _run(args)


def _settings(args: argparse.Namespace) -> Settings:
    """Return the settings of a run.

    Raises:
        UsageError: an option is wrong, or the folder of joints is missing.
        FleetError: `--memory` is not a size.
    """
    from drivelink.fleet.runner import Settings

    if args.joints is None:
        raise UsageError("--joints: expected the folder of the joint files")
    if args.workers is not None and args.scheduler is not None:
        raise UsageError("--workers: expected without --scheduler, whose workers are started elsewhere")
    since = None if args.since is None else _since(args.since)
    if not args.joints.exists():
        raise UsageError(f"--joints: expected a folder of joint files, there is no {args.joints}")
    given = {one.name: getattr(args, one.name) for one in fields(Settings)}
    settings = Settings(**{**given, "since": since})
    _ = settings.limit_bytes  # raises
    return settings


def _run(args: argparse.Namespace) -> int:
    settings = _settings(args)
    from drivelink.fleet import runner, storage
    from drivelink.fleet.joints import Joints

    if settings.scheduler and not settings.scheduler.startswith("tls://") and settings.insecure:
        text = "without TLS: anybody who reaches it runs code on its workers"
        print(f"--scheduler {settings.scheduler}: {text}", file=sys.stderr)
    joints = Joints.load(args.joints)
    sources, empty = storage.find(args.recordings)
    for pattern in empty:
        print(clean_text(f"{pattern}: no recording there"), file=sys.stderr)
    if not sources:
        raise UsageError("RECORDINGS: expected at least one recording, found none")
    said = 0

    def say(line: str) -> None:
        nonlocal said
        said += 1
        if said <= _WARNINGS:
            print(clean_text(line), file=sys.stderr)

    with Meter("fleet", len(sources)) as meter:

        def progress(counts: Counts) -> None:
            meter.update(counts.done + counts.known + counts.early + counts.broken)

        try:
            counts = runner.run(sources, joints, storage.Store(args.out), settings, progress, say)
        except KeyboardInterrupt:
            text = f"interrupted; what was finished is in {args.out}: repeat the command to continue"
            print(text, file=sys.stderr)
            raise
    if said > _WARNINGS:
        print(f"and {said - _WARNINGS} lines more", file=sys.stderr)
    if not args.json:
        print(_summary(counts))
    if args.json or counts.early < counts.found:
        _report(args.out, as_json=args.json)
    return 0


def _summary(counts: Counts) -> str:
    others = {"there already": counts.known, "too early": counts.early, "broken": counts.broken}
    parts = [f"{counts.done} done", *(f"{number} {what}" for what, number in others.items() if number)]
    return f"{counts.found} recording{'s' * (counts.found != 1)}: {', '.join(parts)}"


def _report(folder: str, *, as_json: bool) -> None:
    from rich.console import Console

    from drivelink.fleet import page, summary, table
    from drivelink.fleet.storage import FleetError, Store
    from drivelink.output.document import Lines, Section, show

    store = Store(folder)
    rows = table.read_rows(store, summary.COLUMNS)
    try:  # any column may hold anything: the table may be one that many write to
        document = summary.summarise(rows, _FALSE_SHARE)
        html = page.page(document)
    except (ArithmeticError, AttributeError, LookupError, TypeError, ValueError) as error:
        what = f"what no run of drivelink writes: {type(error).__name__}: {error}"
        raise FleetError(f"{store.url}: its table has {what}") from error
    store.write("fleet.json", (json.dumps(document, indent=1) + "\n").encode())
    store.write("fleet.html", html.encode())
    if as_json:
        print(json.dumps(document))
        return
    looks = [one for one in document["joints"] if one["state"] in summary.LOOK]
    show([Section("", [Lines(tuple(f"{one['joint']}: {one['sentence']}" for one in looks))])], Console())
    for name in ("fleet.json", "fleet.html"):
        print(f"wrote {folder.rstrip('/')}/{name}")


def _since(text: str) -> datetime:
    if text[:-1].isdigit() and text[-1:] in _SPANS:
        return datetime.now(UTC) - timedelta(days=int(text[:-1]) * _SPANS[text[-1]])
    try:
        moment = datetime.fromisoformat(text)
    except ValueError as error:
        raise UsageError(f"--since: expected a date such as 2026-11-22, or 30d, got {text!r}") from error
    return moment if moment.tzinfo else moment.replace(tzinfo=UTC)
