"""`--map q_link=link_position_rad:deg`: maps foreign columns to our names and units."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

from drivelink.errors import RecordingError, UsageError
from drivelink.recording.columns import KNOWN
from estimator.sample import FloatArray

_REVOLUTION = 2.0 * math.pi

UNITS: dict[str, dict[str, float]] = {
    "_rad_s": {
        "rad/s": 1.0,
        "mrad/s": 1e-3,
        "deg/s": _REVOLUTION / 360.0,
        "rpm": _REVOLUTION / 60.0,
        "rev/s": _REVOLUTION,
        "m/s": 1.0,
        "mm/s": 1e-3,
    },
    "_rad": {
        "rad": 1.0,
        "mrad": 1e-3,
        "urad": 1e-6,
        "deg": _REVOLUTION / 360.0,
        "rev": _REVOLUTION,
        "m": 1.0,
        "mm": 1e-3,
        "um": 1e-6,
    },
    "_nm": {"Nm": 1.0, "mNm": 1e-3, "kNm": 1e3, "Ncm": 1e-2, "N": 1.0, "mN": 1e-3, "kN": 1e3},
    "_a": {"A": 1.0, "mA": 1e-3},
    "_s": {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "min": 60.0, "h": 3600.0},
}
"""Accepted units with their SI values, by the ending of a column's name; a linear axis has m and N."""


class _Source(NamedTuple):
    """Source of one of our columns: SI value = factor * value in the file."""

    column: str
    factor: float


ColumnMap = Mapping[str, _Source]
"""Our columns, each with its source."""


def parse_column_map(texts: Sequence[str]) -> ColumnMap:
    """Parse `--map` options `SOURCE=COLUMN[:UNIT]`; a number as unit is a factor.

    Raises:
        UsageError: another form.
    """
    found: dict[str, _Source] = {}
    for text in texts:
        source, equals, target = text.rpartition("=")
        name, _, unit = target.partition(":")
        if not equals or not source.strip() or name not in KNOWN:
            raise UsageError(
                f"--map: expected SOURCE=COLUMN[:UNIT] like q_link=link_position_rad:deg, with COLUMN one of "
                f"{', '.join(sorted(KNOWN))}; got {text!r}"
            )
        if name in found:
            raise UsageError(f"--map: {name} is given twice, as {found[name].column} and {source}")
        found[name] = _Source(source.strip(), _factor(name, unit))
    return found


def _factor(name: str, unit: str) -> float:
    if not unit:
        return 1.0
    units = next(units for ending, units in UNITS.items() if name.endswith(ending))
    if unit in units:
        return units[unit]
    try:
        factor = float(unit)
    except ValueError:
        factor = 0.0
    if factor == 0.0 or not math.isfinite(factor):
        raise UsageError(f"--map: {name}: expected one of {', '.join(units)}, or a factor; got {unit!r}")
    return factor


def renamed(columns: Mapping[str, FloatArray], names: ColumnMap, where: str) -> dict[str, FloatArray]:
    """The columns under our names in SI units; sources are no longer available by their own names.

    Raises:
        RecordingError: a source is missing.
    """
    for name, source in names.items():
        if source.column not in columns:
            raise RecordingError(
                f"{where}: --map {source.column}={name}: no such column, found {', '.join(columns)}"
            )
    used = {source.column for source in names.values()}
    kept = {name: values for name, values in columns.items() if name not in used and name not in names}
    return kept | {name: columns[source.column] * source.factor for name, source in names.items()}
