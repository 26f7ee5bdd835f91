"""Joint recursive estimation whose standard deviations stay honest when the noise is coloured.

A Kalman filter for constant parameters computes a covariance P that is true for white noise only. Behind
a filter the noise is anything but white. So a second covariance, Sigma, is carried along: the covariance
of the estimate that these very gains produce under noise with the autocorrelation that is measured on
the innovations. P decides the gains, Sigma is what is published.
"""

from __future__ import annotations

import math

import numpy as np

from estimator.sample import FloatArray

__all__ = ["ColouredKalman"]

_LAGS = 16  # updates over which the noise is correlated
_MEMORY = 500  # updates over which the noise's autocorrelation is averaged
_QUICK = 3.0  # the noise is an average over this share, one in so many, of the updates so far
_HALVED = 6.0  # updates in which the noise assumed at the start may at most be halved
_OUTLIER = 5.0  # standard deviations that an innovation may count as
_LEAST_FREEDOM = 4.0  # independent errors that are left over parameters


class ColouredKalman:
    """Constant parameters x from scalar equations y = h x + e with coloured e; all in scaled units.

    Args:
        mean: x before any data, (n,).
        std: its standard deviations, (n,): no more uncertainty than this is ever assumed.
        noise: standard deviation of e assumed at the start.
        forgetting: growth of P from one update to the next, at least 1.
        steady: places, counted from the end (negative), of parameters that are not forgotten.

    Attributes:
        caution: how much larger a variance is than Sigma has it, as few independent errors have told it.
    """

    def __init__(
        self, mean: FloatArray, std: FloatArray, noise: float, forgetting: float, steady: tuple[int, ...] = ()
    ) -> None:
        self.x = mean.astype(np.float64)
        self.ceiling = np.square(std)
        self.noise = noise * noise
        self._growth, self._steady = forgetting, steady
        root = np.full(mean.size, math.sqrt(forgetting))
        root[list(steady)] = 1.0
        self._grow = np.outer(root, root)
        self._n = n = mean.size
        self.P = np.diag(self.ceiling)
        self._Ph: FloatArray | None = None  # of the equation at hand, while P is as it was
        # Sigma, and below it what is left of past gains in the estimate, newest first.
        self._stack = np.zeros((n + _LAGS, n))
        self.Sigma, self._gains = self._stack[:n], self._stack[n:]
        self.Sigma[:] = self.P
        self._change = np.zeros(n + _LAGS)
        self._past = np.zeros(_LAGS)  # past innovations, newest first
        self._r = np.zeros(_LAGS)
        self._taper = np.minimum(1.0, 2.0 - 2.0 * np.arange(1, _LAGS + 1) / (_LAGS + 1))
        self._assumed = self.noise
        self._count = 0
        self._pending: tuple[FloatArray, FloatArray, float] | None = None
        self._prepared: tuple[FloatArray, FloatArray] | None = None
        self.caution = self._caution()

    def innovation(self, h: FloatArray, y: float) -> float:
        """What y is beyond h x."""
        return y - float(h @ self.x)

    def spread(self, h: FloatArray) -> float:
        """Variance of h x as P has it."""
        self._Ph = self.P @ h
        return float(h @ self._Ph)

    def learn_noise(self, innovation: float, spread: float) -> None:
        """Take one innovation into the noise's autocorrelation.

        Of an innovation's variance, noise and spread, the noise has its share: innovation² noise / (noise +
        spread) has the noise for its mean. One that sticks out counts as `_OUTLIER` standard deviations.
        """
        self._count += 1
        gain = max(_QUICK / (self._count + _QUICK), 1.0 / _MEMORY)
        e = self._noisy(innovation, spread)
        # As many parameters as there have been equations explain anything: the start is not believed.
        least = self._assumed * 0.5 ** (self._count / _HALVED)
        self.noise = max(self.noise + gain * (e * e - self.noise), least)
        self._r += gain * (e * self._past - self._r)

    def remember(self, innovation: float, spread: float) -> None:
        """Shift the record of past innovations; after `learn_noise`, which wants those before this one."""
        self._past[1:] = self._past[:-1]
        self._past[0] = self._noisy(innovation, spread)

    def _noisy(self, innovation: float, spread: float) -> float:
        e = innovation * math.sqrt(self.noise / (self.noise + max(spread, 0.0)))
        most = _OUTLIER * math.sqrt(self.noise)
        return min(max(e, -most), most)

    def _caution(self) -> float:
        """How much larger a variance is that few independent errors tell: that of a t distribution."""
        shape = self._r * (self._taper / max(self.noise, 1e-300))
        seen = min(self._count, 2.0 / max(self._growth - 1.0, 1e-9))
        freedom = max(seen / (1.0 + 2.0 * float(shape @ shape)) - self._n, _LEAST_FREEDOM)
        return freedom / (freedom - 2.0)

    def update(self, h: FloatArray, innovation: float, floor: float) -> None:
        """One equation: h (n,), its innovation, and the least noise variance to reckon with.

        `account` follows, at leisure, but before the next equation.
        """
        Ph = self._Ph if self._Ph is not None else self.P @ h
        spread = float(h @ Ph)
        if spread < 0.0:  # rounding has eaten a variance
            self.repair()
            Ph = self.P @ h
            spread = float(h @ Ph)
        self._Ph = None
        noise = max(self.noise, floor)
        gain = Ph / (spread + noise)
        self.x += gain * innovation
        P = self.P
        P -= gain[:, None] * Ph
        P *= self._grow
        self._pending = (h, gain, noise)

    def prepare(self) -> None:
        """First half of `account`, for a loop that has only so much time at once."""
        if self._pending is None:
            return
        h, gain, noise = self._pending
        self._pending = None
        n, left, change = self._n, self._gains, self._change
        seen = self._stack @ h
        cross = (self._r * self._taper) @ left
        weight = 0.5 * (float(h @ seen[:n]) + noise) - float(h @ cross)
        cross -= seen[:n]
        cross += weight * gain
        change[:n] = cross
        np.negative(seen[n:], out=change[n:])
        self._prepared = gain, cross
        self.caution = self._caution()

    def account(self) -> None:
        """Carry Sigma over the last equation.

        x~_k = A x~_(k-1) + K e_k with A = 1 - K h, where e_k is correlated with x~_(k-1) through past gains.
        """
        self.prepare()
        if self._prepared is None:
            return
        gain, cross = self._prepared
        self._prepared = None
        left = self._gains
        self._stack += self._change[:, None] * gain
        self.Sigma += gain[:, None] * cross
        left[1:] = left[:-1]
        left[0] = gain

    def repair(self) -> None:
        """Both covariances positive definite again."""
        self.P, self._Ph = _positive(self.P), None
        self.Sigma[:] = _positive(self.Sigma)

    @property
    def finite(self) -> bool:
        """Whether parameters and covariances still are numbers."""
        return math.isfinite(float(self.x.sum() + self.P.sum() + self.Sigma.sum()))

    def keep_regular(self) -> None:
        """P symmetric, as rounding leaves it only nearly, and no direction with a negative variance."""
        self.P = P = 0.5 * (self.P + self.P.T)
        self._Ph = None
        diagonal = P.diagonal()
        if not diagonal.all():  # what is known exactly is no direction
            P = P + np.diag(np.where(diagonal == 0.0, 1.0, 0.0))
        try:
            np.linalg.cholesky(P)
        except np.linalg.LinAlgError:
            self.repair()

    def keep_bounded(self) -> None:
        """No parameter more uncertain than before any data (against wind-up), none much surer than P says."""
        self.account()
        diagonal = self.P.diagonal()
        wound_up = diagonal > self.ceiling
        if wound_up.any():
            shrink = np.sqrt(np.divide(self.ceiling, diagonal, out=np.ones(self._n), where=wound_up))
            self.P *= shrink[:, None] * shrink
            self._Ph = None
        variance = self.Sigma.diagonal()
        low = 1e-4 * self.P.diagonal()
        if (variance < low).any():
            np.fill_diagonal(self.Sigma, np.maximum(variance, low))

    def inflate(self, extra: FloatArray) -> None:
        """Add a covariance (n, n) to both: the parameters may have changed by so much."""
        self.account()
        self._Ph = None
        self.P += extra
        self.Sigma += extra
        self.ceiling = np.maximum(self.ceiling, np.diag(self.P))

    def transformed(self, mean: FloatArray, std: FloatArray, change: FloatArray) -> ColouredKalman:
        """What goes on with other parameters, under the same noise.

        Args:
            mean: the new parameters, (m,).
            std: see the class, (m,).
            change: their slopes by the old ones, (m, n).
        """
        self.account()
        new = ColouredKalman(mean, std, math.sqrt(self._assumed), self._growth, self._steady)
        new.noise, new._count, new.caution = self.noise, self._count, self.caution
        new._r[:], new._past[:] = self._r, self._past
        new.P = change @ self.P @ change.T
        new.ceiling = np.maximum(new.ceiling, new.P.diagonal())
        new.Sigma[:] = change @ self.Sigma @ change.T
        new._gains[:] = self._gains @ change.T
        return new

    def rescale(self, ratio: FloatArray) -> None:
        """Parameters in new units: x becomes ratio * x, exactly."""
        self.account()
        both = np.outer(ratio, ratio)
        self._Ph = None
        self.x *= ratio
        self.P *= both
        self.Sigma *= both
        self._gains *= ratio
        self.ceiling = self.ceiling * ratio * ratio

    def rescale_noise(self, ratio: float) -> None:
        """Equations in new units: y, h x and e become ratio times as large."""
        self.noise *= ratio * ratio
        self._assumed *= ratio * ratio
        self._r *= ratio * ratio
        self._past *= ratio

    def draw(self, index: int, share: float) -> None:
        """Draw one parameter towards zero, as an observation of zero with `share` of its variance does."""
        self.account()
        self._Ph = None
        variance = share * float(self.Sigma[index, index])
        gain = self.P[:, index] / ((1.0 + share) * self.P[index, index])
        self.x -= gain * self.x[index]
        self.P -= np.outer(gain, self.P[index])
        self.Sigma -= np.outer(gain, self.Sigma[index])
        self.Sigma -= np.outer(self.Sigma[:, index], gain)
        self.Sigma += variance * np.outer(gain, gain)
        self._gains -= np.outer(self._gains[:, index], gain)


def _positive(matrix: FloatArray) -> FloatArray:
    """The symmetric positive definite matrix nearest to one that rounding has spoilt."""
    values, vectors = np.linalg.eigh(0.5 * (matrix + matrix.T))
    values = np.maximum(np.abs(values), 1e-14 * float(np.max(np.abs(values))))
    return np.asarray((vectors * values) @ vectors.T)
