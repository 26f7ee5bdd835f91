"""The diagnosis of recordings: checks, bandwidth, search, held-out test, verdict."""

from __future__ import annotations

import math
from collections.abc import Sequence

from estimator.choices import choice, least_rows
from estimator.diagnosis.bandwidth import choose_bandwidth, widest
from estimator.diagnosis.heldout import Held, held_out
from estimator.diagnosis.hypothesis import Fitted, Problem
from estimator.diagnosis.judge import Judge
from estimator.diagnosis.openorder import raised
from estimator.diagnosis.result import Diagnosis
from estimator.diagnosis.search import Progress, Search
from estimator.errors import EstimatorError
from estimator.gate import check
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
    progress("bandwidth")
    bandwidth = bandwidth_hz or choose_bandwidth(records, model)
    most = widest(max(r.period_s for r in records))
    if not 0.0 < bandwidth <= most:
        raise EstimatorError(f"bandwidth: expected more than 0 and at most {most:g} Hz, got {bandwidth:g}")
    alone = validation is None and len(records) == 1
    problem = Problem(records, model, bandwidth, held=alone, least=least_rows())
    search = Search(problem, progress)
    progress("held-out data")
    held = held_out(problem, validation)
    leading = search.run()
    found = _chosen(search, held, [_gated(search, held, one) for one in leading])
    outcome = Judge(search, held, leading[0], found, progress).diagnosis()
    higher = raised(model, outcome.effects)
    if higher is not None:
        return diagnose(records, higher, bandwidth, validation, progress)
    return outcome


def _chosen(search: Search, held: Held, hypotheses: list[Fitted]) -> Fitted:
    """The hypothesis with the best odds on all data, or a simpler one that is as good.

    As good is one with fewer effects and believable numbers that held-out data cannot tell from it, and one
    with fewer parameters while it is an alternative.
    """
    first = hypotheses[0]
    odds = {one: search.advantage(one, first) + held.log_likelihood(one, first) for one in hypotheses}
    best = max(hypotheses, key=lambda one: odds[one])
    fewer = [one for one in hypotheses if len(one.terms) < len(best.terms) and one.believable]
    fewer = [one for one in fewer if not held.confirms(best, one)]
    best = min(fewer, key=lambda one: (len(one.terms), -odds[one]), default=best)
    least = odds[best] + math.log(choice("even"))
    alike = [one for one in hypotheses if odds[one] >= least and one.families == best.families]
    return min(alike, key=lambda one: (one.parameters, -odds[one]))


def _gated(search: Search, held: Held, found: Fitted) -> Fitted:
    """The hypothesis without the terms that held-out data do not confirm."""
    while found.terms:
        as_found = search.problem.numbers(found)
        without = [
            # Its place among the everyday errors stays empty too.
            search.problem.without(
                found, k, {**as_found, term.candidate.key: (0.0,) * len(term.candidate.kind.linear)}
            )
            for k, term in enumerate(found.terms)
        ]
        best = min(range(len(without)), key=lambda k: held.squared(without[k]))
        if held.confirms(found, without[best]):
            break
        found = search.problem.without(found, best)
    return found
