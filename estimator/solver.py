"""The motor's balance over a whole recording as one stacked, scaled, regularised least squares."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from scipy.optimize import minimize_scalar

from estimator.align import Channels
from estimator.coloured import coloured_covariance
from estimator.errors import EstimatorError
from estimator.flexibility import Polynomial, TransmissionModel
from estimator.model import Motor
from estimator.sample import FloatArray

__all__ = ["NUISANCES", "Solution", "Solver"]

_HIGHEST_ORDER = 4
_LATEST_PERIODS = 3.0  # largest delay of the link encoder that is searched
_DELAY_STD_PERIODS = 2.0  # of a delay, where there is one, before any data; there is one every other time
_WIDEST = np.array([2.0, 8.0, 30.0, 30.0, 10.0, 4.0])  # how far a prior gives way, per nuisance
_PENALTY_SAMPLES = 12.0  # how many rows one independent piece of information takes at least
NUISANCES = ("inertia", "damping", "coulomb", "offset", "shift", "torque_skew")


class Solution(NamedTuple):
    """x, y - A x, its rms, the prior standard deviations that were used, and what they cost (see `cost`)."""

    x: FloatArray
    residual: FloatArray
    noise: float
    prior: FloatArray
    penalty: float


class _Late(NamedTuple):
    """The delay that fits best, and the probability that there is one."""

    delay_s: float
    weight: float


class Solver:
    """The stacked, scaled, regularised least squares of one motor."""

    def __init__(self, channels: Channels, motor: Motor, transmission: TransmissionModel) -> None:
        self.channels, self._motor, self.model = channels, motor, transmission
        self.torque_unit = float(np.std(channels.balance)) + 1e-12
        self._least_damping = 0.0
        self._late = _Late(0.0, 0.0)
        phi = channels.deflection(0.0)
        self._phi_unit = float(np.max(np.abs(phi))) + 1e-15
        if not np.std(phi) > 0.0:
            raise EstimatorError("recording: expected a deflection that changes, it stands still")

    def _order(self) -> int:
        if self.model.linear is not None:
            return 1
        return self._motor.transmission.order or 2

    def _nuisances(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Columns (rows, 6), their units and their prior standard deviations in those units."""
        c, motor, unit = self.channels, self._motor, self.torque_unit
        rate = float(np.max(np.abs(c.velocity))) + 1e-12
        self._least_damping = motor.viscous_damping_nm_s_rad * rate / unit
        step = float(np.max(np.abs(c.torque_rate))) * c.period_s + 1e-300
        ones = np.ones(len(c.balance))
        columns = np.stack([-c.acceleration, -c.velocity, -c.friction, -ones, ones, c.torque_rate], axis=1)
        units = np.array([motor.inertia_kg_m2, unit / rate, unit, unit, self._phi_unit, c.period_s])
        damping = 0.2 * motor.viscous_damping_nm_s_rad * rate / unit + 0.05
        resolution = c.resolution_rad / self._phi_unit
        prior = np.array([0.1, damping, 0.1, 0.3, 0.003 + resolution, 0.5 if step > 0.0 else 0.0])
        return columns, units, prior

    def system(
        self, delay: float, shape: tuple[float, ...], order: int
    ) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """(A, y, units, prior std), everything in units of the torque."""
        c, unit = self.channels, self.torque_unit
        columns, units, prior = self._nuisances()
        if isinstance(self.model, Polynomial):
            basis, slope = c.powers(delay, order), None
        else:
            basis, slope = c.basis_and_slope(self.model, delay, shape)
        scale = np.max(np.abs(basis), axis=0) + 1e-300
        # The offset of the deflection acts through sigma: a first guess of alpha makes its column.
        guess, *_ = np.linalg.lstsq(np.column_stack([basis / scale, columns[:, 3]]), c.balance, rcond=None)
        alpha = guess[:order] / scale
        columns[:, 4] = c.slope(delay, alpha) if slope is None else alpha[0] * slope
        A = np.column_stack([basis, columns]) * np.concatenate([unit / scale, units]) / unit
        prior = np.concatenate([np.full(order, 1e4), prior])
        return A, c.balance / unit, np.concatenate([unit / scale, units]), prior

    def solve(self, A: FloatArray, y: FloatArray, prior: FloatArray) -> Solution:
        """MAP estimate; nuisances that strain against their prior are let go."""
        prior, widest = prior.copy(), prior * np.concatenate([np.ones(len(prior) - 6), _WIDEST])
        damping, least = A.shape[1] - 5, -self._least_damping
        declared = prior.copy()
        held, noise, used = None, 0.01, prior
        for _ in range(4):
            used = prior.copy()
            inverse, _ = _penalised(A, noise, used)
            x = inverse @ (A.T @ (y - (held or 0.0) * A[:, damping]))
            x[damping] += held or 0.0
            residual = y - A @ x
            noise = max(float(np.sqrt(np.mean(residual**2))), 1e-9)
            strained = np.abs(x) > 2.5 * prior
            prior[strained] = np.minimum(4.0 * prior[strained], widest[strained])
            if x[damping] < least:  # no transmission drives its motor
                held, prior[damping] = least, 1e-6
        if held is not None:
            used[damping] = declared[damping]
        penalty = float(np.sum((x / used) ** 2 + 2.0 * np.log(used / declared)))
        return Solution(x, residual, noise, used, penalty)

    def cost(self, delay: float, shape: tuple[float, ...], order: int) -> float:
        """Minus twice the logarithm of the posterior at a delay (s) and shape, everything linear at its best.

        A prior that has given way costs the logarithm of how far.
        """
        A, y, _, prior = self.system(delay, shape, order)
        told = self.solve(A, y, prior)
        return 2.0 * len(y) / _PENALTY_SAMPLES * math.log(told.noise) + told.penalty

    def search_delay(self) -> float:
        """Delay of the link encoder in s: a grid of half periods, then a parabola's bracket.

        A delay must earn its place: on a motion that hardly reveals it, none is assumed (`_weigh`).
        """
        T = self.channels.period_s
        model, self.model = self.model, Polynomial()
        order = 3 if model.linear is None or model.shape_names else 1
        grid = np.arange(-_LATEST_PERIODS, _LATEST_PERIODS + 0.1, 0.5) * T
        costs = [self.cost(float(d), (), order) for d in grid]
        best = int(np.argmin(costs))
        found = minimize_scalar(
            lambda d: self.cost(float(d), (), order),
            bounds=(grid[best] - 0.5 * T, grid[best] + 0.5 * T),
            method="bounded",
            options={"xatol": 0.002 * T},
        )
        self._late = self._weigh(float(found.x), order)
        self.model = model
        return self._late.delay_s if self._late.weight > 0.5 else 0.0

    def _weigh(self, delay: float, order: int) -> _Late:
        """How probable it is that the delay which fits best is one, (1 + …)^-1 of the Bayes factor.

        That is sqrt(1 + v/s²) exp(-g/2 v/(s² + v)): g the gain of the posterior over no delay, in effectively
        independent errors, s² the delay's variance under coloured noise, v the one before any data.
        """
        T = self.channels.period_s
        A, y, units, prior = self.system(delay, (), order)
        told = self.solve(A, y, prior)
        A0, y0, _, prior0 = self.system(0.0, (), order)
        none = self.solve(A0, y0, prior0)
        full, std = self._with_delay(A, told, delay, told.x[:order] * units[:order])
        naive, _ = _penalised(full, told.noise, np.append(told.prior, 1e3))
        together = max((std / T) ** 2 / (told.noise**2 * float(naive[-1, -1])), 1.0)
        gain = 2.0 * len(y) / together * math.log(none.noise / told.noise) + none.penalty - told.penalty
        ratio = (_DELAY_STD_PERIODS * T / std) ** 2
        odds = math.exp(min(0.5 * gain * ratio / (1.0 + ratio), 700.0)) / math.sqrt(1.0 + ratio)
        return _Late(delay * ratio / (1.0 + ratio), odds / (1.0 + odds))

    def _with_delay(
        self, A: FloatArray, told: Solution, delay: float, alpha: FloatArray
    ) -> tuple[FloatArray, float]:
        """(A with the delay's column, in periods; standard deviation of the delay by the data alone, s)."""
        T = self.channels.period_s
        column = self.channels.lateness(self.model, delay, alpha) * T / self.torque_unit
        full = np.column_stack([A, column])
        prior = np.append(told.prior, 1e3)
        inverse, held = _penalised(full, told.noise, prior)
        covariance = coloured_covariance(full, told.residual, inverse, held)
        return full, T * math.sqrt(float(covariance[-1, -1]))

    def refine_delay(self, delay: float, shape: tuple[float, ...]) -> float:
        """The delay again, with the transmission's own model."""
        T = self.channels.period_s
        found = minimize_scalar(
            lambda d: self.cost(float(d), shape, 1),
            bounds=(delay - 0.3 * T, delay + 0.3 * T),
            method="bounded",
            options={"xatol": 0.002 * T},
        )
        return float(found.x)

    def choose_order(self, delay: float) -> int:
        """The declared order, or the one with the smallest BIC over effectively independent rows."""
        if self.model.linear is not None or self._motor.transmission.order is not None:
            return self._order()
        rows = max(len(self.channels.balance) / _PENALTY_SAMPLES, 2.0)
        scores = [self.cost(delay, (), p) + p * math.log(rows) for p in range(1, _HIGHEST_ORDER + 1)]
        return int(np.argmin(scores)) + 1

    def covariance(self, A: FloatArray, told: Solution, delay: float, alpha: FloatArray) -> FloatArray:
        """Covariance of x and the delay (last, in periods); whether there is a delay is itself uncertain."""
        without = np.zeros((A.shape[1] + 1, A.shape[1] + 1))
        inverse, held = _penalised(A, told.noise, told.prior)
        without[:-1, :-1] = coloured_covariance(A, told.residual, inverse, held)
        weight = self._late.weight
        if weight < 1e-3:
            return without
        full, _ = self._with_delay(A, told, delay, alpha)
        inverse, held = _penalised(full, told.noise, np.append(told.prior, _DELAY_STD_PERIODS))
        late = coloured_covariance(full, told.residual, inverse, held)
        other = inverse[:, -1] / inverse[-1, -1] * (self._late.delay_s / self.channels.period_s)
        apart = np.outer(other, other) * (weight if delay == 0.0 else 1.0 - weight)
        return np.asarray(weight * late + (1.0 - weight) * without + apart)


def _penalised(A: FloatArray, noise: float, prior: FloatArray) -> tuple[FloatArray, FloatArray]:
    """(inverse normal matrix with the prior's penalty, (n,) what the prior itself leaves open)."""
    penalty = _PENALTY_SAMPLES * noise**2 / prior**2
    inverse = np.linalg.pinv(A.T @ A + np.diag(penalty), hermitian=True)
    return np.asarray(inverse, dtype=np.float64), (penalty * prior) ** 2
