"""Compares two models, two recordings, or a model with a machine: `drivelink compare A B`."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from drivelink import analysis, jointfile
from drivelink.errors import RecordingError, UsageError, require_positive
from drivelink.output.comparison import Comparison, Side
from drivelink.output.numbers import Units
from estimator.errors import EstimatorError
from estimator.freerun import FreeRun, free_run, unbroken_s
from estimator.model import Effect, JointModel
from estimator.sample import Record

_SURE = 4.0  # standard deviations of friction that is not declared


def compare(
    a: str | Path, b: str | Path, joint: str | Path | None = None, *, names: Sequence[str] = (),
    horizon_s: float | None = None,
) -> Comparison:  # fmt: skip
    """Compare two models (joint files) or machines (recordings, which are fitted first).

    Args:
        a: a joint file or a recording.
        joint: the joint file of recordings; left out: that of the other side, or what they carry.
        horizon_s: time between new starts of a free run, s; left out: as `free_run` does, by A's model.

    Raises:
        DrivelinkError: a file cannot be read or fitted, or the joints have different numbers of motors.
    """
    require_positive("horizon_s", horizon_s)
    paths = [Path(a), Path(b)]
    models = [path for path in paths if path.suffix.lower() == ".toml"]
    own = joint if joint is not None else next(iter(models), None)
    sides = [_side(path, None if own is None else Path(own), names) for path in paths]
    first, second = (len(side.model.motors) for side in sides)
    if first != second:
        raise UsageError(f"{paths[1]}: expected {first} motors as in {paths[0]}, got {second}")
    runs = []
    for side, path in zip(sides, paths, strict=True):
        if side.record is not None:
            made: list[FreeRun] = []
            for of, its in zip(paths, sides, strict=True):
                try:
                    made.append(free_run(side.record, its.model, made[0].horizon_s if made else horizon_s))
                except EstimatorError as error:
                    which = f"{of}" if of == path else f"{of}, over {path}"
                    raise RecordingError(f"{which}: {error}{_shorter(side.record, its.model)}") from error
            runs.append((side, made[0], made[1]))
    linear = own is not None and jointfile.load(Path(own)).axis == "linear"
    return Comparison((sides[0], sides[1]), tuple(runs), Units(linear))


def _shorter(record: Record, model: JointModel) -> str:
    """Return which horizon fits between the gaps; empty where the model itself cannot be simulated."""
    if any(motor.flexible and not motor.transmission.parameters for motor in model.motors):
        return ""
    fits_s = unbroken_s(record)
    return f"; --horizon {fits_s:g} fits between its gaps" if fits_s > record.period_s else ""


def _side(path: Path, joint: Path | None, names: Sequence[str]) -> Side:
    if path.suffix.lower() == ".toml":
        return Side(path.name, jointfile.load(path).model(), None)
    made = analysis.fit(path, joint, names=names, warn=lambda _path, _lines: None)
    motors = []
    for one, motor in zip(made.found.fits, made.found.model.motors, strict=True):
        std = one.nuisance_std["coulomb"]
        if one.coulomb_nm > _SURE * std and not any(e.name == "coulomb_friction" for e in motor.effects):
            found = Effect(
                name="coulomb_friction", parameters={"torque_nm": one.coulomb_nm}, std={"torque_nm": std}
            )
            motor = replace(motor, effects=(*motor.effects, found))
        motors.append(motor)
    return Side(path.name, replace(made.found.model, motors=tuple(motors)), made.runs.records[0])
