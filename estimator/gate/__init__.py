"""The gate before any fit: is a recording usable, and are units, signs, gears and time right."""

from __future__ import annotations

from estimator.gate.causes import Change, Kind
from estimator.gate.judge import Discrepancy, GateError, Judgement, examine, judge, refuse
from estimator.gate.usable import check

__all__ = ["Change", "Discrepancy", "GateError", "Judgement", "Kind", "check", "examine", "judge", "refuse"]
