"""The residual baseline in the joint file, and the model monitor that uses it."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from typing import Any

from drivelink.jointfile import JointFile
from estimator.errors import EstimatorError
from estimator.model import JointModel
from estimator.model_monitor import ModelMonitor, ResidualBaseline, can_monitor, measure_baseline
from estimator.sample import Record

_KEY = "floor"
_LOG = logging.getLogger(__name__)


def floor_entry(record: Record | Sequence[Record], model: JointModel, surplus: float) -> dict[str, Any]:
    """Return the entry of [provenance] with the baseline (see `measure_baseline`); empty, with a
    log line, if it cannot
    be measured.
    """
    if not can_monitor(model):
        return {}
    try:
        return {_KEY: measure_baseline(record, model, surplus).as_dict()}
    except EstimatorError as error:
        _LOG.warning("no residual baseline is written, so the daemon cannot raise the model alarm: %s", error)
        return {}


def make_model_monitor(joint: JointFile) -> ModelMonitor | None:
    """Return the model monitor of a joint; None without complete model or baseline."""
    entry = joint.provenance.get(_KEY)
    baseline = ResidualBaseline.from_dict(entry) if isinstance(entry, dict) else None
    model = joint.model()
    if baseline is None or not can_monitor(model):
        return None
    rate = joint.estimator.false_alarms_per_hour
    return ModelMonitor(model, joint.bus.period_s, baseline, rate)
