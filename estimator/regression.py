"""The balance of one motor as one linear equation per update, in units that make every term of order one.

    B0 F[theta''] + D0 F[theta'] + F[x] - F[tau]
        = F[f(phi, alpha)] - dB F[theta''] - dD F[theta'] - Fc F[s] - o + F[sigma (d q' + e)]

F is the filter that all channels share (its delay is common and cancels), B0 and D0 are declared, x are the
declared effects, and alpha, dB, dD, the Coulomb friction Fc, the offset o, the delay d of the link
encoder and its offset e to the motor's are estimated together. The torque's own scale
is the anchor: nothing on the motor side can tell it.
Black-box estimation is the derivative of the same equation, with a local sigma instead of f.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from estimator.flexibility import Polynomial, TransmissionModel
from estimator.kalman import ColouredKalman
from estimator.sample import FloatArray

__all__ = ["NUISANCES", "UNSEEN", "Equation", "Regression", "Signals"]

NUISANCES = ("inertia", "damping", "coulomb", "offset", "delay", "shift")
_SHIFT = -1  # its place
_DIFFUSE = 30.0  # prior std of the linear coefficient: in units of torque per deflection
_SHARE = 2.0  # prior std of a higher power: its share of the torque at the largest deflection
_CUT_OFF_SHARE = 0.003  # … of the first power that a declared order leaves out
_KNOWN = 0.3  # relative prior std of parameters that the model gives
_INERTIA = 0.05  # prior std, relative to the declared inertia
_DAMPING = 0.2  # prior std, relative to the declared damping …
_DAMPING_SHARE = 0.02  # … plus this share of the torque at the largest velocity
_COULOMB_SHARE = 0.03
_OFFSET_SHARE = 0.05
_DELAY_PERIODS = 1.0
_SHIFT_SHARE = 0.003  # of the largest deflection, besides what the encoders' resolution leaves open
_REOPENED_SHARE = 0.1  # std of a deflection's offset after an encoder has moved its zero
_RELAX = 2.5  # a nuisance this many prior std off: the prior was too narrow
_POINTS = 16  # deflections that a nonlinear model is linearised anew over
_LOOKED_AT = (0.4, 0.9)  # of the largest deflection: where a curve is held against its tangent
_RIDGE = 1e-12  # relative, in the normal equations of that
_STEPS = 3  # … and Gauss-Newton steps for that
_HANDED_OVER = 4.0  # by which the covariance of a model's parameters is widened that a polynomial has told
_LEAST_VARIANCE = 0.02
_NOISE_SHARE = 0.01  # noise assumed at the start, as a share of the torque


# Errors that are in no covariance: noise in h, its linearisation, what aligns the channels. Measured as the
# error over its standard deviation without this, on 86 simulated joints that took no part in anything else.
UNSEEN = 1.3


class Signals(NamedTuple):
    """Filtered signals of one motor at one update: each with its derivatives, lowest first."""

    link: list[float]
    motor: list[float]
    torque: list[float]
    basis: list[list[float]]  # per derivative, one entry a basis function, then `slope`'s
    friction: list[float]
    effects: list[float]


class Equation(NamedTuple):
    """y = h x, scaled."""

    h: FloatArray
    y: float


class Regression:
    """Scales, builds and solves the equation above for one motor.

    Args:
        model: transmission model whose basis the channels carry.
        alpha: known parameters (shape included) or None.
        size: number of transmission parameters n.
        inertia: B0. damping: D0.
        period_s: T.
        forgetting: see ColouredKalman.
        black_box: estimate the derivative of the balance.
        cut_off: the last parameter is the first power that a polynomial leaves out: near zero.
    """

    def __init__(
        self,
        model: TransmissionModel,
        alpha: FloatArray | None,
        size: int,
        inertia: float,
        damping: float,
        period_s: float,
        forgetting: float,
        black_box: bool,
        cut_off: bool = False,
    ) -> None:
        self._model, self._B, self._D, self._T = model, inertia, damping, period_s
        self.size = size
        self._known, self._forgetting = alpha, forgetting
        self._first = 1 if black_box else 0
        self._black_box = black_box
        self._polynomial = isinstance(model, Polynomial)
        self._cut_off = cut_off
        self.alpha0 = alpha  # where a nonlinear model is linearised …
        self._tangent: tuple[list[float], FloatArray, FloatArray] = ([], np.zeros(0), np.zeros((0, size)))
        self.filter: ColouredKalman | None = None
        self.torque_unit = self.deflection_unit = self.rate_unit = 0.0
        self._peaks = (0.0, 0.0, 0.0)
        self._motor_side = [0.0] * NUISANCES.index("delay")  # what no deflection depends on
        self.resolution_rad = 0.0
        self._alpha_list: list[float] = []
        self._use(np.ones(size + len(NUISANCES)), 1.0)

    # -- scales ------------------------------------------------------------------------------------

    def observe_scale(self, signals: Signals) -> bool:
        """Follow the largest torque, deflection and velocity; change units when they have outgrown them.

        Returns:
            Whether the units have changed.
        """
        k = self._first
        torque = max(abs(self.balance(signals)), self._B * abs(signals.motor[k + 2]), abs(signals.torque[k]))
        deflection = abs(signals.link[k] - signals.motor[k])
        old = self._peaks
        self._peaks = (
            max(old[0], torque),
            max(old[1], deflection),
            max(old[2], abs(signals.motor[k + 1])),
        )
        if self.filter is not None and (
            self._peaks[0] > 1.5 * self.torque_unit
            or self._peaks[1] > 1.5 * self.deflection_unit
            or self._peaks[2] > 1.5 * self.rate_unit
        ):
            self._change_units()
            return True
        return False

    @property
    def deflection_peak(self) -> float:
        """Largest deflection seen behind the filter, rad."""
        return self._peaks[1]

    def balance(self, signals: Signals) -> float:
        """B0 theta'' + D0 theta' + x - tau, filtered: the flexibility torque as the motor tells it, N·m.

        A position is taken as straight between samples, which costs it (omega T)²/12 of its amplitude; the
        torque, which is held, is given the same loss.
        """
        k = self._first
        torque = signals.torque[k] + (self._T**2 / 12.0) * signals.torque[k + 2]
        motion = self._B * signals.motor[k + 2] + self._D * signals.motor[k + 1]
        return motion + signals.effects[k] - torque

    def _make_units(self) -> FloatArray:
        torque, deflection, rate = self.torque_unit, self.deflection_unit, self.rate_unit
        units = np.empty(self.size + len(NUISANCES))
        if self._polynomial:
            units[: self.size] = torque / deflection ** (2.0 * np.arange(self.size) + 1.0)
        elif self.alpha0 is None:
            units[0] = torque / max(abs(float(self._model.torque(deflection, (1.0,)))), 1e-300)
        else:
            units[: self.size] = np.abs(self.alpha0)
        units[self.size :] = (self._B, torque / rate, torque, torque, self._T, deflection)
        return units

    def _change_units(self) -> None:
        assert self.filter is not None
        old_units, old_torque = self._units, self.torque_unit
        old_std = self._nuisance_std()
        self._set_units()
        ratio = old_units / self._units
        self.filter.rescale(ratio)
        self.filter.rescale_noise(old_torque / self.torque_unit)
        n = self.size
        grown = np.maximum(0.0, self._nuisance_std() ** 2 - (old_std * ratio[n:]) ** 2)
        self.filter.inflate(np.diag(np.concatenate([np.zeros(n), grown])))
        self._restrain_cut_off()
        self._remember_tangent()

    def _restrain_cut_off(self) -> None:
        """Its prior, which was a share of the torque at the deflection reached then, is one of now."""
        assert self.filter is not None
        power, most = self.size - 1, _CUT_OFF_SHARE**2
        variance = float(self.filter.P[power, power])
        if self._cut_off and variance > most:
            self.filter.ceiling[power] = most
            self.filter.draw(power, most / variance)

    def _set_units(self) -> None:
        tiny = 1e-12
        torque, deflection, rate = self._peaks
        self.deflection_unit = max(deflection, tiny)
        self.rate_unit = max(rate, tiny)
        self.torque_unit = max(torque, tiny)
        self._use(self._make_units(), self.torque_unit)

    def _use(self, units: FloatArray, torque_unit: float) -> None:
        self._units = units
        self._scale = units / torque_unit  # of the columns of h

    def _nuisance_std(self) -> FloatArray:
        damping = _DAMPING * self._D * self.rate_unit / self.torque_unit + _DAMPING_SHARE
        late = 0.0 if self._black_box else 1.0
        return np.array(
            [
                _INERTIA,
                damping,
                late * _COULOMB_SHARE,
                late * _OFFSET_SHARE,
                late * _DELAY_PERIODS,
                _SHIFT_SHARE + self.resolution_rad / self.deflection_unit,
            ]
        )

    # -- estimation --------------------------------------------------------------------------------

    def start(self) -> None:
        """Begin with the priors, in the units seen so far."""
        self._set_units()
        n = self.size
        mean = np.zeros(n + len(NUISANCES))
        std = np.empty_like(mean)
        if self._known is not None:
            known = self._known.size
            mean[:known] = self._known / self._units[:known]
            std[:n] = _KNOWN * np.abs(mean[:n])
            if self._polynomial:
                std[:n] += 0.02
        else:
            std[:n] = _SHARE
            std[0] = _DIFFUSE
        if self._cut_off:
            std[n - 1] = _CUT_OFF_SHARE
        std[n:] = self._nuisance_std()
        steady = () if self._black_box else (NUISANCES.index("inertia") - len(NUISANCES),)
        self.filter = ColouredKalman(mean, std, _NOISE_SHARE, self._forgetting, steady)
        self._remember_tangent()

    def adopt(self, alpha: FloatArray, slopes: FloatArray, model: TransmissionModel) -> None:
        """Go on with another model: its parameters, and their slopes by those of the last one."""
        assert self.filter is not None
        n_old, n, old_units = self.size, alpha.size, self._units
        self._model, self.size, self._polynomial = model, n, isinstance(model, Polynomial)
        self.alpha0 = alpha  # the units follow it
        self._known = None
        self._use(self._make_units(), self.torque_unit)
        ceiling = np.concatenate([np.full(n, 1.0), self.filter.ceiling[n_old:]])
        self._transform(alpha, slopes * old_units[:n_old] / self._units[:n, None], ceiling)
        self._remember_tangent()
        open_part = np.zeros_like(self.filter.P)
        open_part[:n, :n] = (_HANDED_OVER - 1.0) * self.filter.Sigma[:n, :n]
        self.filter.inflate(open_part)

    def _transform(self, alpha: FloatArray, slopes: FloatArray, ceiling: FloatArray) -> None:
        """The filter's first parameters become alpha, of these (scaled) slopes by the old ones."""
        assert self.filter is not None
        n, n_old = slopes.shape
        nuisances = self.filter.x[n_old:]
        change = np.zeros((n + len(NUISANCES), n_old + len(NUISANCES)))
        change[:n, :n_old] = slopes
        change[n:, n_old:] = np.eye(len(NUISANCES))
        mean = np.concatenate([alpha / self._units[:n], nuisances])
        self.filter = self.filter.transformed(mean, np.sqrt(ceiling), change)

    def off_tangent(self, share: float) -> bool:
        """Whether the model's curve has left its tangent by more than `share` of the curve's uncertainty."""
        assert self.filter is not None and self.alpha0 is not None
        n = self.size
        alpha = self.values()[:n]
        phis, torques, slopes = self._tangent
        on_tangent = (torques + slopes @ (alpha - self.alpha0)).tolist()
        rows = slopes * self._units[:n]
        variances = self.filter.caution * ((rows @ self.filter.Sigma[:n, :n]) * rows).sum(axis=1)
        return any(
            (self._model.at(phi, alpha)[0] - torque) ** 2 > share * share * variance
            for phi, torque, variance in zip(phis, on_tangent, variances.tolist(), strict=True)
        )

    def _remember_tangent(self) -> None:
        """Deflections, torques and slopes of the tangent at alpha0, for `off_tangent`."""
        if self._polynomial or self.alpha0 is None:
            return
        phis = [part * self.deflection_unit for part in _LOOKED_AT]
        self._tangent = phis, self._model.torque(phis, self.alpha0), self._model.jacobian(phis, self.alpha0)

    def relinearise(self) -> None:
        """Linearise the nonlinear model anew, where the parameters are now.

        What has been learned is the curve, as far as the tangent at the old parameters goes. It is held: the
        new parameters are those of the curve nearest to it, and their covariance is that of the curve.
        Holding the parameters' covariance instead would make sure of what no data have told: the tangent
        turns, so along the direction in which parameters compensate each other, old and new seem to cross.
        """
        assert self.filter is not None and self.alpha0 is not None
        n, old, model = self.size, self.alpha0, self._model
        units = self._units[:n]
        phi = np.linspace(0.0, self.deflection_unit, _POINTS + 1)[1:]
        tangent = model.jacobian(phi, old) * units
        alpha = self.alpha
        curve = model.torque(phi, old) + tangent @ ((alpha - old) / units)
        for _ in range(_STEPS):
            slopes = model.jacobian(phi, alpha) * units
            normal = slopes.T @ slopes
            normal += _RIDGE * np.trace(normal) * np.eye(n)  # what the curve does not tell stays as it is
            step = np.linalg.solve(normal, slopes.T @ (curve - model.torque(phi, alpha)))
            alpha = self._bounded(alpha + units * step)
        change = np.eye(n) + np.linalg.solve(normal, slopes.T @ (tangent - slopes))
        self._transform(alpha, change, self.filter.ceiling)
        self.alpha0 = alpha
        self._remember_tangent()

    def _bounded(self, alpha: FloatArray) -> FloatArray:
        """Alpha with shape parameters that can be."""
        for i, (low, high) in enumerate(self._model.shape_bounds, start=1):
            alpha[i] = min(max(alpha[i], low * (1 + 1e-6)), high)
        return alpha

    def equation(self, signals: Signals) -> Equation:
        """The scaled equation of this update."""
        k, n = self._first, self.size
        self.values()  # the present ones, for what depends on the stiffness
        row = list(signals.basis[k][:n])
        y = self.balance(signals)
        if not self._polynomial:
            # f ~ k g + k0 (c - c0) dg/dc: y is referred to the point of linearisation.
            assert self.alpha0 is not None
            for i in range(1, n):
                row[i] *= float(self.alpha0[0])
                y += row[i] * float(self.alpha0[i])
        late = 0.0
        if not self._black_box:
            late = self.stiffness_fast(signals.link[0] - signals.motor[0]) * signals.link[1]
        row += [-signals.motor[k + 2], -signals.motor[k + 1], -signals.friction[k], -1.0 + k, late]
        row.append(self._slope(signals.basis[k][-1], signals.basis[0][-1]))
        return Equation(self._scale * row, y / self.torque_unit)

    def _slope(self, filtered: float, square: float) -> float:
        """F[sigma] (or its derivative) from the channel of phi², or dg/dphi of a nonlinear model."""
        alpha = self._alpha_list
        if not self._polynomial:
            return alpha[0] * filtered
        if self._black_box:
            return 3.0 * alpha[1] * filtered
        return alpha[0] + sum((2 * h + 1) * alpha[h] * square**h for h in range(1, len(alpha)))

    def stiffness_fast(self, phi: float) -> float:
        """Sigma at phi for the delay's column: good to first order is enough."""
        alpha = self._alpha_list
        if self._polynomial:
            square, value = phi * phi, 0.0
            for h in range(len(alpha) - 1, -1, -1):
                value = value * square + (2 * h + 1) * alpha[h]
            return value
        return self._model.at(phi, alpha)[1]

    def values(self) -> list[float]:
        """Present transmission parameters and, after them, NUISANCES; SI."""
        assert self.filter is not None
        values: list[float] = (self.filter.x * self._units).tolist()
        for i, (low, high) in enumerate(self._model.shape_bounds, start=1):
            values[i] = min(max(values[i], low * (1 + 1e-6)), high)
        self._alpha_list = values[: self.size]
        return values

    @property
    def alpha(self) -> FloatArray:
        """Present transmission parameters, SI."""
        return np.array(self.values()[: self.size])

    @property
    def covariance(self) -> FloatArray:
        """Covariance of alpha (honest, Sigma), SI."""
        assert self.filter is not None
        units = self._units[: self.size]
        honest = self.filter.caution * self.filter.Sigma[: self.size, : self.size]
        return np.asarray(honest * np.outer(units, units))

    def variance(self, by_alpha: list[float], by_delay: float, by_shift: float) -> float:
        """Variance to publish of a function of alpha and of the link's delay and offset, by its slopes."""
        assert self.filter is not None
        row = self._units * [*by_alpha, *self._motor_side, by_delay, by_shift]
        # However the noise is coloured, it leaves more than a share of what white noise would.
        honest = UNSEEN**2 * self.filter.caution * float(row @ self.filter.Sigma @ row)
        return max(honest, _LEAST_VARIANCE * float(row @ self.filter.P @ row))

    def relax(self) -> None:
        """Where a nuisance strains against its prior, the prior was too narrow: widen it."""
        assert self.filter is not None
        n = self.size
        x, ceiling = self.filter.x[n:], self.filter.ceiling[n:]
        strained = x * x > _RELAX**2 * ceiling
        if (strained & (ceiling > 0)).any():
            extra = np.zeros(self.filter.x.size)
            extra[n:] = np.where(strained, 4.0 * ceiling, 0.0)
            self.filter.inflate(np.diag(extra))

    def open_up(self, relative: float) -> None:
        """The stiffness has changed: its scale by about `relative`, its shape by less."""
        assert self.filter is not None
        n = self.size
        extra = np.zeros_like(self.filter.P)
        x = self.filter.x[:n]
        extra[:n, :n] = relative**2 * np.outer(x, x)
        extra[:n, :n] += np.diag((0.1 * relative * np.maximum(np.abs(x), 0.1)) ** 2)
        self.filter.inflate(extra)

    def reopen_shift(self) -> None:
        """The offset of the deflection may have changed by a few percent of the largest deflection."""
        if self.filter is None:
            return
        extra = np.zeros(self.filter.x.size)
        extra[self.size + NUISANCES.index("shift")] = _REOPENED_SHARE**2
        self.filter.inflate(np.diag(extra))

    def delay(self) -> tuple[float, float]:
        """The link encoder's remaining delay and its standard deviation, in periods."""
        if self.filter is None:
            return 0.0, math.inf
        i = self.size + NUISANCES.index("delay")
        return float(self.filter.x[i]), math.sqrt(max(float(self.filter.Sigma[i, i]), 0.0))

    def shift_delay(self, periods: float) -> None:
        """The channels have been aligned by so much: take it out of the estimate."""
        assert self.filter is not None
        self.filter.x[self.size + NUISANCES.index("delay")] -= periods
