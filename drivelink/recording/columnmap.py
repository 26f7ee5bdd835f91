"""Columns of others under our names, in SI: `--map q=link_position_rad:deg`, or `[recording.columns]`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

from drivelink.errors import RecordingError, UsageError
from drivelink.jointfile import JointFile
from drivelink.jointfile.columns import COLUMNS, si_factor
from estimator.sample import FloatArray


class Source(NamedTuple):
    """Source of one of our columns: SI value = factor * value in the file."""

    column: str  # its name in the file
    factor: float  # SI value of its unit, with its sign
    # by `--map`: it has to be there. Else our own name is taken where the source is missing.
    asked: bool = True


ColumnMap = Mapping[str, Source]
"""Our columns, each with its source."""


def parse_column_map(texts: Sequence[str]) -> ColumnMap:
    """Parse `--map` options `SOURCE=COLUMN[:UNIT]`; a number as unit is a factor.

    Raises:
        UsageError: another form.
    """
    found: dict[str, Source] = {}
    for text in texts:
        source, equals, target = text.rpartition("=")
        name, _, unit = target.partition(":")
        if not equals or not source.strip() or name not in COLUMNS:
            raise UsageError(
                f"--map: expected SOURCE=COLUMN[:UNIT] like q_link=link_position_rad:deg, with COLUMN one of "
                f"{', '.join(sorted(COLUMNS))}; got {text[:80]!r}"
            )
        if name in found:
            raise UsageError(f"--map: {name} is given twice, as {found[name].column[:80]} and {source[:80]}")
        try:
            found[name] = Source(source.strip(), si_factor(name, unit))
        except ValueError as error:
            raise UsageError(f"--map: {name}: {error}") from error
    return found


def column_map(joint: JointFile | None, asked: ColumnMap | None) -> ColumnMap:
    """Return the columns of the joint file, replaced by what `--map` asks for."""
    declared = joint.recording.columns if joint else {}
    return {
        name: Source(one.name, one.sign * si_factor(name, one.unit), asked=False)
        for name, one in declared.items()
    } | dict(asked or {})


def renamed(columns: Mapping[str, FloatArray], names: ColumnMap, where: str) -> dict[str, FloatArray]:
    """Return the columns under our names in SI units; sources are no longer available by their own names.

    Raises:
        RecordingError: a source is missing.
    """
    names = {
        name: source
        for name, source in names.items()
        if source.asked or source.column in columns or name not in columns
    }
    for name, source in names.items():
        if source.column not in columns:
            by = f"--map {source.column}={name}" if source.asked else f"recording.columns.{name}"
            raise RecordingError(
                f"{where}: {by}: no such column {source.column!r}, found {', '.join(columns)}"
            )
    used = {source.column for source in names.values()}
    kept = {name: values for name, values in columns.items() if name not in used and name not in names}
    return kept | {name: columns[source.column] * source.factor for name, source in names.items()}
