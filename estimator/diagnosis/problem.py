"""Fits models of a joint to recordings: as declared, everyday errors within their priors, effects.

Everything is fitted at once: transmission parameters, declared numbers and readings within their priors
(`estimator.priors`), and the effects of the hypothesis. Nonlinear parameters (shapes of springs and friction,
delays, zeros of readings) are iterated by Gauss-Newton steps.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from estimator.choices import choice, whole
from estimator.diagnosis.corrections import READINGS, corrected, restored
from estimator.diagnosis.declared import declared_corrections, declared_torque
from estimator.diagnosis.design_matrix import Extra, Pinned, Slot, Stack, Term, step_of, stepped
from estimator.diagnosis.frame import Corrections, Frame, Signals
from estimator.diagnosis.hypothesis import Fitted
from estimator.diagnosis.joint_priors import OF_RUN, everyday
from estimator.diagnosis.law_parameters import Base, start, with_flexibility
from estimator.diagnosis.regression import Regression
from estimator.effects import LIBRARY
from estimator.errors import EstimatorError
from estimator.model import JointModel
from estimator.reasons import percent
from estimator.sample import FloatArray, Record

__all__ = ["Problem", "stretches"]


class Problem:
    """Recordings of one joint and its declared model; fits hypotheses to them.

    Args:
        records: of one joint.
        model: as declared.
        bandwidth_hz: of the filter that all channels share.
        calibrating: the recordings are of a healthy joint and determine its declared numbers.
        least: required independent rows per recording.
        like: another problem, with the same filter: recordings of both are filtered once.

    Raises:
        EstimatorError: a recording has fewer.
    """

    def __init__(
        self,
        records: Sequence[Record],
        model: JointModel,
        bandwidth_hz: float,
        calibrating: bool = False,
        least: int = 1,
        like: Problem | None = None,
    ) -> None:
        self.records, self.model, self.bandwidth_hz = records, model, bandwidth_hz
        self.calibrating = calibrating
        known = [] if like is None else list(zip(like.records, like.signals, strict=True))
        made = [next((s for r, s in known if r is record), None) for record in records]
        pairs = zip(records, made, strict=True)
        self.signals: list[Signals] = [s or Signals(record, bandwidth_hz) for record, s in pairs]
        declared = declared_corrections(model)
        self.declared = declared
        self._frames: dict[Corrections, dict[int, Frame]] = {}
        self._points: dict[tuple[tuple[Corrections, ...], Base], list[Frame]] = {}
        frames = [self._frame(k, declared) for k in range(len(records))]
        self.frames = frames
        self.rows = [frame.rows for frame in frames]
        if min(self.rows) < least:
            raise EstimatorError(
                f"the recording is too short for a bandwidth of {bandwidth_hz:g} Hz: "
                f"expected at least {least} independent rows, got {min(self.rows)}"
            )
        equations = frames[0].equations
        self.group = np.repeat(np.arange(len(frames) * equations), np.repeat(self.rows, equations))
        torque = np.concatenate(
            [
                np.concatenate([f.project(c.torque) - f.project(c.torque).mean() for c in f.motors])
                for f in frames
            ]
        )
        self.torque_rms = float(np.sqrt(np.mean(torque**2)))
        self._begin = start(max(frames, key=lambda f: max(float(np.ptp(c.deflection)) for c in f.motors)))
        self.floor = self._least()
        self.smoothing_rad_s = max(
            signals.velocity_noise(i) for signals in self.signals for i in range(len(model.motors))
        )

    def _least(self) -> FloatArray:
        """(groups,) what filters leave of the torque anyway, and rounding of the springs', N·m.

        Next to nothing in a fit: it names no effect, and below these errors a stiffness is still found.
        """
        if self.calibrating:
            return np.full(len(self.frames) * self.equations, choice("exact") * self.torque_rms)
        made: list[float] = []
        for frame in self.frames:
            motors = with_flexibility(frame, self._begin).motors
            pairs = zip(motors, frame.signals.rounding_rad, strict=True)
            rounded = [float(np.sqrt(np.mean(c.stiffness**2))) * angle for c, angle in pairs]
            made += rounded + [float(np.linalg.norm(np.array(rounded)[list(frame.pulls)]))] * frame.linked
        return np.hypot(choice("floor") * self.torque_rms, made)

    def bent(self, fitted: Fitted) -> FloatArray:
        """Return (groups,) what the springs' laws leave, N·m: of what they have beyond the stiffness at
        rest, as any law, and what the joint file says that its own fit has left.
        """
        made: list[float] = []
        for frame in self.at(fitted.corrections, fitted.base):
            left = []
            for i, law in enumerate(fitted.base.models(frame)):
                c, known = frame.motors[i], frame.model.motors[i].fit_rms_nm or (0.0, np.inf)
                bend = 0.0
                if law is not None:
                    linear = float(law.stiffness(np.zeros(1), fitted.base.alpha[i])[0]) * c.deflection
                    bend = choice("law") * float(np.std(frame.project(c.flexibility_torque - linear)))
                left.append(math.hypot(bend, known[0] * max(self.torque_rms / known[1], 1.0)))
            made += left + [float(np.linalg.norm(np.array(left)[list(frame.pulls)]))] * frame.linked
        return np.array(made)

    def alike(self, records: Sequence[Record]) -> Problem:
        """Return the same joint and filter with other recordings."""
        least = whole("groups")
        return Problem(records, self.model, self.bandwidth_hz, self.calibrating, least, like=self)

    @property
    def period_s(self) -> float:
        """The longest sampling period."""
        return max(signals.period_s for signals in self.signals)

    @property
    def clipped(self) -> list[str]:
        """One sentence on torques at their limit, if there are such."""
        share = max(signals.clipped for signals in self.signals)
        if not share:
            return []
        return [
            f"the torque rests on its largest or smallest value in {percent(share, 1)} of the samples, as if "
            "clipped: what is near is left out"
        ]

    def unit_of(self, term: Term, name: str) -> float:
        """Return a nonlinear parameter's unit per unit of its slot."""
        return step_of(term, name, self.frames[0])[1]

    @property
    def equations(self) -> int:
        """Number of balances of one recording."""
        return self.frames[0].equations

    def _frame(self, k: int, corrections: Corrections) -> Frame:
        made = self._frames.setdefault(corrections, {})
        if k not in made:
            made[k] = Frame.make(self.model, self.signals[k], corrections)
            while len(self._frames) > 6:
                self._frames.pop(next(iter(self._frames)))
        return made[k]

    def at(self, corrections: Sequence[Corrections], base: Base) -> list[Frame]:
        """Return the frames of all recordings, readings corrected, flexibility torques filled in."""
        key = tuple(corrections), base
        if key not in self._points:
            while len(self._points) >= 6:
                self._points.pop(next(iter(self._points)))
            self._points[key] = [with_flexibility(self._frame(k, c), base) for k, c in enumerate(corrections)]
        return self._points[key]

    # -- fitting ------------------------------------------------------------------------------------------

    def null(self, pinned: Pinned | None = None) -> Fitted:
        """Return the fitted declared model, everyday errors within their priors or pinned."""
        corrections = tuple(self.declared for _ in self.signals)
        return self.fit((), self._begin, corrections, pinned=pinned)

    def numbers(self, like: Fitted | None = None) -> Pinned:
        """Return the declared numbers, pinned as they are declared or as another hypothesis has them."""
        made = {}
        for candidate in everyday(self.frames[0]):
            name, motor = candidate.key
            if name in READINGS or name in OF_RUN:
                continue
            parts = [] if like is None else like.total("everyday", name, motor)
            made[candidate.key] = tuple(parts) or (0.0,) * len(candidate.kind.linear)
        return made

    def fit(
        self,
        terms: tuple[Term, ...],
        base: Base,
        corrections: tuple[Corrections, ...],
        steps: int | None = None,
        extra: Extra | None = None,
        pinned: Pinned | None = None,
    ) -> Fitted:
        """Return the Gauss-Newton iteration from a given point; return the best point.

        The evidence is too optimistic of the first step, and where the next correction of a reading is more
        than its standard deviation: of a hypothesis that is kept it does not stop there. The fit of a healthy
        joint continues until it converges. A step that leads too far (`_carries`) is halved.
        """
        best = self._linearised(terms, base, corrections, extra, pinned or {})
        for k in range(whole("newton_steps") if steps is None else steps):
            if not self._curved(best) or _converged(best):
                break
            shares = (0.5**j for j in range(whole("newton_steps")))
            points = (self._moved(best, share) for share in shares)
            there = next((point for point in points if self._carries(*point[1:])), None)
            if there is None:
                break
            now = self._linearised(*there, extra, pinned or {})
            judged = not self.calibrating and (steps is not None or _read(best))
            if k and judged and now.posterior.evidence < best.evidence(now):
                break
            best = now
        return best

    def added(self, fitted: Fitted, term: Term, steps: int | None = None, begin: float = 0.0) -> Fitted:
        """Return the hypothesis with one more term; that of a reading may begin at a correction."""
        corrections = fitted.corrections
        if begin:
            name, motor = term.candidate.key
            there = tuple(corrected(c, name, motor, 0, begin) for c in corrections)
            corrections = there if self._carries(fitted.base, there) else corrections
        return self.fit((*fitted.terms, term), fitted.base, corrections, steps, pinned=fitted.pinned)

    def without(self, fitted: Fitted, k: int, pinned: Pinned | None = None) -> Fitted:
        """Return the hypothesis without one term; its correction of a reading is undone."""
        term = fitted.terms[k]
        terms = fitted.terms[:k] + fitted.terms[k + 1 :]
        corrections = tuple(restored(c, self.declared, term.candidate) for c in fitted.corrections)
        return self.fit(terms, fitted.base, corrections, extra=fitted.extra, pinned=pinned)

    def with_declared(self, fitted: Fitted, key: tuple[str, int | None]) -> Fitted:
        """Return the hypothesis with an everyday error of a reading as it is declared."""
        candidate = next(c for c in everyday(self.frames[0]) if c.key == key)
        corrections = tuple(restored(c, self.declared, candidate) for c in fitted.corrections)
        pinned = {**fitted.pinned, key: (0.0,)}
        return self.fit(fitted.terms, fitted.base, corrections, pinned=pinned)

    def with_curve(self, fitted: Fitted, extra: Extra, steps: int) -> Fitted:
        """Return the hypothesis with a free curve."""
        return self.fit(fitted.terms, fitted.base, fitted.corrections, steps, extra=extra)

    def transferred(self, fitted: Fitted, corrections: Corrections) -> Fitted:
        """Return a model fitted to other recordings, evaluated on this one without refitting."""
        bare = tuple(replace(t, weights=()) for t in fitted.terms)
        kept = [(s, x) for s, x in zip(fitted.slots, fitted.posterior.x, strict=True) if s.kind != "shape"]
        there = self._linearised(bare, fitted.base, (corrections,), fitted.extra, fitted.pinned)
        values = {(s.kind, s.name, s.motor, s.place, s.part): float(x) + s.taken for s, x in kept}
        x = np.array([values[s.kind, s.name, s.motor, s.place, s.part] - s.taken for s in there.slots])
        return replace(there, posterior=there.posterior._replace(x=x))

    def torque(self) -> FloatArray:
        """Return the measured torque of each row without its mean, as declared; zero for the link."""
        made = []
        for frame in self.frames:
            made += [frame.project(c.torque) - float(np.mean(frame.project(c.torque))) for c in frame.motors]
            made += [np.zeros(frame.rows)] * (frame.equations - len(frame.motors))
        return np.concatenate(made)

    def _carries(self, base: Base, corrections: tuple[Corrections, ...]) -> bool:
        """Whether what filters leave of the transmissions' torque is less than what acts on them.

        Beyond that a model says nothing: a step too long leads there of an exponential spring.
        """
        frames = self.at(corrections, base)
        carried = np.concatenate([base.torque(f) for f in frames])
        exerted = np.concatenate([f.target() - declared_torque(f) for f in frames])
        most = float(np.linalg.norm(exerted)) + np.sqrt(len(exerted)) * self.torque_rms
        return bool(choice("floor") * np.linalg.norm(carried) <= most)

    def _curved(self, fitted: Fitted) -> bool:
        return any(
            slot.kind == "shape" or slot.name in READINGS for slot in fitted.slots if slot.kind != "base"
        ) or any(m is not None and m.shape_names for m in fitted.base.models(self.frames[0]))

    def _linearised(
        self,
        terms: tuple[Term, ...],
        base: Base,
        corrections: tuple[Corrections, ...],
        extra: Extra | None,
        pinned: Pinned,
    ) -> Fitted:
        frames = self.at(corrections, base)
        stack = Stack(frames, corrections, self.declared, self.torque_rms, self.calibrating)
        stack.transmissions(base)
        stack.lever(base)
        stack.turns()
        stack.everyday({t.candidate.key for t in terms}, pinned)
        for k, term in enumerate(terms):
            stack.term(k, term)
        if extra is not None:
            stack.curve(extra)
        groups = self.equations * len(frames)
        regression = Regression.make(
            stack.design,
            np.concatenate([f.target() - declared_torque(f) - base.torque(f) for f in frames]),
            np.array(stack.mean),
            np.array(stack.std),
            np.array(stack.low),
            self.group,
            self.floor,
            stack.scales(terms),
        )
        times = np.ones(groups)
        posterior = regression.solve(times)
        for _ in range(2):
            times = regression.autocorrelation_times(posterior.x)
            posterior = regression.solve(times, posterior)
        laws = np.concatenate([declared_torque(f, laws=True) for f in frames])
        if terms or (np.any(laws) and not self.calibrating):
            regression = replace(regression, floor=self._floor(regression, stack.slots, posterior.x, laws))
            posterior = regression.solve(times, posterior)
        terms = _weighed(terms, stack.slots, posterior.x)
        slots = tuple(stack.slots)
        return Fitted(terms, base, corrections, slots, regression, times, posterior, extra, pinned)

    def _floor(
        self, regression: Regression, slots: list[Slot], x: FloatArray, laws: FloatArray
    ) -> FloatArray:
        """(groups,) noise floor: rounding, and the typical error of an effect's law, be it declared."""
        effect = [j for j, s in enumerate(slots) if s.kind == "term" and LIBRARY[s.name].nonlinear]
        square = self.floor**2
        torque = regression.design[:, effect] @ x[effect]
        for g in range(len(square)):
            mine = self.group == g
            square[g] += choice("law") ** 2 * float(np.mean(torque[mine] ** 2) + np.mean(laws[mine] ** 2))
        return np.asarray(np.sqrt(square))

    def _moved(
        self, fitted: Fitted, share: float = 1.0
    ) -> tuple[tuple[Term, ...], Base, tuple[Corrections, ...]]:
        """The optimum of the linearised model, or a share of the way to it."""
        x = share * fitted.posterior.x
        own = np.array([v for slot, v in zip(fitted.slots, x, strict=True) if slot.kind == "base"])
        base = fitted.base.moved(self.frames[0], own)
        corrections = list(fitted.corrections)
        terms = list(fitted.terms)
        for slot, value in zip(fitted.slots, x.tolist(), strict=True):
            if slot.kind == "shape":
                term = terms[slot.place]
                terms[slot.place] = replace(term, values=stepped(term, slot.name, value, self.frames[0]))
            elif slot.name in READINGS:
                for run in range(len(corrections)) if slot.run is None else (slot.run,):
                    corrections[run] = corrected(corrections[run], slot.name, slot.motor, slot.part, value)
        return tuple(terms), base, tuple(corrections)


def stretches(problem: Problem) -> NDArray[np.int64]:
    """Return (n,) stretch of time of each row, equal in all balances of a recording."""
    count = whole("groups")
    each = [np.arange(rows) * count // rows + k * count for k, rows in enumerate(problem.rows)]
    return np.concatenate([np.tile(one, problem.equations) for one in each])


def _weighed(terms: tuple[Term, ...], slots: list[Slot], x: FloatArray) -> tuple[Term, ...]:
    made = []
    for k, term in enumerate(terms):
        weights = tuple(
            s.taken + float(v) for s, v in zip(slots, x, strict=True) if s.kind == "term" and s.place == k
        )
        made.append(replace(term, weights=weights))
    return tuple(made)


def _read(fitted: Fitted) -> bool:
    """Whether no correction of a reading is more than its standard deviation."""
    std = np.sqrt(np.maximum(np.diag(fitted.posterior.covariance), 0.0))
    moves = zip(fitted.slots, fitted.posterior.x, std, strict=True)
    return all(abs(x) <= s for slot, x, s in moves if slot.name in READINGS)


def _converged(fitted: Fitted) -> bool:
    std = np.sqrt(np.maximum(np.diag(fitted.posterior.covariance), 0.0))
    moves = [
        abs(x) > choice("converged") * s
        for slot, x, s in zip(fitted.slots, fitted.posterior.x, std, strict=True)
        if slot.kind in ("shape", "base") or slot.name in READINGS
    ]
    first = any(t.free and not _has_shapes(fitted, k) for k, t in enumerate(fitted.terms))
    return not first and not any(moves)


def _has_shapes(fitted: Fitted, k: int) -> bool:
    return any(s.kind == "shape" and s.place == k for s in fitted.slots)
