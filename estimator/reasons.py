"""Why an estimate is not valid, in one sentence: one table for status, views and `replay`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from estimator.sample import Status

if TYPE_CHECKING:
    from estimator.online import Estimator

_SERVICE = (
    (Status.STALE, "stale"),
    (Status.CONTRADICTED, "contradicted"),
    (Status.MODEL_ALARM, "alarm"),
)

REASONS: dict[str, str] = {
    "stale": "no fresh sample has come",
    "alarm": "the residual is above the model's own baseline: the model is not sufficient",
    "contradicted": "two readings of one quantity contradict each other",
    "settling": "filters are settling",
    "rejected": "the samples cannot be used",
    "unmoved": "the motion has not revealed the stiffness yet",
    "open": "the motion leaves the stiffness open",
    "imprecise": "stiffness known to ± {share} %, asked for ± {asked:.2g} %",
    "torque_imprecise": "torque known to ± {share} % of its rms, asked for ± {asked:.2g} %",
    "not_positive": "the stiffness comes out at or below zero: check signs, torque and inertia",
    "unexplained": "the model leaves {share} % of the torque balance unexplained",
    "beyond": "the deflection is larger than any that was learned from",
    "changed": "{changes} changed",
    "lost": "the zero between the encoders, or the torque's, is not known: move the joint, or home it",
    "lever": "motor 2 has set another stiffness: it is learned anew",
}

CHANGES: dict[str, str] = {
    "stiffness": "stiffness",
    "spring_shape": "shape of the spring",
    "inertia": "inertia",
    "friction": "friction",
    "torque_zero": "torque offset",
    "position_zero": "zero between the encoders",
    "link_delay": "delay of the link encoder",
    "motor_scale": "scale of the motor encoder",
    "link_scale": "scale of the link encoder",
    "torque_scale": "torque gain",
    "motor_delay": "delay of the motor encoder",
    "torque_delay": "delay of the torque",
}


def reason_text(
    name: str, *, motor: int = 0, share: float = 0.0, asked: float = 0.0, changes: Sequence[str] = ()
) -> str:
    """Return the sentence of a reason.

    Args:
        name: key of `REASONS`.
        motor: whose it is, from 1 on; 0: the joint's, or its only one.
        share: the sentence's number, a fraction: relative standard deviation, or unexplained share (rms).
        asked: `valid_within` of the settings.
        changes: keys of `CHANGES` between which the data do not decide; empty: not known yet.
    """
    # Two digits, or as many as tell it from what is asked for.
    digits = next((n for n in range(2, 6) if share == asked or f"{share:.{n}g}" != f"{asked:.{n}g}"), 6)
    words = " or ".join(CHANGES[change] for change in changes)
    text = REASONS[name].format(
        share=f"{float(f'{100.0 * share:.{digits}g}'):g}",  # no 1e+02
        asked=100.0 * asked,
        changes=f"{words} has" if words else "the joint has",
    )
    return f"motor {motor}: {text}" if motor else text


def counted(number: int, noun: str) -> str:
    """Return so many of a thing: "1 row", "2 rows"."""
    return f"{number} {noun}{'' if number == 1 else 's'}"


def percent(share: float, decimals: int) -> str:
    """Return a share of one in per cent, of four digits at most: "12.01 %", "5621 %"."""
    whole = len(f"{abs(100.0 * share):.0f}")
    return f"{100.0 * share:.{max(0, min(decimals, 4 - whole))}f} %".replace("-", "−")


def why_not_valid(status: int, estimator: Estimator) -> tuple[str, str] | None:
    """Return why the last published estimate is not valid: key of `REASONS` and sentence; None: it is.

    Args:
        status: its bits, those of the service included.
        estimator: that made it.
    """
    if status & Status.VALID:
        return None
    for bit, name in _SERVICE:
        if status & bit:
            return name, REASONS[name]
    return estimator.why()
