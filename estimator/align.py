"""A recording made ready for batch estimation: gaps bridged and masked, every channel filtered alike."""

from __future__ import annotations

import math

import numpy as np

from estimator.declared import effect_torque
from estimator.errors import EstimatorError
from estimator.filters import StateVariableFilter, linear_filter
from estimator.flexibility import Polynomial, TransmissionModel
from estimator.model import Motor
from estimator.sample import FloatArray, Record

__all__ = ["Channels", "prepare"]

_ORDER = 4
_ROW_HZ = 100.0
_LIGHT_RATIO = 5.0
_FRICTION_SPEEDS = 0.02  # of the largest velocity: over which Coulomb friction changes its sign
_BRIDGED = 3  # periods of a gap that leave no trace worth masking


class Channels:
    """Filtered signals of one motor, decimated to about 100 rows a second.

    Attributes:
        period_s: of the recording.
        acceleration, velocity: F[theta''], F[theta'].
        friction: F[s(theta')].
        torque_rate: F[tau'].
        balance: B F[theta''] + D F[theta'] + F[x] - F[tau] with the declared effects x, which is F[tau_e]
            where the declared model is right.
        resolution_rad: noise of the deflection, standard deviation of one sample.
    """

    def __init__(
        self,
        theta: FloatArray,
        tau: FloatArray,
        q: FloatArray,
        rows: FloatArray,
        motor: Motor,
        filter_: StateVariableFilter,
    ) -> None:
        T = filter_.period_s
        self.period_s = T
        self._filter, self._rows, self._theta, self._q = filter_, rows, theta, q
        _, velocity, acceleration = filter_.apply(theta, 2)
        torque, rate, bend = filter_.apply(tau, 2, held=True)
        torque = torque + (T * T / 12.0) * bend  # see Regression.balance
        self.velocity, self.acceleration = velocity[rows], acceleration[rows]
        self.torque_rate = rate[rows]
        self.friction = filter_.apply(_sign_of_velocity(theta, filter_))[0][rows]
        balance = motor.inertia_kg_m2 * acceleration + motor.viscous_damping_nm_s_rad * velocity - torque
        if motor.effects:
            balance = (
                balance + filter_.apply(effect_torque(motor, theta, q, tau, T, filter_.bandwidth_rad_s))[0]
            )
        self.balance = balance[rows]
        self.resolution_rad = math.hypot(_noise(theta), _noise(q))
        self._phi_of: tuple[float, FloatArray] = (math.nan, np.zeros(0))  # the last delay's

    def _phi(self, delay: float) -> FloatArray:
        """Raw deflection with the link encoder's delay taken out, as of the motor's time."""
        if self._phi_of[0] != delay:
            q = self._q if delay == 0.0 else _shifted(self._q, delay / self.period_s)
            self._phi_of = delay, q - self._theta
        return self._phi_of[1]

    def deflection(self, delay: float) -> FloatArray:
        """F[phi], (rows,)."""
        return np.asarray(self._filter.apply(self._phi(delay))[0][self._rows])

    def powers(self, delay: float, order: int) -> FloatArray:
        """F of the odd powers of phi, (rows, order)."""
        columns = Polynomial().basis(self._phi(delay), order=order)
        return np.stack([self._filter.apply(column)[0][self._rows] for column in columns.T], axis=1)

    def basis_and_slope(
        self, model: TransmissionModel, delay: float, shape: tuple[float, ...]
    ) -> tuple[FloatArray, FloatArray]:
        """(F[g], F[dg/dphi]) of a model f = k g, (rows, 1) and (rows,)."""
        torque, stiffness = model.both(self._phi(delay), (1.0, *shape))
        first, slope = (self._filter.apply(x)[0][self._rows] for x in (torque, stiffness))
        return first[:, None], slope

    def slope(self, delay: float, coefficients: FloatArray) -> FloatArray:
        """F[sigma(phi)] of a polynomial, (rows,)."""
        return np.asarray(
            self._filter.apply(Polynomial().stiffness(self._phi(delay), coefficients))[0][self._rows]
        )

    def lateness(self, model: TransmissionModel, delay: float, alpha: FloatArray) -> FloatArray:
        """dF[f(phi)]/d(delay), (rows,)."""
        step = 0.25 * self.period_s
        change = model.torque(self._phi(delay + step), alpha) - model.torque(self._phi(delay - step), alpha)
        return np.asarray(self._filter.apply(change / (2.0 * step))[0][self._rows])

    def sensitivity(self, model: TransmissionModel, delay: float, alpha: FloatArray) -> FloatArray:
        """F[df/dshape], (rows, shape parameters)."""
        columns = model.jacobian(self._phi(delay), alpha)[:, 1:]
        return np.stack([self._filter.apply(column)[0][self._rows] for column in columns.T], axis=1)


def prepare(record: Record, index: int, motor: Motor, bandwidth_rad_s: float) -> Channels:
    """Filter one motor's channels of a recording.

    Raises:
        EstimatorError: too few samples are usable.
    """
    filter_ = StateVariableFilter(_ORDER, bandwidth_rad_s, record.period_s)
    assert record.link_position_rad is not None
    theta, tau = record.motor_position_rad[:, index], record.motor_torque_nm[:, index]
    q = record.link_position_rad
    good = np.isfinite(theta) & np.isfinite(tau) & np.isfinite(q)
    if np.count_nonzero(good) < 8:
        raise EstimatorError("recording: expected motor position, motor torque and link position as numbers")
    sequence = record.sequence[good]
    grid = np.arange(sequence[0], sequence[-1] + 1)
    settle = math.ceil(filter_.settling_periods * 0.6)
    if len(grid) < 3 * settle:
        raise EstimatorError(
            f"recording: expected at least {3 * settle * record.period_s:.2g} s, "
            f"got {len(grid) * record.period_s:.2g} s"
        )
    held = np.searchsorted(sequence, grid, side="right") - 1
    usable = np.ones(len(grid), dtype=bool)
    usable[:settle] = False
    for k in np.flatnonzero(np.diff(sequence) > _BRIDGED):
        usable[sequence[k] - grid[0] : sequence[k + 1] - grid[0] + settle] = False
    step = max(1, round(1.0 / (_ROW_HZ * record.period_s)))
    rows = np.flatnonzero(usable)
    rows = rows[rows % step == 0]
    if len(rows) < 50:
        raise EstimatorError("recording: expected more than half a second without long gaps")
    return Channels(
        np.interp(grid, sequence, theta[good]),
        tau[good][held],
        np.interp(grid, sequence, q[good]),
        rows,
        motor,
        filter_,
    )


def _shifted(signal: FloatArray, periods: float) -> FloatArray:
    """The signal so many periods later, cubic between samples: straight lines would look like an inertia."""
    whole = math.floor(periods)
    x = periods - whole
    weights = (
        -x * (x - 1.0) * (x - 2.0) / 6.0,
        (x + 1.0) * (x - 1.0) * (x - 2.0) / 2.0,
        -(x + 1.0) * x * (x - 2.0) / 2.0,
        (x + 1.0) * x * (x - 1.0) / 6.0,
    )
    at = np.arange(len(signal)) + whole
    last = len(signal) - 1
    shifted = np.zeros(len(signal))
    for k, weight in enumerate(weights):
        shifted += weight * signal[np.clip(at + (k - 1), 0, last)]
    return shifted


def _sign_of_velocity(theta: FloatArray, filter_: StateVariableFilter) -> FloatArray:
    """tanh of the velocity over a small share of its largest, the velocity smoothed without delay."""
    T = filter_.period_s
    pole = math.exp(-_LIGHT_RATIO * filter_.bandwidth_rad_s * T)
    velocity = np.gradient(theta, T)
    for _ in range(2):
        for _ in range(2):
            start = velocity[0]
            velocity = linear_filter([1.0 - pole], [1.0, -pole], velocity - start) + start
        velocity = velocity[::-1]
    largest = float(np.max(np.abs(velocity)))
    return np.tanh(velocity / (_FRICTION_SPEEDS * largest)) if largest > 0.0 else velocity


def _noise(signal: FloatArray) -> float:
    """Standard deviation of white noise on a smooth signal, from third differences."""
    return float(np.sqrt(np.mean(np.diff(signal, 3) ** 2) / 20.0))
