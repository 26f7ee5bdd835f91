"""An extended Kalman filter on the raw positions, with the stiffness parameters as states: a rival.

States are θ, θ′, q, q′, q″, the law's parameters, Coulomb friction, the torque's offset, the zero between the
encoders and the link's delay; the motor moves by eq 5, the link by white jerk. It is given what a user would
have to find out: the law with parameters that are right to its prior, the variance of the torque's noise and
of the link's jerk. It has no gaps, no alarms and no check of its input; its covariance is published as it is.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from estimator.sample import Sample
from estimator.transmissions import MODELS

if TYPE_CHECKING:
    from estimators import Drawn

THETA, OMEGA, Q, DQ, DDQ, LAW = range(6)
STRIBECK_RAD_S = 0.02  # friction is a tanh of the velocity over this
DELAY_STD = 3.0  # periods
FRICTION_STD, OFFSET_STD = 0.1, 0.1  # of the largest torque
ZERO_STD_RAD = 0.01
WANDER = 1e-4  # of a parameter's prior standard deviation, in a second: it is a constant
PRECISE = 0.25  # standard deviation over stiffness, up to which it is usable
FROM_NOTHING = {"vsa-ii": ((500.0, 1.7), (200.0, 0.15)), "exponential": ((150.0, 7.0), (80.0, 3.0))}


class Ekf:
    """The filter of one joint."""

    def __init__(self, drawn: Drawn) -> None:
        record, (motor,) = drawn.record, drawn.model.motors
        assert record.link_position_rad is not None
        self.B, self.D, self.T = motor.inertia_kg_m2, motor.viscous_damping_nm_s_rad, record.period_s
        self.law = MODELS[motor.transmission.model]
        theta, q = record.motor_position_rad[:, 0], record.link_position_rad
        torque = np.abs(record.motor_torque_nm).max()
        self.noise = [np.min(np.diff(np.unique(x))) ** 2 / 12.0 for x in (theta, q)]
        mean, std = self._prior(motor.transmission, torque, np.abs(q - theta).max())
        self.laws = slice(LAW, LAW + len(mean))
        self.n = n = LAW + len(mean) + 4
        self.friction, self.offset, self.zero, self.delay = range(n - 4, n)
        self.x, prior = np.zeros(n), np.zeros(n)
        self.x[THETA], self.x[Q], self.x[self.laws] = theta[0], q[0], mean
        prior[[THETA, Q]], prior[[OMEGA, DQ]], prior[DDQ] = np.sqrt(self.noise), 1.0, 30.0
        prior[self.laws], prior[self.zero], prior[self.delay] = std, ZERO_STD_RAD, DELAY_STD
        prior[self.friction], prior[self.offset] = FRICTION_STD * torque, OFFSET_STD * torque
        self.P = np.diag(prior**2)
        self.Q = np.diag((WANDER * prior) ** 2 * self.T)
        self.Q[OMEGA, OMEGA] = (self.T / self.B * drawn.torque_noise_nm) ** 2
        walk = np.array([self.T**3 / 6.0, self.T**2 / 2.0, self.T])  # of q, q′, q″ by a jerk that is white
        self.Q[Q : DDQ + 1, Q : DDQ + 1] = drawn.jerk_rad_s3**2 * np.outer(walk, walk)
        self.Q[THETA, THETA] = 0.0
        self.F = np.eye(n)
        self.F[THETA, OMEGA] = self.F[Q, DQ] = self.F[DQ, DDQ] = self.T
        self.F[Q, DDQ] = 0.5 * self.T**2
        self.torque_nm = 0.0

    def _prior(self, declared, torque, deflection):
        if declared.parameters:
            given = self.law.alpha(declared.parameters)
            return given, 0.3 * np.abs(given)
        if declared.model in FROM_NOTHING:
            return map(np.array, FROM_NOTHING[declared.model])
        powers = 2 * np.arange(1 if declared.model == "linear" else declared.order or 3) + 1
        unit = torque / deflection**powers
        return 0.5 * unit * (powers == 1), 2.0 * unit

    def step(self, sample: Sample) -> tuple[float, float, bool]:
        """Predict by the torque that acted, correct by both positions: stiffness, its std, usable."""
        if sample.sequence:
            self._predict()
            for place, measured in ((THETA, sample.motor_position_rad[0]), (Q, sample.link_position_rad)):
                self._correct(place, measured)
        self.torque_nm = sample.motor_torque_nm[0]
        x, row = self.x, np.zeros(self.n)
        phi = np.array([x[Q] - x[THETA] + x[self.zero]])
        stiffness = float(self.law.stiffness(phi, x[self.laws])[0])
        above, below = (self.law.stiffness(phi + h, x[self.laws])[0] for h in (1e-6, -1e-6))
        row[self.laws] = self.law.stiffness_jacobian(phi, x[self.laws])[0]
        row[[THETA, Q, self.zero]] = (above - below) / 2e-6 * np.array([-1.0, 1.0, 1.0])
        std = float(np.sqrt(max(row @ self.P @ row, 0.0)))
        return stiffness, std, std < PRECISE * stiffness

    def _predict(self) -> None:
        x, F, T, gain = self.x, self.F, self.T, self.T / self.B
        phi, grip = np.array([x[Q] - x[THETA] + x[self.zero]]), np.tanh(x[OMEGA] / STRIBECK_RAD_S)
        spring, slope = self.law.torque(phi, x[self.laws])[0], self.law.stiffness(phi, x[self.laws])[0]
        F[OMEGA, [THETA, Q, self.zero]] = gain * slope * np.array([-1.0, 1.0, 1.0])
        steep = (1.0 - grip**2) / STRIBECK_RAD_S * x[self.friction]
        F[OMEGA, OMEGA] = 1.0 - gain * (self.D + steep)
        F[OMEGA, self.laws] = gain * self.law.jacobian(phi, x[self.laws])[0]
        F[OMEGA, self.friction], F[OMEGA, self.offset] = -gain * grip, gain
        losses = self.D * x[OMEGA] + x[self.friction] * grip
        pull = gain * (self.torque_nm + spring - losses + x[self.offset])
        x[THETA] += T * x[OMEGA] + 0.5 * T * pull
        x[OMEGA] += pull
        x[Q] += T * x[DQ] + 0.5 * T * T * x[DDQ]
        x[DQ] += T * x[DDQ]
        self.P = F @ self.P @ F.T + self.Q

    def _correct(self, place: int, measured: float) -> None:
        x, h = self.x, np.zeros(self.n)
        h[place] = 1.0
        expected = x[place]
        if place == Q:  # the link is late by so many periods
            expected -= self.T * x[self.delay] * x[DQ]
            h[DQ], h[self.delay] = -self.T * x[self.delay], -self.T * x[DQ]
        Ph = self.P @ h
        gain = Ph / (h @ Ph + self.noise[place == Q])
        self.x = x + gain * (measured - expected)
        self.P -= np.outer(gain, Ph)
        self.P = 0.5 * (self.P + self.P.T)
