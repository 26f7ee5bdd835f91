"""How sure a least-squares solution is where the errors are correlated in time, as behind a filter."""

from __future__ import annotations

import numpy as np

from estimator.sample import FloatArray

__all__ = ["coloured_covariance"]

_LAGS = 60  # rows over which errors are taken as correlated
_ROUNDS = 6  # of the fixed point that frees the autocovariance from what the fit took out of it
_LEAST_FREEDOM = 4.0


def coloured_covariance(
    A: FloatArray, residual: FloatArray, inverse: FloatArray, held: FloatArray
) -> FloatArray:
    """Covariance A# E[e e'] A#' of x = inverse A' y, (n, n), the errors e being stationary but coloured.

    E[e e'] is Toeplitz, with the residual's autocovariance. Two things make that one too small, and both
    are undone: a fit takes a part of the errors into x, most of it at the slow motions of the regressors;
    and with few independent errors their variance is itself uncertain (the variance of a t distribution).

    Args:
        A: regressors, (s, n). residual: y - A x, (s,).
        inverse: (A'A + penalty)^-1, (n, n).
        held: what the penalty itself leaves open, the covariance of its part of A'y, (n,), a diagonal.
    """
    rows = len(residual)
    lags = min(_LAGS, rows // 4)
    taper = np.minimum(1.0, 2.0 - 2.0 * np.arange(lags + 1) / lags)
    measured = _lagged(residual[:, None], residual[:, None], lags) / rows
    projector = A @ _root(inverse)
    r = measured * taper
    for _ in range(_ROUNDS):
        r = r + taper * (measured - _left(r, projector, lags))
    middle = np.diag(held) + r[0] * (A.T @ A)
    for m in range(1, lags + 1):
        R = A[m:].T @ A[: rows - m]
        middle += r[m] * (R + R.T)
    shape = r / max(r[0], 1e-300)
    independent = rows / (2.0 * float(shape @ shape) - 1.0)
    freedom = max(independent - A.shape[1], _LEAST_FREEDOM)
    covariance = freedom / (freedom - 2.0) * (inverse @ middle @ inverse)
    floor = np.mean(residual**2) * np.diag(inverse) * 1e-3
    np.fill_diagonal(covariance, np.maximum(np.diag(covariance), floor))
    return np.asarray(covariance)


def _left(r: FloatArray, Q: FloatArray, lags: int) -> FloatArray:
    """Autocovariance that a residual (1 - Q Q') e shows where e has autocovariance r, (lags + 1,)."""
    rows = len(Q)
    size = 1 << (2 * rows - 1).bit_length()
    kernel = np.zeros(size)
    kernel[: lags + 1] = r
    kernel[-lags:] = r[:0:-1]
    VQ = np.fft.irfft(np.fft.rfft(kernel)[:, None] * np.fft.rfft(Q, size, axis=0), size, axis=0)[:rows]
    fitted = Q @ (Q.T @ VQ).T - 2.0 * VQ
    return np.asarray(r * (1.0 - np.arange(lags + 1) / rows) + _lagged(Q, fitted, lags) / rows)


def _lagged(x: FloatArray, y: FloatArray, lags: int) -> FloatArray:
    """Sum over columns and rows of x_t y_(t+m), the mean of m and -m, for m = 0 … lags."""
    size = 1 << (2 * len(x) - 1).bit_length()
    cross = np.sum(np.conj(np.fft.rfft(x, size, axis=0)) * np.fft.rfft(y, size, axis=0), axis=1)
    c = np.fft.irfft(cross, size)
    return np.asarray(0.5 * (c[: lags + 1] + np.concatenate([c[:1], c[: -lags - 1 : -1]])))


def _root(matrix: FloatArray) -> FloatArray:
    """R with R R' = matrix, symmetric and not negative."""
    values, vectors = np.linalg.eigh(0.5 * (matrix + matrix.T))
    return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0)))
