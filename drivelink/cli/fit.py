"""`drivelink fit RECORDING --joint JOINT`: model-based estimation from a recording."""

from __future__ import annotations

import argparse
import math
from pathlib import Path

from drivelink import jointfile
from drivelink.errors import RecordingError, UsageError

_EPILOG = """\
example:
  drivelink fit healthy.csv --joint elbow.toml --out fit/ --plots --write elbow-fitted.toml

--write puts the transmission's parameters, and the motor's inertia and damping as far as the recording
tells them, into a copy of the joint file; `run`, `replay` and `diagnose` start from there.
"""


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.epilog = _EPILOG
    parser.add_argument("recording", type=Path, metavar="RECORDING", help="measured data: CSV, MCAP, CAN log")
    parser.add_argument("--joint", type=Path, required=True, metavar="JOINT", help="joint file")
    parser.add_argument("--out", type=Path, metavar="DIR", help="write fit.json there")
    parser.add_argument("--write", type=Path, metavar="JOINT2", help="write a copy of the joint file")
    parser.add_argument(
        "--plots", nargs="?", type=Path, const=Path(), metavar="DIR", help="write plots there, or into --out"
    )
    parser.add_argument(
        "--bandwidth-hz", type=float, metavar="F", help="of the filter that all channels share"
    )


def run(args: argparse.Namespace) -> int:
    """Do the job; return the exit status."""
    if args.bandwidth_hz is not None and not 0.0 < args.bandwidth_hz < math.inf:
        raise UsageError(f"--bandwidth-hz: expected a number above 0, got {args.bandwidth_hz:g}")
    folder = _plots_folder(args)
    joint = jointfile.load(args.joint)
    if not args.recording.exists():
        raise RecordingError(f"{args.recording}: no such file")
    from drivelink.cli.fitting import fit_recording  # a second; what can be wrong before is said before

    fit_recording(args, joint, folder)
    return 0


def _plots_folder(args: argparse.Namespace) -> Path | None:
    folder: Path | None = args.plots
    if folder == Path():
        if args.out is None:
            raise UsageError("--plots: expected a folder, or --out to put the plots into")
        folder = args.out
    return folder
