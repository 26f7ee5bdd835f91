"""What the gate says of recordings, on stderr: units, signs, gears and time that look wrong."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path


def warn(path: Path, lines: Sequence[str]) -> None:
    """Print what the gate says of a recording, on stderr."""
    for line in lines:
        print(f"{path}: warning: {line}", file=sys.stderr)
