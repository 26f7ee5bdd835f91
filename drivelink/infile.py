"""Opens input files: regular ones only, where a device or a pipe would hang or never end."""

from __future__ import annotations

import io
import os
import stat
from pathlib import Path


def open_regular(path: Path) -> io.BufferedReader:
    """Open a file for reading bytes.

    Raises:
        OSError: it cannot be opened, or is a folder, a device, a pipe or a socket.
    """
    fd = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)  # of a pipe, O_NONBLOCK returns at once
    if not stat.S_ISREG(os.fstat(fd).st_mode):
        os.close(fd)
        raise OSError(0, "expected a regular file", str(path))
    return os.fdopen(fd, "rb")


def read_regular(path: Path, most_bytes: int) -> bytes:
    """Return the content of a file.

    Raises:
        OSError: as `open_regular`, or it is larger than `most_bytes`.
    """
    with open_regular(path) as file:
        data = file.read(most_bytes + 1)
    if len(data) > most_bytes:
        raise OSError(0, f"expected at most {most_bytes >> 10} KiB, got more", str(path))
    return data
