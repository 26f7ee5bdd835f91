"""Access to recordings and results by fsspec (`file:`, `sftp:`, `s3:`, `http:`).

Credentials and endpoints are those of fsspec (configuration files, `FSSPEC_…` and `AWS_…` variables).
"""

import hashlib
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from email.utils import parsedate_to_datetime
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import urlsplit
from uuid import uuid4

from fsspec.core import url_to_fs
from fsspec.implementations.local import LocalFileSystem

from drivelink.errors import DrivelinkError
from drivelink.files import open_regular, write_whole
from drivelink.recording.canlog import CAN_SUFFIXES
from drivelink.recording.formats import FORMATS
from drivelink.recording.mapping import side_file


class FleetError(DrivelinkError):
    """The scheduler, the joint folder or the result folder cannot be used."""

    exit_status = 3


_MODIFIED = ("mtime", "LastModified", "last_modified", "Last-Modified", "time", "created")


class Source(NamedTuple):
    """Listing of a recording."""

    url: str  # address; an absolute path for local files
    size: int  # bytes; -1: unknown
    stamp: str  # changes when the content does: the entity tag, else the time of modification; "" if unknown
    modified: datetime | None  # time of modification, if known

    @property
    def name(self) -> str:
        """The file name."""
        return urlsplit(self.url).path.rsplit("/", 1)[-1] if "://" in self.url else Path(self.url).name


def find(patterns: Iterable[str]) -> tuple[list[Source], list[str]]:
    """Expand paths, globs, folders and URLs to distinct recordings, sorted by name.

    Args:
        patterns: of the user; a folder stands for all recordings below it.

    Returns:
        The recordings, and the patterns that match nothing.

    Raises:
        FleetError: a storage is unknown or cannot be reached.
    """
    found: dict[str, Source] = {}
    empty = []
    for pattern in patterns:
        sources = _listed(pattern)
        if not sources:
            empty.append(pattern)
        found.update((source.url, source) for source in sources)
    return sorted(found.values(), key=lambda source: source.url), empty


def _listed(pattern: str) -> list[Source]:
    fs, path = _opened(pattern)
    with _checked(f"{pattern}: cannot be listed"):
        if any(sign in path for sign in "*?["):
            entries = fs.glob(path, detail=True)
        elif fs.isdir(path) and not _is_recording(path):
            entries = fs.find(path, detail=True)
        else:
            entries = {path: fs.info(path)} if fs.exists(path) else {}
    single = path in entries and len(entries) == 1
    return [
        _source(_url(pattern, fs, str(name)), info)
        for name, info in entries.items()
        if info.get("type", "file") == "file" and (single or _is_recording(str(name)))
    ]


def _is_recording(path: str) -> bool:
    return Path(path).suffix.lower() in FORMATS


def _source(url: str, info: dict[str, Any]) -> Source:
    modified = next((_time(info[key]) for key in _MODIFIED if info.get(key)), None)
    tag = info.get("ETag") or info.get("etag")
    stamp = str(tag) if tag else (modified.isoformat() if modified else "")
    size = info.get("size")
    return Source(url, -1 if size is None else int(size), stamp, modified)


def _time(value: Any) -> datetime | None:
    if isinstance(value, datetime):
        return value if value.tzinfo else value.replace(tzinfo=UTC)
    if isinstance(value, int | float):
        return datetime.fromtimestamp(value, UTC)
    with suppress(ValueError):
        return parsedate_to_datetime(str(value))
    return None


def _opened(url: str) -> tuple[Any, str]:
    with _checked(f"{url}: cannot be reached"):
        try:
            fs, path = url_to_fs(url)
        except ImportError as error:
            raise FleetError(f"{url}: {one_line(error)}") from error
    return fs, str(path)


@contextmanager
def _checked(what: str) -> Iterator[None]:
    """Make one line of what a storage raises."""
    try:
        yield
    except FleetError:
        raise
    except Exception as error:  # each storage of fsspec has its own
        raise FleetError(f"{what}: {one_line(error)}") from error


def _url(pattern: str, fs: Any, path: str) -> str:
    """Return the address of a listed file: file systems omit protocol and sometimes host."""
    if "://" in path:
        return path
    if "://" not in pattern or pattern.startswith(("file://", "local://")):
        return path
    split = urlsplit(pattern)
    addresses = (f"{split.scheme}://{host}{path}" for host in (split.netloc, ""))
    return next(url for url in addresses if fs._strip_protocol(url) == path)


def one_line(error: BaseException) -> str:
    """Return what an error says, in one line."""
    text = getattr(error, "strerror", None) or error  # without the name, which `what` has
    return " ".join(str(text).split()) or type(error).__name__


@contextmanager
def fetched(source: Source) -> Iterator[tuple[Path, str]]:
    """Provide a recording as a local file, with the SHA-256 of its content; a remote one is copied.

    Raises:
        OSError: it cannot be read.
    """
    with tempfile.TemporaryDirectory(prefix="drivelink-fleet-") as folder:
        path = Path(source.url)
        if "://" in source.url:
            path = Path(folder) / source.name
            fs, place = _opened(source.url)
            fs.get_file(place, str(path))
            if path.suffix.lower() in CAN_SUFFIXES:
                with suppress(FileNotFoundError):  # most have none
                    fs.get_file(place + side_file(path).name.removeprefix(path.name), str(side_file(path)))
        with open_regular(path) as file:
            digest = hashlib.file_digest(file, "sha256").hexdigest()
        yield path, digest


class Store:
    """The folder of results, with atomic writes.

    A file exists complete or not at all: locally and over SFTP it gets its name when complete; object stores
    are atomic.

    Args:
        url: the folder; created if missing.

    Raises:
        FleetError: it cannot be reached or created.
    """

    def __init__(self, url: str) -> None:
        self.url = url  # as given
        self._fs, self._root = _opened(url)
        # the local folder, or None
        self.folder: Path | None = Path(self._root) if isinstance(self._fs, LocalFileSystem) else None

    def write(self, name: str, data: bytes) -> None:
        """Write or replace a file.

        Raises:
            FleetError: it cannot be written.
        """
        target = f"{self._root}/{name}"
        with _checked(f"{self.url}/{name}: cannot be written"):
            self._fs.makedirs(target.rpartition("/")[0], exist_ok=True)
            if self.folder is not None:
                write_whole(Path(target), data, force=True)
            elif hasattr(self._fs, "ftp"):
                temporary = f"{target}.{uuid4().hex}.tmp"
                self._fs.pipe_file(temporary, data)
                self._fs.ftp.posix_rename(temporary, target)
            else:
                self._fs.pipe_file(target, data)

    def read(self, name: str) -> bytes:
        """Return the content of a file.

        Raises:
            FleetError: it cannot be read.
        """
        with _checked(f"{self.url}/{name}: cannot be read"):
            return bytes(self._fs.cat_file(f"{self._root}/{name}"))

    def names(self, folder: str, suffix: str) -> list[str]:
        """Return the names of a folder's files with this ending, relative to the store; no hidden ones."""
        self._fs.invalidate_cache()
        with _checked(f"{self.url}: cannot be listed"):
            place = f"{self._root}/{folder}"
            paths = self._fs.ls(place, detail=False) if self._fs.exists(place) else []
        names = (str(path).rstrip("/").rpartition("/")[2] for path in paths)
        return sorted(f"{folder}/{n}" for n in names if n.endswith(suffix) and not n.startswith("."))

    def remove(self, name: str) -> None:
        """Delete a file, if it exists."""
        with suppress(FileNotFoundError):
            self._fs.rm_file(f"{self._root}/{name}")
