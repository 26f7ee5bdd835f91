"""From a polynomial that has been estimated to the nonlinear model it approximates, with its covariance."""

from __future__ import annotations

import numpy as np

from estimator.errors import EstimatorError
from estimator.flexibility import Polynomial, TransmissionModel
from estimator.leastsquares import search_shape
from estimator.sample import FloatArray

__all__ = ["polynomial_to_model"]

_POINTS = 24
_MARGIN = 1.02  # how far beyond the deflections a model has to go on
_ENOUGH = 0.1  # relative std of the higher coefficients from which on the shape is told


def polynomial_to_model(
    model: TransmissionModel, coefficients: FloatArray, covariance: FloatArray, reach_rad: float
) -> tuple[FloatArray, FloatArray] | None:
    """Alpha of a model k g(phi, shape), (n,), and its slopes by the coefficients, (n, p); None: too early.

    The shape is searched, k follows linearly (variable projection), over |phi| <= reach_rad.

    Args:
        model: the model to go over to.
        coefficients: of the odd polynomial, (p,).
        covariance: of the coefficients, (p, p).
        reach_rad: largest deflection that the polynomial was estimated with.
    """
    std = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    told = 1 + len(model.shape_names)
    if coefficients[0] <= 0.0 or std[0] > 0.5 * _ENOUGH * coefficients[0]:
        return None
    if np.any(std[1:told] > _ENOUGH * np.abs(coefficients[1:told])):
        return None
    phi = np.linspace(0.0, reach_rad, _POINTS + 1)[1:]
    curve = Polynomial().torque(phi, coefficients)

    def project(shape: tuple[float, ...]) -> tuple[float, float]:
        g = model.torque(phi, (1.0, *shape))
        k = float(g @ curve / (g @ g)) if np.any(g) else 0.0
        return float(np.sum((k * g - curve) ** 2)), k

    try:
        shape = search_shape(model, _MARGIN * reach_rad, lambda candidate: project(candidate)[0])
    except EstimatorError:  # no shape reaches so far
        return None
    alpha = np.array([project(shape)[1], *shape])
    if alpha[0] <= 0.0:
        return None
    to_alpha = np.linalg.pinv(model.jacobian(phi, alpha)) @ Polynomial().jacobian(phi, coefficients)
    return alpha, to_alpha
