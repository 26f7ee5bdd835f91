"""Errors on data that took no part in a fit: another recording, each recording in turn, or blocks of time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from estimator.choices import choice, whole
from estimator.diagnosis.beliefs import OF_RUN
from estimator.diagnosis.hypothesis import Fitted, Problem
from estimator.diagnosis.result import Errors
from estimator.sample import FloatArray, Record

__all__ = ["Held", "Residual", "errors_of", "held_out", "residual_of", "wider"]


class Residual(NamedTuple):
    """What a model leaves of some rows.

    Attributes:
        left_nm: (n,) residual.
        torque_nm: (n,) measured torque without its mean.
        motors: (n,) whether a row belongs to a motor's balance.
    """

    left_nm: FloatArray
    torque_nm: FloatArray
    motors: NDArray[np.bool_]

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
        """Mean square of all balances."""
        return float(np.mean(self.left_nm**2))

    @property
    def torque_square(self) -> float:
        """Mean square of the measured torque."""
        return float(np.mean(self.torque_nm[self.motors] ** 2))


class Fold(NamedTuple):
    """A fit, and what takes no part in it.

    Attributes:
        fitted: the data fitted.
        kept: which of all recordings these are.
        other: the held-out recording; None: the held-out blocks of `fitted`.
        like: rows of the whole problem whose residual it should equal.
    """

    fitted: Problem
    kept: Sequence[int]
    other: Problem | None
    like: NDArray[np.bool_]


class Held:
    """Held-out data for judging models.

    Args:
        problem: the data for fitting.
        folds: how they are held out.
    """

    def __init__(self, problem: Problem, folds: Sequence[Fold]) -> None:
        self.problem, self._folds = problem, folds
        self._memo: dict[int, tuple[Fitted, list[Residual]]] = {}

    def residuals(self, fitted: Fitted) -> list[Residual]:
        """Return the held-out residual of each fold, the model fitted again to what is kept."""
        if id(fitted) not in self._memo:
            self._memo[id(fitted)] = fitted, [self._residual(fitted, fold) for fold in self._folds]
        return self._memo[id(fitted)][1]

    def _residual(self, fitted: Fitted, fold: Fold) -> Residual:
        again = fitted
        if fold.fitted is not self.problem:
            corrections = tuple(fitted.corrections[k] for k in fold.kept)
            again = fold.fitted.fit(
                fitted.terms, fitted.base, corrections, extra=fitted.extra, pinned=fitted.pinned
            )
        if fold.other is None:
            return residual_of(fold.fitted, again, ~fold.fitted.used)
        return _on_other(fold.other, again)

    def squared(self, fitted: Fitted) -> float:
        """Mean squared error of all balances, relative to each recording's torque."""
        return float(np.mean([one.square / one.torque_square for one in self.residuals(fitted)]))

    def confirms(self, found: Fitted, rest: Fitted) -> bool:
        """Return whether held-out data need what one model has beyond another.

        The error falls by more than filters and rounding leave, and the mean of its logarithm over stretches
        of time by more than its standard error.
        """
        least = choice("floor") ** 2
        if self.squared(rest) - self.squared(found) < least:
            return False
        gain = np.log((self._by_stretch(rest) + least) / (self._by_stretch(found) + least))
        return bool(np.mean(gain) > np.std(gain, ddof=1) / np.sqrt(len(gain)))

    def alike(self, found: Fitted, other: Fitted) -> bool:
        """Return whether held-out data cannot tell another model from the one found; fitted
        alike well, too.
        """
        square = [residual_of(self.problem, one, self.problem.used).square for one in (found, other)]
        if square[1] - square[0] > (choice("floor") * self.problem.torque_rms) ** 2:
            return False
        return not self.confirms(found, other)

    def _by_stretch(self, fitted: Fitted) -> FloatArray:
        """Mean squared error of stretches of time, relative to each recording's torque."""
        made = []
        for one in self.residuals(fitted):
            square = (one.left_nm**2).reshape(self.problem.equations, -1).mean(axis=0) / one.torque_square
            made += [np.mean(part) for part in np.array_split(square, whole("groups"))]
        return np.array(made)

    def log_likelihood(self, fitted: Fitted, like: Fitted) -> float:
        """Log likelihood of the held-out data, up to a constant, with the noise of another hypothesis."""
        rows = sum(len(one.left_nm) for one in self.residuals(fitted))
        least = float(np.mean(like.regression.floor**2)) / self.problem.torque_rms**2
        error = self.squared(fitted) + least  # errors at the level of rounding are not compared
        return -0.5 * rows / float(np.mean(like.times)) * float(np.log(error))

    def surplus(self, fitted: Fitted) -> float:
        """Mean squared error on held-out data over that on the fitted data, at least 1.

        A true model leaves as much in both. A wrong one claims too much information, by this factor (tempered
        likelihood; Grünwald and van Ommen, Bayesian Analysis 12, 2017). A recording is compared with itself
        where it is fitted as well, as each has its own noise. The smaller of the absolute and the relative
        error's: noise does not grow with the torque, a model's error does.
        """
        least = float(np.mean(fitted.regression.floor**2))
        ratios = []
        for fold, outside in zip(self._folds, self.residuals(fitted), strict=True):
            inside = residual_of(self.problem, fitted, fold.like)
            larger = max(outside.torque_square / max(inside.torque_square, 1e-300), 1.0)
            ratios.append((outside.square + least) / (inside.square + least) / larger)
        return max(float(np.mean(ratios)), 1.0)

    def errors(self, before: Fitted, after: Fitted) -> Errors:
        """Return errors of all held-out data."""
        return _errors(_joined(self.residuals(before)), _joined(self.residuals(after)))

    def of(self, k: int, before: Fitted, after: Fitted) -> Errors | None:
        """Return errors of the k-th recording when held out; None if it never is."""
        if len(self._folds) < 2:
            return None
        return _errors(self.residuals(before)[k], self.residuals(after)[k])


def held_out(problem: Problem, validation: Record | None = None) -> Held:
    """Return the validation recording; or each recording in turn; or blocks of the only one."""
    records, every = problem.records, range(len(problem.records))
    if validation is not None:
        return Held(problem, [Fold(problem, every, problem.alike([validation]), problem.used)])
    if len(records) == 1:
        blocks = problem if problem.held else problem.alike(records, held=True)
        return Held(problem, [Fold(blocks, every, None, problem.used)])
    folds = []
    for k in every:
        kept = [j for j in every if j != k]
        rest, other = problem.alike([records[j] for j in kept]), problem.alike([records[k]])
        folds.append(Fold(rest, kept, other, problem.group // problem.equations == k))
    return Held(problem, folds)


def residual_of(problem: Problem, fitted: Fitted, rows: NDArray[np.bool_]) -> Residual:
    """Return the residual of some rows under a model fitted to that problem."""
    left, torque, motors = _residual(problem, fitted, fitted.regression.residual(fitted.posterior.x))
    return Residual(left[rows], torque[rows], motors[rows])


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
    run = [
        j
        for j, s in enumerate(there.slots)
        if s.kind == "everyday" and s.name in OF_RUN and (s.name, s.motor) not in fitted.pinned
    ]
    x = there.posterior.x
    left = there.regression.residual(x)
    if run:
        free = there.regression.design[:, run]
        left = left - free @ np.linalg.lstsq(free, left, rcond=1e-9)[0]
    return _residual(other, fitted, left)


def _residual(problem: Problem, fitted: Fitted, left: FloatArray) -> Residual:
    """Residual of all rows; relative to the declared torque if the torque's scale has been fitted."""
    left = left.copy()
    equation = problem.group % problem.equations
    for scale in fitted.regression.scales:
        left[equation == scale.groups[0] % problem.equations] /= scale.size(fitted.posterior.x)
    return Residual(left, problem.torque(), equation < len(problem.model.motors))


def _joined(parts: Sequence[Residual]) -> Residual:
    left, torque, motors = zip(*parts, strict=True)
    return Residual(np.concatenate(left), np.concatenate(torque), np.concatenate(motors))


def _errors(before: Residual, after: Residual) -> Errors:
    return Errors(before.rms_nm, after.rms_nm, before.relative, after.relative)
