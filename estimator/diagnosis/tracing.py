"""The diagnosis: verdict, effects, transmissions and errors from recordings and model."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from estimator.diagnosis.bandwidth import choose_bandwidth
from estimator.diagnosis.certainty import accounts, standing
from estimator.diagnosis.choices import choice, least_rows
from estimator.diagnosis.curves import best_curve
from estimator.diagnosis.excitation import advice_for, poor
from estimator.diagnosis.heldout import Held, errors_of, held_out, wider
from estimator.diagnosis.hypothesis import Fitted, Problem
from estimator.diagnosis.openorder import raised
from estimator.diagnosis.outcome import (
    alignment_of,
    curves_of,
    findings_of,
    rivals_of,
    series_of,
    transmissions_of,
)
from estimator.diagnosis.result import Diagnosis, Errors, Finding, RecordingErrors, Verdict
from estimator.diagnosis.search import Progress, Search
from estimator.diagnosis.stiffness import stiffness_curves
from estimator.effects import LIBRARY
from estimator.errors import EstimatorError
from estimator.gate import check, refuse
from estimator.model import JointModel
from estimator.priors import PRIORS
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
        GateError: units, signs, gear ratio or time of a recording do not fit the joint.
    """
    records = [record] if isinstance(record, Record) else list(record)
    everything = records + ([] if validation is None else [validation])
    for one in everything:
        check(one, model)
    progress("units and signs")
    doubts = [remark for one in everything if (remark := refuse(one, model).remark)]
    progress("bandwidth")
    bandwidth = bandwidth_hz or choose_bandwidth(records[0], model)
    nyquist = 0.4 / max(r.period_s for r in records)
    if not 0.0 < bandwidth <= nyquist:
        raise EstimatorError(f"bandwidth: expected more than 0 and at most {nyquist:g} Hz, got {bandwidth:g}")
    alone = validation is None and len(records) == 1
    problem = Problem(records, model, bandwidth, held=alone, least=least_rows())
    search = Search(problem, progress)
    progress("held-out data")
    held = held_out(problem, validation)
    leading = search.run()
    found = _chosen(search, held, [_gated(search, held, one) for one in leading])
    outcome = _Judge(search, held, leading[0], found, progress).diagnosis()
    higher = raised(model, outcome.effects)
    if higher is not None:
        return diagnose(records, higher, bandwidth, validation, progress)
    return replace(outcome, notes=tuple(dict.fromkeys((*outcome.notes, *doubts))))


def _chosen(search: Search, held: Held, hypotheses: list[Fitted]) -> Fitted:
    """Of the hypotheses that pass the held-out test, the one with the best odds on all data."""
    best = hypotheses[0]

    def odds(one: Fitted) -> float:
        return search.advantage(one, best) + held.log_likelihood(one, best)

    return max(hypotheses, key=odds)


def _gated(search: Search, held: Held, found: Fitted) -> Fitted:
    """The hypothesis without the terms that do not lower the error on held-out data."""
    while found.terms:
        error = held.squared(found)
        as_found = search.problem.numbers(found)
        without = [search.problem.without(found, k, as_found) for k in range(len(found.terms))]
        left = [held.squared(rest) for rest in without]
        best = int(np.argmin(left))
        if left[best] > error:
            break
        found = search.problem.without(found, best)
    return found


class _Judge:
    """Turns the result of the search into a verdict."""

    def __init__(
        self, search: Search, held: Held, first: Fitted, found: Fitted, progress: Callable[[str], None]
    ) -> None:
        self.search, self.held, self.first, self.found = search, held, first, found
        self.problem, self.progress = search.problem, progress

    def _sides(self, before: Fitted, after: Fitted) -> list[str]:
        """Residuals of both balances, after over before, in words."""
        problem = self.problem
        if not problem.frames[0].linked:
            return []
        equation = problem.group % problem.equations
        sides = [equation < problem.equations - 1, equation == problem.equations - 1]
        residuals = [h.regression.residual(h.posterior.x) for h in (before, after)]
        left = np.array(
            [[np.sqrt(np.mean(r[side & problem.used] ** 2)) for side in sides] for r in residuals]
        )
        motor, link = left[1] / np.maximum(left[0], 1e-300)
        return [f"the motor's balance (eq 5) leaves {motor:.1%} of what it did, the link's (eq 4) {link:.1%}"]

    def diagnosis(self) -> Diagnosis:
        """Make verdict, findings and errors."""
        problem, found, null = self.problem, self.found, self.search.null
        surplus = self._surplus()
        rivals = [self.search.rivals(found, k) for k in range(len(found.terms))]
        self.progress("free curves")
        curve = best_curve(self.search, null)
        others = [null, *(r for each in rivals for r in each)]
        free = [] if curve is None else [curve]
        beside = accounts(self.search, found, [*others, *self.search.seen, *free])
        standings = [standing(self.search, found, k, beside) for k in range(len(found.terms))]
        effects = findings_of(problem, found, null, standings, surplus)
        verdict: Verdict = "effect" if effects else "sufficient"
        after, notes = found, []
        before = self._declared(effects)
        if curve is None or not self._unlisted(curve):
            curve = self._remaining()
        if curve is not None and (extra := curve.extra) is not None:
            verdict, after = "unexplained", curve
            gone = 1.0 - self.held.squared(curve) / max(self.held.squared(before), 1e-300)
            effects = [
                Finding(
                    name="unlisted", location=extra.location, motor=extra.motor, parameters={}, std={},
                    coordinates=extra.coordinates, share=float(gone),
                )
            ]  # fmt: skip
        elif all(poor(frame) for frame in problem.frames):
            notes.append("the motion is hardly more than one sine: many effects look alike in it")
            if not problem.frames[0].linked or not effects or any(f.alternatives for f in effects):
                verdict = "insufficient_excitation"
        elif verdict == "sufficient" and (left := self._left(found)) > PRIORS["effect"].std:
            notes.append(
                f"the model leaves {left:.0%} of the torque, and the recording hides what is missing"
            )
            verdict = "insufficient_excitation"
        train = errors_of(problem, before, after, problem.used)
        validation = self.held.errors(before, after)
        if verdict == "effect" and self.held.squared(after) > self.held.squared(before):
            verdict = "insufficient_excitation"
            notes.append("on data that took no part the effects do not lower the error: they are not written")
        explanations = [h for h in (found, *others) if h is not after]
        chances = [(self.search.chance(after, h, surplus), h) for h in explanations]
        transmissions, unsure = transmissions_of(self.search, after, chances, surplus)
        notes += unsure + self._doubts(effects)
        if verdict in ("effect", "unexplained"):
            notes += self._sides(before, after)
        return Diagnosis(
            verdict=verdict,
            bandwidth_hz=problem.signals[0].bandwidth_hz,
            effects=tuple(effects),
            train=train,
            validation=validation,
            floor_nm=tuple(self._floor(after)),
            transmissions=transmissions,
            alignment=alignment_of(problem, after, effects, surplus),
            rivals=tuple(rivals_of(self.search)),
            curves=curves_of(problem, after),
            series=series_of(problem, before, after),
            advice=tuple(dict.fromkeys(line for f in effects for line in advice_for(f.name, f.alternatives))),
            notes=tuple(dict.fromkeys((*notes, *wider(surplus)))),
            surplus=surplus,
            recordings=self._recordings(before, after),
            stiffness=stiffness_curves(problem, before, after, surplus),
        )

    def _surplus(self) -> float:
        """Of the explanation found, or of the one that the fitted data alone prefer, if that has more.

        Held-out data took part in choosing the former.
        """
        return max(self.held.surplus(one) for one in (self.first, self.found))

    def _declared(self, effects: list[Finding]) -> Fitted:
        """The fitted declared model: declared numbers, readings aligned within everyday errors."""
        pinned = dict(self.problem.numbers())
        for finding in effects:
            kind = LIBRARY[finding.name]
            if kind.channel != "torque" or kind.name == "torque_offset":
                pinned[kind.name, finding.motor] = (0.0,) * len(kind.linear)
        zeros = ("torque_offset", "deflection_offset")
        if self.problem.frames[0].linked or "torque_offset" in {f.name for f in effects}:
            motors = range(len(self.problem.model.motors))
            pinned |= {(name, i): (0.0,) for name in zeros for i in motors}
        return self.problem.null(pinned)

    def _unlisted(self, curve: Fitted) -> bool:
        """Whether a free curve explains more than all named effects, here and on held-out data."""
        if self.search.advantage(curve, self.found) <= 0.0:
            return False
        named = min(self.held.squared(h) for h in (self.found, *self.search.leading()))
        free, before = self.held.squared(curve), self.held.squared(self.search.null)
        return free < before and free < (choice("curve") ** 2 if self.found.terms else 1.0) * named

    def _remaining(self) -> Fitted | None:
        """A curve for a balance that named effects leave unexplained although its physics is declared."""
        problem, found = self.problem, self.found
        if not problem.frames[0].linked:
            return None
        left = found.posterior.sigma / found.regression.floor
        worst = int(np.argmax(left)) % problem.equations
        if float(np.max(left)) < choice("far"):
            return None
        link = worst == problem.equations - 1
        return best_curve(self.search, found, ("link", None) if link else ("motor", worst))

    def _doubts(self, effects: list[Finding]) -> list[str]:
        """What these data cannot decide, one sentence each."""
        link = self.problem.model.link
        for finding in effects:
            if finding.name not in ("motor_inertia", "link_inertia"):
                continue
            at_link = finding.name == "link_inertia" and link is not None
            motor = self.problem.model.motors[finding.motor or 0]
            declared = link.inertia_kg_m2 if at_link and link is not None else motor.inertia_kg_m2
            more = finding.parameters["inertia_kg_m2"]
            if self.problem.frames[0].linked and isinstance(more, float):
                if abs(more) > PRIORS["anchor"].std * declared:
                    return [
                        f"an inertia of {more:.3g} kg·m² beyond the declared {declared:.3g} kg·m² is hardly "
                        "to be believed: check it, and what may be missing in the library"
                    ]
            elif isinstance(more, float):
                return [
                    "without [link.dynamics] a wrong motor inertia, a wrong torque constant and a wrong "
                    "stiffness look alike: check the declared inertia and torque constant first"
                ]
        return []

    def _left(self, found: Fitted) -> float:
        """Relative error of the motors' balances."""
        return float(np.sqrt(np.mean(np.square(self._floor(found))))) / self.problem.torque_rms

    def _floor(self, after: Fitted) -> list[float]:
        left = after.regression.residual(after.posterior.x)
        motors = len(self.problem.model.motors)
        return [
            float(np.sqrt(np.mean(left[self.problem.group % self.problem.equations == i] ** 2)))
            for i in range(motors)
        ]

    def _recordings(self, before: Fitted, after: Fitted) -> tuple[RecordingErrors, ...]:
        problem, equations = self.problem, self.problem.equations
        made: list[RecordingErrors] = []
        for k in range(len(problem.signals)):
            mine = (problem.group // equations == k) & problem.used
            train: Errors = errors_of(problem, before, after, mine)
            made.append(RecordingErrors(train, self.held.of(k, before, after)))
        return tuple(made)
