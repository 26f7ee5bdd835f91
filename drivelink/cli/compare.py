"""`drivelink compare A B`: two models, two recordings, or a model beside a machine."""

import argparse
from pathlib import Path

from drivelink.cli import add_map, add_number, conclude, wrote
from drivelink.errors import RecordingError
from drivelink.files import check_target

EPILOG = """\
examples:
  drivelink compare elbow.toml monday.mcap --out page/     the model beside the machine
  drivelink compare before.csv after.csv --joint elbow.toml
  drivelink compare elbow.toml elbow-20260105T081500Z.toml

A recording is fitted first. Every recording is simulated with both models from its motor torque, in windows
that start from the measured state: the fit is 100 (1 - |y - y_sim| / |y - mean y|). The page has simulation
over measurement, the residual's correlation with itself and with the torque, and curves of stiffness and
friction with their 95 % intervals.
"""


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    parser.add_argument("a", type=Path, metavar="A", help="joint file or recording")
    parser.add_argument("b", type=Path, metavar="B", help="joint file or recording")
    parser.add_argument("--joint", type=Path, metavar="JOINT", help="joint file of the recordings")
    add_number(parser, "--horizon", metavar="S", help="time between new starts of a free run (default: 1)")
    about = "write comparison.json and comparison.html there"
    parser.add_argument("--out", type=Path, metavar="DIR", help=about)
    about = "print the content of comparison.json, nothing else"
    parser.add_argument("--json", action="store_true", help=about)
    add_map(parser)


def run(args: argparse.Namespace) -> int:
    """Run the verb; return the exit status."""
    for path in (args.a, args.b):
        if not path.exists():
            raise RecordingError(f"{path}: no such file")
    if args.out is not None:
        check_target(args.out / "comparison.json", (args.a, args.b), force=True, makes_folder=True)
    from drivelink.comparison import compare  # takes a second; the arguments are checked
    from drivelink.output.document import Paragraph, Section, page, write

    made = compare(args.a, args.b, args.joint, names=args.map, horizon_s=args.horizon)
    content, document = made.as_json(), made.document()
    conclude(args.json, content, [Section("", [Paragraph(made.about)]), *document.sections])
    if args.out is not None:
        args.out.mkdir(parents=True, exist_ok=True)
        wrote(args.json, write(args.out, "comparison", content, page(document)))
    return 0
