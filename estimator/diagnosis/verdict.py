"""The verdict on what a search has found, and what is reported of it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from estimator.choices import choice
from estimator.diagnosis.curves import best_curve
from estimator.diagnosis.excitation import advice_for, poor
from estimator.diagnosis.findings import (
    alignment_of,
    curves_of,
    findings_of,
    rivals_of,
    series_of,
    stamped_wrongly,
    transmissions_of,
)
from estimator.diagnosis.heldout import errors_of, wider
from estimator.diagnosis.hypothesis import Fitted
from estimator.diagnosis.probabilities import Chances, accounts, believed, chances, standing
from estimator.diagnosis.result import Diagnosis, Errors, Finding, RecordingErrors, Refitted, Verdict
from estimator.diagnosis.search import Progress, Search
from estimator.diagnosis.stiffness import stiffness_curves
from estimator.diagnosis.twins import twins
from estimator.effects import LIBRARY
from estimator.priors import PRIORS
from estimator.reasons import percent

__all__ = ["Judge"]


class _Judged(NamedTuple):
    """A verdict.

    Attributes:
        verdict: in a word.
        effects: the missing effects.
        before, after: the model as declared, and with what was found.
        notes: what qualifies the verdict.
        in_spring: whether what is unexplained is part of the transmission's torque or deflection.
    """

    verdict: Verdict
    effects: list[Finding]
    before: Fitted
    after: Fitted
    notes: list[str]
    in_spring: bool = False


class Judge:
    """Turns the result of a search into a verdict.

    Args:
        search: the candidates.
        found: the explanation that held-out data confirm, from which improbable effects are taken.
        progress: called with the current step.
    """

    def __init__(self, search: Search, found: Fitted, progress: Progress) -> None:
        self.search, self.held = search, search.held
        self.problem, self.progress = search.problem, progress
        self.found = believed(self.held, found, search.seen)
        self.surplus = self.held.surplus(self.found)

    def diagnosis(self) -> Diagnosis:
        """Make verdict, findings and errors."""
        self.progress("free curves")
        curve = best_curve(self.search, self.search.null)
        seen = [*self.search.seen, *([] if curve is None else [curve])]
        beside = accounts(self.held, self.found, seen)
        alike = [twin for twin in twins(self.found, self.problem) if not twin.measured]
        chance = chances(self.found, beside, alike)
        terms = range(len(self.found.terms))
        standings = [standing(self.found, k, beside, chance, alike) for k in terms]
        effects = findings_of(self.search, self.found, standings, self.surplus)
        return self._stated(self._judged(effects, curve), beside, chance)

    def _judged(self, effects: list[Finding], curve: Fitted | None) -> _Judged:
        """The verdict, with the declared model kept where what explains it is worse on held-out data."""
        judged = self._explained(effects, curve)
        if not self._harmful(judged.before, judged.after):
            return judged
        judged = judged._replace(after=judged.before)
        notes = [*judged.notes]
        if judged.verdict == "effect":
            notes.append("on held-out data the effects do not lower the error: they are not written")
        elif not self._astray(judged.before, judged.before):
            return judged
        return judged._replace(verdict="insufficient_excitation", notes=notes)

    def _explained(self, effects: list[Finding], curve: Fitted | None) -> _Judged:
        """The verdict on the effects found, or on a free curve that explains more than they do."""
        before = self._declared(effects)
        if effects and not self.found.terms and not self.held.confirms(self.found, before):
            effects, before = (
                [],
                self._declared([]),
            )  # a reading is off, and nothing held out is the better for it
        if curve is None or not self._unlisted(curve):
            curve = self._remaining()
        if curve is not None and (extra := curve.extra) is not None:
            gone = 1.0 - self.held.squared(curve) / max(self.held.squared(before), 1e-300)
            unlisted = Finding(
                name="unlisted", location=extra.location, motor=extra.motor, parameters={}, std={},
                coordinates=extra.coordinates, share=float(gone),
            )  # fmt: skip
            return _Judged("unexplained", [unlisted], before, curve, [], extra.location == "transmission")
        stamps = self._stamped_wrongly(effects)
        if stamps:
            return _Judged("unexplained", [_unlisted(f) for f in effects], before, self.found, stamps, True)
        verdict, notes = self._named(effects)
        return _Judged(verdict, effects, before, self.found, notes)

    def _harmful(self, before: Fitted, after: Fitted) -> bool:
        """Whether a model is worse on held-out data than the declared one, or than none at all."""
        return self.held.squared(after) > self.held.squared(before) or self._astray(before, after)

    def _astray(self, before: Fitted, after: Fitted) -> bool:
        """Whether a model leaves more than the torque that is measured."""
        return self.held.errors(before, after).after_relative > 1.0

    def _stamped_wrongly(self, effects: list[Finding]) -> list[str]:
        """Delays beyond those of any drive or bus, one sentence each."""
        return [
            said
            for finding in effects
            if isinstance(delay := finding.parameters.get("delay_s"), float)
            and (said := stamped_wrongly(finding.name, delay, self.problem.period_s))
        ]

    def _named(self, effects: list[Finding]) -> tuple[Verdict, list[str]]:
        """(verdict on named effects, what the motion cannot decide)."""
        verdict: Verdict = "effect" if effects else "sufficient"
        if all(poor(frame) for frame in self.problem.frames):
            if not self.problem.frames[0].linked or not effects or any(f.alternatives for f in effects):
                verdict = "insufficient_excitation"
            return verdict, ["the motion is hardly more than one sine: many effects look alike in it"]
        held = self.held.errors(self.found, self.found).after_relative
        left = max(self._left(self.found), held)
        if verdict == "sufficient" and left > PRIORS["effect"].std:
            hidden = (
                f"the model leaves {percent(left, 0)} of the torque, and the recording hides what is missing"
            )
            return "insufficient_excitation", [hidden]
        return verdict, []

    def _stated(self, judged: _Judged, beside: list[tuple[float, Fitted]], chance: Chances) -> Diagnosis:
        """What is reported of a verdict."""
        problem, surplus = self.problem, self.surplus
        effects, before, after = judged.effects, judged.before, judged.after
        transmissions, unsure = transmissions_of(self.search, after, beside, surplus, self._floor(after))
        if judged.in_spring:
            transmissions = tuple(Refitted(one.model, {}, {}) for one in transmissions)
            unsure = ["no stiffness is reported: what is unexplained is in the spring's torque or deflection"]
        sides = self._sides(before, after) if judged.verdict in ("effect", "unexplained") else []
        notes = [*judged.notes, *unsure, *self._doubts(effects), *sides, *problem.clipped, *wider(surplus)]
        aligned = alignment_of(problem, after, effects, surplus, transmissions)
        return Diagnosis(
            verdict=judged.verdict,
            bandwidth_hz=problem.bandwidth_hz,
            effects=tuple(effects),
            train=errors_of(problem, before, after, np.ones(len(problem.group), dtype=bool)),
            validation=self.held.errors(before, after),
            floor_nm=tuple(self._floor(after)),
            transmissions=transmissions,
            alignment={name: value for name, (value, _) in aligned.items()},
            alignment_std={name: std for name, (_, std) in aligned.items()},
            rivals=tuple(rivals_of(self.search, effects, chance)),
            curves=curves_of(problem, after),
            series=series_of(problem, before, after),
            advice=tuple(dict.fromkeys(line for f in effects for line in advice_for(f.name, f.alternatives))),
            notes=tuple(dict.fromkeys(notes)),
            surplus=surplus,
            recordings=self._recordings(before, after),
            stiffness=stiffness_curves(problem, before, after, surplus, transmissions),
        )

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
        if not self._sure(curve):
            return False
        named = min(self.held.squared(h) for h in (self.found, *self.search.leading()))
        return self.held.squared(curve) < (choice("curve") ** 2 if self.found.terms else 1.0) * named

    def _remaining(self) -> Fitted | None:
        """A curve for a balance that named effects leave unexplained although its physics is declared."""
        problem, found = self.problem, self.found
        declared = problem.model.link
        if not problem.frames[0].linked or declared is None:
            return None
        floor = found.regression.floor.copy()
        for frame, k in zip(
            problem.frames, range(problem.equations - 1, len(floor), problem.equations), strict=True
        ):
            read = frame.signals.row_noise(declared, frame.motors[0].stiffness)
            floor[k] = np.hypot(floor[k], np.sqrt(read))
        left = found.posterior.sigma / floor
        worst = int(np.argmax(left)) % problem.equations
        if float(np.max(left)) < choice("far"):
            return None
        link = worst == problem.equations - 1
        return best_curve(self.search, found, ("link", None) if link else ("motor", worst))

    def _sure(self, curve: Fitted) -> bool:
        """Whether held-out data surely ask for a curve: the best of several in noise gains a deviation."""
        return self.held.margin(curve, self.found) > choice("sure")

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

    def _sides(self, before: Fitted, after: Fitted) -> list[str]:
        """What the effects leave of the residuals of both balances, in words."""
        problem = self.problem
        if not problem.frames[0].linked:
            return []
        equation = problem.group % problem.equations
        sides = [equation < problem.equations - 1, equation == problem.equations - 1]
        residuals = [h.regression.residual(h.posterior.x) for h in (before, after)]
        left = np.array([[np.sqrt(np.mean(r[side] ** 2)) for side in sides] for r in residuals])
        motor, link = (percent(float(x), 1) for x in left[1] / np.maximum(left[0], 1e-300))
        said = f"of the error {motor} is left in the motor's balance, {link} in the link's"
        return [f"{said} (an effect at one side lowers only that side's)"]

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
            mine = problem.group // equations == k
            train: Errors = errors_of(problem, before, after, mine)
            made.append(RecordingErrors(train, self.held.of(k, before, after)))
        return tuple(made)


def _unlisted(finding: Finding) -> Finding:
    """A finding without its name and numbers."""
    coordinates = LIBRARY[finding.name].coordinates[:1]
    return Finding(
        name="unlisted", location=finding.location, motor=finding.motor, parameters={}, std={},
        coordinates=coordinates, share=finding.share,
    )  # fmt: skip
