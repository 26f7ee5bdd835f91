"""Fits and diagnoses recordings from Python: `drivelink.fit`, `drivelink.diagnose`."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from drivelink import jointfile, recording
from drivelink.errors import HarmfulModelError, RecordingError, UsageError, raised_as, require_positive
from drivelink.files import check_target
from drivelink.jointfile import apply_diagnosis
from drivelink.jointfile.apply_diagnosis import as_read, diagnosed_model, floor_entry
from drivelink.jointfile.digits import kept_model
from drivelink.output import fitreport, plots, report, sentences
from drivelink.output import motion as motions
from drivelink.output.comparison import beside, fits, simulated
from drivelink.output.document import Section, as_text, write
from drivelink.plaintext import some
from drivelink.recording.columns import parse_column_map
from drivelink.runs import Paths, Runs, Warn, load
from estimator.choices import choice
from estimator.diagnosis import Diagnosis
from estimator.diagnosis import diagnose as _diagnose
from estimator.diagnosis.fourier import Limits
from estimator.diagnosis.motion import NextMotion, design
from estimator.errors import EstimatorError
from estimator.freerun import FreeRun, free_run
from estimator.harm import Unseen, harm, harm_of_parts
from estimator.identify import Identified, identify
from estimator.model import JointModel
from estimator.reasons import percent
from estimator.sample import Record
from estimator.transmissions import RIGID

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True, slots=True)
class Picture:
    """A figure that a notebook shows."""

    figure: Figure

    def _repr_png_(self) -> bytes:
        return plots.png(self.figure)

    def save(self, path: str | Path) -> Path:
        """Write it in the format of the file name's ending (png, svg, pdf)."""
        return plots.save(self.figure, Path(path))


@dataclass(frozen=True)
class Fit:
    """A joint, fitted to recordings.

    Attributes:
        runs: the recordings.
        found: parameters in SI units at the joint side, with standard deviations.
        bandwidth_rad_s: of the filter, if it was given.
    """

    runs: Runs
    found: Identified
    bandwidth_rad_s: float | None = None

    def __repr__(self) -> str:
        return as_text(fitreport.sections(self.found, (), (), self.runs.units))

    def predict(self, other: str | Path, horizon_s: float | None = None) -> FreeRun:
        """Simulate the fitted model under the motor torque of another recording (or of the same).

        Args:
            other: the recording.
            horizon_s: time between new starts from the measured state, s; left out: a second, as in reports.

        Returns:
            Measured and simulated positions in rad, and the fit of each in %.

        Raises:
            RecordingError: it cannot be read, or the model cannot be simulated.
        """
        path = Path(other)
        require_positive("horizon_s", horizon_s)
        for number, motor in enumerate(self.found.model.motors, start=1):
            if motor.flexible and not motor.transmission.parameters:
                raise RecordingError(
                    f"{self.runs.named}: expected a motion that determines the stiffness of motor {number}"
                )
        joint, names = self.runs.source.joint, parse_column_map(self.runs.names)
        record = recording.read(path, joint, base_dir=self.runs.source.folder, names=names)
        with raised_as(RecordingError, str(path), EstimatorError):
            return free_run(record, self.found.model, horizon_s)

    def plot(self) -> Picture:
        """Draw stiffness (N·m/rad), torque and residuals (N·m) of each flexible transmission.

        Raises:
            UsageError: every transmission is rigid.
        """
        return Picture(fitreport.fit_plot(self.found.fits, self.runs.source.joint))

    def write(self, target: str | Path, *, force: bool = False) -> Path:
        """Write a copy of the joint file with the fitted numbers.

        Args:
            target: the file.
            force: replace it if it exists.

        Raises:
            RecordingError: the motion does not determine a stiffness above zero.
            HarmfulModelError: the declared model is better on held-out data, or no stiffness is known.
            DrivelinkError: the file exists, is an input, or cannot be written.
        """
        path, runs = Path(target), self.runs
        check_target(path, runs.paths, force=force)
        self._require_stiffness()
        if harmful := self._harm():
            raise HarmfulModelError(
                f"{some(runs.paths)}: --write: {harmful}: nothing is written. "
                "`drivelink diagnose` may say what is missing"
            )
        provenance = {
            **floor_entry(runs.records, self.found.model, self.found.surplus),
            "fit": apply_diagnosis.origin(runs.records, runs.named),
        }
        changes = jointfile.changes_to(self.found.model) | {"provenance": provenance}
        jointfile.write_model(runs.source, path, changes, force=force)
        return path

    def _harm(self) -> str | None:
        declared = self.runs.source.joint.model()

        def make(records: Sequence[Record]) -> JointModel:
            found = identify(records, declared, self.bandwidth_rad_s)
            return as_read(found.model, records, found.surplus)

        written = as_read(self.found.model, self.runs.records, self.found.surplus)
        return harm_of_parts(declared, written, self.runs.records, make, self.runs.source.joint.estimator)

    def _require_stiffness(self) -> None:
        flexible = [(i, one) for i, one in enumerate(self.found.fits, start=1) if one.model != RIGID]
        for number in (number for number, one in flexible if not one.excited):
            text = f"expected a motion that determines the stiffness of motor {number}"
            raise RecordingError(f"{self.runs.named}: --write: {text}")
        for number in (number for number, one in flexible if not one.stiffens):
            text = "expected a stiffness above zero, interval included, over all deflections of the recording"
            raise RecordingError(f"{self.runs.named}: --write: {text}; that of motor {number} is not")

    @cached_property
    def free_runs(self) -> list[dict[str, FreeRun]]:
        """The fitted model under the motor torque of each recording; empty where it cannot be simulated."""
        return [simulated(record, fitted=self.found.model) for record in self.runs.records]

    def as_json(self) -> dict[str, Any]:
        """Return the content of fit.json."""
        return fitreport.as_json(self.found, self.runs.names_of_files, self.free_runs, self.runs.notes)

    def sections(self) -> list[Section]:
        """Return what was fitted, as tables."""
        return fitreport.sections(self.found, self.runs.names_of_files, self.free_runs, self.runs.units)


@dataclass(frozen=True)
class Diagnosed:
    """What a joint's model lacks."""

    runs: Runs  # the recordings; their notes include those of the validation
    outcome: Diagnosis  # verdict, effects with parameters and probabilities, errors before and after in N·m
    validated: str | None = None  # the held-out recording's name; None: held-out blocks
    held: Record | None = None  # its values
    motion: NextMotion | None = None  # the one to record next, if it was asked for

    def __repr__(self) -> str:
        return sentences.sentence(self.outcome)

    @property
    def documented(self) -> Diagnosis:
        """The outcome with the gate's notes, as the reports have it."""
        return replace(self.outcome, notes=(*self.runs.notes, *self.outcome.notes))

    @property
    def judged(self) -> tuple[str, Record]:
        """The recording that free runs are of, with its name: the held-out one, else the first."""
        if self.held is not None:
            return str(self.validated), self.held
        return self.runs.paths[0].name, self.runs.records[0]

    @property
    def models(self) -> tuple[JointModel, JointModel]:
        """The joint as declared, and with what was found."""
        joint = self.runs.source.joint
        return joint.model(), diagnosed_model(joint, self.outcome)

    @cached_property
    def free_runs(self) -> dict[str, FreeRun]:
        """Both under the measured motor torque, as "declared" and "found", where they can be simulated."""
        declared, found = self.models
        return simulated(self.judged[1], declared=declared, found=found)

    def as_json(self) -> dict[str, Any]:
        """Return the content of report.json."""
        document = report.as_json(self.documented, self.free_runs, self.judged[0])
        return document if self.motion is None else document | {"motion": motions.as_json(self.motion)}

    def sections(self) -> list[Section]:
        """Return what the report describes and draws."""
        made = [*report.sections(self.documented, self.runs.units), fits(self.free_runs, self.judged[0])]
        return [*made, *self._to_move()]

    def _to_move(self) -> list[Section]:
        """The motion to record next, or how to have it designed where something is left open."""
        found = self.outcome
        is_open = found.verdict == "insufficient_excitation" or any(e.alternatives for e in found.effects)
        asked = is_open or self.motion is not None
        return [motions.section(self.motion, self.runs.units)] if asked else []

    def report(self, folder: str | Path) -> list[Path]:
        """Write report.json and report.html into a folder.

        Raises:
            OSError: they cannot be written.
        """
        joint, out = self.runs.source.joint, Path(folder)
        out.mkdir(parents=True, exist_ok=True)
        title = report.Title(joint.name, self.runs.named, self.validated, joint.axis == "linear")
        name, record = self.judged
        made = beside(name, self.models, self.free_runs, record, self.runs.units)
        page = report.html_page(self.documented, title, [*self._to_move(), *made])
        return write(out, "report", self.as_json(), page)

    def next_motion(
        self, seconds: float = 12.0, progress: Callable[[str], None] = lambda _: None
    ) -> Diagnosed:
        """Design the motion that tells apart what is left open, within `[motion]` of the joint file.

        Args:
            seconds: its length, s.
            progress: called with the name of each stage.

        Returns:
            The same with `motion`, which the reports show.

        Raises:
            RecordingError: nothing is left open, or no motion within the limits moves the joint.
        """
        require_positive("seconds", seconds)
        model, joint = self.runs.source.joint.model(), self.runs.source.joint
        with raised_as(RecordingError, f"{self.runs.named}: --motion", EstimatorError):
            limits = Limits.declared(self.runs.records, **joint.motion.model_dump())
            found = design(self.runs.records, model, self.outcome, limits, seconds, progress)
        return replace(self, motion=found)

    def write_motion(self, target: str | Path, *, force: bool = False) -> list[Path]:
        """Write the motion as a CSV file (s, rad, rad/s, rad/s², N·m), and its picture beside it.

        Raises:
            UsageError: none was designed.
            OSError: a file exists, or cannot be written.
        """
        if self.motion is None:
            raise UsageError("expected a motion, next_motion() designs one")
        return motions.write(self.motion, Path(target), self.runs.units, force=force)

    def plot(self) -> Picture:
        """Draw what the model leaves of the motor torque over time (N·m), before and after."""
        return Picture(report.residual_figure(self.outcome, self.runs.units))

    def write(self, target: str | Path, *, force: bool = False) -> Path:
        """Write a copy of the joint file with the effects found and the transmission refitted.

        Args:
            target: the file.
            force: replace it if it exists.

        Raises:
            HarmfulModelError: the declared model is better on held-out data, or no stiffness is known.
            DrivelinkError: the file exists, is an input, or cannot be written.
        """
        path, runs = Path(target), self.runs
        check_target(path, runs.paths, force=force)
        if harmful := self._harm():
            raise HarmfulModelError(f"{runs.named}: --write: {harmful}: no joint file is written")
        apply_diagnosis.write(runs.source, path, self.outcome, runs.records[0], runs.named, force=force)
        return path

    def _harm(self) -> str | None:
        joint, records = self.runs.source.joint, self.runs.records

        def as_written(outcome: Diagnosis, records: Sequence[Record]) -> JointModel:
            return as_read(diagnosed_model(joint, outcome), records[0], outcome.surplus)

        def make(kept: list[Record]) -> JointModel:
            return as_written(_diagnose(kept, joint.model(), self.outcome.bandwidth_hz), kept)

        written = as_written(self.outcome, records)
        if self.held is not None:
            return harm(joint.model(), written, [Unseen.whole(self.held)], joint.estimator)
        return harm_of_parts(joint.model(), written, records, make, joint.estimator)


def fit(
    recordings: Paths,
    joint: str | Path | None = None,
    *,
    bandwidth_hz: float | None = None,
    names: Sequence[str] = (),
    strict: bool = False,
    warn: Warn | None = None,
) -> Fit:
    """Fit stiffness, inertia, damping, link, delays and friction of a joint to healthy recordings.

    Args:
        recordings: one file or several of the same joint.
        joint: its joint file; left out: the one that the first recording carries.
        bandwidth_hz: of the filter that all channels share, Hz; left out: chosen from the data.
        names: columns of others, "SOURCE=COLUMN[:UNIT]", e.g. "q_link=link_position_rad:deg".
        strict: refuse units, signs, gears or time that look wrong, instead of a warning.
        warn: called with a recording and what looks wrong in it; left out: a Python warning.

    Raises:
        DrivelinkError: a file cannot be read, or the recordings cannot be fitted.
    """
    require_positive("bandwidth_hz", bandwidth_hz)
    runs = load(recordings, joint, names=names, strict=strict, warn=warn)
    bandwidth = None if bandwidth_hz is None else 2.0 * math.pi * bandwidth_hz
    with raised_as(RecordingError, some(runs.paths), EstimatorError):
        found = identify(list(runs.records), runs.source.joint.model(), bandwidth)
    found = replace(found, model=kept_model(found.model))
    for name, one in zip(runs.names_of_files, found.recordings, strict=True):
        _require_explained(name, one.train.relative, choice("unexplained"))
    return Fit(runs, found, bandwidth)


def diagnose(
    recordings: Paths,
    joint: str | Path | None = None,
    *,
    validation: str | Path | None = None,
    bandwidth_hz: float | None = None,
    names: Sequence[str] = (),
    strict: bool = False,
    warn: Warn | None = None,
    progress: Callable[[str], None] = lambda _: None,
) -> Diagnosed:
    """Name the physical effect that a joint's model lacks.

    Args:
        recordings: as of `fit`; so are joint, bandwidth_hz (Hz), names, strict and warn.
        joint: the joint file that `Fit.write` made of a healthy run, for best results.
        validation: held-out recording; left out: held-out blocks of the same ones.
        progress: called with the name of each stage.

    Raises:
        DrivelinkError: a file cannot be read, or the recordings cannot be diagnosed.
    """
    require_positive("bandwidth_hz", bandwidth_hz)
    runs = load(recordings, joint, names=names, strict=strict, warn=warn)
    held, told = None, runs.notes
    if validation is not None:
        other = load(validation, joint, names=names, strict=strict, warn=warn)
        held, told = other.records[0], tuple(dict.fromkeys((*told, *other.notes)))
    model = runs.source.joint.model()
    with raised_as(RecordingError, runs.named, EstimatorError):
        outcome = _diagnose(list(runs.records), model, bandwidth_hz, held, progress)
    _require_explained(runs.named, outcome.validation.after_relative, 1.0)
    validated = None if validation is None else Path(validation).name
    return Diagnosed(replace(runs, notes=told), outcome, validated, held)


def _require_explained(named: str, left: float, most: float) -> None:
    """Refuse to state numbers of a joint that leaves more than so much of the torque's rms."""
    if left > most:
        raise RecordingError(
            f"{named}: whatever its numbers, this joint file leaves {percent(left, 0)} of the motor torque: "
            "expected a recording of this joint (or its inertias, units and signs are far off)"
        )
