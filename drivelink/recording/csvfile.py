"""Recordings as CSV: fast where the file is clean, forgiving where spreadsheets and crashes left marks."""

from __future__ import annotations

import io
import logging
import re
from pathlib import Path

import numpy as np

from drivelink.errors import RecordingError
from drivelink.jointfile import JointFile
from drivelink.recording.columns import KNOWN, record_from_columns
from estimator.sample import FloatArray, Record

__all__ = ["read_csv", "read_csv_columns"]

_LOG = logging.getLogger("drivelink.recording")

_EMPTY = re.compile(rb"(?:(?<=,)|(?<=\n)|^)[ \t]*(?:null|none|n/a|na|-)?[ \t\r]*(?=,|\n|$)", re.IGNORECASE)


def read_csv(path: Path, joint: JointFile | None = None, keep_nan: bool = False) -> Record:
    """Read a CSV recording (columns as in docs/recordings.md).

    Raises:
        RecordingError: it cannot be read, or lacks what is needed.
    """
    return record_from_columns(read_csv_columns(path), str(path), joint, keep_nan)


def read_csv_columns(path: Path) -> dict[str, FloatArray]:
    """(rows,) values of each column by its name; an empty cell is NaN.

    Comma, semicolon or tab between the columns, decimal commas with the latter two, a byte-order mark,
    `#` comments before the header, and a last line that a crash cut off are understood.

    Raises:
        RecordingError: no header, a cell that is no number, or a line with another number of columns.
    """
    try:
        text = path.read_bytes()
    except OSError as error:
        raise RecordingError(f"{path}: cannot be read: {error.strerror}") from error
    header, body, line = _split_header(text, path)
    names, body = _columns(header, body, path)
    body, cut = _without_cut_line(body, len(names))
    if cut:
        _LOG.warning("%s: the last line is cut off and left out", path)
    table = _numbers(body, names, path, line)
    return {name: np.ascontiguousarray(table[:, k]) for k, name in enumerate(names)}


def _split_header(text: bytes, path: Path) -> tuple[str, bytes, int]:
    """Header line, what follows it, and the line number of the latter's first line."""
    if text.startswith((b"\xff\xfe", b"\xfe\xff")):
        raise RecordingError(f"{path}: expected UTF-8 text, got UTF-16 (save it as plain CSV)")
    text = text.removeprefix(b"\xef\xbb\xbf")
    number = 0
    while text:
        line, _, text = text.partition(b"\n")
        number += 1
        if line.strip() and not line.lstrip().startswith(b"#"):
            if b"\0" in line:
                break
            return line.decode("utf-8", errors="replace").strip(), text, number + 1
    raise RecordingError(f"{path}: expected a CSV file with a line of column names, got no text")


def _columns(header: str, body: bytes, path: Path) -> tuple[list[str], bytes]:
    """Column names, and the body with commas between its columns."""
    separator = max(",;\t", key=header.count)
    names = [name.strip().strip("\"'").strip() for name in header.split(separator)]
    if not KNOWN.intersection(names):
        raise RecordingError(
            f"{path}: expected a header with time_s, motor1_position_rad, motor1_torque_nm, …, "
            f"got {header[:60]!r}"
        )
    twice = {name for name in names if name and names.count(name) > 1}
    if twice:
        raise RecordingError(f"{path}: column {min(twice)} appears twice")
    if separator != ",":
        body = body.replace(b",", b".").replace(separator.encode(), b",")
    return names, body.replace(b"\r\n", b"\n")


def _without_cut_line(body: bytes, width: int) -> tuple[bytes, bool]:
    body = body.rstrip(b" \t\r\n\0")
    begin = body.rfind(b"\n") + 1
    if begin and body.count(b",", begin) < width - 1:
        return body[:begin], True
    return body, False


def _numbers(body: bytes, names: list[str], path: Path, first_line: int) -> FloatArray:
    if not body.strip():
        raise RecordingError(f"{path}: expected samples below the header, got none")
    for attempt in ("as it is", "with empty cells filled"):
        text = body if attempt == "as it is" else _EMPTY.sub(b"nan", body)
        try:
            table = np.loadtxt(
                io.BytesIO(text), dtype=np.float64, delimiter=",", ndmin=2, comments="#", quotechar='"'
            )
        except ValueError:
            continue
        if table.shape[1] == len(names):
            return table
    raise RecordingError(_wrong_line(body, names, path, first_line))


def _wrong_line(body: bytes, names: list[str], path: Path, first_line: int) -> str:
    """Say which line and cell is wrong: the slow look, after the fast reading failed."""
    for number, line in enumerate(body.split(b"\n"), first_line):
        if not line.strip() or line.lstrip().startswith(b"#"):
            continue
        cells = line.decode("utf-8", errors="replace").split(",")
        if len(cells) != len(names):
            return f"{path}: line {number}: expected {len(names)} columns, got {len(cells)}"
        for name, cell in zip(names, cells, strict=True):
            try:
                float(cell.strip().strip('"') or "nan")
            except ValueError:
                return f"{path}: line {number}: {name}: expected a number, got {cell.strip()[:40]!r}"
    return f"{path}: cannot be read as CSV"
