"""The paper's second stage over arrays: least squares in alpha, linear (21)-(24) and nonlinear (25)-(27)."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, Literal, NamedTuple

import numpy as np
from scipy.optimize import minimize, minimize_scalar

from estimator.choices import choice, whole
from estimator.errors import EstimatorError
from estimator.flexibility import Polynomial, TransmissionModel
from estimator.sample import FloatArray

__all__ = ["ArrayFit", "fit_alpha", "fit_polynomial", "fit_projected", "solve"]


class ArrayFit(NamedTuple):
    """Parameters fitted to torques.

    Attributes:
        alpha: (n,).
        covariance: (n, n) if the errors were independent.
        sum_of_squares: of the errors, N²·m².
        iterations: evaluations of the model that it took; 1 for a linear fit.
    """

    alpha: FloatArray
    covariance: FloatArray
    sum_of_squares: float
    iterations: int


def solve(regressors: FloatArray, target: FloatArray) -> ArrayFit:
    """alpha = J# r by the pseudoinverse (eqs 22, 23), columns scaled so that powers of phi keep their digits.

    Args:
        regressors: J, (s, n).
        target: r_tau_e, (s,).
    """
    scale = np.sqrt(np.einsum("ij,ij->j", regressors, regressors))
    scale[scale == 0.0] = 1.0
    alpha, _, _, _ = np.linalg.lstsq(regressors / scale, target, rcond=None)
    error = target - (regressors / scale) @ alpha
    squares = float(error @ error)
    freedom = max(len(target) - len(alpha), 1)
    gram = np.linalg.pinv((regressors / scale).T @ (regressors / scale), hermitian=True)
    covariance = squares / freedom * gram / np.outer(scale, scale)
    return ArrayFit(alpha / scale, covariance, squares, 1)


def fit_polynomial(
    columns: FloatArray,
    target: FloatArray,
    rule: Literal["paper", "bic", "cross-validation"] = "bic",
    gamma: float = 1e-2,
) -> ArrayFit:
    """Fit odd polynomials of increasing order p (eq 24) until the rule stops.

    Args:
        columns: f_h(phi), h = 1 … p_max, (s, p_max), filtered like the target where lags are to cancel.
        target: r_tau_e, (s,).
        rule: "paper": stop when the sum of squared errors changes by less than gamma (in N²·m², so it
            depends on units and number of samples); "bic": smallest s ln(e/s) + p ln s;
            "cross-validation": smallest error on blocks left out, and by more than 1 %. The last two are
            scale-free, and also stop at the error that filters leave of exact data.
        gamma: threshold of the paper's rule.
    """
    highest = columns.shape[1]
    fits = [solve(columns[:, :p], target) for p in range(1, highest + 1)]
    if rule == "paper":
        # e^(0) is the error of no model; the paper reports the order at which the last gain was made.
        last = float(target @ target)
        for p, fit in enumerate(fits, start=1):
            if abs(fit.sum_of_squares - last) < gamma:
                return fits[max(p - 2, 0)]
            last = fit.sum_of_squares
        return fits[-1]
    scores = [
        _cross_validated(columns[:, :p], target) if rule == "cross-validation" else _bic(fit, p, len(target))
        for p, fit in enumerate(fits, start=1)
    ]
    best = 0
    enough = choice("exact") ** 2 * float(target @ target)
    for p in range(1, highest):
        if fits[best].sum_of_squares < enough:
            break
        better = scores[p] < 0.99 * scores[best] if rule == "cross-validation" else scores[p] < scores[best]
        if better:
            best = p
    return fits[best]


def _bic(fit: ArrayFit, order: int, samples: int) -> float:
    return samples * math.log(max(fit.sum_of_squares, 1e-300) / samples) + order * math.log(samples)


def _cross_validated(columns: FloatArray, target: FloatArray) -> float:
    blocks = np.array_split(np.arange(len(target)), whole("groups"))
    error = 0.0
    for block in blocks:
        keep = np.ones(len(target), dtype=bool)
        keep[block] = False
        alpha = solve(columns[keep], target[keep]).alpha
        error += float(np.sum((target[block] - columns[block] @ alpha) ** 2))
    return error


def fit_alpha(
    model: TransmissionModel,
    phi: FloatArray,
    target: FloatArray,
    start: FloatArray | None = None,
    *,
    damped: bool = True,
    tolerance: float = 1e-10,
    most: int = 300,
) -> ArrayFit:
    """Iterative least squares for a nonlinearly parametrised model (eqs 25, 26).

    Damped (Levenberg-Marquardt) unless asked otherwise: the printed undamped step diverges from the
    paper's start. The step is relative to alpha (the paper's delta = 1 mixes k and C).

    Args:
        model: f and its Jacobian.
        phi: deflections, (s,).
        target: r_tau_e, (s,).
        start: alpha of iteration 0; the model's own if left out.
        damped: False for the printed Gauss-Newton step.
        tolerance: relative step at which it has converged.
        most: iterations at most.

    Raises:
        EstimatorError: it did not converge.
    """
    alpha = np.array([1.0, *model.shape_start]) if start is None else np.asarray(start, dtype=np.float64)
    damping = 1e-3 if damped else 0.0
    error = target - model.torque(phi, alpha)
    squares = float(error @ error)
    for iteration in range(1, most + 1):
        trial = _trial(model, phi, alpha, error, damping)
        new = target - model.torque(phi, trial)
        new_squares = float(new @ new)
        if damped and not new_squares <= squares:
            damping *= 4.0
            if damping > 1e12:
                break
            continue
        relative = float(np.max(np.abs(trial - alpha) / np.maximum(np.abs(trial), 1e-12)))
        alpha, error, squares = trial, new, new_squares
        damping *= 0.3
        if not np.all(np.isfinite(alpha)):
            break
        if relative < tolerance:
            return _finished(model, phi, alpha, squares, iteration)
    if damped and np.isfinite(squares):
        return _finished(model, phi, alpha, squares, most)
    raise EstimatorError(f"{model.name}: least squares diverged from the start that was given")


def _trial(
    model: TransmissionModel, phi: FloatArray, alpha: FloatArray, error: FloatArray, damping: float
) -> FloatArray:
    """The next alpha; a damped one has its shape inside the model's bounds."""
    J = model.jacobian(phi, alpha)
    gram = J.T @ J
    gram += damping * np.diag(np.diag(gram))
    trial = np.asarray(alpha + np.linalg.pinv(gram, hermitian=True) @ (J.T @ error))
    if not damping:
        return trial
    low = np.array([-np.inf, *(bound[0] + 1e-9 * abs(bound[0]) for bound in model.shape_bounds)])
    high = np.array([np.inf, *(bound[1] for bound in model.shape_bounds)])
    return np.clip(trial, low, high)


def _finished(
    model: TransmissionModel, phi: FloatArray, alpha: FloatArray, squares: float, iterations: int
) -> ArrayFit:
    J = model.jacobian(phi, alpha)
    freedom = max(len(phi) - alpha.size, 1)
    inverse = np.asarray(np.linalg.pinv(J.T @ J, hermitian=True), dtype=np.float64)
    return ArrayFit(alpha, squares / freedom * inverse, squares, iterations)


def fit_projected(
    model: TransmissionModel,
    phi: FloatArray,
    target: FloatArray,
    filtered: Callable[[FloatArray], FloatArray] | None = None,
) -> ArrayFit:
    """Variable projection: k is linear given the shape, so only the shape is searched.

    Args:
        model: k g(phi, shape).
        phi: deflections, (s,).
        target: r_tau_e, (s,).
        filtered: optional callable that filters g(phi) like the target, so that their lags cancel.
    """
    count = 0

    def passes(signal: FloatArray) -> FloatArray:
        return signal if filtered is None else filtered(signal)

    def project(shape: tuple[float, ...]) -> tuple[float, float]:
        nonlocal count
        count += 1
        g = passes(np.asarray(model.torque(phi, (1.0, *shape))))
        power = float(g @ g)
        k = float(g @ target) / power if power > 0.0 else 0.0
        error = target - k * g
        return float(error @ error), k

    reach = float(np.max(np.abs(phi)))
    shape = search_shape(model, reach, lambda candidate: project(candidate)[0])
    squares, k = project(shape)
    alpha = np.array([k, *shape])
    J = np.stack([passes(column) for column in model.jacobian(phi, alpha).T], axis=-1)
    freedom = max(len(phi) - alpha.size, 1)
    inverse = np.asarray(np.linalg.pinv(J.T @ J, hermitian=True), dtype=np.float64)
    return ArrayFit(alpha, squares / freedom * inverse, squares, count)


def search_shape(
    model: TransmissionModel,
    reach_rad: float,
    cost: Callable[[tuple[float, ...]], float],
    tolerance: float = 1e-10,
) -> tuple[float, ...]:
    """The shape parameters with the least cost(shape), within bounds and where the model reaches |phi|.

    Args:
        model: of the transmission.
        reach_rad: largest |phi| in the data.
        cost: of a shape, everything linear at its best.
        tolerance: relative, of a single shape parameter.
    """
    if not model.shape_names:
        return ()
    if len(model.shape_names) > 1:
        search: Any = minimize  # its stubs know no bounds for this method
        result = search(
            lambda x: cost(tuple(x.tolist())),
            np.asarray(model.shape_start, dtype=np.float64),
            method="Nelder-Mead",
            bounds=list(model.shape_bounds),
            options={"xatol": 1e-8, "fatol": 0.0, "maxfev": 400},
        )
        return tuple(result.x.tolist())
    grid = model.shapes(1.001 * reach_rad, whole("points"))
    if grid.size == 0:
        raise EstimatorError(
            f"{model.name}: no {model.shape_names[0]} reaches deflections of {reach_rad:g} rad"
        )
    # Coarse to fine: a golden section over the grid's neighbours of its best point.
    costs = [cost((float(c),)) for c in grid]
    best = int(np.argmin(costs))
    bounds = (float(grid[max(best - 1, 0)]), float(grid[min(best + 1, grid.size - 1)]))
    if bounds[0] == bounds[1]:
        return (bounds[0],)
    found = minimize_scalar(
        lambda c: cost((float(c),)), bounds=bounds, method="bounded", options={"xatol": tolerance * bounds[1]}
    )
    return (float(found.x),)


def polynomial_columns(phi: FloatArray, order: int) -> FloatArray:
    """f_h(phi) = phi^(2h-1), h = 1 … order (eq 24)."""
    return Polynomial().basis(phi, order=order)
