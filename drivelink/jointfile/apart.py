"""Reads a joint file in a process of its own, so that no file takes the interpreter from the cycle."""

import os
import subprocess
import sys
from pathlib import Path

from drivelink.errors import JointFileError
from drivelink.jointfile.document import from_json, load_text, to_json
from drivelink.jointfile.schema import JointFile

_PATIENCE_S = 20.0  # a second is usual, most of it for starting the interpreter
_NICENESS = 10
_MAX_BYTES = 64 << 10  # without comments, which the cycle awaits for a third of a ms; usual are 10 KiB


def load_apart(path: Path) -> JointFile:
    """Read and validate a joint file; what takes long is done by another process.

    Raises:
        JointFileError: as `load`; or it takes too long.
    """
    command = [sys.executable, "-P", "-m", __name__, str(path)]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    try:
        done = subprocess.run(
            command, capture_output=True, timeout=_PATIENCE_S, env=environment, stdin=subprocess.DEVNULL
        )
    except subprocess.TimeoutExpired as error:
        raise JointFileError(f"{path}: expected to be read within {_PATIENCE_S:g} s") from error
    except OSError as error:
        raise JointFileError(f"{path}: no process to read it in: {error.strerror}") from error
    if done.returncode:
        lines = done.stderr.decode(errors="replace").splitlines()
        raise JointFileError(lines[-1] if lines else f"{path}: its reader ended with {done.returncode}")
    if len(done.stdout) > _MAX_BYTES:
        most = f"at most {_MAX_BYTES >> 10} KiB without comments"
        raise JointFileError(f"{path}: expected {most}, to be read while a joint is served")
    return from_json(done.stdout.decode(), str(path))


def _main() -> int:
    os.nice(_NICENESS)
    try:
        given = load_text(sys.argv[1])
    except JointFileError as error:
        sys.stderr.write(f"{error}\n")
        return 1
    sys.stdout.write(to_json(given.text, given.name))
    return 0


if __name__ == "__main__":
    sys.exit(_main())
