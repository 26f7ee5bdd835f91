"""Recordings of one joint as a user names them, read and checked: what `fit` and `diagnose` begin with."""

import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from drivelink import recording
from drivelink.errors import RecordingError
from drivelink.jointfile import JointText
from drivelink.output.numbers import Units
from drivelink.plaintext import some
from drivelink.recording.columns import parse_column_map
from drivelink.recording.corrections import gate
from drivelink.recording.mapping import joint_of
from estimator.sample import Record

Paths = str | Path | Sequence[str | Path]
Warn = Callable[[Path, Sequence[str]], None]


@dataclass(frozen=True, slots=True)
class Runs:
    """Recordings of one joint, as read."""

    source: JointText  # the joint file, given or carried by the first recording
    paths: tuple[Path, ...]  # of the recordings
    records: tuple[Record, ...]  # their values
    notes: tuple[str, ...]  # what the gate says of units, signs, gears and time
    names: tuple[str, ...] = ()  # columns of others under our names

    @property
    def names_of_files(self) -> list[str]:
        """The names of the files, without their folders."""
        return [path.name for path in self.paths]

    @property
    def named(self) -> str:
        """The same in one line, of many some."""
        return some(self.names_of_files)

    @property
    def units(self) -> Units:
        """Units of a rotary or linear axis."""
        return Units(self.source.joint.axis == "linear")


def load(
    recordings: Paths,
    joint: str | Path | None = None,
    *,
    names: Sequence[str] = (),
    strict: bool = False,
    warn: Warn | None = None,
) -> Runs:
    """Read recordings of one joint and check units, signs, gears and time; arguments as of `fit`."""
    several = [recordings] if isinstance(recordings, str | Path) else recordings
    paths = tuple(Path(path) for path in several)
    if not paths:
        raise RecordingError("expected a recording, got none")
    source = joint_of(paths[0], None if joint is None else Path(joint))
    columns = parse_column_map(names)
    read = [recording.read(path, source.joint, base_dir=source.folder, names=columns) for path in paths]
    notes: list[str] = []
    for path, record in zip(paths, read, strict=True):
        said = gate(path, source.joint, record, strict=strict)
        (warn or _warn)(path, said)
        notes += said
    return Runs(source, paths, tuple(read), tuple(dict.fromkeys(notes)), tuple(names))


def _warn(path: Path, lines: Sequence[str]) -> None:
    for line in lines:
        warnings.warn(f"{path}: {line}", stacklevel=4)
