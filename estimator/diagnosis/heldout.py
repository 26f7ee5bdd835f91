"""Errors on data that took no part in a fit: another recording, each recording in turn, or blocks of time."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import softmax

from estimator.choices import choice, whole
from estimator.diagnosis.candidates import members
from estimator.diagnosis.declared import declared_laws, held_at_rest
from estimator.diagnosis.frame import Corrections
from estimator.diagnosis.hypothesis import Fitted
from estimator.diagnosis.problem import Problem, stretches
from estimator.diagnosis.result import Errors
from estimator.diagnosis.twins import twins
from estimator.sample import FloatArray, Record

__all__ = ["Held", "Residual", "errors_of", "held_out", "residual_of", "wider"]


class Residual(NamedTuple):
    """What a model leaves of some rows.

    Attributes:
        left_nm: (n,) residual.
        torque_nm: (n,) measured torque without its mean.
        motors: (n,) whether a row belongs to a motor's balance.
        held_nm: (n,) what dry friction may hold of the residual at rest, by which no model is judged.
    """

    left_nm: FloatArray
    torque_nm: FloatArray
    motors: NDArray[np.bool_]
    held_nm: FloatArray

    def of(self, rows: NDArray[np.bool_]) -> Residual:
        """Return that of some rows."""
        return Residual(self.left_nm[rows], self.torque_nm[rows], self.motors[rows], self.held_nm[rows])

    @property
    def rms_nm(self) -> float:
        """Of the motors' balances."""
        return float(np.sqrt(np.mean(self.left_nm[self.motors] ** 2)))

    @property
    def relative(self) -> float:
        """The same over the rms of the measured torque."""
        return self.rms_nm / max(float(np.sqrt(self.torque_square)), 1e-300)

    @property
    def square(self) -> float:
        """Mean square of all balances, as models are judged."""
        return float(np.mean((self.left_nm - self.held_nm) ** 2))

    @property
    def torque_square(self) -> float:
        """Mean square of the measured torque."""
        return float(np.mean(self.torque_nm[self.motors] ** 2))


class Held:
    """Data that take no part in a fit: what every decision about models is made by.

    The blocks are stretches of time. Of one recording each is left out in turn; of several, each recording.
    Another recording's blocks come on top. A block's score is its log likelihood per independent error, the
    noise of each block and balance unknown: -1/2 log of the mean square. What filters, rounding and the laws
    of effects leave anyway (`Regression.floor`) is added, so errors below it are not compared.

    Args:
        problem: the data that are fitted.
        other: a recording that is not.
    """

    def __init__(self, problem: Problem, other: Problem | None = None) -> None:
        self.problem, self.other = problem, other
        self.price = math.log(max(len(members(problem.frames[0])), 1))  # log odds against any one effect
        alone = len(problem.records) == 1
        self._laws = declared_laws(problem.model)
        self._labels = stretches(problem) if alone else problem.group // problem.equations
        self._memo: dict[int, tuple[Fitted, list[Residual], list[Residual]]] = {}
        self._squares: dict[int, FloatArray] = {}

    def _residuals(self, fitted: Fitted) -> tuple[list[Residual], list[Residual]]:
        """(of what is left out of each recording, of the other one)."""
        if id(fitted) not in self._memo:
            other = [] if self.other is None else [_on_other(self.other, fitted)]
            self._memo[id(fitted)] = fitted, self._left_out(fitted), other
        return self._memo[id(fitted)][1:]

    def _left_out(self, fitted: Fitted) -> list[Residual]:
        problem = self.problem
        left = fitted.regression.left_out(fitted.times, fitted.posterior, self._labels)
        recording = problem.group // problem.equations
        every = range(len(problem.records))
        for k in every if len(every) > 1 else ():
            left = _own_removed(fitted, left, k)
        every_row = _residual(problem, fitted, left, fitted.corrections)
        return [every_row.of(recording == k) for k in every]

    def residuals(self, fitted: Fitted) -> list[Residual]:
        """Return the residual of the other recording; without one, of each recording when it is left out."""
        own, other = self._residuals(fitted)
        return other or own

    def squared(self, fitted: Fitted) -> float:
        """Mean squared error of all balances, relative to each recording's torque."""
        return float(np.mean([one.square / one.torque_square for one in self.residuals(fitted)]))

    def scores(self, fitted: Fitted, among: Sequence[Fitted] = ()) -> FloatArray:
        """Return (blocks,) log likelihood of each block, per independent error; errors that the laws of any
        `among` these models leave anyway are not compared.
        """
        key = id(fitted)
        if key not in self._squares:
            own, other = self._residuals(fitted)
            self._squares[key] = np.concatenate([self._by_stretch(one) for one in own + other])
        least = self._relative(self.problem.floor)
        for one in among:
            least = np.maximum(least, self._relative(one.regression.floor))
        return np.asarray(-0.5 * np.sum(np.log(self._squares[key] + least), axis=1))

    def _relative(self, floor: FloatArray) -> FloatArray:
        """(balances,) mean square of a floor (groups,), relative to the torque's."""
        square = floor.reshape(-1, self.problem.equations) ** 2
        return np.asarray(np.mean(square, axis=0) / self.problem.torque_rms**2)

    def _by_stretch(self, one: Residual) -> FloatArray:
        """(stretches, balances) mean squared error, relative to the recording's torque."""
        square = ((one.left_nm - one.held_nm) ** 2).reshape(self.problem.equations, -1) / one.torque_square
        parts = np.array_split(square, whole("groups"), axis=1)
        return np.array([np.mean(part, axis=1) for part in parts])

    def confirms(self, found: Fitted, rest: Fitted, of: Held | None = None) -> bool:
        """Return whether held-out data need what one model has beyond another: the one rule of acceptance.

        `of`: the same data under another declared model, which the other one is of.

        The mean score of the blocks rises by more than its standard error, and the error falls by more than
        filters and rounding leave anyway; by more than laws leave, for a law of the same phenomenon with
        more parameters, and for a free curve, which is of any.
        """
        return self.margin(found, rest, of) > 1.0

    def margin(self, found: Fitted, rest: Fitted, of: Held | None = None) -> float:
        """Return how many times more than `confirms` asks for one model gains over another."""
        own = found.extra is None and not self._refines(found, rest)
        floor = self.problem.floor if own else rest.regression.floor
        if found.bends - rest.bends:  # a declared spring is a law, as declared effects are
            floor = np.hypot(floor, self.problem.bent(rest))
        theirs, both = of or self, (found, rest)
        fall = (theirs.squared(rest) - self.squared(found)) / float(np.mean(self._relative(floor)))
        return min(fall, _in_errors(self.scores(found, both) - theirs.scores(rest, both)))

    def _refines(self, one: Fitted, other: Fitted) -> bool:
        """Whether a model has laws of the same phenomena with more parameters; of a declared one, as many."""
        kinds = [t.candidate for t in one.terms]
        declared = {c.family for c in kinds if len(c.kind.parameters) >= self._laws.get(c.family, math.inf)}
        return one.families <= other.families | declared and one.parameters > other.parameters

    def _preferred(self, found: Fitted, models: Sequence[Fitted]) -> list[bool]:
        """Whether each says more of the phenomena of the one found and held-out data surely ask for it, for
        more than it costs, be it for less than laws leave anyway; none that they tell from the best of these.

        Not surely: a single one of ten blocks has its gain as mean and as standard error.
        """
        errors = self._independent(found)

        def beats(one: Fitted, other: Fitted) -> bool:
            gain = self.scores(one) - self.scores(other)
            cost = other.log_prior(errors, self.price) - one.log_prior(errors, self.price)
            return _in_errors(gain) > choice("sure") and errors * float(np.mean(gain)) > cost

        richer = [one for one in models if self._refines(one, found) and beats(one, found)]
        best = max(richer, key=lambda one: float(np.mean(self.scores(one))), default=found)
        return [one in richer and not beats(best, one) for one in models]

    def simplest(self, models: Sequence[Fitted]) -> Fitted:
        """Return the simplest of the models that held-out data cannot tell from the best, and over which no
        other of these with as few effects is confirmed.

        Simple is what has the larger prior: few parameters, and declared numbers that are believed. Then, of
        laws for the same phenomena that leave no more than laws leave anyway, the simplest is chosen, if it
        scores more than every model over which the best is confirmed.
        """

        def score(one: Fitted) -> float:
            return float(np.mean(self.scores(one)))

        best = max(models, key=score)
        errors = self._independent(best)
        ruled_out = [one for one in models if self.confirms(best, one)]
        alike = [one for one in models if not self.confirms(best, one)]
        alike.sort(key=lambda one: -one.log_prior(errors, self.price))
        found = next((one for one in alike if not self._beaten(one, alike)), best)
        most, least = self.squared(found), max(map(score, ruled_out), default=-math.inf)
        laws = [
            one
            for one in models
            if one.families == found.families
            and one.parameters < found.parameters
            and self.squared(one) - most < float(np.mean(self._relative(one.regression.floor)))
            and score(one) > least
        ]
        return max([found, *laws], key=lambda one: one.log_prior(errors, self.price))

    def _beaten(self, found: Fitted, models: Sequence[Fitted]) -> bool:
        """Whether a model of at most as many effects is confirmed over one."""
        return any(len(one.terms) <= len(found.terms) and self.confirms(one, found) for one in models)

    def weights(self, models: Sequence[Fitted], found: Fitted, *, naming: bool = True) -> FloatArray:
        """Return (m,) probability of each model: its prior times its stacking weight.

        The weight is the mean over Bayesian bootstraps of the blocks (pseudo-BMA+ of Yao, Vehtari, Simpson
        and Gelman, Bayesian Analysis 13, 2018). Of names, a difference to the one found that is not
        confirmed is none, and a richer law that the data prefer and that laws' errors hide is as likely.
        """
        errors = self._independent(found)
        gain = np.array([self.scores(one, models) - self.scores(found, models) for one in models])
        shares = np.random.default_rng(0).dirichlet(np.ones(gain.shape[1]), whole("bootstraps"))
        odds = errors * (shares @ gain.T)
        prior = np.array([one.log_prior(errors, self.price) for one in models])
        if naming:
            least = np.array([-np.inf if self.confirms(found, one) else 0.0 for one in models])
            most = np.array([np.inf if self.confirms(one, found) else 0.0 for one in models])
            odds = np.clip(odds, least, most)
            as_likely = np.array(self._preferred(found, models))
            prior = np.where(as_likely, np.maximum(prior, found.log_prior(errors, self.price)), prior)
        odds = odds + prior
        for pair in self._twins(models):
            odds[:, pair] = np.max(odds[:, pair], axis=1, keepdims=True)
        return np.asarray(np.mean(softmax(odds, axis=1), axis=0))

    def _twins(self, models: Sequence[Fitted]) -> list[list[int]]:
        """Pairs of models that hold twins and do not differ by more than laws leave."""
        keys = [one.keys for one in models]
        pairs = [
            [keys.index(other), k]
            for k, own in enumerate(keys)
            for twin in twins(models[k], self.problem)
            if (other := own - twin.held | twin.instead) in keys
        ]
        return [pair for pair in pairs if self._differ(*(models[k] for k in pair)) < 1.0]

    def _differ(self, one: Fitted, other: Fitted) -> float:
        """Difference of the squared errors of two models, over what their laws leave anyway."""
        floor = np.maximum(one.regression.floor, other.regression.floor)
        return abs(self.squared(one) - self.squared(other)) / float(np.mean(self._relative(floor)))

    def _independent(self, like: Fitted) -> float:
        """Number of independent errors in each balance of all blocks."""
        rows = sum(self.problem.rows) + (0 if self.other is None else sum(self.other.rows))
        return rows / float(np.mean(like.times))

    def surplus(self, fitted: Fitted) -> float:
        """Mean squared error on held-out data over that on the fitted data, at least 1.

        A true model leaves as much in both. A wrong one claims too much information, by this factor (tempered
        likelihood; Grünwald and van Ommen, Bayesian Analysis 12, 2017). A recording is compared with itself
        where it is fitted as well, as each has its own noise. The smaller of the absolute and the relative
        error's: noise does not grow with the torque, a model's error does.
        """
        least = float(np.mean(fitted.regression.floor**2))
        ratios = []
        for k, outside in enumerate(self.residuals(fitted)):
            mine = self.problem.group // self.problem.equations == k
            inside = residual_of(self.problem, fitted, mine if self.other is None else np.ones_like(mine))
            larger = max(outside.torque_square / max(inside.torque_square, 1e-300), 1.0)
            ratios.append((outside.square + least) / (inside.square + least) / larger)
        return max(float(np.mean(ratios)), 1.0)

    def errors(self, before: Fitted, after: Fitted) -> Errors:
        """Return errors of all held-out data."""
        return _errors(_joined(self.residuals(before)), _joined(self.residuals(after)))

    def of(self, k: int, before: Fitted, after: Fitted) -> Errors | None:
        """Return errors of the k-th recording when held out; None if it never is."""
        if self.other is not None or len(self.problem.records) < 2:
            return None
        return _errors(self.residuals(before)[k], self.residuals(after)[k])


def _in_errors(gain: FloatArray) -> float:
    """Mean gain of the blocks (n,) in its standard errors."""
    return float(np.mean(gain) / max(np.std(gain, ddof=1) / np.sqrt(len(gain)), 1e-300))


def held_out(problem: Problem, validation: Record | None = None) -> Held:
    """Return the validation recording; or each recording in turn; or blocks of the only one."""
    return Held(problem, None if validation is None else problem.alike([validation]))


def residual_of(problem: Problem, fitted: Fitted, rows: NDArray[np.bool_]) -> Residual:
    """Return the residual of some rows under a model fitted to that problem."""
    left = fitted.regression.residual(fitted.posterior.x)
    return _residual(problem, fitted, left, fitted.corrections).of(rows)


def errors_of(problem: Problem, before: Fitted, after: Fitted, rows: NDArray[np.bool_]) -> Errors:
    """Return errors of the motors' balances over some of the rows that were fitted."""
    return _errors(residual_of(problem, before, rows), residual_of(problem, after, rows))


def wider(surplus: float) -> list[str]:
    """Return one sentence on a `Held.surplus` that shows in the intervals."""
    factor = f"{np.sqrt(surplus):.1f}"
    if factor == "1.0":
        return []
    return [f"held-out data leave {factor} times the error of the fitted data, which widens the intervals"]


def _on_other(other: Problem, fitted: Fitted) -> Residual:
    """Residual of another recording under a model fitted elsewhere.

    Only the recording's own offsets are fitted.
    """
    corrections = replace(
        fitted.corrections[0],
        offset_rad=tuple(
            float(np.mean([c.offset_rad[i] for c in fitted.corrections]))
            for i in range(len(other.model.motors))
        ),
    )
    there = other.transferred(fitted, corrections)
    left = there.regression.residual(there.posterior.x)
    return _residual(other, fitted, _own_removed(there, left, 0), (corrections,))


def _own_removed(fitted: Fitted, left: FloatArray, run: int) -> FloatArray:
    """A recording's residual without what its own offsets explain."""
    own = [
        j
        for j, s in enumerate(fitted.slots)
        if s.kind == "everyday" and s.run == run and (s.name, s.motor) not in fitted.pinned
    ]
    if not own:
        return left
    free = fitted.regression.design[:, own]
    return left - free @ np.linalg.lstsq(free, left, rcond=1e-9)[0]


def _residual(
    problem: Problem, fitted: Fitted, left: FloatArray, corrections: Sequence[Corrections]
) -> Residual:
    """Residual of all rows; relative to the declared torque if the torque's scale has been fitted."""
    frames = problem.at(corrections, fitted.base)
    ends = np.cumsum([frame.rows * frame.equations for frame in frames])[:-1]
    pairs = zip(frames, np.split(left, ends), strict=True)
    held = np.concatenate([held_at_rest(frame, part) for frame, part in pairs])
    size, equation = np.ones(len(left)), problem.group % problem.equations
    for scale in fitted.regression.scales:
        size[equation == scale.groups[0] % problem.equations] = scale.size(fitted.posterior.x)
    return Residual(left / size, problem.torque(), equation < len(problem.model.motors), held / size)


def _joined(parts: Sequence[Residual]) -> Residual:
    return Residual(*(np.concatenate(part) for part in zip(*parts, strict=True)))


def _errors(before: Residual, after: Residual) -> Errors:
    return Errors(before.rms_nm, after.rms_nm, before.relative, after.relative)
