"""`drivelink diagnose RECORDING --joint JOINT`: residual, missing effect, better model, its error."""

import argparse
from pathlib import Path

from drivelink import analysis
from drivelink.cli import add_number, add_recordings, conclude, recording_path, require_distinct, warn, wrote
from drivelink.errors import RecordingError, UsageError
from drivelink.files import check_target
from drivelink.output.progress import Meter
from drivelink.recording.mapping import joint_of

EPILOG = """\
examples:
  drivelink diagnose suspect.csv --joint elbow.toml --out diagnosis/
  drivelink diagnose suspect.csv --joint elbow.toml --motion next.csv
  drivelink diagnose train.csv --joint axis.toml --validate other.csv --write axis-better.toml

Fit a healthy run first (`drivelink fit healthy.csv --joint elbow.toml --write elbow-healthy.toml`), then
diagnose against its result: small imperfections of the rig are then no findings.

Writes report.json and report.html into --out (default: the current folder).
"""


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    add_recordings(parser)
    about = "held-out data: an effect is kept only if it lowers the error there"
    parser.add_argument("--validate", type=recording_path, metavar="RECORDING2", help=about)
    parser.add_argument("--out", type=Path, default=Path(), metavar="DIR", help="where the reports go")
    about = "write a joint file with the effects found"
    parser.add_argument("--write", type=Path, metavar="JOINT2", help=about)
    parser.add_argument(
        "--motion",
        type=Path,
        metavar="FILE",
        help="design the motion that tells apart what is left open, within [motion] of the joint file: a CSV "
        "file for the controller and `drivelink sim --motion`, a picture beside it",
    )
    about = "its length (default: %(default)g)"
    add_number(parser, "--motion-seconds", least=4.0, most=120.0, default=12.0, metavar="S", help=about)
    parser.add_argument("--force", action="store_true", help="replace the files of --write and --motion")
    about = "print the content of report.json and nothing else"
    parser.add_argument("--json", action="store_true", help=about)


def run(args: argparse.Namespace) -> int:
    """Run the verb; return the exit status."""
    require_distinct([*args.recording, *([args.validate] if args.validate else [])])
    joint_of(args.recording[0], args.joint)  # its error comes first
    inputs = [path for path in (*args.recording, args.validate, args.joint) if path is not None]
    if args.write is not None:  # the joint file itself may be brought up to date
        check_target(args.write, [path for path in inputs if path != args.joint], force=args.force)
    if args.motion is not None:
        if args.motion.suffix.lower() != ".csv":
            raise UsageError(f"--motion: expected a name that ends with .csv, got {args.motion}")
        for path in (args.motion, args.motion.with_suffix(".png")):
            check_target(path, inputs, force=args.force)
    for name in ("report.json", "report.html"):
        check_target(args.out / name, inputs, force=True, makes_folder=True)
    with Meter(f"diagnose {', '.join(path.name for path in args.recording)}") as meter:
        found = analysis.diagnose(
            args.recording,
            args.joint,
            validation=args.validate,
            bandwidth_hz=args.bandwidth_hz,
            names=args.map,
            strict=args.strict,
            warn=warn,
            progress=meter.stage,
        )
        undesigned: RecordingError | None = None
        if args.motion is not None:
            try:
                found = found.next_motion(args.motion_seconds, meter.stage)
            except RecordingError as error:  # what was found is reported all the same
                undesigned = error
    conclude(args.json, found.as_json(), found.sections())  # before anything is written, as `fit` does
    made = found.report(args.out)
    try:
        if found.motion is not None:
            made += found.write_motion(args.motion, force=args.force)
        if args.write is not None:
            made.append(found.write(args.write, force=args.force))
    finally:
        wrote(args.json, made)
    if undesigned is not None:
        raise undesigned
    return 0
