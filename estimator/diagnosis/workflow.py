"""The diagnosis of recordings: checks, bandwidth, search, held-out test, verdict."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from estimator.choices import least_rows
from estimator.diagnosis.bandwidth import choose_bandwidth, require_bandwidth
from estimator.diagnosis.heldout import Held, held_out
from estimator.diagnosis.misdeclared import asks
from estimator.diagnosis.order import bends, ordered_beside, sharp
from estimator.diagnosis.problem import Problem
from estimator.diagnosis.result import Diagnosis
from estimator.diagnosis.search import Progress, Search
from estimator.diagnosis.verdict import Judge
from estimator.effects import sharpened
from estimator.gate import check, without_hold
from estimator.model import JointModel
from estimator.sample import Record

__all__ = ["diagnose"]


def diagnose(
    record: Record | Sequence[Record],
    model: JointModel,
    bandwidth_hz: float | None = None,
    validation: Record | None = None,
    progress: Progress = lambda _: None,
) -> Diagnosis:
    """Trace a model's residual to the missing effects.

    Args:
        record: the recording, or several of one joint: stiffness, inertia, delays and effects are shared,
            offsets and encoder zeros belong to each.
        model: the joint as it is declared.
        bandwidth_hz: of the filter that all channels share; None: chosen from the data.
        validation: a held-out recording; a term is kept only if it lowers the error there. None: each of
            several recordings in turn, or blocks of a single one, are held out.
        progress: called with the current step.

    Returns:
        The diagnosis.

    Raises:
        EstimatorError: the recordings cannot be diagnosed.
    """
    records = [record] if isinstance(record, Record) else list(record)
    everything = records + ([] if validation is None else [validation])
    for one in everything:
        check(one, model)
    declared = model = without_hold(everything, model)
    progress("bandwidth")
    bandwidth = choose_bandwidth(records, model) if bandwidth_hz is None else bandwidth_hz
    require_bandwidth(bandwidth, records)

    def made(model: JointModel, like: Problem | None = None) -> Problem:
        return Problem(records, model, bandwidth, least=least_rows(), like=like)

    def hold(problem: Problem) -> Held:
        return held_out(problem, validation)

    def judged(problem: Problem) -> tuple[Judge, Diagnosis]:
        search = Search(problem, hold(problem), progress)
        judge = Judge(search, search.run(), progress)
        return judge, judge.diagnosis()

    smoothing_rad_s = sharp(model, made)
    model = sharpened(model, smoothing_rad_s)
    judge, outcome = judged(made(model))
    tried = [_orders(judge.problem.model)]
    while bends(model, outcome.effects):
        problem = ordered_beside(model, made, hold, judge.found)
        if _orders(problem.model) in tried:
            break
        tried.append(_orders(problem.model))
        other, raised = judged(problem)
        if judge.held.confirms(judge.found, other.found, other.held):
            break
        judge, outcome = other, raised
    outcome = replace(outcome, smoothing_rad_s=smoothing_rad_s)
    if outcome.verdict == "sufficient" and any(asks(records, declared)):
        return replace(outcome, verdict="insufficient_excitation")
    return outcome


def _orders(model: JointModel) -> list[int]:
    return [motor.transmission.order or 1 for motor in model.motors]
