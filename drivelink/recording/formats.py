"""The formats of recordings, by the ending of the file's name: reader of columns (CSV), writer.

A file is read line by line; only the numbers of known columns are kept in memory.
"""

import csv
import logging
import math
from array import array
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import IO, NamedTuple

import numpy as np

from drivelink.errors import RecordingError, raised_as
from drivelink.files import open_regular
from drivelink.jointfile import JointFile
from drivelink.jointfile.columns import COLUMNS
from drivelink.plaintext import some
from drivelink.recording.canlog import CAN_FORMATS
from drivelink.recording.columns import ColumnMap
from drivelink.recording.limits import MAX_COLUMNS, require_samples, whole_lines
from drivelink.recording.sinks import CanSink, CsvSink, McapSink, Sink
from estimator.sample import FloatArray

_LOG = logging.getLogger("drivelink.recording")

_EMPTY = frozenset({"", "null", "none", "n/a", "#n/a", "na", "-"})  # cells without a value, in lower case


def read_csv_columns(path: Path, names: ColumnMap) -> tuple[dict[str, FloatArray], tuple[str, ...]]:
    """Read the known columns (docs/reference/recordings.md); an empty cell is NaN.

    Accepts comma, semicolon, tab or spaces as separator, decimal commas but with commas, a byte-order mark,
    Windows-1252, and `#` comments. A last line without end is omitted, because it may be incomplete.

    Args:
        names: columns with other names in the file.

    Returns:
        (rows,) values of each by its name in the file, and the names of the others.

    Raises:
        RecordingError: no header, a cell that is not a number, a line with another number of columns, or too
            many lines or columns.
    """
    with raised_as(RecordingError, f"{path}: cannot be read"), open_regular(path) as file:
        layout, rows = _opened(file, path, names)
        values, count = array("d"), 0
        for count, row in enumerate(rows, start=1):
            require_samples(count, str(path))
            values.extend(row)
    if not count:
        raise RecordingError(f"{path}: expected samples below the header, got none")
    table = np.frombuffer(values).reshape(count, -1)
    columns = {name: np.ascontiguousarray(table[:, k]) for k, name in enumerate(layout.used)}
    return columns, tuple(name for name in layout.names if name not in columns)


def first_row(path: Path, names: ColumnMap) -> dict[str, FloatArray]:
    """Read the known columns of the first row, as `read_csv_columns` does of all."""
    with open_regular(path) as file:
        layout, rows = _opened(file, path, names)
        return dict(zip(layout.used, np.reshape(next(rows), (-1, 1)), strict=True))


class _Layout(NamedTuple):
    """The columns of a file."""

    names: tuple[str, ...]  # of all of them
    used: tuple[str, ...]  # of those that are read
    places: tuple[int, ...]  # their indices
    separator: str  # between columns


def _opened(file: IO[bytes], path: Path, names: ColumnMap) -> tuple[_Layout, Iterator[list[float]]]:
    """Return the layout of a file, and its rows."""
    known = COLUMNS | {source.column for source in names.values()}
    header, line = _header(file, path, known)
    layout = _layout(header, path, known)
    return layout, _rows(file, layout, path, line)


def _header(file: IO[bytes], path: Path, known: frozenset[str]) -> tuple[str, int]:
    """Header line, and the number of the line after it."""
    for number, line in enumerate(whole_lines(file, path), start=1):
        if number == 1 and line.startswith((b"\xff\xfe", b"\xfe\xff")):
            raise RecordingError(f"{path}: expected UTF-8 text, got UTF-16 (save it as plain CSV)")
        text = _text(line.removeprefix(b"\xef\xbb\xbf")).strip()
        header = text.lstrip("# ")
        if not header or (number == 1 and header.startswith("sep=")):  # a spreadsheet's separator
            continue
        # A comment that names time, position and torque is the header: so numpy.savetxt writes it.
        if header == text or len(known.intersection(_names(header)[0])) >= 3:
            if b"\0" in line:
                break
            return header, number + 1
    raise RecordingError(f"{path}: expected a CSV file with a line of column names, got no text")


def _text(line: bytes) -> str:
    """Return a line that is UTF-8, or of Windows' western code page."""
    try:
        return line.decode()
    except UnicodeDecodeError:
        return line.decode("cp1252", errors="replace")


def _names(header: str) -> tuple[tuple[str, ...], str]:
    """Return the names in a header, and what separates them."""
    separator = max(",;\t", key=header.count)
    if separator not in header and len(words := header.split()) > 1:
        return tuple(words), " "
    return tuple(name.strip().strip("\"'").strip() for name in header.split(separator)), separator


def _layout(header: str, path: Path, known: frozenset[str]) -> _Layout:
    names, separator = _names(header)
    if len(names) > MAX_COLUMNS:
        raise RecordingError(f"{path}: expected at most {MAX_COLUMNS} columns, got {len(names)}")
    used = tuple(name for name in names if name in known)
    if not used:
        raise RecordingError(
            f"{path}: expected a header with time_s, motor1_position_rad, motor1_torque_nm, …, found "
            f"{some(names, 40)} ([recording.columns] of the joint file says which is which)"
        )
    if twice := {name for name in names if name and names.count(name) > 1}:
        raise RecordingError(f"{path}: column {min(twice)} appears twice")
    return _Layout(names, used, tuple(map(names.index, used)), separator)


def _rows(file: IO[bytes], layout: _Layout, path: Path, first_line: int) -> Iterator[list[float]]:
    """The numbers of each row, of the columns that are read."""
    lines = map(_bare, whole_lines(file, path, first_line))
    reader = csv.reader(lines, delimiter=layout.separator, skipinitialspace=True)
    try:
        for cells in reader:
            if len(cells) == len(layout.names):
                yield _row(cells, layout)
            elif "".join(cells).strip():
                raise ValueError(f"expected {len(layout.names)} columns, got {len(cells)}")
    except (csv.Error, ValueError) as error:
        raise RecordingError(f"{path}: line {first_line + reader.line_num - 1}: {error}") from error


def _bare(line: bytes) -> str:
    """Return a row without a comment and the spaces around it; `#N/A` in a cell is none."""
    text = line.decode(errors="replace").strip(" \r\n")
    return "" if text.startswith("#") else text.partition(" #")[0].rstrip(" ")


def _row(cells: list[str], layout: _Layout) -> list[float]:
    try:
        return [float(cells[place] or "nan") for place in layout.places]
    except ValueError:  # a decimal comma, or a word
        return [_number(cells[k].strip(), name) for k, name in zip(layout.places, layout.used, strict=True)]


def _number(cell: str, name: str) -> float:
    try:
        return math.nan if cell.lower() in _EMPTY else float(cell.replace(",", "."))
    except ValueError:
        raise ValueError(f"{name}: expected a number, got {cell[:40]!r}") from None


Columns = tuple[dict[str, FloatArray], tuple[str, ...]]


class Format(NamedTuple):
    """A format of recordings."""

    holds: str  # in a few words
    sink: Callable[..., Sink] | None = None  # its writer; None: only read
    # reads columns by their names in the file, and names of those left out; None: it has none
    columns: Callable[[Path, ColumnMap], Columns] | None = None
    # whether it is text, some thirty times smaller than the memory that its analysis takes
    text: bool = False


FORMATS = {
    ".mcap": Format("samples, estimates, status, model, joint file, mapping, raw CAN", McapSink),
    ".csv": Format("samples", CsvSink, read_csv_columns, text=True),
} | {
    suffix: Format(f"raw CAN, {kind.tool}", CanSink if kind.writer else None, text=kind.text)
    for suffix, kind in CAN_FORMATS.items()
}


CONVERTERS = {
    ".mf4": 'python -c "from asammdf import MDF; '
    "MDF('{0}').to_dataframe().to_csv('{0}.csv', index_label='time_s')\"",
    ".trc": "can_logconvert {0} {0}.log",
}
"""Command lines that make a recording of a file in another format, by its ending."""


def open_sink(path: Path, joint: JointFile, joint_text: str = "", *, force: bool = False) -> Sink:
    """Open the writer for the file's ending.

    Args:
        joint_text: its joint file, stored if the format allows.

    Raises:
        RecordingError: no such format, or the file cannot be written.
    """
    kind = FORMATS.get(path.suffix.lower())
    if kind is None or kind.sink is None:
        written = [ending for ending, one in FORMATS.items() if one.sink]
        raise RecordingError(f"{path}: expected a name that ends in {', '.join(written)}")
    return kind.sink(path, joint, joint_text, force=force)
