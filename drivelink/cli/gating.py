"""What the gate says of recordings, on stderr: units, signs, gears and time that look wrong."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

from drivelink.jointfile import JointFile
from drivelink.recording.gate import gate
from estimator.sample import Record


def warned(
    paths: Sequence[Path], records: Sequence[Record], joint: JointFile, *, strict: bool
) -> tuple[str, ...]:
    """Print what the gate says of recordings, on stderr; arguments, result and errors as of `gate`."""
    lines = []
    for path, record in zip(paths, records, strict=True):
        said = gate(path, joint, record, strict=strict)
        warn(path, said)
        lines += said
    return tuple(dict.fromkeys(lines))


def warn(path: Path, lines: Sequence[str]) -> None:
    """Print what the gate says of a recording, on stderr."""
    for line in lines:
        print(f"{path}: warning: {line}", file=sys.stderr)
