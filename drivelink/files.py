"""Opens input files, and writes files atomically, without replacing existing files or inputs unasked.

Input is of regular files only, where a device or a pipe would hang or never end. A file is written under a
temporary name in the same folder, synced and renamed, so that either the old or the new file exists, never a
part.

For all verbs: a named file (`--out FILE`, `--write`, `new PATH`) is replaced only with `--force`, an input
never. Files of a results folder (`--out DIR`, `--plots DIR`) are replaced by each run.
"""

import errno
import io
import os
import secrets
import stat
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path

from drivelink.errors import UsageError


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


_NO_LINKS = (errno.EPERM, errno.ENOTSUP, errno.EOPNOTSUPP, errno.ENOSYS, errno.EMLINK)


def check_target(
    path: Path, inputs: Iterable[Path] = (), *, force: bool = False, makes_folder: bool = False
) -> None:
    """Check an output path before any work is done for it.

    Args:
        inputs: input files; symbolic and hard links count as the same file.
        force: whether it may take the place of another file.
        makes_folder: whether its folder is made where there is none.

    Raises:
        UsageError: it is an input or a folder, it exists, or its folder is none or read-only.
    """
    for given in inputs:
        if _same(path, given):
            raise UsageError(f"{path}: is read here and must not be replaced: choose another name")
    if path.is_dir():
        raise UsageError(f"{path}: expected the name of a file, got a folder")
    if path.parent.exists() and not path.parent.is_dir():
        raise UsageError(f"{path.parent}: expected a folder, got a file")
    if not makes_folder and not path.parent.exists():
        raise UsageError(f"{path}: there is no folder {path.parent}")
    if not force and path.is_file():
        raise UsageError(f"{path}: exists already; force=True replaces it")
    folder = next(one for one in path.absolute().parents if one.exists())
    if not os.access(folder, os.W_OK) and (path.is_file() or not path.exists()):
        raise UsageError(f"{path}: the folder {folder} cannot be written to")


def _same(path: Path, other: Path) -> bool:
    try:
        return path.samefile(other)
    except OSError:  # one of them does not exist
        return os.path.realpath(path) == os.path.realpath(other)


class NewFile:
    """A file under way to its place.

    Args:
        path: final path; a symbolic link stays and points to the new file. Pipes and devices are written
            directly.
        force: whether it may take the place of another file.

    Raises:
        OSError: it cannot be written; `filename` is the final path.
    """

    def __init__(self, path: Path, *, force: bool = False) -> None:
        self.path = path
        self._place = Path(os.path.realpath(path))
        self._force = force
        try:
            mode = self._place.stat().st_mode if self._place.exists() else None
            self.placed = mode is not None and not stat.S_ISREG(mode)  # whether it has its final name
            if mode is not None and not (force or self.placed):
                raise FileExistsError(errno.EEXIST, os.strerror(errno.EEXIST))
            hidden = f".{self._place.name[:200]}.{secrets.token_hex(4)}.tmp"  # in the same folder
            self._temporary = self._place if self.placed else self._place.with_name(hidden)
            if mode is not None and not os.access(self._place, os.W_OK):
                raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))  # rename would replace it
            flags = os.O_WRONLY if self.placed else os.O_WRONLY | os.O_CREAT | os.O_EXCL
            self.fd = os.open(self._temporary, flags | os.O_CLOEXEC, 0o666)  # descriptor to write to
            if mode is not None and not self.placed:
                os.fchmod(self.fd, stat.S_IMODE(mode))
        except OSError as error:
            raise OSError(error.errno, error.strerror, str(path)) from error

    def place(self) -> None:
        """Sync the file and rename it to its final name; a second call only syncs.

        Raises:
            OSError: it cannot be written, or a file exists and `force` is not given.
        """
        try:
            sync(self.fd)
            if not self.placed:
                put_in_place(self._temporary, self._place, force=self._force)
                self.placed = True
        except OSError as error:
            raise OSError(error.errno, error.strerror, str(self.path)) from error

    def close(self) -> None:
        """Close it, and remove a file that was not placed. May be called twice."""
        if self.fd < 0:
            return
        os.close(self.fd)
        self.fd = -1
        if not self.placed:
            with suppress(OSError):
                self._temporary.unlink()


def write_whole(path: Path, data: str | bytes, *, force: bool = False) -> None:
    """Write a file atomically.

    Args:
        data: bytes, or text for UTF-8.
        force: whether it may take the place of another file.

    Raises:
        OSError: it cannot be written; an existing file is unchanged.
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
    """Rename a complete, synced file, and sync the folder.

    Raises:
        OSError: a file exists and `force` is not given, or the folder cannot be written.
    """
    if force:
        temporary.replace(path)
    else:
        try:
            os.link(temporary, path)  # unlike rename, it refuses to replace a file
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
    """Sync to disk; ignored for pipes and devices."""
    try:
        os.fsync(fd)
    except OSError as error:
        if error.errno not in (errno.EINVAL, errno.EROFS):
            raise
