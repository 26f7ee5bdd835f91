"""Bayesian linear regression of stacked balances, each with its own noise, and the evidence for a model.

y_g = X_g x + e_g for each balance g, x ~ N(mean, std²) by the priors. The variance of e_g is estimated with x
(evidence approximation; MacKay, Neural Computation 4, 1992), so a badly fitted balance has less weight.
Errors behind a filter are correlated: n_g rows count as n_g / t_g independent ones, t_g from the
autocorrelation of the residual (Bartlett, J. Royal Statistical Society B 8, 1946).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from estimator.choices import choice, whole
from estimator.sample import FloatArray

__all__ = ["Posterior", "Regression", "Scale", "autocorrelation_time"]


class Scale(NamedTuple):
    """Scaling of a balance's torque: r_t changes by s_t = 1 + slopes_t x per N·m.

    If errors are the torque's, r / s is the residual; if they are the model's, r is. Minimising the first
    favours a large s, minimising the second a small one. As the source is unknown, x is the compromise of
    geometric mean regression, and the evidence is the lower of the two: a scale that reduces errors under one
    assumption only does not pay. No torque is measured of a link's balance: its errors are those of the
    readings that s multiplies, so r / s is the residual (`Regression.tangent`).

    Attributes:
        groups: the balances. columns: (j,) the entries of x that scale them.
        slopes: (m, j) at the moments of the rows; one moment, where it is the same at all of them.
        measured: whether a torque is measured; else the scale is the same at all moments.
    """

    groups: tuple[int, ...]
    columns: NDArray[np.int64]
    slopes: FloatArray
    measured: bool = True

    def sizes(self, x: FloatArray) -> FloatArray:
        """Return (m,) s at each moment."""
        return np.maximum(1.0 + self.slopes @ x[self.columns], choice("least_scale"))

    def size(self, x: FloatArray) -> float:
        """Return the divisor of r in the less favourable of both assumptions: geometric mean of
        s, at most one.
        """
        size = float(np.exp(np.mean(np.log(self.sizes(x)))))
        return min(size, 1.0) if self.measured else size


class Posterior(NamedTuple):
    """x given y, with noise and evidence.

    Attributes:
        x: (k,) maximum a posteriori.
        covariance: (k, k) for the assumed number of independent rows.
        sigma: (groups,) standard deviation of each balance's errors, N·m.
        evidence: logarithm of the marginal likelihood, up to a constant of the data.
        bound: (k,) whether x is at its bound.
    """

    x: FloatArray
    covariance: FloatArray
    sigma: FloatArray
    evidence: float
    bound: NDArray[np.bool_]


class _Grams(NamedTuple):
    """All balances as normal equations, columns scaled: A'A (g, k, k), A'y (g, k), y'y (g,), rows (g,)."""

    matrix: FloatArray
    side: FloatArray
    square: FloatArray
    rows: FloatArray

    def left(self, x: FloatArray) -> FloatArray:
        """Return (g,) squared errors at x."""
        return np.maximum(self.square + (self.matrix @ x - 2.0 * self.side) @ x, 0.0)


@dataclass(frozen=True, slots=True, eq=False)
class Regression:
    """Rows of all balances, and the prior of x.

    Attributes:
        design: (n, k). target: (n,).
        mean, std: (k,) of the prior. low: (k,) lower bounds, or -inf.
        group: (n,) which balance a row belongs to, from 0.
        floor: (groups,) smallest standard deviation of each balance, N·m.
        scales: of balances against their measurements.
    """

    design: FloatArray
    target: FloatArray
    mean: FloatArray
    std: FloatArray
    low: FloatArray
    group: NDArray[np.int64]
    floor: FloatArray
    scales: tuple[Scale, ...]
    _grams: _Grams
    _unit: FloatArray

    @classmethod
    def make(
        cls,
        design: FloatArray,
        target: FloatArray,
        mean: FloatArray,
        std: FloatArray,
        low: FloatArray,
        group: NDArray[np.int64],
        floor: FloatArray,
        scales: tuple[Scale, ...] = (),
    ) -> Regression:
        """Make the normal equations of each balance, with columns of norm one."""
        unit = np.sqrt(np.einsum("ij,ij->j", design, design))
        unit[unit == 0.0] = 1.0
        grams = []
        for g in range(int(group.max()) + 1):
            rows = np.flatnonzero(group == g)
            a, y = design[rows], target[rows]
            grams.append((a.T @ a / np.outer(unit, unit), a.T @ y / unit, y @ y, float(len(rows))))
        made = _Grams(*(np.array(part) for part in zip(*grams, strict=True)))
        return cls(design, target, mean, std, low, group, floor, scales, made, unit)

    def solve(self, times: FloatArray, start: Posterior | None = None) -> Posterior:
        """Return the parameters, noise and evidence by fixed-point iteration, with an active set for bounds.

        Args:
            times: (groups,) autocorrelation times of the errors, in rows.
            start: where to begin.
        """
        low, grams = self.low * self._unit, self._grams
        sigma = np.sqrt(grams.square / np.maximum(grams.rows, 1.0)) if start is None else start.sigma
        sigma = np.maximum(sigma, self.floor)
        held = np.where(np.isfinite(low), low, 0.0)
        free = np.ones(len(low), dtype=bool)
        x = (self.mean if start is None else start.x) * self._unit
        last = whole("newton_steps") + len(x) - 1
        for attempt in range(last + 1):
            precision, side = self._normal(times, sigma, x)
            old, x = x, np.where(free, 0.0, held)
            whole_x = free.all()
            inner = precision if whole_x else precision[np.ix_(free, free)]
            x[free] = np.linalg.solve(inner, side if whole_x else (side - precision @ x)[free])
            left = grams.left(x)
            new = np.maximum(np.sqrt(left / grams.rows), self.floor * self._sizes(x / self._unit))
            steady = bool((np.abs(new - sigma) < 1e-3 * sigma).all())
            sigma = new
            wrong = free & (x < low)
            if wrong.any() and attempt < last:
                free = free & ~wrong
            elif steady and (not self.scales or bool((np.abs(x - old) <= 1e-8 + 1e-4 * np.abs(old)).all())):
                break
        covariance = np.zeros_like(precision)
        covariance[np.ix_(free, free)] = np.linalg.inv(inner)
        evidence = self._evidence(x, times, sigma, left, free, inner)
        return Posterior(
            x / self._unit, covariance / np.outer(self._unit, self._unit), sigma, evidence, ~free
        )

    def _normal(self, times: FloatArray, sigma: FloatArray, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Posterior precision and its side, of scaled columns, linearised at x where a torque is scaled."""
        weights, prior = 1.0 / (times * sigma**2), 1.0 / (self.std * self._unit) ** 2
        precision = np.tensordot(weights, self._grams.matrix, axes=1)
        precision.flat[:: len(x) + 1] += prior
        side = weights @ self._grams.side + self.mean * self._unit * prior
        for scale in self.scales:
            if not scale.measured:  # Gauss and Newton's step of the sum of (r / s)²
                slope, left = self._relative_slope(scale, x), self._grams.left(x)
                for g in scale.groups:
                    both = np.outer(self._grams.side[g] - self._grams.matrix[g] @ x, slope)
                    more = weights[g] * (both + both.T + left[g] * np.outer(slope, slope))
                    precision += more
                    side += weights[g] * left[g] * slope + more @ x
                continue
            # Newton's step of -sum log s / 2
            rows = 0.5 * sum(self._grams.rows[g] / float(times[g]) for g in scale.groups)
            steep = scale.slopes / self._unit[scale.columns] / scale.sizes(x / self._unit)[:, None]
            curvature = rows * (steep.T @ steep) / len(steep)
            precision[np.ix_(scale.columns, scale.columns)] += curvature
            side[scale.columns] += rows * steep.mean(axis=0) + curvature @ x[scale.columns]
        return precision, side

    def _relative_slope(self, scale: Scale, x: FloatArray) -> FloatArray:
        """(k,) change of log s per unit of the scaled columns, of a scale that is the same at all moments."""
        slope = np.zeros(len(x))
        slope[scale.columns] = scale.slopes[0] / self._unit[scale.columns] / scale.sizes(x / self._unit)
        return slope

    def _sizes(self, x: FloatArray) -> FloatArray:
        """(groups,) scale of each balance against the measurement."""
        sizes = np.ones(len(self._grams.rows))
        for scale in self.scales:
            sizes[list(scale.groups)] = scale.size(x)
        return sizes

    def _evidence(
        self,
        x: FloatArray,
        times: FloatArray,
        sigma: FloatArray,
        left: FloatArray,
        free: NDArray[np.bool_],
        inner: FloatArray,
    ) -> float:
        """Logarithm of the marginal likelihood by Laplace's approximation, up to a constant of the data."""
        independent = self._grams.rows / times
        std = self.std * self._unit
        strain = (x - self.mean * self._unit) / std
        _, logdet = np.linalg.slogdet(inner)
        return float(
            np.sum(independent * np.log(self._sizes(x / self._unit) / sigma))
            - 0.5 * np.sum(left / (times * sigma**2))
            - 0.5 * strain @ strain
            - 0.5 * logdet
            - np.sum(np.log(std[free]))
        )

    def residual(self, x: FloatArray) -> FloatArray:
        """Return (n,) residual of every row."""
        return np.asarray(self.target - self.design @ x)

    def tangent(self, x: FloatArray) -> FloatArray:
        """Return (n, k) what the residual of every row falls by per unit of x, its balance's scale kept:
        the design, where a torque is measured.
        """
        design = self.design
        for scale in self.scales:
            if not scale.measured:
                slope = self._relative_slope(scale, x * self._unit) * self._unit
                mine = np.isin(self.group, scale.groups)
                design = design + np.where(mine, self.residual(x), 0.0)[:, None] * slope
        return design

    def left_out(self, times: FloatArray, posterior: Posterior, labels: NDArray[np.int64]) -> FloatArray:
        """Return the (n,) residual of each row under the fit without all rows of its label.

        Their part of the sums is subtracted; noise and linearisation stay.

        Args:
            times: (groups,) autocorrelation times of the errors, in rows.
            posterior: of the fit to all rows.
            labels: (n,) of the rows that are left out together.
        """
        x, free = posterior.x * self._unit, ~posterior.bound
        precision, side = self._normal(times, posterior.sigma, x)
        weight = (1.0 / (times * posterior.sigma**2))[self.group]
        design, held = self.tangent(posterior.x) / self._unit, np.where(free, 0.0, x)
        low, left = self.low * self._unit, np.empty(len(self.target))
        aims = self.residual(posterior.x) + design @ x
        for label in np.unique(labels):
            mine = labels == label
            own, y = design[mine], aims[mine]
            weighted = own.T * weight[mine]
            rest, target = precision - weighted @ own, side - weighted @ y
            there = held.copy()
            there[free] = np.linalg.solve(rest[np.ix_(free, free)], (target - rest @ held)[free])
            left[mine] = y - own @ np.maximum(there, low)
        return left

    def autocorrelation_times(self, x: FloatArray) -> FloatArray:
        """Return the (groups,) autocorrelation times of the residual, in rows."""
        residual = self.residual(x)
        return np.array(
            [autocorrelation_time(residual[self.group == g]) for g in range(len(self._grams.rows))]
        )


def autocorrelation_time(error: FloatArray) -> float:
    """Return 1 + 2 sum of the squared autocorrelation: rows per independent error."""
    error = error - error.mean()
    n = len(error)
    size = 1 << (2 * n - 1).bit_length()
    power = np.abs(np.fft.rfft(error, size)) ** 2
    correlation = np.fft.irfft(power, size)[: min(n // 4, whole("memory")) + 1]
    if correlation[0] <= 0.0:
        return 1.0
    rho = correlation[1:] / correlation[0]
    return float(1.0 + 2.0 * rho @ rho)
