"""The gate before any fit: is a recording usable, and are units, signs, gears and time right."""

from __future__ import annotations

from estimator.gate.causes import Change, Kind
from estimator.gate.decision import Discrepancy, Judgement, examine, judge
from estimator.gate.usable import at_limit, check, is_held, without_hold

__all__ = [
    "Change",
    "Discrepancy",
    "Judgement",
    "Kind",
    "at_limit",
    "check",
    "examine",
    "is_held",
    "judge",
    "without_hold",
]
