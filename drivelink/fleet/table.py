"""The table of results: Parquet files with one row per recording and transmission.

A run writes one part, which is replaced as a whole while it grows, so that a reader never sees a row twice or
incomplete. A later run continues a small last part, so compaction is not needed. New results of a recording
replace the old ones.
"""

from __future__ import annotations

import contextlib
import fcntl
import io
import os
import time
from datetime import UTC, datetime
from typing import Any, NamedTuple, Self
from uuid import uuid4

import pyarrow as pa
import pyarrow.parquet as pq

from drivelink.fleet.analysis import NAMED
from drivelink.fleet.errors import FleetError
from drivelink.fleet.storage import Source, Store

FOLDER = "table"

_PART_ROWS = 5000  # a part is full: about 2 MB, rewritten in some 0.1 s
_FLUSH_S = 5.0  # finished work that a power loss may cost
_FLUSH_SHARE = 0.05  # share of the time for writing

_NAMED = [
    (f"{quantity}_{name}{unit}", pa.float64())
    for name in NAMED
    for quantity, unit in (
        ("deflection", "_rad"),
        ("stiffness", "_nm_rad"),
        ("stiffness_std", "_nm_rad"),
    )
]
SCHEMA = pa.schema(
    [
        ("id", pa.string()),
        ("joint", pa.string()),
        ("transmission", pa.int16()),
        ("part", pa.int16()),
        ("parts", pa.int16()),
        ("time", pa.timestamp("us", tz="UTC")),
        ("recording", pa.string()),
        ("digest", pa.string()),
        ("size_bytes", pa.int64()),
        ("stamp", pa.string()),
        ("status", pa.string()),
        ("error", pa.string()),
        ("verdict", pa.string()),
        ("sentence", pa.string()),
        ("effects", pa.list_(pa.string())),
        ("details", pa.string()),
        ("error_before_rms_nm", pa.float64()),
        ("error_after_rms_nm", pa.float64()),
        ("error_before_relative", pa.float64()),
        ("error_after_relative", pa.float64()),
        ("validated_on", pa.string()),
        ("model", pa.string()),
        *_NAMED,
        ("parameters", pa.string()),
        ("parameters_std", pa.string()),
        ("covariance", pa.list_(pa.float64())),
        ("inertia_kg_m2", pa.float64()),
        ("viscous_damping_nm_s_rad", pa.float64()),
        ("fit_error_relative", pa.float64()),
        ("deflection_rms_rad", pa.float64()),
        ("torque_rms_nm", pa.float64()),
        ("excited", pa.bool_()),
        ("duration_s", pa.float64()),
        ("samples", pa.int64()),
        ("period_s", pa.float64()),
        ("accepted_model", pa.string()),
        ("report", pa.string()),
        ("cpu_s", pa.float64()),
        ("wall_s", pa.float64()),
        ("worker", pa.string()),
        ("version", pa.string()),
        ("written", pa.timestamp("us", tz="UTC")),
    ]
)
_INDEX = ["id", "joint", "recording", "digest", "size_bytes", "stamp", "status", "version", "accepted_model"]


class Known(NamedTuple):
    """Entry of a recording in the table; `part` is the file with its rows."""

    digest: str
    joint: str | None
    version: str
    failed: bool
    accepted_model: str | None
    part: str


class FleetTable:
    """The table, open for appending by one run, as a context manager that flushes at the end.

    Args:
        store: where it is.

    Attributes:
        appended: recordings appended by this run.

    Raises:
        FleetError: a part cannot be read.
    """

    def __init__(self, store: Store) -> None:
        self.appended = 0
        self._store = store
        self._lock = _locked(store)
        self._by_place: dict[tuple[str, int, str], Known] = {}
        self._by_content: dict[tuple[str, str | None], Known] = {}
        self._stale: dict[str, set[str]] = {}  # by part: ids that a newer row replaces
        self._ids: dict[tuple[str, str | None], list[str]] = {}
        self._failed: dict[str, tuple[str, str | None]] = {}  # by recording: the key of its row of error
        self._sizes: dict[int, set[tuple[str, str | None]]] = {}
        self._now: set[tuple[str, str | None]] = set()
        self._rows: list[dict[str, Any]] = []
        self._part = f"{FOLDER}/part-{datetime.now(UTC):%Y%m%dT%H%M%S%f}-{uuid4().hex[:8]}.parquet"
        self._changed = False
        self._flushed, self._cost = time.monotonic(), 0.0
        self._open()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        try:
            self.flush()
        finally:
            if self._lock is not None:
                os.close(self._lock)
                self._lock = None

    def at(self, source: Source) -> Known | None:
        """Entry of the recording at this address, if size and stamp are unchanged."""
        return self._by_place.get((source.url, source.size, source.stamp)) if source.stamp else None

    def has_now(self, digest: str, joint: str | None) -> bool:
        """Whether this run has appended this content as a recording of this joint."""
        return (digest, joint) in self._now

    def contents(self, size: int, version: str) -> frozenset[tuple[str, str | None]]:
        """Digest and joint of results of this version with the same size."""
        keys = self._sizes.get(size, set())
        return frozenset(k for k in keys if self._by_content[k].version == version)

    def append(self, rows: list[dict[str, Any]]) -> None:
        """Add the rows of one recording; replace those of the same content and joint.

        Raises:
            FleetError: the table cannot be written.
        """
        now = datetime.now(UTC)
        key = (rows[0]["digest"], rows[0]["joint"])
        self._replace(key)
        failed = self._failed.pop(rows[0]["recording"], key)
        if failed != key:
            self._replace(failed)
        for row in rows:
            self._rows.append(row | {"written": now})
            self._remember(row, self._part)
        self._now.add(key)
        self.appended += 1
        self._changed = True
        if time.monotonic() - self._flushed > max(_FLUSH_S, self._cost / _FLUSH_SHARE):
            self.flush()
        if len(self._rows) >= _PART_ROWS:
            self.flush()
            self._rows, self._part = [], _next(self._part)

    def flush(self) -> None:
        """Write the appended rows.

        Raises:
            FleetError: the table cannot be written.
        """
        if not self._changed:
            return
        begin = time.monotonic()
        self._store.write(self._part, _bytes(pa.Table.from_pylist(self._rows, SCHEMA)))
        if self._lock is not None:  # other runs' parts are changed only under the lock
            for part, ids in self._stale.items():
                self._drop(part, ids)
            self._stale.clear()
        self._changed = False
        self._flushed = time.monotonic()
        self._cost = self._flushed - begin

    def _open(self) -> None:
        """Read the parts; continue the last one if it is small and not locked."""
        newest: dict[str, tuple[datetime, str]] = {}
        parts = self._store.names(FOLDER, ".parquet")
        for part in parts:
            for row in _read(self._store, part, [*_INDEX, "written"]).to_pylist():
                before = newest.get(row["id"])
                if before is not None and before[0] >= row["written"]:
                    self._stale.setdefault(part, set()).add(row["id"])
                    continue
                if before is not None:
                    self._stale.setdefault(before[1], set()).add(row["id"])
                newest[row["id"]] = (row["written"], part)
                self._remember(row, part)
        if not parts or self._lock is None:
            return
        last = _read(self._store, parts[-1])
        if last.num_rows < _PART_ROWS:
            stale = self._stale.pop(parts[-1], set())
            self._part = parts[-1]
            self._rows = [row for row in last.to_pylist() if row["id"] not in stale]

    def _remember(self, row: dict[str, Any], part: str) -> None:
        known = Known(
            row["digest"],
            row["joint"],
            row["version"],
            row["status"] != "done",
            row["accepted_model"],
            part,
        )
        key = (row["digest"], row["joint"])
        self._by_place[(row["recording"], row["size_bytes"], row["stamp"])] = known
        self._by_content[key] = known
        if known.failed:
            self._failed[row["recording"]] = key
        else:
            self._sizes.setdefault(row["size_bytes"], set()).add(key)
        ids = self._ids.setdefault(key, [])
        if row["id"] not in ids:
            ids.append(row["id"])

    def _replace(self, key: tuple[str, str | None]) -> None:
        """Remove the rows of a recording; from other parts at the next flush."""
        known = self._by_content.pop(key, None)
        if known is None:
            return
        for keys in self._sizes.values():
            keys.discard(key)
        ids = set(self._ids.pop(key))
        if known.part == self._part:
            self._rows = [row for row in self._rows if row["id"] not in ids]
        else:
            self._stale.setdefault(known.part, set()).update(ids)

    def _drop(self, part: str, ids: set[str]) -> None:
        kept = [row for row in _read(self._store, part).to_pylist() if row["id"] not in ids]
        if kept:
            self._store.write(part, _bytes(pa.Table.from_pylist(kept, SCHEMA)))
        else:
            self._store.remove(part)


def read_rows(store: Store, columns: list[str] | None = None) -> list[dict[str, Any]]:
    """The rows of a table, the newest of each id, in order of time.

    Args:
        store: where it is.
        columns: columns to read; None: all.

    Raises:
        FleetError: there is none, or a part cannot be read.
    """
    parts = store.names(FOLDER, ".parquet")
    if not parts:
        raise FleetError(
            f"{store.url}: expected a table of `drivelink fleet` ({FOLDER}/*.parquet), found none"
        )
    names = None if columns is None else list(dict.fromkeys([*columns, "id", "time", "recording", "written"]))
    newest: dict[str, dict[str, Any]] = {}
    for part in parts:
        for row in _read(store, part, names).to_pylist():
            before = newest.get(row["id"])
            if before is None or before["written"] <= row["written"]:
                newest[row["id"]] = row
    epoch = datetime.fromtimestamp(0, UTC)
    return sorted(newest.values(), key=lambda row: (row["time"] or epoch, row["recording"], row["id"]))


def _read(store: Store, part: str, columns: list[str] | None = None) -> Any:
    """Read a part; columns missing in an older version are empty."""
    wanted = SCHEMA if columns is None else pa.schema([SCHEMA.field(name) for name in columns])
    try:
        file = pq.ParquetFile(io.BytesIO(store.read(part)))
        table = file.read([name for name in wanted.names if name in file.schema_arrow.names])
    except pa.ArrowException as error:
        raise FleetError(f"{store.url}/{part}: expected a Parquet file of drivelink: {error}") from error
    arrays = [
        table.column(field.name).cast(field.type)
        if field.name in table.column_names
        else pa.nulls(table.num_rows, field.type)
        for field in wanted
    ]
    return pa.Table.from_arrays(arrays, schema=wanted)


def _bytes(table: Any) -> bytes:
    sink = io.BytesIO()
    pq.write_table(table, sink, compression="zstd")
    return sink.getvalue()


def _next(part: str) -> str:
    """The name of the next part; names sort in order of writing."""
    stem, _, number = part.removesuffix(".parquet").partition("_")
    return f"{stem}_{int(number or 0) + 1:04d}.parquet"


def _locked(store: Store) -> int | None:
    """A lock for changing existing parts; None if another run has it.

    Remote storage has none: each run writes its own part.
    """
    if store.folder is None:
        return None
    folder = store.folder / FOLDER
    try:
        folder.mkdir(parents=True, exist_ok=True)
        descriptor = os.open(folder / ".lock", os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
    except OSError as error:
        raise FleetError(f"{folder}: cannot be written: {error.strerror}") from error
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        with contextlib.suppress(OSError):
            os.close(descriptor)
        return None
    return descriptor
