"""`drivelink dbc JOINT`: the joint's frames as a DBC database for other CAN tools."""

import argparse
from pathlib import Path

from drivelink import jointfile
from drivelink.cli.record import known_layouts
from drivelink.errors import UsageError
from drivelink.files import check_target, write_whole
from drivelink.recording.mapping import dbc_text, joint_of, recorded_layouts

EPILOG = """\
examples:
  drivelink dbc elbow.toml --out elbow.dbc     as the running daemon, the joint file or the EDS files say
  drivelink dbc elbow.mcap --out elbow.dbc     as it was when this was recorded
"""


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    parser.add_argument("source", type=Path, metavar="JOINT", help="joint file, or a recording")
    parser.add_argument("--out", type=Path, metavar="FILE", help="the database (default: print it)")
    parser.add_argument("--force", action="store_true", help="replace a file that exists")


def run(args: argparse.Namespace) -> int:
    """Run the verb; return the exit status."""
    if args.source.suffix == ".toml":
        source = jointfile.load_text(args.source)
        layouts = known_layouts(source)
    else:
        try:
            source = joint_of(args.source, None)
        except UsageError as error:
            raise UsageError(
                f"{args.source}: expected a joint file, or a recording that carries one"
            ) from error
        layouts = recorded_layouts(args.source, source.joint.name, daemon=False)
    if not layouts:
        raise UsageError(
            f"{args.source}: expected the mapping of its nodes: from a running daemon, a recording, "
            "[[motor.drive.tpdo]] or an EDS file"
        )
    text = dbc_text(source.joint.name, layouts)
    if args.out is None:
        print(text, end="")
        return 0
    check_target(args.out, [args.source], force=args.force)
    write_whole(args.out, text, force=args.force)
    print(f"wrote {args.out}")
    return 0
