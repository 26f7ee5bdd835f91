"""Files we write: whole or not at all, nothing replaced unasked, and never what was read.

A file grows under another name beside its place, is put on the disk, and then takes its place in one step.
Whatever happens, there is the old file or the new one there, never a part of it.

One rule for all verbs: a file that is named (`--out FILE`, `--write`, `new PATH`) is replaced only with
`--force`, a recording or a joint file that was read never. The files of a results folder (`--out DIR`,
`--plots DIR`) hold what the last run found.
"""

from __future__ import annotations

import errno
import os
import secrets
import stat
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path

from drivelink.errors import UsageError

__all__ = ["NewFile", "check_target", "put_in_place", "sync", "write_whole"]

_NO_LINKS = (errno.EPERM, errno.ENOTSUP, errno.EOPNOTSUPP, errno.ENOSYS, errno.EMLINK)


def check_target(path: Path, inputs: Iterable[Path] = (), *, force: bool = False) -> None:
    """Refuse a file to be written before any work is done for it.

    Args:
        path: where it is to go.
        inputs: files that are read; the same file under another name counts, by symbolic or hard link.
        force: whether the user allows an existing file to be replaced.

    Raises:
        UsageError: it is one of the inputs, a folder, or exists already.
    """
    for given in inputs:
        if _same(path, given):
            raise UsageError(f"{path}: is read here and must not be replaced: choose another name")
    if path.is_dir():
        raise UsageError(f"{path}: expected the name of a file, got a folder")
    if not force and path.is_file():
        raise UsageError(f"{path}: exists already; --force replaces it")


def _same(path: Path, other: Path) -> bool:
    try:
        return path.samefile(other)
    except OSError:  # one of them does not exist
        return path.resolve() == other.resolve()


class NewFile:
    """A file under way to its place.

    Args:
        path: its place; a symbolic link there stays, and leads to the new file. What is no regular file (a
            pipe, a device) is written as it is.
        force: whether it may take the place of another file.

    Attributes:
        fd: descriptor to write to.
        placed: whether it is in its place.

    Raises:
        OSError: it cannot be written there; `filename` is its place.
    """

    def __init__(self, path: Path, *, force: bool = False) -> None:
        self.path = path
        self._place = Path(os.path.realpath(path))
        self._force = force
        try:
            mode = _mode(self._place)
            self.placed = mode is not None and not stat.S_ISREG(mode)
            if mode is not None and not (force or self.placed):
                raise FileExistsError(errno.EEXIST, os.strerror(errno.EEXIST))
            self._temporary = self._place if self.placed else _beside(self._place)
            if mode is not None and not os.access(self._place, os.W_OK):
                raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))  # a renaming would not ask
            flags = os.O_WRONLY if self.placed else os.O_WRONLY | os.O_CREAT | os.O_EXCL
            self.fd = os.open(self._temporary, flags | os.O_CLOEXEC, 0o666)
            if mode is not None and not self.placed:
                os.fchmod(self.fd, stat.S_IMODE(mode))
        except OSError as error:
            raise OSError(error.errno, error.strerror, str(path)) from error

    def place(self) -> None:
        """Put what has been written on the disk, and the file in its place; a second time only the former.

        Raises:
            OSError: it cannot be written, or there is a file by now and `force` is not given.
        """
        try:
            sync(self.fd)
            if not self.placed:
                put_in_place(self._temporary, self._place, force=self._force)
                self.placed = True
        except OSError as error:
            raise OSError(error.errno, error.strerror, str(self.path)) from error

    def close(self) -> None:
        """Close it; a file that has not come to its place is removed. A second time does nothing."""
        if self.fd < 0:
            return
        os.close(self.fd)
        self.fd = -1
        if not self.placed:
            with suppress(OSError):
                self._temporary.unlink()


def write_whole(path: Path, data: str | bytes, *, force: bool = False) -> None:
    """Write a file in one step.

    Args:
        path: its place.
        data: its bytes, or its text, which becomes UTF-8.
        force: whether it may take the place of another file.

    Raises:
        OSError: it cannot be written; what was there is there still.
    """
    rest = memoryview(data.encode() if isinstance(data, str) else data)
    file = NewFile(path, force=force)
    try:
        while rest:
            rest = rest[os.write(file.fd, rest) :]
        file.place()
    except OSError as error:
        raise OSError(error.errno, error.strerror, str(path)) from error
    finally:
        file.close()


def put_in_place(temporary: Path, path: Path, *, force: bool) -> None:
    """Give a file that is whole, and on the disk, its name; the disk knows the name on return.

    Raises:
        OSError: there is a file already and `force` is not given, or the folder cannot be written.
    """
    if force:
        temporary.replace(path)
    else:
        try:
            os.link(temporary, path)  # unlike a renaming, it refuses to replace a file
            temporary.unlink()
        except OSError as error:
            if error.errno not in _NO_LINKS:
                raise
            if path.exists():
                raise FileExistsError(errno.EEXIST, os.strerror(errno.EEXIST), str(path)) from error
            temporary.replace(path)
    folder = os.open(path.parent, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        sync(folder)
    finally:
        os.close(folder)


def sync(fd: int) -> None:
    """Wait until the disk has it; where there is no such thing (pipes, devices), do not."""
    try:
        os.fsync(fd)
    except OSError as error:
        if error.errno not in (errno.EINVAL, errno.EROFS):
            raise


def _mode(path: Path) -> int | None:
    try:
        return path.stat().st_mode
    except FileNotFoundError:
        return None


def _beside(path: Path) -> Path:
    """A hidden name in the same folder, that nobody has."""
    return path.with_name(f".{path.name[:200]}.{secrets.token_hex(4)}.tmp")
