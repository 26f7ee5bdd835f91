"""The table of results: Parquet files with one row per recording and transmission.

A run writes parts of its own, each replaced as a whole while it grows, so that a reader never sees an
incomplete one. At its end it merges small parts and leaves out rows that newer ones replace.
"""

import contextlib
import fcntl
import io
import os
import time
from collections.abc import Iterator
from datetime import UTC, datetime
from itertools import compress, islice
from typing import Any, NamedTuple, Self
from uuid import uuid4

import pyarrow as pa
import pyarrow.parquet as pq

from drivelink.errors import raised_as
from drivelink.fleet.analysis import NAMED
from drivelink.fleet.storage import FleetError, Source, Store

FOLDER = "table"

_PART_ROWS = 5000  # a part is full: about 2 MB, rewritten in some 0.1 s
_MOST_ROWS = 2 * _PART_ROWS  # one that is all but full, and the rows of one recording more
_MOST_BYTES = 64 << 20  # of the rows of a part in memory: 6 KiB for each of as many as it may have
_AT_ONCE = 64  # rows that are unpacked before they are counted
_FLUSH_S = 5.0  # finished work that a power loss may cost

_TEXT, _REAL, _FEW, _MANY = pa.string(), pa.float64(), pa.int16(), pa.int64()
_TIME = pa.timestamp("us", tz="UTC")
_NAMED = [
    (f"{quantity}_{name}{unit}", _REAL)
    for name in NAMED
    for quantity, unit in (("deflection", "_rad"), ("stiffness", "_nm_rad"), ("stiffness_std", "_nm_rad"))
]
SCHEMA = pa.schema([
    ("id", _TEXT), ("joint", _TEXT), ("transmission", _FEW), ("part", _FEW), ("parts", _FEW),
    ("time", _TIME), ("recording", _TEXT), ("digest", _TEXT), ("size_bytes", _MANY), ("stamp", _TEXT),
    ("status", _TEXT), ("error", _TEXT), ("verdict", _TEXT), ("sentence", _TEXT),
    ("effects", pa.list_(pa.string())), ("details", _TEXT), ("error_before_rms_nm", _REAL),
    ("error_after_rms_nm", _REAL), ("error_before_relative", _REAL), ("error_after_relative", _REAL),
    ("validated_on", _TEXT), ("axis", _TEXT), ("model", _TEXT), *_NAMED, ("parameters", _TEXT),
    ("parameters_std", _TEXT), ("covariance", pa.list_(pa.float64())), ("inertia_kg_m2", _REAL),
    ("inertia_std_kg_m2", _REAL), ("viscous_damping_nm_s_rad", _REAL),
    ("viscous_damping_std_nm_s_rad", _REAL), ("deflection_offset_rad", _REAL),
    ("deflection_offset_std_rad", _REAL), ("fit_error_relative", _REAL), ("deflection_rms_rad", _REAL),
    ("torque_rms_nm", _REAL), ("excited", pa.bool_()), ("duration_s", _REAL), ("samples", _MANY),
    ("period_s", _REAL), ("accepted_model", _TEXT), ("report", _TEXT), ("cpu_s", _REAL),
    ("wall_s", _REAL), ("worker", _TEXT), ("version", _TEXT), ("written", _TIME),
])  # fmt: skip
_INDEX = [
    "id", "joint", "recording", "digest", "size_bytes", "stamp", "status", "version", "accepted_model",
    "written",
]  # fmt: skip
_NEVER_EMPTY = ["id", "recording", "digest", "size_bytes", "status", "written"]
_Key = tuple[str, str | None]  # digest and joint


class Known(NamedTuple):
    """Entry of a recording in the table."""

    digest: str
    joint: str | None
    version: str
    failed: bool
    accepted_model: str | None


class FleetTable:
    """The table, open for appending by one run, as a context manager that flushes and compacts at the end.

    Raises:
        FleetError: a part cannot be read.
    """

    def __init__(self, store: Store) -> None:
        self._store, self._lock = store, _locked(store)
        self._parts = store.names(FOLDER, ".parquet")
        self._by_place: dict[tuple[str, int, str], Known] = {}
        self._by_content: dict[_Key, Known] = {}
        self._sizes: dict[int, set[_Key]] = {}
        self._now: set[_Key] = set()
        self._rows: list[dict[str, Any]] = []
        self._part = _new_part()
        self._flushed = time.monotonic()
        rows = [row for part in self._parts for row in _read(store, part, _INDEX).to_pylist()]
        for row, current in zip(rows, _current(rows), strict=True):
            if current:
                self._remember(row)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        try:
            self.flush()
            if self._lock is not None:  # parts of earlier runs are changed only under the lock
                self._compact()
        finally:
            if self._lock is not None:
                os.close(self._lock)
                self._lock = None

    def at(self, source: Source) -> Known | None:
        """Return the entry of the recording at this address, if size and stamp are unchanged."""
        return self._by_place.get((source.url, source.size, source.stamp)) if source.stamp else None

    def has_now(self, digest: str, joint: str | None) -> bool:
        """Return whether this run has appended this content as a recording of this joint."""
        return (digest, joint) in self._now

    def contents(self, size: int, version: str) -> frozenset[_Key]:
        """Return the digest and joint of results of this version with the same size."""
        return frozenset(k for k in self._sizes.get(size, ()) if self._by_content[k].version == version)

    def append(self, rows: list[dict[str, Any]]) -> None:
        """Add the rows of one recording; they replace those of the same content and joint.

        Raises:
            FleetError: the table cannot be written.
        """
        now = datetime.now(UTC)
        for row in rows:
            self._rows.append(row | {"written": now})
            self._remember(row)
        self._now.add((rows[0]["digest"], rows[0]["joint"]))
        full = len(self._rows) >= _PART_ROWS
        if full or time.monotonic() - self._flushed > _FLUSH_S:
            self.flush()
        if full:
            self._rows, self._part = [], _new_part()

    def flush(self) -> None:
        """Write the appended rows.

        Raises:
            FleetError: the table cannot be written.
        """
        if not self._rows:
            return
        self._store.write(self._part, _bytes(pa.Table.from_pylist(self._rows, SCHEMA)))
        if self._part not in self._parts:
            self._parts.append(self._part)
        self._flushed = time.monotonic()

    def _remember(self, row: dict[str, Any]) -> None:
        failed = row["status"] != "done"
        known = Known(row["digest"], row["joint"], row["version"], failed, row["accepted_model"])
        self._by_place[(row["recording"], row["size_bytes"], row["stamp"])] = known
        self._by_content[known[:2]] = known
        same = self._sizes.setdefault(row["size_bytes"], set())
        (same.discard if failed else same.add)(known[:2])

    def _compact(self) -> None:
        """Rewrite the parts that are not full or have rows that were replaced; parts of other runs stay."""
        index = [_read(self._store, part, _INDEX).to_pylist() for part in self._parts]
        current = iter(_current([row for rows in index for row in rows]))
        masks = [list(islice(current, len(rows))) for rows in index]
        again = [k for k, mask in enumerate(masks) if len(mask) < _PART_ROWS or not all(mask)]
        if len(again) < 2 and all(all(masks[k]) for k in again):
            return
        kept = [_read(self._store, self._parts[k]).filter(pa.array(masks[k], pa.bool_())) for k in again]
        whole = pa.concat_tables(kept)
        for begin in range(0, whole.num_rows, _PART_ROWS):
            self._store.write(_new_part(), _bytes(whole.slice(begin, _PART_ROWS)))
        for k in again:
            self._store.remove(self._parts[k])


def _current(rows: list[dict[str, Any]]) -> list[bool]:
    """Return whether each row is the newest of its content and, if it is an error, of its recording."""
    of_content: dict[_Key, datetime] = {}
    of_place: dict[str, datetime] = {}
    for row in rows:
        key, place, written = (row["digest"], row["joint"]), row["recording"], row["written"]
        of_content[key] = max(of_content.get(key, written), written)
        of_place[place] = max(of_place.get(place, written), written)
    seen: set[str] = set()  # a kill in the middle of a compaction leaves rows twice
    found = []
    for row in rows:
        newest = row["written"] == of_content[row["digest"], row["joint"]]
        newest &= row["status"] == "done" or row["written"] == of_place[row["recording"]]
        found.append(newest and row["id"] not in seen)
        seen |= {row["id"]} if newest else set()
    return found


def read_rows(store: Store, columns: list[str] | None = None) -> list[dict[str, Any]]:
    """Return the rows of a table, without those that were replaced, in order of time.

    Raises:
        FleetError: there is none, or a part cannot be read.
    """
    parts = store.names(FOLDER, ".parquet")
    if not parts:
        raise FleetError(
            f"{store.url}: expected a table of `drivelink fleet` ({FOLDER}/*.parquet), found none"
        )
    names = None if columns is None else list(dict.fromkeys([*columns, "time", *_INDEX]))
    rows = [row for part in parts for row in _read(store, part, names).to_pylist()]
    epoch = datetime.fromtimestamp(0, UTC)
    kept = compress(rows, _current(rows))
    return sorted(kept, key=lambda row: (row["time"] or epoch, row["recording"], row["id"]))


def _read(store: Store, part: str, columns: list[str] | None = None) -> Any:
    """Read a part; columns missing in an older version are empty."""
    wanted = SCHEMA if columns is None else pa.schema([SCHEMA.field(name) for name in columns])
    content, where = store.read(part), f"{store.url}/{part}"
    try:
        about = pq.read_metadata(io.BytesIO(content))
        groups = [about.row_group(k) for k in range(about.num_row_groups)]
        rows = sum(group.num_rows for group in groups)
        if not 0 <= rows <= _MOST_ROWS:
            raise FleetError(f"{where}: expected at most {_MOST_ROWS} rows, got {rows}")
        _require_memory(_MOST_BYTES - sum(group.total_byte_size for group in groups), where)
        table = pa.Table.from_batches(_batches(content, wanted, where), wanted)
        table.validate(full=True)  # texts are UTF-8
    except (pa.ArrowException, OSError, KeyError, ValueError) as error:  # also of UTF-8, and twice a column
        raise FleetError(f"{where}: expected a Parquet file of drivelink: {error}") from error
    for name in _NEVER_EMPTY:
        if name in table.column_names and table[name].null_count:
            raise FleetError(
                f"{where}: expected a value in each row of {name}, got {table[name].null_count} without"
            )
    return table


def _require_memory(left: int, where: str) -> None:
    if left < 0:
        raise FleetError(f"{where}: expected rows of at most {_MOST_BYTES >> 20} MiB in memory, got more")


def _batches(content: bytes, schema: Any, where: str) -> Iterator[Any]:
    """Yield some rows after the other: a text may stand in the file once for thousands of them."""
    file, left = pq.ParquetFile(pa.BufferReader(content)), _MOST_BYTES
    present = set(file.schema_arrow.names)
    columns = [name for name in schema.names if name in present]
    for batch in file.iter_batches(_AT_ONCE, columns=columns, use_threads=False):
        left -= batch.nbytes
        _require_memory(left, where)
        arrays = [
            batch.column(one.name).cast(one.type) if one.name in present else pa.nulls(len(batch), one.type)
            for one in schema
        ]
        yield pa.RecordBatch.from_arrays(arrays, schema=schema)


def _bytes(table: Any) -> bytes:
    pq.write_table(table, sink := io.BytesIO(), compression="zstd")
    return sink.getvalue()


def _new_part() -> str:
    """Return the name of a new part; names sort in order of writing."""
    return f"{FOLDER}/part-{datetime.now(UTC):%Y%m%dT%H%M%S%f}-{uuid4().hex[:8]}.parquet"


def _locked(store: Store) -> int | None:
    """Return a lock for changing existing parts; None if another run has it.

    Remote storage has none: each run writes its own part.
    """
    if store.folder is None:
        return None
    folder = store.folder / FOLDER
    with raised_as(FleetError, f"{folder}: cannot be written"):
        folder.mkdir(parents=True, exist_ok=True)
        descriptor = os.open(folder / ".lock", os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        with contextlib.suppress(OSError):
            os.close(descriptor)
        return None
    return descriptor
