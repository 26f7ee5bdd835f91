"""Stiffness over deflection with its uncertainty, and whether it is determined."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from estimator.choices import whole
from estimator.diagnosis.covariance import hac_covariance
from estimator.diagnosis.frame import Frame
from estimator.diagnosis.hypothesis import Fitted
from estimator.diagnosis.problem import Problem
from estimator.diagnosis.result import Refitted, StiffnessCurve
from estimator.sample import SIGMA_95, FloatArray
from estimator.transmissions import TransmissionModel

__all__ = ["Middle", "middle", "stiffness_curves"]


class Middle(NamedTuple):
    """A transmission's stiffness at the median of the observed deflections.

    Attributes:
        stiffness_nm_rad: N·m/rad. std_nm_rad: its standard deviation.
        slope: (n,) of the stiffness over the transmission's parameters.
    """

    stiffness_nm_rad: float
    std_nm_rad: float
    slope: FloatArray

    @property
    def determined(self) -> bool:
        """Whether its 95 % interval is within half of it.

        A control loop usually has a gain margin of two, which a larger error would exceed.
        """
        return SIGMA_95 * self.std_nm_rad < 0.5 * self.stiffness_nm_rad


def middle(model: TransmissionModel, alpha: FloatArray, covariance: FloatArray, phi: FloatArray) -> Middle:
    """Return the stiffness at the median of the deflections' sizes.

    Args:
        model: the transmission.
        alpha: (n,) its parameters. covariance: (n, n) of them.
        phi: observed deflections, rad.
    """
    at = np.array([float(np.median(np.abs(phi)))])
    slope = np.asarray(model.stiffness_jacobian(at, alpha))[0]
    variance = float(slope @ covariance @ slope)
    # A negative variance is rounding of one without bound.
    possible = variance >= 0.0 and bool(np.all(np.diag(covariance) >= 0.0))
    std = float(np.sqrt(variance)) if possible else np.inf
    return Middle(float(np.asarray(model.stiffness(at, alpha))[0]), std, slope)


def stiffness_curves(
    problem: Problem, before: Fitted, after: Fitted, surplus: float, stated: Sequence[Refitted]
) -> tuple[StiffnessCurve, ...]:
    """Return one curve for each flexible transmission, over the deflections of the first recording.

    Args:
        problem: the recordings.
        before: of the declared model. after: with the effects.
        surplus: see `hac_covariance`.
        stated: each motor's transmission, whose covariance the refitted band has where there is one.
    """
    both = [(fitted, hac_covariance(problem, fitted, surplus)) for fitted in (before, after)]
    frame, made = problem.frames[0], []
    for i, motor in enumerate(problem.model.motors):
        if not motor.flexible:
            continue
        reach = float(np.max(np.abs(frame.motors[i].deflection)))
        phi = np.linspace(-reach, reach, 2 * whole("points") + 1)
        curves = [
            _stiffness(frame, *one, i, phi, rows)
            for one, rows in zip(both, ((), stated[i].covariance), strict=True)
        ]
        made.append(StiffnessCurve(i, phi, *curves[0], *curves[1]))
    return tuple(made)


def _stiffness(
    frame: Frame,
    fitted: Fitted,
    covariance: FloatArray,
    motor: int,
    phi: FloatArray,
    stated: Sequence[Sequence[float]],
) -> tuple[FloatArray, FloatArray]:
    """(stiffness, standard deviation) of one motor's transmission."""
    model = fitted.base.models(frame)[motor]
    nothing = np.full_like(phi, np.nan)
    if model is None:
        return nothing, nothing
    mine = [j for j, slot in enumerate(fitted.slots) if slot.kind == "base" and slot.motor == motor]
    alpha = np.array([fitted.slots[j].taken + fitted.posterior.x[j] for j in mine])
    own = np.array(stated) if stated else covariance[np.ix_(mine, mine)]
    slopes = model.stiffness_jacobian(phi, alpha)
    variance = np.einsum("ij,jk,ik->i", slopes, own, slopes)
    return np.asarray(model.stiffness(phi, alpha)), np.sqrt(np.maximum(variance, 0.0))
