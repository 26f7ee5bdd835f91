"""Mode "paper": eqs 14, 28, 32, 33 as printed, correctly discretised, one tick at a time.

Faithful on purpose: regressors are not filtered like the residual, velocities are taken as the drive
gives them (a difference of positions where it gives none). What that costs on a real drive's signals is
what the robust mode is for.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from estimator.arrangement import check_arrangement, joint_estimate
from estimator.flexibility import Polynomial
from estimator.inputs import InputGuard
from estimator.model import JointModel, Motor
from estimator.recursive import RecursiveLeastSquares
from estimator.regressor import regressor_step
from estimator.residuals import FirstOrder, SecondOrder
from estimator.sample import Estimate, Sample, Status, TransmissionEstimate
from estimator.settings import EstimatorSettings
from estimator.transmissions import RIGID, transmission_model

__all__ = ["PaperEstimator"]

# Plain integers: an IntFlag costs a microsecond per operation.
_VALID, _OBSERVABLE = int(Status.VALID), int(Status.OBSERVABLE)
_NOTHING = TransmissionEstimate(math.nan, math.nan, math.nan, math.nan)
_EXCITED_RAD2_S2 = 1e-6  # mean square of phi' above which K_R phi'² teaches anything
_ENERGY_S = 0.5  # over which that mean is taken …
_SCATTER_S = 0.5  # … and those of the stiffness and of its scatter
_SIGMA_95 = 1.96


class _Transmission:
    """One motor with its transmission."""

    def __init__(self, motor: Motor, settings: EstimatorSettings, period_s: float) -> None:
        known = (motor.inertia_kg_m2, motor.viscous_damping_nm_s_rad)
        self.rigid = motor.transmission.model == RIGID
        model = transmission_model(motor.transmission)
        self._settings, self._T = settings, period_s
        self.torque = FirstOrder(*known, settings.k_tau_rad_s, period_s)
        self._slope = SecondOrder(*known, settings.k_sigma_1_rad2_s2, settings.k_sigma_2_rad_s, period_s)
        order = motor.transmission.order or 2
        polynomial = model if isinstance(model, Polynomial) else None
        self._model = polynomial if settings.method == "mbe" else None
        size = order if polynomial is None or polynomial.linear is None else 1
        self._squares = RecursiveLeastSquares(size)
        self.reset()

    def reset(self) -> None:
        self.stiffness = 0.0
        self._energy = 0.0
        self._mean = self._scatter = 0.0
        self._squares.reset()
        self.restart()

    def restart(self) -> None:
        self.torque.reset()
        self._slope.reset()
        self._theta = self._q = math.nan
        self.held = _NOTHING

    def update(
        self, theta: float, omega: float, tau: float, q: float, q_rate: float, periods: int
    ) -> TransmissionEstimate:
        span = self._T * periods
        if not math.isfinite(omega):
            omega = (theta - self._theta) / span
            if math.isnan(omega):  # the first position alone gives no velocity to start from
                self._theta, self._q = theta, q
                return self.held
        torque = self.torque.update(theta, omega, tau, periods)
        self._theta = theta
        if self.rigid:
            self.held = TransmissionEstimate(torque, math.nan, math.nan, math.nan)
            return self.held
        if not math.isfinite(q_rate):
            q_rate = 0.0 if math.isnan(self._q) else (q - self._q) / span
        self._q = q
        phi, rate = q - theta, q_rate - omega
        slope = self._slope.update(theta, omega, tau, periods)
        self._energy += min(1.0, span / _ENERGY_S) * (rate * rate - self._energy)
        if self._model is None:
            gains = (self._settings.k_r_s2_rad2, self._settings.k_max)
            self.stiffness = _finite(regressor_step(self.stiffness, slope, rate, *gains))
        else:
            self._squares.update(self._model.basis(phi, order=self._squares.size), torque)
            self.stiffness = float(self._model.stiffness(phi, self._squares.alpha))
        gain, off = min(1.0, span / _SCATTER_S), self.stiffness - self._mean
        self._mean += gain * off
        self._scatter += gain * (off * off - self._scatter)
        self.held = TransmissionEstimate(torque, self.stiffness, math.nan, phi)
        return self.held

    @property
    def usable(self) -> bool:
        """Whether the torque is a number and the stiffness is told to be positive.

        The paper's stiffness has no standard deviation. Its scatter over half a second is the least that
        it is uncertain by: where mean and scatter leave zero inside 95 %, nothing is told, not even the sign.
        """
        if not math.isfinite(self.held[0]):
            return False
        if self.rigid:
            return True
        return self.stiffness > 0.0 and self._mean > _SIGMA_95 * math.sqrt(self._scatter)

    @property
    def observable(self) -> bool:
        return not self.rigid and self._energy > _EXCITED_RAD2_S2

    def parameters(self) -> dict[str, Any]:
        if self._model is None:
            value = {} if self.rigid else {"stiffness_nm_rad": self.stiffness}
            return {"model": RIGID if self.rigid else "unknown", "parameters": value, "std": {}}
        std = np.sqrt(np.diag(self._squares.covariance))
        return {
            "model": self._model.name,
            "parameters": self._model.parameters(self._squares.alpha),
            "std": self._model.parameters(std),
        }


class PaperEstimator:
    """The paper's estimator for a whole joint; see `estimator.online.Estimator`."""

    def __init__(self, model: JointModel, settings: EstimatorSettings, period_s: float) -> None:
        check_arrangement(model)
        self._arrangement = model.arrangement
        self._guard = InputGuard(model, period_s)
        self._parts = [_Transmission(motor, settings, period_s) for motor in model.motors]

    @property
    def residual_nm(self) -> float:
        """The paper has no model to fall short of: always nan."""
        return math.nan

    def distrust(self) -> None:
        """Nothing to do: the paper's residuals are made from every sample."""

    def reset(self) -> None:
        """Forget everything."""
        self._guard.reset()
        for part in self._parts:
            part.reset()

    def parameters(self) -> list[dict[str, Any]]:
        """Current transmission parameters and their standard deviations, one entry a motor."""
        return [part.parameters() for part in self._parts]

    def step(self, sample: Sample) -> Estimate:
        """The estimate at this sample; never raises, whatever floats it holds."""
        periods, restart, status, _, _ = self._guard.check(sample)
        if restart:
            for part in self._parts:
                part.restart()
        if periods:
            velocities = sample.motor_velocity_rad_s
            if len(velocities) != len(self._parts):
                velocities = (math.nan,) * len(self._parts)
            for part, theta, omega, tau in zip(
                self._parts, sample.motor_position_rad, velocities, sample.motor_torque_nm, strict=True
            ):
                part.update(theta, omega, tau, sample.link_position_rad, sample.link_velocity_rad_s, periods)
        held = tuple(part.held for part in self._parts)
        flexible = [part for part in self._parts if not part.rigid]
        if all(part.usable for part in self._parts):
            status |= _VALID
        if periods and flexible and all(part.observable for part in flexible):
            status |= _OBSERVABLE
        return joint_estimate(self._arrangement, sample.sequence, status, held)


def _finite(value: float) -> float:
    return value if math.isfinite(value) else 0.0
