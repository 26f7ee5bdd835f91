"""Watches the estimates of the joints: faults, model alarm, contradicting and suspected readings."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable
from typing import Any

from drivelink.cycle.loop import LoopJoint
from drivelink.cycle.pipeline import ResidualMonitor
from drivelink.daemon.status import EventLog
from estimator.sample import Status

_MODEL_ALARM = int(Status.MODEL_ALARM)
_BRIEF = ("impossible", "jumped")  # of single samples, reported by their status bit


class JointWatch:
    """The state of the joints; every event is reported once.

    Args:
        contradiction: the reading of a joint that a second one contradicts, or None.
    """

    def __init__(self, events: EventLog, contradiction: Callable[[LoopJoint], dict[str, Any] | None]) -> None:
        self._events = events
        self._contradiction = contradiction
        self._alarmed: set[str] = set()  # joints with a model alarm

    def check(self, loop_joint: LoopJoint) -> None:
        """Check for changes since the last call."""
        self._check_fault(loop_joint)
        self._check_model(loop_joint)
        self._check_contradiction(loop_joint)
        self._check_readings(loop_joint)

    def _check_fault(self, loop_joint: LoopJoint) -> None:
        name, fault = loop_joint.name, loop_joint.fault
        text = f"{name}: no estimates since {fault}; rewrite its joint file or restart the daemon"
        over = f"{name}: estimates restart"
        self._events.keep(f"joint {name}", bool(fault), text, over, logging.ERROR)

    def _check_model(self, loop_joint: LoopJoint) -> None:
        """Report begin and end of the model alarm, its amount and what to do."""
        status = loop_joint.pipeline.status
        if status is None:
            return
        alarm = bool(status & _MODEL_ALARM)
        if alarm == (loop_joint.name in self._alarmed):
            return
        monitor = loop_joint.pipeline.model_monitor
        if alarm:
            self._alarmed.add(loop_joint.name)
            self._events.say(
                f"{loop_joint.name}: model alarm{residual_text(monitor)}: do not control on its numbers; "
                "record a minute of motion, then drivelink diagnose names the effect",
                logging.WARNING,
                key=f"{loop_joint.name}: model alarm",
            )
        else:
            self._alarmed.discard(loop_joint.name)
            text = f"{loop_joint.name}: the model alarm is over{residual_text(monitor)}"
            self._events.say(text, key=f"{loop_joint.name}: no model alarm")

    def _check_contradiction(self, loop_joint: LoopJoint) -> None:
        """Report begin and end of a contradiction between readings."""
        key, found = f"contradiction {loop_joint.name}", self._contradiction(loop_joint)
        if found is None:
            self._events.end(key, f"{loop_joint.name}: no reading contradicts another")
        else:
            self._events.begin(key, f"{loop_joint.name}: {found['text']}")

    def _check_readings(self, loop_joint: LoopJoint) -> None:
        """Report begin and end of a suspicion against a reading."""
        suspicion = (
            loop_joint.pipeline.estimator.suspicion() if loop_joint.pipeline.status is not None else None
        )
        key = f"reading {loop_joint.name}"
        if suspicion is None:
            self._events.end(key, f"{loop_joint.name}: no reading is suspected")
        elif suspicion["reason"] not in _BRIEF:
            self._events.begin(key, f"{loop_joint.name}: no valid estimates; suspected: {suspicion['text']}")


def residual_text(monitor: ResidualMonitor | None) -> str:
    """Return the residual against its baseline in words, if known."""
    location = monitor.describe().get("location") if monitor is not None else None
    ratio = residual_ratio(monitor)
    where = f", likely at the {location}" if location else ""
    return "" if ratio is None else f": the residual is {ratio:.2g} times its baseline{where}"


def residual_ratio(monitor: ResidualMonitor | None) -> float | None:
    """Return the largest residual over its baseline, if known."""
    described = monitor.describe() if monitor is not None else {}
    residuals, baselines = described.get("residual_nm") or (), described.get("floor_nm") or ()
    ratios = [r / b for r, b in zip(residuals, baselines, strict=False) if b > 0.0 and math.isfinite(r)]
    return max(ratios, default=None)
