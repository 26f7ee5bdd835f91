"""Diagnoses a kept recording at idle priority: `python -m drivelink.loop.diagnosing RECORDING`."""

import logging
import math
import os
import signal
import sys
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from drivelink import recording as recordings
from drivelink.errors import DrivelinkError, RecordingError
from drivelink.jointfile import JointFile, JointText, apply_diagnosis, fingerprint
from drivelink.jointfile.apply_diagnosis import make_model_monitor
from drivelink.loop import finding
from drivelink.loop.finding import proposal_file
from drivelink.output import report, sentences
from drivelink.output.comparison import simulated
from drivelink.output.numbers import Units
from drivelink.plaintext import log_to_stderr
from drivelink.recording.canframes import read_frame_record
from drivelink.recording.mapping import joint_of
from drivelink.recording.mcapfile import read_messages
from estimator.diagnosis import Diagnosis, Errors, diagnose
from estimator.errors import EstimatorError
from estimator.gate import check
from estimator.harm import Unseen, harm
from estimator.model_monitor import Second, can_monitor, seconds_of
from estimator.reasons import percent
from estimator.sample import Record


class Summary(NamedTuple):
    """A finding in one sentence, in a few words, and its parameters with their intervals, a line each."""

    sentence: str
    short: str
    parameters: tuple[str, ...]


def summary(outcome: Diagnosis, error: Errors, joint: JointFile, better: bool) -> Summary:
    """Describe what was found.

    Args:
        error: before and after, on held-out data.
        better: whether the joint file with what was found is worth proposing.
    """
    units = Units(joint.axis == "linear")
    fall = f"{percent(error.before_relative, 2)} to {percent(error.after_relative, 2)}"
    on = f"on held-out data the error of the {'link' if _of_link(outcome) else 'motor'} torque"
    if outcome.verdict == "effect":
        names = " and ".join(sentences.title_of(one, outcome) for one in outcome.effects)
        how = "falls" if error.after_rms_nm < error.before_rms_nm else "does not fall, but goes"
        sentence, short = f"{sentences.lacks(outcome)}: {on} {how} from {fall}.", f"{names}, error {fall}"
    elif outcome.verdict == "sufficient" and better:
        sentence = f"No effect is missing, but the joint has changed: refitted, {on} falls from {fall}."
        short = f"the joint has changed, error {fall}"
    else:
        sentence = sentences.sentence(outcome)
        short = sentence.partition(":")[0].rstrip(".")
    return Summary(sentence, short, tuple(_parameters(outcome, joint, units)))


def _of_link(outcome: Diagnosis) -> bool:
    """Return whether all that was found is in the link's balance alone (eq 4), none in a motor's."""
    return bool(outcome.effects) and all(one.location == "link" for one in outcome.effects)


def _parameters(outcome: Diagnosis, joint: JointFile, units: Units) -> list[str]:
    lines = [
        f"{sentences.title_of(one, outcome)}: {name} = {units.value(name, value, one.std.get(name))}"
        for one in outcome.effects
        for name, value in one.parameters.items()
    ]
    for number, (one, motor) in enumerate(zip(outcome.transmissions, joint.motor, strict=True), start=1):
        where = f"motor {number}" if len(joint.motor) > 1 else "transmission"
        for name, value in one.parameters.items():
            declared = motor.transmission.parameters.get(name)
            was = "" if declared is None else f", was {units.value(name, declared, None)}"
            lines.append(f"{where}: {name} = {units.value(name, value, one.std.get(name))}{was}")
    return lines


_LOG = logging.getLogger("drivelink.loop")
_LEAST_SECONDS = 6  # of residual, to tell two levels from one
_NOTHING_NM = 1e-12
_TRAINED = 2 / 3  # of the data; the rest is held out


def since(seconds: Sequence[Second]) -> tuple[int, int] | None:
    """Return the sequence numbers around the second in which the residual rose; None: not in this recording.

    Two levels of its logarithm explain it better than one, by the Bayesian information criterion.
    """
    n = len(seconds)
    if n < _LEAST_SECONDS:
        return None
    level = np.log(np.maximum([np.linalg.norm(one.residual_nm) for one in seconds], _NOTHING_NM))
    errors = [float(np.var(level[:k]) * k + np.var(level[k:]) * (n - k)) for k in range(2, n - 1)]
    k = 2 + int(np.argmin(errors))
    gain = n * math.log(float(np.var(level)) * n / max(errors[k - 2], 1e-300))
    rose = float(np.mean(level[k:])) > float(np.mean(level[:k]))
    return (seconds[k - 1].sequence, seconds[k].sequence) if rose and gain > 2.0 * math.log(n) else None


def _split(record: Record) -> tuple[Record, Record]:
    """Return the rows to learn from, and those that are held out."""
    from_ = int(record.sequence[round(_TRAINED * (len(record) - 1))])
    return record.rows(record.sequence < from_), record.rows(record.sequence >= from_)


def make(recording: Path) -> dict[str, Any]:
    """Diagnose a kept recording, and put the joint file that it proposes beside it.

    Returns:
        The finding.

    Raises:
        DrivelinkError: it cannot be read, or carries no joint file.
        EstimatorError: it cannot be diagnosed.
    """
    begin_s = time.monotonic()
    source = joint_of(recording, None)
    record = _read(recording, source)
    model = source.joint.model()
    rose = since(seconds_of(record, model)) if can_monitor(model) else None
    part, (trained, held) = record, _split(record)
    if rose is not None:
        later = record.rows(record.sequence > rose[1])
        try:
            for one in _split(later):
                check(one, model)
            part, (trained, held) = later, _split(later)
        except EstimatorError:  # too late in the recording to be diagnosed by itself
            rose = None
    held_from = int(held.sequence[0])
    outcome = diagnose(trained, model, None, held)
    change = _change(part, source.joint, outcome)
    error, state, harmful = _error(part, source.joint, change, held_from), finding.NOTHING, None
    # Of a sufficient model, only where it fails its own test: then its numbers have changed.
    changed = change.verdict == "effect" or (change.verdict == "sufficient" and _alarms(part, source.joint))
    better = error.after_rms_nm < error.before_rms_nm and changed
    if not better and change.verdict != "effect":
        error = change.validation  # which the sentence is about
    said = summary(change, error, source.joint, better)
    if better:
        proposed = apply_diagnosis.diagnosed_model(source.joint, change)
        harmful = harm(model, proposed, [Unseen(part, held_from)], source.joint.estimator)
        if harmful is None:
            shown = replace(change, validation=error)  # the views have one error before and after
            apply_diagnosis.write(source, proposal_file(recording), shown, part, recording.name, force=True)
            state = finding.PROPOSED
    first_s = next(read_messages(recording, frozenset({"sample"}))).log_time_ns * 1e-9
    runs = simulated(held, declared=model, found=apply_diagnosis.diagnosed_model(source.joint, change))
    title = report.Title(source.joint.name, recording.name, None, source.joint.axis == "linear")
    finding.put(finding.page_file(recording), report.html_page(outcome, title))
    sentence = f"{said.sentence} Nothing is proposed: {harmful}." if harmful else said.sentence
    return {
        **finding.begun(recording, state, sentence),
        "summary": said.short,
        "parameters": list(said.parameters),
        "since": None if rose is None else first_s + (rose[0] - int(record.sequence[0])) * record.period_s,
        "error": error._asdict(),
        "joint_file": fingerprint(source.text),
        "took_s": round(time.monotonic() - begin_s, 1),
        "report": report.as_json(outcome, runs, recording.name),
    }


def _read(recording: Path, source: JointText) -> Record:
    """Read the samples, or the frames where more of them came: zenoh drops samples on a busy machine."""
    record = recordings.read(recording, source.joint)
    if len(record.sequence) > int(record.sequence[-1] - record.sequence[0]):
        return record
    try:
        frames = read_frame_record(recording, source.joint, source.folder, None)
    except DrivelinkError:
        return record
    return max(record, frames, key=lambda one: len(one.sequence))


def _alarms(part: Record, joint: JointFile) -> bool:
    monitor = make_model_monitor(joint)
    return monitor is not None and any(map(monitor.core.step, part.samples()))


def _change(part: Record, joint: JointFile, outcome: Diagnosis) -> Diagnosis:
    """Return what is to change: of motors that pass their own test nothing, if the finding is the link's."""
    if not _of_link(outcome) or not can_monitor(joint.model()) or _alarms(part, joint):
        return outcome
    kept = tuple(replace(one, parameters={}, motor={}) for one in outcome.transmissions)
    return replace(outcome, transmissions=kept, alignment={})


def _error(part: Record, joint: JointFile, outcome: Diagnosis, held_from: int) -> Errors:
    """Return the error on held-out data of the model in use and of the proposed one: of the motors, or of the
    link where what was found is there.

    Of a model without parameters, which is no model yet, the error before is that of its best fit.
    """
    declared, later = joint.model(), held_from + 1 / part.period_s
    if not can_monitor(declared):
        return outcome.validation
    motors, both = part.motors, []
    judged = slice(motors, None) if _of_link(outcome) else slice(motors)
    for one in (declared, apply_diagnosis.diagnosed_model(joint, outcome)):
        held = [second for second in seconds_of(part, one) if second.sequence > later]
        if not held:
            return outcome.validation
        squares = np.square([(s.residual_nm[judged], s.torque_nm[judged]) for s in held])
        both.append(np.sqrt(np.mean(np.sum(squares, axis=2), axis=0)).tolist())
    (before, torque), (after, _) = both
    return Errors(before, after, before / torque, after / torque)


def main() -> int:
    """Diagnose one recording; whatever comes of it lies beside it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # of a terminal, for the daemon: the black box ends this
    log_to_stderr(logging.INFO)
    os.nice(19)
    with suppress(OSError, AttributeError):  # not every system has it
        os.sched_setscheduler(0, os.SCHED_IDLE, os.sched_param(0))
    recording = Path(sys.argv[1])
    try:
        found = make(recording)
    except (DrivelinkError, EstimatorError) as error:
        found = finding.begun(
            recording, finding.FAILED, f"not diagnosed: {error}: drivelink keep makes another recording"
        )
    try:
        finding.write(recording, found)
    except RecordingError as error:  # the disk is full
        _LOG.error("%s: %s", found["joint"], error)
        return error.exit_status
    level = logging.INFO if found["state"] == finding.NOTHING else logging.WARNING
    _LOG.log(level, "%s: %s", found["joint"], found["sentence"])
    return 0


if __name__ == "__main__":
    for said in ("drivelink.recording", "drivelink.jointfile"):  # the daemon has said what is missing, edited
        logging.getLogger(said).setLevel(logging.ERROR)
    sys.exit(main())
