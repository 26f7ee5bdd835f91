"""Errors on data that took no part in a fit: another recording, each recording in turn, or blocks of time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from estimator.diagnosis.beliefs import OF_RUN
from estimator.diagnosis.hypothesis import Fitted, Problem
from estimator.diagnosis.result import Errors
from estimator.model import JointModel
from estimator.sample import FloatArray, Record

__all__ = ["Held", "errors_of", "held_out"]

_Left = tuple[FloatArray, FloatArray, NDArray[np.bool_]]  # error, torque, rows of the motors' balances


class Held:
    """Held-out data for judging models.

    Args:
        problem: the data for fitting.
        others: problems of held-out recordings, each with the fitted recordings; empty: the held-out blocks
            of `problem`.
    """

    def __init__(self, problem: Problem, others: Sequence[tuple[Problem, Problem]]) -> None:
        self._problem, self._others = problem, others
        self._memo: dict[int, tuple[Fitted, list[_Left]]] = {}

    def squared(self, fitted: Fitted) -> float:
        """Mean squared error of all balances, relative to each recording's torque."""
        return float(
            np.mean(
                [
                    np.mean(left**2) / np.mean(torque[motors] ** 2)
                    for left, torque, motors in self._left(fitted)
                ]
            )
        )

    def log_likelihood(self, fitted: Fitted, like: Fitted) -> float:
        """Log likelihood of the held-out data, up to a constant, with the noise of another hypothesis."""
        rows = sum(len(left) for left, _, _ in self._left(fitted))
        least = float(np.mean(like.regression.floor**2)) / self._problem.torque_rms**2
        error = self.squared(fitted) + least  # errors at the level of rounding are not compared
        return -0.5 * rows / float(np.mean(like.times)) * float(np.log(error))

    def surplus(self, fitted: Fitted) -> float:
        """Mean squared error on held-out data over that on the fitted data, at least 1.

        A true model leaves as much in both. A wrong one claims too much information, by this factor (tempered
        likelihood; Grünwald and van Ommen, Bayesian Analysis 12, 2017). The smaller of the absolute and the
        relative error's: noise does not grow with the torque, a model's error does.
        """
        problem = self._problem
        least = float(np.mean(fitted.regression.floor**2))
        here, torque, motors = _balances(problem, fitted, problem.used)
        inside, scale = float(np.mean(here**2)) + least, float(np.mean(torque[motors] ** 2))
        outside = [
            (float(np.mean(left**2)) + least, float(np.mean(t[m] ** 2))) for left, t, m in self._left(fitted)
        ]
        absolute = float(np.mean([error for error, _ in outside])) / inside
        relative = float(np.mean([error / max(size, 1e-300) for error, size in outside])) * scale / inside
        return max(min(absolute, relative), 1.0)

    def errors(self, before: Fitted, after: Fitted) -> Errors:
        """Errors of all held-out data."""
        first, second = self._left(before), self._left(after)
        return _errors(
            np.concatenate([x[m] for x, _, m in first]),
            np.concatenate([x[m] for x, _, m in second]),
            np.concatenate([t[m] for _, t, m in first]),
        )

    def of(self, k: int, before: Fitted, after: Fitted) -> Errors | None:
        """Errors of the k-th recording when held out; None if it never is."""
        if len(self._others) < 2:
            return None
        (first, torque, motors), (second, _, _) = self._left(before)[k], self._left(after)[k]
        return _errors(first[motors], second[motors], torque[motors])

    def _left(self, fitted: Fitted) -> list[_Left]:
        """Residual of each held-out recording."""
        if id(fitted) in self._memo:
            return self._memo[id(fitted)][1]
        problem = self._problem
        if not self._others:
            made = [_balances(problem, fitted, ~problem.used)]
        else:
            made = []
            for rest, other in self._others:
                again = fitted if rest is problem else _refitted(rest, fitted)
                made.append(on_other(other, again))
        self._memo[id(fitted)] = fitted, made
        return made


def held_out(
    records: Sequence[Record],
    model: JointModel,
    bandwidth_hz: float,
    validation: Record | None,
    problem: Problem,
) -> Held:
    """The validation recording; or each recording in turn; or blocks of the only one."""
    if validation is not None:
        return Held(problem, [(problem, Problem([validation], model, bandwidth_hz))])
    if len(records) == 1:
        return Held(problem, [])
    pairs = []
    for k, record in enumerate(records):
        rest = [r for j, r in enumerate(records) if j != k]
        pairs.append((Problem(rest, model, bandwidth_hz), Problem([record], model, bandwidth_hz)))
    return Held(problem, pairs)


def errors_of(problem: Problem, before: Fitted, after: Fitted, rows: NDArray[np.bool_]) -> Errors:
    """Errors of the motors' balances over some of the rows that were fitted."""
    (first, torque, motors), (second, _, _) = (
        _balances(problem, before, rows),
        _balances(problem, after, rows),
    )
    return _errors(first[motors], second[motors], torque[motors])


def on_other(other: Problem, fitted: Fitted) -> _Left:
    """Errors of another recording under a model fitted elsewhere.

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
    return (
        _scaled(other, fitted, left),
        other.torque(),
        other.group % other.equations < len(other.model.motors),
    )


def _refitted(rest: Problem, fitted: Fitted) -> Fitted:
    corrections = fitted.corrections[: len(rest.signals)]
    return rest.fit(fitted.terms, fitted.base, corrections, extra=fitted.extra, pinned=fitted.pinned)


def _balances(problem: Problem, fitted: Fitted, rows: NDArray[np.bool_]) -> _Left:
    left = _scaled(problem, fitted, fitted.regression.residual(fitted.posterior.x))
    motors = problem.group % problem.equations < len(problem.model.motors)
    return left[rows], problem.torque()[rows], motors[rows]


def _scaled(problem: Problem, fitted: Fitted, left: FloatArray) -> FloatArray:
    """Errors relative to the declared torque if the torque's scale has been fitted."""
    left = left.copy()
    for scale in fitted.regression.scales:
        motor = scale.groups[0] % problem.equations
        left[problem.group % problem.equations == motor] /= scale.size(fitted.posterior.x)
    return left


def _errors(before: FloatArray, after: FloatArray, torque: FloatArray) -> Errors:
    sizes = [float(np.sqrt(np.mean(x**2))) for x in (before, after, torque)]
    scale = max(sizes[2], 1e-300)
    return Errors(sizes[0], sizes[1], sizes[0] / scale, sizes[1] / scale)
