"""A motor without a flexible transmission: only its torque balance, no stiffness."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from estimator.model import Motor
from estimator.regression import Signals
from estimator.sample import FloatArray, TransmissionEstimate
from estimator.transmissions import RIGID

__all__ = ["RigidTrack"]


class RigidTrack:
    """The load torque B theta'' + D theta' + x - tau, brought up to the present by its own slope."""

    channels = 0
    misfit_nm = math.nan
    acting_nm = 0.0
    changed = False

    def __init__(self, motor: Motor, period_s: float) -> None:
        self._T = period_s
        self._B, self._D = motor.inertia_kg_m2, motor.viscous_damping_nm_s_rad
        self.reset()

    def reset(self) -> None:
        """Forget everything."""
        self._torque, self._rate = math.nan, 0.0

    def update(self, signals: Signals, excited: bool, usable: bool, late_s: float, noise_rad: float) -> None:
        """Take in the filtered signals of one update, which are late_s old."""
        motor, torque = signals.motor, signals.torque
        value = self._B * motor[2] + self._D * motor[1] + signals.effects[0] - torque[0]
        self._rate = self._B * motor[3] + self._D * motor[2] + signals.effects[1] - torque[1]
        self._torque = value + late_s * self._rate

    def along(self, phi: FloatArray) -> tuple[FloatArray, FloatArray]:
        """A rigid transmission has no curve."""
        return np.zeros_like(phi), np.zeros_like(phi)

    def columns(self, phi: FloatArray) -> FloatArray:
        """It has no basis channels."""
        return np.zeros((len(phi), 0))

    def reopen_shift(self) -> None:
        """It has no deflection."""

    def relearn(self) -> None:
        """Nothing is learned."""

    def learn(self) -> None:
        """Nothing is learned."""

    def correct(self) -> None:
        """Nothing is estimated."""

    def prepare(self) -> None:
        """Nothing is estimated."""

    def account(self) -> None:
        """Nothing is estimated."""

    def publish(self, phi: float, link_rate: float) -> None:
        """Nothing is estimated."""

    def estimate(self, phi: float, aligned: float, link_rate: float) -> tuple[TransmissionEstimate, bool]:
        """Torque alone; valid as soon as there is one."""
        torque = self._torque
        self._torque = torque + self._T * self._rate  # until the next update
        return TransmissionEstimate(torque, math.nan, math.nan, math.nan), math.isfinite(torque)

    def parameters(self) -> dict[str, Any]:
        """Nothing is estimated."""
        return {"model": RIGID, "parameters": {}, "std": {}}
