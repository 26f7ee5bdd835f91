"""From a polynomial that has been estimated to the nonlinear model it approximates, with its covariance."""

from __future__ import annotations

import numpy as np
from scipy.optimize import minimize_scalar

from estimator.flexibility import Polynomial, TransmissionModel
from estimator.sample import FloatArray

__all__ = ["polynomial_to_model"]

_POINTS = 24
_GRID = 60
_ENOUGH = 0.1  # relative std of the cubic coefficient from which on the shape is told


def polynomial_to_model(
    model: TransmissionModel, coefficients: FloatArray, covariance: FloatArray, reach_rad: float
) -> tuple[FloatArray, FloatArray] | None:
    """Alpha of a model k g(phi, shape) with one shape parameter, and its slopes by the coefficients, (2, p).

    None if it is too early.

    The shape is searched on a line, k follows linearly (variable projection), over |phi| <= reach_rad.

    Args:
        model: the model to go over to.
        coefficients: of the odd polynomial, (p,).
        covariance: of the coefficients, (p, p).
        reach_rad: largest deflection that the polynomial was estimated with.
    """
    std = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    if coefficients[0] <= 0.0 or std[0] > 0.5 * _ENOUGH * coefficients[0]:
        return None
    if len(coefficients) > 1 and std[1] > _ENOUGH * abs(coefficients[1]):
        return None
    phi = np.linspace(0.0, reach_rad, _POINTS + 1)[1:]
    curve = Polynomial().torque(phi, coefficients)

    def project(shape: float) -> tuple[float, float]:
        g = model.torque(phi, (1.0, shape))
        k = float(g @ curve / (g @ g)) if np.any(g) else 0.0
        return float(np.sum((k * g - curve) ** 2)), k

    grid = model.shapes(1.02 * reach_rad, _GRID)
    if grid.size < 3:
        return None
    best = int(np.argmin([project(c)[0] for c in grid]))
    bounds = (grid[max(best - 1, 0)], grid[min(best + 1, grid.size - 1)])
    shape = float(minimize_scalar(lambda c: project(c)[0], bounds=bounds, method="bounded").x)
    alpha = np.array([project(shape)[1], shape])
    if alpha[0] <= 0.0:
        return None
    to_alpha = np.linalg.pinv(model.jacobian(phi, alpha)) @ Polynomial().jacobian(phi, coefficients)
    return alpha, to_alpha
