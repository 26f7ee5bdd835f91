"""Bayesian linear regression of stacked balances, each with its own noise, and the evidence for a model.

y_g = X_g x + e_g for each balance g, x ~ N(mean, std²) by the priors. The variance of e_g is estimated with
x (evidence approximation; MacKay, Neural Computation 4, 1992), so a balance that the model fits badly loses
its say. Errors behind a filter are correlated: n_g rows count as n_g / t_g independent ones, t_g from the
autocorrelation of what is left (Bartlett, J. Royal Statistical Society B 8, 1946).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from estimator.sample import FloatArray

__all__ = ["Posterior", "Regression", "Scale", "autocorrelation_time"]

_LAGS = 60  # rows, 20 periods of the bandwidth: what repeats with the motion is no correlation of errors
_LEAST_SCALE = 0.05  # a scale that falls below this has left the range of its linearisation
_ROUNDS = 8  # of the fixed point between parameters and noise; it converges by a factor in each


class Scale(NamedTuple):
    """How a balance is scaled against its measurement: r changes by s = constant + direction x per unit.

    The likelihood is that of the measurements, so each independent row has the factor s; without it the
    errors could be made small by making everything small.

    Attributes:
        groups: the balances. direction: (k,). constant: at x = 0.
    """

    groups: tuple[int, ...]
    direction: FloatArray
    constant: float


class Posterior(NamedTuple):
    """x given y, with noise and evidence.

    Attributes:
        x: (k,) maximum a posteriori.
        covariance: (k, k) if rows were as independent as assumed.
        sigma: (groups,) standard deviation of each balance's errors, N·m.
        evidence: logarithm of the marginal likelihood, up to a constant of the data.
        bound: (k,) where a sign holds x at its bound.
    """

    x: FloatArray
    covariance: FloatArray
    sigma: FloatArray
    evidence: float
    bound: NDArray[np.bool_]


@dataclass(frozen=True, slots=True, eq=False)
class Regression:
    """Rows of all balances and what is believed of x before.

    Attributes:
        design: (n, k). target: (n,).
        mean, std: (k,) of the prior. low: (k,) bounds from below, -inf where there are none.
        group: (n,) which balance a row belongs to, from 0.
        block: (n,) block of time of a row; negative: takes no part.
        floor: (groups,) smallest standard deviation of each balance, N·m.
        scales: of balances against their measurements.
    """

    design: FloatArray
    target: FloatArray
    mean: FloatArray
    std: FloatArray
    low: FloatArray
    group: NDArray[np.int64]
    block: NDArray[np.int64]
    floor: FloatArray
    scales: tuple[Scale, ...]
    _grams: list[tuple[FloatArray, FloatArray, float, int]]
    _scale: FloatArray

    @classmethod
    def make(
        cls,
        design: FloatArray,
        target: FloatArray,
        mean: FloatArray,
        std: FloatArray,
        low: FloatArray,
        group: NDArray[np.int64],
        block: NDArray[np.int64],
        floor: FloatArray,
        scales: tuple[Scale, ...] = (),
    ) -> Regression:
        """The normal equations of each balance, made once."""
        scale = np.linalg.norm(design, axis=0)
        scale[scale == 0.0] = 1.0
        scaled = design / scale
        grams = []
        for g in range(int(group.max()) + 1):
            rows = (group == g) & (block >= 0)
            a, y = scaled[rows], target[rows]
            grams.append((a.T @ a, a.T @ y, float(y @ y), int(rows.sum())))
        return cls(design, target, mean, std, low, group, block, floor, scales, grams, scale)

    def solve(self, times: FloatArray, start: FloatArray | None = None) -> Posterior:
        """Parameters, noise and evidence.

        Args:
            times: (groups,) autocorrelation times of the errors, in rows.
            start: (groups,) noise to begin with.
        """
        mean, std = self.mean * self._scale, self.std * self._scale
        low = self.low * self._scale
        counts = np.array([n for *_, n in self._grams], dtype=np.float64)
        free = np.ones(len(mean), dtype=bool)
        if start is None:
            start = np.array([np.sqrt(yy / max(n, 1)) for _, _, yy, n in self._grams])
        sigma = np.maximum(start, self.floor)
        held = np.where(np.isfinite(low), low, 0.0)
        x = np.where(free, mean, held)
        independent = counts / times
        last = _ROUNDS + len(mean) - 1
        for attempt in range(last + 1):
            weight = 1.0 / (times * sigma**2)
            precision = np.diag(1.0 / std**2)
            side = mean / std**2
            for w, (gram, product, _, _) in zip(weight, self._grams, strict=True):
                precision = precision + w * gram
                side = side + w * product
            for scale in self.scales:  # Newton's step of -n log s
                direction = scale.direction / self._scale
                share = float(independent[list(scale.groups)].sum())
                size = max(scale.constant + float(direction @ x), _LEAST_SCALE * abs(scale.constant))
                precision = precision + share / size**2 * np.outer(direction, direction)
                side = side + share * direction * (1.0 / size + float(direction @ x) / size**2)
            old, x = x, np.where(free, 0.0, held)
            inner = precision[np.ix_(free, free)]
            x[free] = np.linalg.solve(inner, side[free] - precision[np.ix_(free, ~free)] @ x[~free])
            left = np.array([max(yy - 2.0 * x @ p + x @ g @ x, 0.0) for g, p, yy, _ in self._grams])
            new = np.maximum(np.sqrt(left / counts), self.floor)
            steady = bool(np.all(np.abs(new - sigma) < 1e-3 * sigma))
            sigma = new
            wrong = free & (x < low) if attempt < last else np.zeros_like(free)
            if wrong.any():
                free = free & ~wrong
            elif steady and (not self.scales or np.allclose(x, old, rtol=1e-4)):
                break
        covariance = np.zeros_like(precision)
        covariance[np.ix_(free, free)] = np.linalg.inv(inner)
        _, logdet = np.linalg.slogdet(inner)
        strain = (x - mean) / std
        scaled = 0.0
        for scale in self.scales:
            size = scale.constant + float(scale.direction @ (x / self._scale))
            scaled += float(independent[list(scale.groups)].sum()) * np.log(
                max(size, _LEAST_SCALE * abs(scale.constant))
            )
        evidence = (
            scaled
            - float(np.sum(independent * np.log(sigma)))
            - 0.5 * float(np.sum(left / (times * sigma**2)))
            - 0.5 * float(strain @ strain)
            - 0.5 * float(logdet)
            - float(np.sum(np.log(std[free])))
        )
        return Posterior(
            x / self._scale, covariance / np.outer(self._scale, self._scale), sigma, evidence, ~free
        )

    def residual(self, x: FloatArray) -> FloatArray:
        """(n,) what is left of every row."""
        return np.asarray(self.target - self.design @ x)

    def autocorrelation_times(self, x: FloatArray) -> FloatArray:
        """(groups,) autocorrelation times of what is left, in rows."""
        residual = self.residual(x)
        return np.array([autocorrelation_time(residual[self.group == g]) for g in range(len(self._grams))])


def autocorrelation_time(error: FloatArray) -> float:
    """1 + 2 sum of the squared autocorrelation: rows per independent error."""
    error = error - error.mean()
    n = len(error)
    size = 1 << (2 * n - 1).bit_length()
    power = np.abs(np.fft.rfft(error, size)) ** 2
    correlation = np.fft.irfft(power, size)[: min(n // 4, _LAGS) + 1]
    if correlation[0] <= 0.0:
        return 1.0
    rho = correlation[1:] / correlation[0]
    return float(1.0 + 2.0 * rho @ rho)
