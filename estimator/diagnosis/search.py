"""The search for missing effects: a beam of hypotheses, compared by what held-out blocks say (`Held`).

The best hypotheses so far are extended by one effect, with its nonlinear parameters fitted together with all
others; then each effect of the best is left out or replaced, until nothing better or simpler is found.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from estimator.choices import choice, whole
from estimator.diagnosis.candidates import Candidate, columns, grid, members
from estimator.diagnosis.design_matrix import Term
from estimator.diagnosis.frame import Frame
from estimator.diagnosis.heldout import Held
from estimator.diagnosis.hypothesis import Fitted, Keys
from estimator.diagnosis.joint_priors import effect_std
from estimator.diagnosis.problem import Problem
from estimator.priors import PRIORS
from estimator.sample import FloatArray

__all__ = ["Progress", "Search"]

_SMOOTHING, _PEAK, _PERIODS = "smoothing_rad_s", "stribeck_velocity_rad_s", "periods_per_rev"

Progress = Callable[[str], None]


@dataclass(slots=True)
class _Entry:
    """One candidate over its grid of n points: m columns each, at the declared model.

    Attributes:
        candidate: it. values: (n) of its nonlinear parameters.
        rows: of the library's columns. grams: (groups, n, m, m) of the columns in each balance.
        std: (n, m) prior of the linear parameters.
    """

    candidate: Candidate
    values: list[dict[str, float]]
    rows: slice
    grams: FloatArray
    std: FloatArray


class _Tried(NamedTuple):
    """An effect added to a hypothesis at the most promising point of its grid.

    Attributes:
        candidate: it. values: its nonlinear parameters. points: of its grid.
        gain: of the logarithm of the evidence.
        shift: (m, k) of x per prior standard deviation of the effect's parameters.
        precision: (m, m) of these. side: (m,) this precision times their estimates.
    """

    candidate: Candidate
    values: dict[str, float]
    points: int
    gain: float
    shift: FloatArray
    precision: FloatArray
    side: FloatArray

    def independent(self, effect: float) -> _Tried:
        """Return the same where so many rows have the information of one (`design_effects`)."""
        eye = np.eye(len(self.precision))
        precision, side = eye + (self.precision - eye) / effect, self.side / effect
        return self._replace(precision=precision, side=side, gain=float(_gain(precision, side)))

    @property
    def covariance(self) -> FloatArray:
        """(k, k) increase of the covariance of x, times the odds that the data leave it, at most once."""
        if not math.isfinite(self.gain):
            return np.zeros((self.shift.shape[1],) * 2)
        made = self.shift.T @ np.linalg.solve(self.precision, self.shift)
        return np.asarray(math.exp(min(self.gain, 0.0)) * 0.5 * (made + made.T))

    @property
    def change(self) -> FloatArray:
        """(k,) change of x."""
        return np.asarray(np.linalg.solve(self.precision, self.side) @ self.shift)


def _gain(precision: FloatArray, side: FloatArray) -> FloatArray:
    """(...) gain of evidence by parameters of this precision (..., m, m), or minus infinity."""
    sign, logdet = np.linalg.slogdet(precision)
    sound = (sign > 0.0) & np.isfinite(logdet)
    at = np.linalg.solve(np.where(sound[..., None, None], precision, np.eye(side.shape[-1])), side[..., None])
    gain = 0.5 * np.einsum("...i,...i", side, at[..., 0]) - 0.5 * logdet
    return np.where(sound & np.isfinite(gain), gain, -np.inf)


def _change(one: Fitted, other: Fitted) -> FloatArray:
    """(k,) of the columns of one hypothesis, what they are in another beyond it."""
    here, there = (
        {slot[:-1]: slot.taken + float(x) for slot, x in zip(h.slots, h.posterior.x, strict=True)}
        for h in (one, other)
    )
    return np.array([there.get(key, x) - x for key, x in here.items()])


class Search:
    """Finds the simplest hypothesis that held-out data cannot tell from the best.

    Args:
        problem: the recordings and the declared model.
        held: what decides; left out: blocks of the recordings.
        progress: called with the current step.
        null: the fitted declared model, if available.

    Attributes:
        seen: the hypotheses that were compared.
    """

    def __init__(
        self,
        problem: Problem,
        held: Held | None = None,
        progress: Progress = lambda _: None,
        null: Fitted | None = None,
    ) -> None:
        self.problem, self._progress = problem, progress
        self.held = held or Held(problem)
        self.null = null or problem.null()
        self._singles: list[Fitted] = []
        self.seen: list[Fitted] = [self.null]
        frames = problem.at(self.null.corrections, self.null.base)
        self._library: list[_Entry] = []
        made: list[FloatArray] = []
        for candidate in members(frames[0]):
            self._enter(candidate, frames, made)
        self._columns = np.concatenate(made) if made else np.zeros((0, len(problem.group)))

    def _enter(self, candidate: Candidate, frames: Sequence[Frame], made: list[FloatArray]) -> None:
        """Add a candidate over its grid to the library, and its columns to those made."""
        problem = self.problem
        # A fit names no effect: of the ripples only slow ones look like a spring, and may widen its interval.
        ripples = whole("points" if problem.calibrating else "ripples")
        values = grid(frames[0], candidate, problem.smoothing_rad_s, ripples)
        if not values:
            return
        each = [np.concatenate([columns(f, candidate, v).T for f in frames], axis=1) for v in values]
        stacked = np.stack(each)
        points, count, _ = stacked.shape
        ends = np.cumsum(np.bincount(problem.group))[:-1]
        grams = [mine @ mine.swapaxes(1, 2) for mine in np.split(stacked, ends, axis=-1)]
        sizes = np.sqrt(np.mean(stacked * stacked, axis=-1)) + 1e-100
        by_torque = PRIORS["effect"].std * problem.torque_rms / np.sqrt(count) / sizes
        std = effect_std(frames, candidate, by_torque)
        first = sum(map(len, made))
        made.append(stacked.reshape(points * count, -1))
        rows = slice(first, first + points * count)
        self._library.append(_Entry(candidate, values, rows, np.array(grams), std))

    def run(self) -> Fitted:
        """Return the simplest hypothesis that held-out data cannot tell from the best of all compared."""
        beam, leader = [self.null], self.null
        for size in itertools.count(1):
            self._progress(f"term {size}")
            grown = [child for parent in beam for child in self.children(parent)]
            self._singles = self._singles or grown
            if not grown:
                break
            beam = self.ranked(grown)[: whole("beam")]
            self.seen += beam if size > 1 else self.ranked(grown)
            if self.held.confirms(beam[0], leader):
                leader = beam[0]
            elif size > 1:
                break
        self._progress("alternatives")
        settled, tried = {self.null}, set[Fitted]()
        while True:
            found = self.held.simplest(self.seen)
            if found in tried:
                return found
            if found in settled:
                tried.add(found)
                beside = self._beside(found)
                self.seen += beside
            else:
                self.seen.remove(found)
                found = self._settled(found)
                settled.add(found)
                self.seen.append(found)

    def _beside(self, found: Fitted) -> list[Fitted]:
        """The hypothesis without each of its effects, with another instead, with one for a pair."""
        made: list[Fitted] = []
        for k in range(len(found.terms)):
            rest = self.problem.without(found, k)
            made += [rest, *self.rivals(found, k, rest)[: whole("beam")]]
            for j in range(k):
                made += self.children(self.problem.without(rest, j), most=whole("beam"))
        return made

    def singles(self) -> list[Fitted]:
        """Return the promising effects, each alone."""
        return self._singles

    def leading(self) -> list[Fitted]:
        """Return the best single effects."""
        return self.ranked(self._singles)[: whole("beam")]

    def children(
        self, parent: Fitted, like: Candidate | None = None, most: int | None = None
    ) -> list[Fitted]:
        """Return the most promising extensions by one effect; `like`, `most`: see `screen`."""
        return [child for child in self.grown(parent, like, most) if child.is_real_beside(parent)]

    def grown(self, parent: Fitted, like: Candidate | None = None, most: int | None = None) -> list[Fitted]:
        """Return the same with those that the data hold at zero."""
        return [self._grown(parent, term) for term in self.screen(parent, like, most)]

    def with_effect(self, parent: Fitted, name: str, motor: int | None) -> Fitted | None:
        """Return the extension by a named effect; None: the data cannot reveal it."""
        for one in self._library_beside(parent):
            if (one.candidate.kind.name, one.candidate.motor) == (name, motor):
                return self._grown(parent, Term(one.candidate, dict(one.values)))
        return None

    def _grown(self, parent: Fitted, term: Term) -> Fitted:
        """Add one effect; from several starts, as friction and a long delay have several optima."""
        child = self.problem.added(parent, term, whole("rough_steps"))
        if term.candidate.kind.name == "deflection_delay":
            late = (PRIORS["late_deflection"].std * 2.0**k for k in (-1.0, 0.0, 1.0, 1.75))
            others = [self.problem.added(parent, term, whole("rough_steps"), one) for one in late]
            return max(child, *others, key=lambda h: h.evidence(child))
        if _SMOOTHING not in term.values:
            return child
        sharpest = next(e.values[0] for e in self._library if e.candidate == term.candidate)
        softer = {**term.values, _SMOOTHING: choice("softer") * term.values[_SMOOTHING]}
        starts = [softer] if term.values == sharpest else [softer, dict(sharpest)]
        if _PEAK in term.values:
            starts.append({**softer, _PEAK: term.values[_PEAK] / choice("softer")})
        others = [self.problem.added(parent, Term(term.candidate, v), whole("rough_steps")) for v in starts]
        return max(child, *others, key=lambda h: h.evidence(child))

    def ranked(self, hypotheses: Sequence[Fitted]) -> list[Fitted]:
        """Return the best by held-out blocks first, without duplicates."""
        unique: dict[Keys, Fitted] = {}
        for one in sorted(hypotheses, key=lambda h: -float(np.mean(self.held.scores(h)))):
            unique.setdefault(one.keys, one)
        return list(unique.values())

    def _settled(self, hypothesis: Fitted) -> Fitted:
        return self.problem.fit(hypothesis.terms, hypothesis.base, hypothesis.corrections)

    def rivals(self, hypothesis: Fitted, k: int, rest: Fitted) -> list[Fitted]:
        """Return alternatives to a term beside the rest, best first; a ripple elsewhere also starts at its
        period, once a turn for an eccentric encoder.
        """
        own = hypothesis.terms[k]
        grown, here = self.children(rest, like=own.candidate), own.candidate
        once = {_PERIODS: 1.0} if here.kind.name == "encoder_eccentricity" else {}
        if values := once | {name: own.values[name] for name in own.values if name == _PERIODS}:
            ripples = [e.candidate for e in self._library if _PERIODS in e.candidate.kind.nonlinear]
            each = [c.beside(rest.keys) for c in ripples if c != here and here.motor in (c.motor, None)]
            moved = [self._grown(rest, Term(c, values)) for c in each if c is not None]
            grown += [child for child in moved if child.is_real_beside(rest)]
        return self.ranked([child for child in grown if child.terms[-1].candidate.key != own.candidate.key])

    def screen(self, parent: Fitted, like: Candidate | None = None, most: int | None = None) -> list[Term]:
        """Return the most promising additional effects, at the best point of their grid.

        Args:
            parent: the hypothesis.
            like: an effect whose whole family is included.
            most: so many at most.
        """
        found = []
        rubbing = {t.candidate.motor for t in parent.terms if t.candidate.rubs}
        for one in self._library_beside(parent):
            if one.candidate.rubs and one.candidate.motor in rubbing:
                continue
            gain = one.gain - math.log(one.points)
            if gain > 0.0 or not parent.terms:  # fitted alone, one may gain that does not on the grid
                found.append((gain, Term(one.candidate, dict(one.values))))
        found.sort(key=lambda pair: -pair[0])
        tried = most or whole("tried")
        more = [t for _, t in found[tried:] if like is not None and t.candidate.family == like.family]
        return [term for _, term in found[:tried]] + more

    def unseen(self, parent: Fitted, places: Sequence[int], effect: float) -> tuple[FloatArray, FloatArray]:
        """Increase of a hypothesis' covariance by effects that it lacks: at their prior size, and as found.

        A rejected effect may still be present if the motion does not separate it: a gear with losses that is
        always driven in one direction looks like a softer spring. It adds the covariance of the larger model
        minus that of the hypothesis (consider covariance; S. F. Schmidt, Advances in Control Systems 3,
        1966): as likely as not before the data, times the odds that they leave it. Families of effects are
        independent contributions (JCGM 100, 5.1.2); of the laws of one family the largest contribution
        counts. An effect that the data support also changes x: fitted beside the rest, as a linear step
        would shrink the torque that a drive's effect explains. The squares of these changes are added by the
        hypotheses' weights (`Held.weights`), as the residual has one explanation.

        Args:
            parent: the hypothesis.
            places: of the parameters in question.
            effect: design effect of the rows (`design_effects`).

        Returns:
            (k, k) each, every effect at its most promising shape. Excluded from the first are effects that
            change the transmission's curve, which are another model, and, in a fit, those of the drive; its
            constant scale is the anchor.
        """
        families: dict[tuple[object, ...], FloatArray] = {}
        nothing = np.zeros_like(parent.posterior.covariance)
        precise = 1.0 / np.maximum(np.diag(parent.posterior.covariance)[places], 1e-300)
        supported = []
        for one in self._library_beside(parent):
            candidate = one.candidate
            drive = self.problem.calibrating and candidate.kind.channel == "motor_torque"
            best = one.independent(effect)
            if drive and (candidate.kind.name == "torque_constant" or best.gain <= 0.0):
                continue
            if best.gain > 0.0:
                supported.append((best.gain, Term(candidate, dict(one.values))))
            more = nothing if candidate.bends or drive else best.covariance
            _, *family = candidate.family  # either side of the motor's balance is the same to it
            before = families.get(tuple(family), nothing)
            families[tuple(family)] = max(more, before, key=lambda x: float(np.diag(x)[places] @ precise))
        supported.sort(key=lambda pair: -pair[0])
        models = [parent, *(self._grown(parent, term) for _, term in supported[: whole("tried")])]
        apart = [np.outer(x, x) for x in (_change(parent, one) for one in models)]
        between = np.tensordot(self.held.weights(models, parent, naming=False), apart, axes=1)
        return np.asarray(sum(families.values(), nothing)), between

    def _library_beside(self, parent: Fitted) -> Iterator[_Tried]:
        """All additional effects, linearised, each at the most promising point of its grid."""
        problem, posterior = self.problem, parent.posterior
        weights = 1.0 / (parent.times * posterior.sigma**2)
        weight = weights[problem.group]
        cross = self._columns @ (parent.regression.tangent(posterior.x) * weight[:, None])
        sides = self._columns @ (parent.regression.residual(posterior.x) * weight)
        taken = {t.candidate.key for t in parent.terms}
        for entry in self._library:
            candidate = entry.candidate.beside(taken)
            if candidate is None:
                continue
            std = entry.std
            side = sides[entry.rows].reshape(std.shape) * std
            against = cross[entry.rows].reshape(*std.shape, -1) * std[..., None]
            shift = against @ posterior.covariance
            inner = np.tensordot(weights, entry.grams, axes=1) * std[..., None] * std[:, None, :]
            precision = np.eye(std.shape[1]) + inner - against @ shift.swapaxes(1, 2)
            gain = _gain(precision, side)
            k = int(np.argmax(gain))
            yield _Tried(
                candidate, entry.values[k], len(gain), float(gain[k]), shift[k], precision[k], side[k]
            )
