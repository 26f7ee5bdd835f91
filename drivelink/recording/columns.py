"""Converts a recording's named columns, of any file format, to a `Record`.

Columns of others become ours, in SI: `--map q=link_position_rad:deg`, or `[recording.columns]`.
"""

import difflib
import logging
import shlex
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from drivelink.errors import RecordingError, UsageError, raised_as
from drivelink.jointfile import JointFile
from drivelink.jointfile.columns import COLUMNS, OF_LINK, OF_MOTOR, si_factor, suits
from drivelink.plaintext import some
from drivelink.recording.grid import (
    Grid,
    NotUniformError,
    find_grid,
    report_gaps,
    resampled,
    stamps_are_instants,
)
from drivelink.recording.limits import require_samples
from estimator.errors import EstimatorError
from estimator.reasons import counted
from estimator.sample import FloatArray, Record, Sample


class Source(NamedTuple):
    """Source of one of our columns: SI value = factor * value in the file."""

    column: str  # its name in the file
    factor: float  # SI value of its unit, with its sign
    # by `--map`: it has to be there. Else our own name is taken where the source is missing.
    asked: bool = True
    unit: str | float = ""  # by which it was given


ColumnMap = Mapping[str, Source]
"""Our columns, each with its source."""


def parse_column_map(texts: Sequence[str]) -> ColumnMap:
    """Parse the `names` of columns `SOURCE=COLUMN[:UNIT]`; a number as unit is a factor.

    Raises:
        UsageError: another form.
    """
    found: dict[str, Source] = {}
    for text in (texts,) if isinstance(texts, str) else texts:
        source, equals, target = text.rpartition("=")
        name, _, unit = target.partition(":")
        if not equals or not source.strip() or name not in COLUMNS:
            raise UsageError(
                f"names: expected SOURCE=COLUMN[:UNIT] like q_link=link_position_rad:deg, with COLUMN one of "
                f"{', '.join(sorted(COLUMNS))}; got {text[:80]!r}"
            )
        if name in found:
            raise UsageError(f"names: {name} is given twice, as {found[name].column[:80]} and {source[:80]}")
        with raised_as(UsageError, f"names: {name}", ValueError):
            found[name] = Source(source.strip(), si_factor(name, unit), unit=unit)
    return found


def column_map(joint: JointFile | None, asked: ColumnMap | None) -> ColumnMap:
    """Return the columns of the joint file, replaced by what `--map` asks for.

    Raises:
        UsageError: a unit is none of the joint's axis.
    """
    declared = joint.recording.columns if joint else {}
    found = {
        name: Source(one.name, one.sign * si_factor(name, one.unit), asked=False, unit=one.unit)
        for name, one in declared.items()
    } | dict(asked or {})
    for name, source in found.items():
        if joint is not None and not suits(source.unit, joint.axis):
            fix = f"is no unit of a {joint.axis} axis: give the factor to SI"
            raise UsageError(f"{name}: {source.unit} {fix}")
    return found


def renamed(
    columns: Mapping[str, FloatArray], names: ColumnMap, where: str, unread: Sequence[str] = ()
) -> dict[str, FloatArray]:
    """Return the columns under our names in SI units; sources are no longer available by their own names.

    Args:
        names: of ours, where they come from.
        unread: names of its other columns.

    Raises:
        RecordingError: a source is missing.
    """
    names = {n: s for n, s in names.items() if s.asked or s.column in columns or n not in columns}
    for name, source in names.items():
        if source.column not in columns:
            by = f"--map {source.column}={name}" if source.asked else f"recording.columns.{name}"
            there = [*columns, *unread]
            near = difflib.get_close_matches(source.column, there, n=1)
            hint = f"; did you mean {near[0]}?" if near else ""
            raise RecordingError(
                f"{where}: {by}: no such column {source.column!r}, found {some(there, 40)}{hint}"
            )
    used = {source.column for source in names.values()}
    kept = {name: values for name, values in columns.items() if name not in used and name not in names}
    return kept | {name: columns[source.column] * source.factor for name, source in names.items()}


_LOG = logging.getLogger("drivelink.recording")


def sample_columns(motors: int) -> tuple[str, ...]:
    """Return the names of a sample's columns, in the order of `sample_row`."""
    per_motor = [f"motor{i}_{name}" for i in range(1, motors + 1) for name in OF_MOTOR[:3]]
    return ("time_s", *per_motor, *OF_LINK)


def sample_row(sample: Sample, period_s: float) -> tuple[float, ...]:
    """Return a sample as the values of `sample_columns`; its time is that of its SYNC, sequence * period."""
    sequence, position, velocity, torque, *of_link = sample
    per_motor = chain.from_iterable(zip(position, velocity, torque, strict=True))
    return (sequence * period_s, *per_motor, *of_link)


def record_of_samples(samples: Iterable[Sample], motors: int, period_s: float, where: str) -> Record:
    """Make a record of samples; a channel without a finite value is left out.

    Raises:
        RecordingError: fewer than three samples, or more periods from first to last than fit into memory.
    """
    names = ("sequence", *sample_columns(motors)[1:])

    def rows() -> Iterator[tuple[float, ...]]:
        first = None
        for sample in samples:
            first = sample.sequence if first is None else first
            require_samples(sample.sequence - first + 1, where)
            yield sample_row(sample, 1.0)

    table = np.fromiter(rows(), dtype=np.dtype((np.float64, len(names))))
    if len(table) < 3:
        raise RecordingError(f"{where}: expected at least 3 complete samples, got {len(table)}")
    columns = dict(zip(names, table.T, strict=True))

    def motor(name: str) -> FloatArray:
        return np.stack([columns[f"motor{i}_{name}"] for i in range(1, motors + 1)], axis=1)

    velocity = motor("velocity_rad_s")
    known = (name for name in OF_LINK if np.any(np.isfinite(columns[name])))
    link: dict[str, Any] = {name: np.ascontiguousarray(columns[name]) for name in known}
    return Record(
        period_s=period_s,
        sequence=columns["sequence"].astype(np.int64),
        motor_position_rad=motor("position_rad"),
        motor_torque_nm=motor("torque_nm"),
        motor_velocity_rad_s=velocity if np.any(np.isfinite(velocity)) else None,
        **link,
    )


def record_from_columns(
    columns: Mapping[str, FloatArray],
    where: str,
    joint: JointFile | None = None,
    keep_nan: bool = False,
    ignored: Sequence[str] = (),
) -> Record:
    """Make a record of named columns: find the grid, convert currents to torques, make NaN rows gaps.

    Args:
        columns: (rows,) each; names other than `COLUMNS` are ignored with a warning.
        joint: gives the number of motors, whether a link position is needed, and torque constants.
        keep_nan: keep rows with NaN, for use tick by tick.
        ignored: names of columns in the file that are not in `columns`.

    Raises:
        RecordingError: a column is missing, or the sampling is not uniform.
    """
    columns = {**columns, **dict.fromkeys(ignored, np.empty(0))}
    if unknown := [name for name in columns if name and name not in COLUMNS]:
        _LOG.warning("%s: ignored columns: %s", where, some(unknown, 40))
    factors = joint.recording.scale if joint else {}
    columns = {name: x * factors[name] if name in factors else x for name, x in columns.items()}
    table = _Table(columns, where, joint)
    numbers = range(1, table.motors() + 1)
    table.require("time_s")
    columns, grid = _on_grid(columns, where, joint.bus.period_s if joint else None)
    table.columns = {name: values[grid.keep] if values.size else values for name, values in columns.items()}
    positions = [table.needed(f"motor{i}_position_rad") for i in numbers]
    torques = [table.torque(i) for i in numbers]
    velocities = [table.known(f"motor{i}_velocity_rad_s") for i in numbers]
    link = {name: values for name in OF_LINK if (values := table.known(name)) is not None}
    if "link_position_rad" not in link and joint and joint.model().has_deflection:
        table.needed("link_position_rad")
    for i, position in zip(numbers, positions, strict=True):
        if np.nanmin(position) == np.nanmax(position):
            name = f"motor{i}_position_rad"
            _LOG.warning("%s: %s never changes: nothing moved, or the signal is not connected", where, name)
    usable = _usable([*positions, *torques, link.get("link_position_rad", positions[0])], where)
    rows = np.ones_like(usable) if keep_nan else usable

    def stacked(arrays: Sequence[FloatArray | None]) -> FloatArray:
        none = np.full(len(rows), np.nan)
        return np.ascontiguousarray(np.stack([none if x is None else x for x in arrays], axis=1)[rows])

    sequence = grid.sequence[rows]
    report_gaps(sequence, grid.period_s, where)
    if not keep_nan:  # use tick by tick does not allocate the gaps
        require_samples(int(sequence[-1]) + 1, where)
    with raised_as(RecordingError, where, EstimatorError):
        return Record(
            period_s=grid.period_s,
            sequence=sequence,
            motor_position_rad=stacked(positions),
            motor_torque_nm=stacked(torques),
            motor_velocity_rad_s=stacked(velocities) if any(v is not None for v in velocities) else None,
            start_s=grid.start_s,
            **{name: values[rows] for name, values in link.items()},
        )


def _on_grid(
    columns: Mapping[str, FloatArray], where: str, nominal_s: float | None
) -> tuple[Mapping[str, FloatArray], Grid]:
    """Number the rows, or resample them where the motion shows that their irregular stamps are right.

    Raises:
        RecordingError: the sampling is not uniform, and the motion does not follow the stamps either.
    """
    refused, grid = None, None
    try:
        grid = find_grid(columns["time_s"], where, nominal_s, _repeats(columns))
    except NotUniformError as error:
        refused = error
    if grid is not None and not grid.jittering:
        return columns, grid
    measured = {n: v for n, v in columns.items() if n in COLUMNS and v.size and np.any(np.isfinite(v))}
    rows = np.all(np.isfinite(list(measured.values())), axis=0)
    rows[rows] &= np.diff(measured["time_s"][rows], prepend=-np.inf) > 0.0
    position = measured.get("motor1_position_rad")
    time = measured["time_s"][rows]
    number = np.arange(len(time), dtype=float)
    if grid is not None:
        number = np.interp(np.flatnonzero(rows), np.flatnonzero(grid.keep), grid.sequence)
    if position is not None and stamps_are_instants(time, number, position[rows]):
        steps = np.diff(time)
        text = "%s: steps from %.3g s to %.3g s, and the motion follows the stamps: resampled every %.3g s"
        _LOG.warning(text, where, steps.min(), steps.max(), np.median(steps))
        again = resampled(measured, rows)
        return again, find_grid(again["time_s"], where, nominal_s)
    if grid is None:
        known = columns["time_s"][np.isfinite(columns["time_s"])]
        period_s = nominal_s or float(known[-1] - known[0]) / (len(known) - 1)
        raise RecordingError(f"{refused}{_renumber(where, period_s)}")
    text = "%s: the stamps jitter by up to %.2g periods: taken as arrival times of a uniform sampling"
    _LOG.warning(text, where, grid.jittering)
    return columns, grid


def _renumber(where: str, period_s: float) -> str:
    """Return what makes uniform samples of a table whose stamps say nothing of them."""
    path = Path(where)
    if path.suffix.lower() != ".csv":
        return ""
    target = path.with_stem(f"{path.stem}-numbered")
    return (
        ", and the motion does not follow them. If the samples are uniform, number them, time_s first: "
        f"awk -F, -v OFS=, 'NR > 1 {{ $1 = (NR - 2) * {period_s:.3g} }} 1' {shlex.quote(str(path))} > "
        f"{shlex.quote(str(target))}"
    )


@dataclass(slots=True)
class _Table:
    """The columns of a recording, (rows,) each; what is missing is an error with a hint."""

    columns: Mapping[str, FloatArray]
    where: str
    joint: JointFile | None

    def motors(self) -> int:
        """Return the number of motors: of the joint, or of the columns."""
        recorded = 2 if "motor2_position_rad" in self.columns else 1
        motors = recorded if self.joint is None else len(self.joint.motor)
        if motors < recorded:
            text = "%s: has a second motor, the joint file has not: its columns are ignored"
            _LOG.warning(text, self.where)
        return motors

    def known(self, name: str) -> FloatArray | None:
        """Return a column, infinities as NaN; None if it has no finite value."""
        values = self.columns.get(name)
        if values is None or not np.any(np.isfinite(values)):
            return None
        return np.where(np.isfinite(values), values, np.nan)

    def needed(self, name: str, other: str = "") -> FloatArray:
        """Return a column that has to be there.

        Raises:
            RecordingError: it is not, or has no number.
        """
        self.require(name, other)
        values = self.known(name)
        if values is None:
            raise RecordingError(f"{self.where}: column {name} holds no numeric value")
        return values

    def torque(self, number: int) -> FloatArray:
        """Return a motor's joint-side torque: as recorded, or current * constant * gear ratio * scale."""
        torque, current = f"motor{number}_torque_nm", f"motor{number}_current_a"
        if torque in self.columns or current not in self.columns:
            return self.needed(torque, f" (or {current})")
        amperes = self.needed(current)
        drive = self.joint.motor[number - 1].drive if self.joint else None
        if drive is None or drive.torque_constant_nm_a is None:
            raise RecordingError(
                f"{self.where}: {current} needs motor[{number}].drive.torque_constant_nm_a (and gear_ratio) "
                "in the joint file to become a torque"
            )
        scale = self.joint.recording.scale.get(torque, 1.0) if self.joint else 1.0
        return amperes * (drive.torque_constant_nm_a * drive.gear_ratio * scale)

    def require(self, name: str, other: str = "") -> None:
        """Require a column, with values or not."""
        if name not in self.columns:
            near = difflib.get_close_matches(name, set(self.columns) - COLUMNS, n=1, cutoff=0.75)
            hint = f"; did you mean it by {near[0]}?" if near else ""
            found = some(self.columns, 40) or "none"
            raise RecordingError(f"{self.where}: expected a column {name}{other}, found {found}{hint}")


def _usable(needed: Sequence[FloatArray], where: str) -> NDArray[np.bool_]:
    """(rows,) whether all needed values are finite.

    Raises:
        RecordingError: fewer than three rows are.
    """
    usable: NDArray[np.bool_] = np.all(np.isfinite(needed), axis=0)
    if lost := int(np.count_nonzero(~usable)):
        _LOG.warning("%s: taken as gaps: %s with missing values", where, counted(lost, "row"))
    if len(usable) - lost < 3:
        raise RecordingError(f"{where}: expected at least 3 complete samples, got {len(usable) - lost}")
    return usable


def _repeats(columns: Mapping[str, FloatArray]) -> NDArray[np.bool_]:
    """(rows,) whether a row equals the previous one, its time included."""
    same = np.zeros(len(columns["time_s"]), dtype=np.bool_)
    if len(same) > 1 and np.any(np.diff(columns["time_s"]) == 0.0):
        same[1:] = np.all([v[1:] == v[:-1] for name, v in columns.items() if name in COLUMNS], axis=0)
    return same
