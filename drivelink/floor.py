"""The floor of a joint's model, kept with it in the joint file, and the watch that compares with it."""

from __future__ import annotations

from typing import Any

from drivelink.jointfile import JointFile
from estimator.errors import EstimatorError
from estimator.model import JointModel
from estimator.sample import Record
from estimator.watch import Floor, ResidualWatch, measure_floor, watchable

__all__ = ["floor_entry", "make_watch"]

_KEY = "floor"


def floor_entry(record: Record, model: JointModel) -> dict[str, Any]:
    """What [provenance] keeps of a model's floor; nothing where it cannot be measured."""
    if not watchable(model):
        return {}
    try:
        return {_KEY: measure_floor(record, model).as_dict()}
    except EstimatorError:
        return {}


def make_watch(joint: JointFile) -> ResidualWatch | None:
    """The watch of a joint, where its model is complete and its floor is known."""
    entry = joint.provenance.get(_KEY)
    floor = Floor.from_dict(entry) if isinstance(entry, dict) else None
    model = joint.model()
    if floor is None or not watchable(model):
        return None
    return ResidualWatch(model, joint.bus.period_s, floor)
