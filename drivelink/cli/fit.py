"""`drivelink fit RECORDING… --joint JOINT`: model-based estimation from recordings."""

import argparse
import json
from pathlib import Path

from drivelink import jointfile
from drivelink.cli import add_recordings, conclude, require_distinct, warn, wrote
from drivelink.errors import RecordingError, UsageError
from drivelink.files import check_target, write_whole
from drivelink.recording.mapping import joint_of

EPILOG = """\
examples:
  drivelink fit healthy.csv --joint elbow.toml --out fit/ --plots --write elbow-fitted.toml
  drivelink fit monday.csv tuesday.csv --joint elbow.toml      runs of one joint, each validated by the others
  drivelink fit healthy.mcap --json                   a recording of drivelink contains its joint file

Of several recordings stiffness, inertias, dampings, link dynamics and delays are shared; zeros of encoders,
offsets and the level of friction belong to each.

What is printed, and what fit.json says, is what --write puts into a copy of the joint file: parameters of
the transmission, inertia and damping of the motor, link dynamics where they are declared, delays and zeros of
the readings and friction of a rigid joint, as effects. `run`, `replay` and `diagnose` start from there.
"""


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    add_recordings(parser)
    parser.add_argument("--out", type=Path, metavar="DIR", help="write fit.json there")
    parser.add_argument("--write", type=Path, metavar="JOINT2", help="write a copy of the joint file")
    parser.add_argument("--force", action="store_true", help="replace the file of --write if it exists")
    about = "write plots there, or into --out"
    parser.add_argument("--plots", nargs="?", type=Path, const=Path(), metavar="DIR", help=about)
    parser.add_argument("--json", action="store_true", help="print the content of fit.json and nothing else")


def run(args: argparse.Namespace) -> int:
    """Run the verb; return the exit status."""
    folder = args.out if args.plots == Path() else args.plots
    if args.plots == Path() and args.out is None:
        raise UsageError("--plots: expected a folder, or --out to put the plots into")
    require_distinct(args.recording)
    if args.joint is not None:
        jointfile.load(args.joint)  # its error comes first if both are wrong
    for path in args.recording:
        if not path.exists():
            raise RecordingError(f"{path}: no such file")
    if args.write is not None:  # the joint file itself may be brought up to date
        check_target(args.write, args.recording, force=args.force)
    inputs = [*args.recording, *([args.joint] if args.joint else [])]
    for target in (args.out and args.out / "fit.json", folder and folder / "fit.png"):
        if target is not None:
            check_target(target, inputs, force=True, makes_folder=True)
    joint_of(args.recording[0], args.joint)
    from drivelink import analysis  # takes a second; the arguments are checked

    options = {"bandwidth_hz": args.bandwidth_hz, "names": args.map, "strict": args.strict}
    made = analysis.fit(args.recording, args.joint, warn=warn, **options)
    document = made.as_json()
    conclude(args.json, document, made.sections())  # before anything is written: a full disk loses no result
    written = []
    if args.out is not None:
        written.append(args.out / "fit.json")
        args.out.mkdir(parents=True, exist_ok=True)
        write_whole(written[0], json.dumps(document, indent=2) + "\n", force=True)
    if folder is not None:
        folder.mkdir(parents=True, exist_ok=True)
        written.append(made.plot().save(folder / "fit.png"))
    if args.write is not None:
        written.append(made.write(args.write, force=args.force))
    wrote(args.json, written)
    return 0
