"""A finding in words."""

from __future__ import annotations

from typing import NamedTuple

from drivelink.jointfile import JointFile
from drivelink.output import report
from drivelink.output.numbers import Units
from estimator.diagnosis import Diagnosis, Errors


class Summary(NamedTuple):
    """A finding in one sentence, in a few words, and its parameters with their intervals, a line each."""

    sentence: str
    short: str
    parameters: tuple[str, ...]


def summary(outcome: Diagnosis, error: Errors, joint: JointFile) -> Summary:
    """Describe what was found.

    Args:
        error: of the model in use and of the proposed one, on held-out data.
    """
    units = Units(joint.axis == "linear")
    fall = f"{error.before_relative:.2%} to {error.after_relative:.2%}"
    on = "on held-out data the error of the motor torque"
    if outcome.verdict == "effect":
        names = " and ".join(report.title_of(one, outcome) for one in outcome.effects)
        sentence, short = f"{report.lacks(outcome)}: {on} falls from {fall}.", f"{names}, error {fall}"
    elif outcome.verdict == "sufficient" and error.after_rms_nm < 0.5 * error.before_rms_nm:
        sentence = f"No effect is missing, but the joint has changed: refitted, {on} falls from {fall}."
        short = f"the joint has changed, error {fall}"
    else:
        sentence = report.sentence(outcome)
        short = sentence.partition(":")[0].rstrip(".")
    return Summary(sentence, short, tuple(_parameters(outcome, joint, units)))


def _parameters(outcome: Diagnosis, joint: JointFile, units: Units) -> list[str]:
    lines = [
        f"{report.title_of(one, outcome)}: {name} = {units.value(name, value, one.std.get(name))}"
        for one in outcome.effects
        for name, value in one.parameters.items()
    ]
    for number, (one, motor) in enumerate(zip(outcome.transmissions, joint.motor, strict=True), start=1):
        for name, value in one.parameters.items():
            declared = motor.transmission.parameters.get(name)
            line = f"transmission {number}: {name} = {units.value(name, value, one.std.get(name))}"
            lines.append(
                line + (f", was {units.value(name, declared, None)}" if declared is not None else "")
            )
    return lines
