"""A file that is readable up to its last flush after a kill, a full disk or a power loss."""

from __future__ import annotations

import io
import os
from pathlib import Path

from drivelink.errors import RecordingError
from drivelink.outfile import NewFile


class SafeFile(io.BufferedIOBase):
    """Binary file for writers: whole blocks reach the disk, or none of a block.

    `write` buffers bytes; `flush` writes them as one block; `sync` also syncs to disk. The first `sync` gives
    the file its name. If the disk is full, the file is truncated to the last whole block, so that it ends
    between two records.

    Args:
        force: replace an existing file, at the first `sync`.

    Raises:
        RecordingError: it cannot be opened or, later, written.
    """

    def __init__(self, path: Path, *, force: bool = False) -> None:
        super().__init__()
        self._path = path
        self.name = str(path)  # the path
        self._pending = bytearray()
        self._place: int | None = None  # position of a write before the end
        self._size = 0
        try:
            self._file = NewFile(path, force=force)
        except OSError as error:
            raise RecordingError(f"{path}: cannot be written: {error.strerror}") from error

    def writable(self) -> bool:
        """Return always."""
        return True

    def seekable(self) -> bool:
        """Return always True: a header may be rewritten at the end."""
        return True

    def tell(self) -> int:
        """Return the position of the next byte."""
        return self._size + len(self._pending) if self._place is None else self._place

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        """Set the position, after writing pending bytes."""
        self.flush()
        end = whence == os.SEEK_END
        self._place = None if end else offset
        return self.tell()

    def write(self, data: bytes) -> int:  # type: ignore[override]
        """Write bytes; at the end of the file they are buffered until `flush`."""
        if self._place is not None:
            self._put(bytes(data), self._place)
            self._place += len(data)
            return len(data)
        self._pending += data
        return len(data)

    def flush(self) -> None:
        """Write all pending bytes as one block."""
        if self._file.fd < 0 or not self._pending:
            return
        self._put(bytes(self._pending), self._size)
        self._size += len(self._pending)
        self._pending.clear()

    def sync(self) -> None:
        """Flush, and sync file and name to disk."""
        self.flush()
        try:
            self._file.place()
        except OSError as error:
            raise self._failed(error) from error

    def close(self) -> None:
        """Flush and close; after a write error only close."""
        if self._file.fd < 0:
            return
        try:
            self.sync()
        finally:
            self._file.close()
            super().close()

    def abandon(self) -> None:
        """Close without writing pending bytes; remove a file that was never synced."""
        self._pending.clear()
        self._file.close()
        super().close()

    def _put(self, data: bytes, offset: int) -> None:
        fd, done = self._file.fd, 0
        try:
            while done < len(data):
                done += os.pwrite(fd, data[done:], offset + done)
        except OSError as error:
            self._pending.clear()
            if offset >= self._size:
                os.ftruncate(fd, self._size)
            raise self._failed(error) from error

    def _failed(self, error: OSError) -> RecordingError:
        kept = "it holds everything up to the last second" if self._file.placed else "nothing was written"
        return RecordingError(f"{self._path}: cannot be written any further: {error.strerror}; {kept}")
