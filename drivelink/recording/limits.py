"""Memory limits of recordings, checked before allocation.

A file declares the lengths of its parts and may declare anything. Real recordings are far below these limits
(docs/reference/recordings.md).
"""

from __future__ import annotations

from pathlib import Path

from drivelink.errors import RecordingError

MAX_SAMPLES = 10_000_000  # periods from first to last sample of a recording in memory: 2.7 h at 1 kHz
MAX_COLUMNS = 4096  # columns of a CSV file; unknown ones are not kept in memory
MAX_LINE_BYTES = 1 << 20  # of a line of text
MAX_BLOCK_BYTES = 64 << 20  # an MCAP chunk or a BLF container, unpacked; tools write up to 8 MiB
_LAST_STAMP_NS = (1 << 63) - 1  # of the year 2262


def require_samples(count: int, where: str) -> None:
    """Refuse more samples, or periods including gaps, than fit into memory.

    Raises:
        RecordingError: the limit is exceeded.
    """
    if count > MAX_SAMPLES:
        raise RecordingError(
            f"{where}: expected at most {MAX_SAMPLES} periods from the first sample to the last, "
            f"got {count}: split it, at a gap if there is one"
        )


def require_stamp(stamp_ns: int, path: Path) -> None:
    """Check that a stamp has 64 bits.

    Raises:
        RecordingError: it has not.
    """
    if stamp_ns > _LAST_STAMP_NS:
        raise RecordingError(f"{path}: expected stamps below 2^63 ns, got {stamp_ns:.3g}")
