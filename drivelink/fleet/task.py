"""The task on a worker: one recording, in parts that fit into its memory, to rows of the table."""

import csv
import logging
import math
import re
import signal
import socket
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import unquote

from drivelink import __version__, recording
from drivelink.errors import DrivelinkError, RecordingError
from drivelink.fleet.analysis import analyse
from drivelink.fleet.joints import Joint, Joints
from drivelink.fleet.storage import Source, fetched
from drivelink.jointfile import JointFile
from drivelink.output.report import Title
from drivelink.recording.canframes import FrameLog, is_frame_log
from drivelink.recording.canlog import CAN_SUFFIXES, read_frames
from drivelink.recording.columns import column_map, renamed, sample_columns, sample_row
from drivelink.recording.corrections import gate
from drivelink.recording.cycles import Cycle
from drivelink.recording.formats import FORMATS, first_row
from drivelink.recording.mcapfile import read_messages, recorded_cycles
from estimator.errors import EstimatorError
from estimator.sample import Record

# Rise of the peak memory of fit, diagnosis and report over that of the file's size. Of a CSV it is measured
# (26 at 1 kHz, benchmarks/fleet_memory.py) and rounded up. A text log has about as
# many bytes a sample, compressed formats have a fraction.
_EXPANSION_TEXT, _EXPANSION_OTHER = 30.0, 100.0
_BASE_BYTES = 550 << 20  # memory of a worker without a recording: interpreter, libraries, Dask, caches
_LEAST_BYTES = 64 << 20  # minimum for a part, which must contain enough motion
_USED = 0.7  # share of the limit that is used: Dask pauses a worker at 0.8 and ends it at 0.95


def dask_setup(worker: object) -> None:
    """Leave Ctrl-C, and what the joint files are warned of, to the client; Dask calls it in its workers."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    logging.getLogger("drivelink.jointfile").setLevel(logging.ERROR)


def pieces(
    path: Path, joint: JointFile, base_dir: Path, limit_bytes: float
) -> Iterator[tuple[Record, int, int]]:
    """Read a recording, in equal parts in time if it does not fit: each, its number from 1, and how many.

    Args:
        base_dir: folder in which the joint's EDS files are found.
        limit_bytes: memory of the worker; not above 0: no limit.

    Raises:
        RecordingError: it cannot be read, or is too large in a format that cannot be split.
    """
    parts = _parts(path, limit_bytes)
    if parts == 1:
        yield recording.read(path, joint, base_dir=base_dir), 1, 1
        return
    logging.getLogger("drivelink.fleet").warning(
        "%s: larger than the memory of a worker: cut into %d parts", path.name, parts
    )
    with tempfile.TemporaryDirectory(prefix="drivelink-parts-") as folder:
        table = path if path.suffix.lower() == ".csv" else _as_csv(path, joint, base_dir, Path(folder))
        for number, piece in enumerate(_cut(table, parts, Path(folder) / path.with_suffix(".csv").name), 1):
            yield recording.read(piece, joint, base_dir=base_dir), number, parts


def _parts(path: Path, limit_bytes: float) -> int:
    if limit_bytes <= 0:
        return 1
    budget = max(_USED * limit_bytes - _BASE_BYTES, min(_LEAST_BYTES, limit_bytes))
    kind = FORMATS.get(path.suffix.lower(), FORMATS[".csv"])
    needed = path.stat().st_size * (_EXPANSION_TEXT if kind.text else _EXPANSION_OTHER)
    return max(1, math.ceil(needed / budget))


def _as_csv(path: Path, joint: JointFile, base_dir: Path, folder: Path) -> Path:
    """Convert the samples of a recording to CSV, cycle by cycle."""
    motors = len(joint.motor)
    cycles: Iterator[Cycle]
    if is_frame_log(path):
        log = FrameLog(path, joint, base_dir)
        cycles, period_s = log.cycles(), log.period_s
    elif path.suffix.lower() == ".mcap":
        cycles, period_s = recorded_cycles(path, motors), joint.bus.period_s
    else:
        raise RecordingError(f"{path}: larger than the memory of a worker, and {path.suffix} cannot be cut")
    target = folder / "samples.csv"
    with target.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(sample_columns(motors))
        writer.writerows(sample_row(c.sample, period_s) for c in cycles if c.sample is not None)
    return target


def _cut(table: Path, parts: int, target: Path) -> Iterator[Path]:
    """Split a CSV into parts of about the same size, each with the header; one temporary file is reused."""
    share = math.ceil(table.stat().st_size / parts)
    with table.open("rb") as file:
        head = []
        for line in file:
            head.append(line)
            if line.strip() and not line.lstrip().startswith(b"#"):
                break
        lines: Iterator[bytes] = iter(file)
        while (first := next(lines, None)) is not None:
            with target.open("wb") as out:
                size = 0
                out.writelines(head)
                for line in chain([first], lines):
                    out.write(line)
                    size += len(line)
                    if size >= share:
                        break
            yield target


HELD_OUT = "held-out blocks"

_UNIX = 1.0e9  # larger stamps are UNIX time (from 2001 on)
_DATE = re.compile(
    r"(?<!\d)(20\d\d)[-_.]?(0[1-9]|1[0-2])[-_.]?(0[1-9]|[12]\d|3[01])"
    r"(?:[T_ -]?([01]\d|2[0-3])[-:._]?([0-5]\d)(?:[-:._]?([0-5]\d))?)?(?!\d)"
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Task:
    """Input of a task."""

    source: Source
    version: str  # required version of drivelink
    # finished contents of the same size, with their joints
    done: frozenset[tuple[str, str | None]] = frozenset()
    previous: Source | None = None  # the joint's previous recording, for validation
    since: datetime | None = None  # omit earlier recordings
    limit_bytes: float = 0.0  # memory of a worker; 0: Dask's limit


class Outcome(NamedTuple):
    """What came of it."""

    # "done", "error", "known" (the same content is in the table already) or "early" (before `since`)
    kind: str
    rows: list[dict[str, Any]]  # for the table
    reports: list[tuple[str, str]]  # (name below the result folder, content)
    notes: list[str]  # messages for the user


def process(task: Task, joints: Joints) -> Outcome:
    """Fetch, identify, read, fit, diagnose. An error becomes a row."""
    begin, start = time.process_time(), time.monotonic()
    row: dict[str, Any] = broken_row(task, "")
    where = task.source.url
    with _notes() as notes:
        try:
            if task.version != __version__:
                raise DrivelinkError(
                    f"expected drivelink {task.version} on worker {socket.gethostname()}, got {__version__}"
                )
            with fetched(task.source) as (path, digest):
                where = str(path)  # a copy, where it comes from elsewhere
                joint = joints.of(path, task.source.url)
                row |= {"joint": joint.name, "accepted_model": joint.digest}
                if (digest, joint.name) in task.done:
                    return Outcome("known", [], [], [])
                row["time"] = recorded_time(path, task.source, joint.file)
                if task.since and row["time"] and row["time"] < task.since:
                    return Outcome("early", [], [], [])
                rows, reports = _results(task, joint, path, row | {"digest": digest})
        except (DrivelinkError, EstimatorError, OSError) as error:
            line = str(error).replace(f"{where}: ", "").replace(f"{task.source.url}: ", "")
            return _broken(row, line, notes, begin)
        except MemoryError:
            return _broken(row, "does not fit into the memory of a worker", notes, begin)
        except Exception as error:  # noqa: BLE001 - one recording never ends the run
            return _broken(row, f"unexpected {type(error).__name__}: {error}", notes, begin)
    for one in rows:
        one["cpu_s"] = (time.process_time() - begin) / len(rows)
        one["wall_s"] = (time.monotonic() - start) / len(rows)
    return Outcome("done", rows, reports, notes)


def broken_row(task: Task, error: str) -> dict[str, Any]:
    """Return the row of a recording that could not be read: each is one, also where nights failed alike."""
    time_ = named_time(task.source) or task.source.modified
    place = f"{task.source.url}|{task.source.size}|{task.source.stamp}"
    return {
        "id": f"broken-{place}",
        "joint": None,
        "time": time_,
        "recording": task.source.url,
        "digest": f"unread-{place}",
        "size_bytes": task.source.size,
        "stamp": task.source.stamp,
        "status": "error",
        "error": error,
        "accepted_model": None,
        "worker": socket.gethostname(),
        "version": task.version,
    }


def _broken(row: dict[str, Any], error: str, notes: list[str], begin: float) -> Outcome:
    line = " ".join(error.split())
    return Outcome("error", [row | {"error": line, "cpu_s": time.process_time() - begin}], [], notes)


def _results(
    task: Task, joint: Joint, path: Path, row: dict[str, Any]
) -> tuple[list[dict[str, Any]], list[tuple[str, str]]]:
    """Return the rows of a recording, and its reports."""
    rows, reports = [], []
    file, limit = joint.file, task.limit_bytes or _declared_limit()
    with joint.base_dir() as base, _validation(task, joint, base) as validation:
        where = HELD_OUT if validation is None or task.previous is None else task.previous.url
        begin: float | None = None
        for record, number, parts in pieces(path, file, base, limit):
            at = record.start_s + float(record.sequence[0]) * record.period_s
            begin = at if begin is None else begin
            name, suffix = task.source.name, ""
            if parts > 1:
                name, suffix = f"{name}, part {number} of {parts}", f"-{number}"
            held = None if validation is None else where
            title = Title(joint.name, name, held, file.axis == "linear")
            remarks = gate(path, file, record, strict=True)
            analysis = analyse(record, file, validation, title, remarks)
            folder = f"diagnoses/{joint.name}/{row['digest'][:24]}{suffix}"
            common = row | analysis.joint | {
                "status": "done", "error": None, "part": number, "parts": parts,
                "axis": file.axis, "validated_on": where, "report": f"{folder}/report.html",
                "time": row["time"] and row["time"] + timedelta(seconds=at - begin),
            }  # fmt: skip
            for one in analysis.transmissions:
                own = f"{row['digest'][:24]}-{joint.name}-{one['transmission']}{suffix}"
                rows.append(common | one | {"id": own})
            reports.append((f"{folder}/report.json", analysis.report_json))
            reports.append((f"{folder}/report.html", analysis.report_html))
    return rows, reports


@contextmanager
def _validation(task: Task, joint: Joint, base: Path) -> Iterator[Record | None]:
    """The joint's previous recording; None, with a note, if it cannot be read."""
    if task.previous is None:
        yield None
        return
    record = None
    try:
        with fetched(task.previous) as (path, _):
            read = recording.read(path, joint.file, base_dir=base)
            gate(path, joint.file, read, strict=True)
            record = read
    except (DrivelinkError, OSError) as error:
        logging.getLogger("drivelink.fleet").warning("validated on held-out blocks: %s", error)
    yield record


def named_time(source: Source) -> datetime | None:
    """Return the date and, if present, time (UTC) in the name of a file or of a folder above."""
    for part in reversed(re.split(r"[/\\]", unquote(source.url))):
        for match in _DATE.finditer(part):
            year, month, day, hour, minute, second = (int(text or 0) for text in match.groups())
            try:
                return datetime(year, month, day, hour, minute, second, tzinfo=UTC)
            except ValueError:
                continue
    return None


def recorded_time(path: Path, source: Source, joint: JointFile | None = None) -> datetime | None:
    """Return the time of a recording: UNIX stamps, else the date in its name, else its modification time."""
    stamp_s = 0.0
    suffix = path.suffix.lower()
    if suffix == ".mcap":
        message = next(iter(read_messages(path, frozenset({"sample", "can"}))), None)
        stamp_s = message.log_time_ns * 1e-9 if message else 0.0
    elif suffix in CAN_SUFFIXES:
        frame = next(iter(read_frames(path, configured=joint.bus.channel if joint else "")), None)
        stamp_s = frame.stamp_ns * 1e-9 if frame else 0.0
    elif suffix == ".csv":
        with suppress(DrivelinkError, KeyError, IndexError, StopIteration):
            names = column_map(joint, None)
            stamp_s = float(renamed(first_row(path, names), names, path.name)["time_s"][0])
    if _UNIX < stamp_s < 1e11:
        return datetime.fromtimestamp(stamp_s, UTC)
    return named_time(source) or source.modified


def _declared_limit() -> float:
    """Dask's memory limit of this worker; 0: none, or not a worker."""
    from distributed import get_worker

    try:
        manager = getattr(get_worker(), "memory_manager", None)
    except ValueError:
        return 0.0
    return float(getattr(manager, "memory_limit", None) or 0.0)


@contextmanager
def _notes() -> Iterator[list[str]]:
    """Collect the readers' warnings as lines."""
    lines: list[str] = []

    class Collect(logging.Handler):
        def emit(self, record: logging.LogRecord) -> None:
            lines.append(record.getMessage())

    handler, logger = Collect(logging.WARNING), logging.getLogger("drivelink")
    before = logger.propagate
    logger.addHandler(handler)
    logger.propagate = False
    try:
        yield lines
    finally:
        logger.removeHandler(handler)
        logger.propagate = before
