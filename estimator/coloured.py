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
    measured = _autocovariance(residual[:, None], lags)
    grams = [A[m:].T @ A[: rows - m] for m in range(lags + 1)]
    root = _root(inverse)
    left = _what_a_fit_leaves(np.array([root.T @ gram @ root for gram in grams]), A @ root, lags)
    r = measured * taper
    for _ in range(_ROUNDS):
        r = r + taper * (measured - left @ r)
    middle = np.diag(held) + r[0] * grams[0]
    for m in range(1, lags + 1):
        middle += r[m] * (grams[m] + grams[m].T)
    shape = r / max(r[0], 1e-300)
    independent = rows / (2.0 * float(shape @ shape) - 1.0)
    freedom = max(independent - A.shape[1], _LEAST_FREEDOM)
    covariance = freedom / (freedom - 2.0) * (inverse @ middle @ inverse)
    floor = np.mean(residual**2) * np.diag(inverse) * 1e-3
    np.fill_diagonal(covariance, np.maximum(np.diag(covariance), floor))
    return np.asarray(covariance)


def _what_a_fit_leaves(grams: FloatArray, Q: FloatArray, lags: int) -> FloatArray:
    """M (lags + 1, lags + 1): errors of autocovariance r leave a residual (1 - Q Q') e of autocovariance M r.

    With V the Toeplitz matrix of r and G_m = sum_t Q_(t+m) Q_t' that is, but for the rows at the two ends,
    (V - 2 V Q Q' + Q (Q' V Q) Q') summed along its m-th diagonal.

    Args:
        grams: (lags + 1, n, n), G_m. Q: (rows, n).
    """
    rows = len(Q)
    own = rows * _autocovariance(Q, 2 * lags)  # tr G_m
    k = np.arange(lags + 1)
    both = own[np.abs(k[:, None] - k)] + own[k[:, None] + k]  # V Q against Q, m by k: r_k acts at -k and k
    both[:, 0] = own[: lags + 1]
    seen = grams + np.swapaxes(grams, 1, 2)  # Q' V Q is the sum of these times r
    seen[0] = grams[0]
    middle = 0.5 * np.einsum("mij,kij->mk", grams + np.swapaxes(grams, 1, 2), seen)
    return np.asarray(np.diag(1.0 - k / rows) + (middle - 2.0 * both) / rows)


def _autocovariance(x: FloatArray, lags: int) -> FloatArray:
    """Sum over columns and mean over rows of x_t x_(t+m), for m = 0 … lags."""
    size = 1 << (len(x) + lags - 1).bit_length()
    power = np.sum(np.abs(np.fft.rfft(x, size, axis=0)) ** 2, axis=1)
    return np.asarray(np.fft.irfft(power, size)[: lags + 1] / len(x))


def _root(matrix: FloatArray) -> FloatArray:
    """R with R R' = matrix, symmetric and not negative."""
    values, vectors = np.linalg.eigh(0.5 * (matrix + matrix.T))
    return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0)))
