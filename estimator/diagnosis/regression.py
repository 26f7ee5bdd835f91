"""Weighted least squares over blocks of time: fit, cross-validation, held-out blocks."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from estimator.sample import FloatArray

__all__ = ["Blocks", "Fit", "Rows"]

_RIDGE = 1e-13
_LEAST_PIECE = 10  # rows of a piece of a block, at least
_MOST_LAPS = 6
_TURN = 5  # the blocks' order is turned by so much from lap to lap
_SHRINK = 1e-3  # of the largest squared norm among the columns that are shrunk


@dataclass(frozen=True, slots=True)
class Blocks:
    """Which block of time each row of one equation belongs to.

    Attributes:
        index: (n,) block of each row; -1: held out of every fit and selection.
        count: number of blocks for cross-validation.
    """

    index: NDArray[np.int64]
    count: int

    @classmethod
    def make(cls, rows: int, count: int, held: int, spread: bool = False) -> Blocks:
        """Contiguous blocks, or spread ones of several pieces each; `held` of them are held out.

        A motion that changes over time, a chirp or a walk through the range, is known to all spread blocks.
        """
        total = count + held
        laps = int(np.clip(rows // (total * _LEAST_PIECE), 1, _MOST_LAPS)) if spread else 1
        pieces = laps * total
        place = np.minimum(np.arange(rows) * pieces // max(rows, 1), pieces - 1)
        out = {int((k + 0.7) * total / held) for k in range(held)} if held else set()
        order = np.full(total, -1)
        order[[k for k in range(total) if k not in out]] = np.arange(count)
        turned = [(k + (k // total) * _TURN) % total for k in range(pieces)]
        return cls(order[turned][place], count)


class Fit(NamedTuple):
    """Coefficients, their covariance by blocks, and the error of each block when it is left out.

    Attributes:
        coefficients: (k,).
        covariance: (k, k), from the scatter between blocks, so that correlated noise is no problem.
        cross: (blocks,) squared weighted error of each block under a fit without it.
        inner: (blocks,) squared weighted error of each block under the fit to all.
    """

    coefficients: FloatArray
    covariance: FloatArray
    cross: FloatArray
    inner: FloatArray

    @property
    def error(self) -> float:
        """Sum of the cross-validated errors."""
        return float(self.cross.sum())


class Rows:
    """The stacked equations with their weights.

    Args:
        blocks: of one equation's rows.
        equations: how many equations are stacked.
        weights: (equations,) 1 / expected noise.
    """

    def __init__(self, blocks: Blocks, equations: int, weights: FloatArray) -> None:
        self.blocks = blocks
        self.index = np.tile(blocks.index, equations)
        self.train = self.index >= 0
        self.weights = weights
        self.weight = np.repeat(weights, len(blocks.index))
        order = np.argsort(self.index, kind="stable")
        order = order[self.index[order] >= 0]
        self._order = order
        self._starts = np.searchsorted(self.index[order], np.arange(blocks.count + 1))

    def weighted(self, columns: FloatArray) -> FloatArray:
        """Training rows, weighted, sorted by block."""
        chosen = columns[self._order]
        weight = self.weight[self._order]
        return chosen * (weight[:, None] if chosen.ndim == 2 else weight)

    def fit(self, design: FloatArray, target: FloatArray, shrunk: int = 0) -> Fit:
        """Least squares and blocked cross-validation of already weighted rows.

        Args:
            design: (n, k) from `weighted`.
            target: (n,) from `weighted`.
            shrunk: so many last columns are drawn towards zero where there are hardly data for them.
        """
        count, width = self.blocks.count, design.shape[1]
        if width == 0:
            cross = np.array([float(y @ y) for y in self._split(target)])
            return Fit(np.zeros(0), np.zeros((0, 0)), cross, cross)
        scale = np.linalg.norm(design, axis=0)
        scale[scale == 0.0] = 1.0
        a = design / scale
        pieces, targets = self._split(a), self._split(target)
        grams = np.array([piece.T @ piece for piece in pieces])
        sides = np.array([piece.T @ y for piece, y in zip(pieces, targets, strict=True)])
        gram, side = grams.sum(axis=0), sides.sum(axis=0)
        ridge = np.full(width, _RIDGE)
        if shrunk:
            sizes = scale[width - shrunk :]
            ridge[width - shrunk :] = _SHRINK * (sizes.max() / sizes) ** 2
        gram = gram + np.diag(ridge)
        inverse = np.linalg.pinv(gram, hermitian=True)
        solution = inverse @ side
        cross, inner = np.empty(count), np.empty(count)
        for b in range(count):
            left = targets[b] - pieces[b] @ solution
            inner[b] = left @ left
            without = np.linalg.lstsq(gram - grams[b], side - sides[b], rcond=1e-13)[0]
            error = targets[b] - pieces[b] @ without
            cross[b] = error @ error
        scores = sides - grams @ solution
        scatter = scores.T @ scores * count / max(count - 1, 1)
        covariance = inverse @ scatter @ inverse
        return Fit(solution / scale, covariance / np.outer(scale, scale), cross, inner)

    def _split(self, x: FloatArray) -> list[FloatArray]:
        return [x[a:b] for a, b in zip(self._starts[:-1], self._starts[1:], strict=True)]
