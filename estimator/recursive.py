"""Recursive weighted least squares: eq 23 one row at a time, the same answer as the batch."""

from __future__ import annotations

import numpy as np

from estimator.model import require
from estimator.sample import FloatArray

__all__ = ["RecursiveLeastSquares"]


class RecursiveLeastSquares:
    """min over alpha of sum_j forgetting^(k-j) w_j (r_j - J_j alpha)², updated with each row (eqs 22, 23).

    Kept as the triangular square root of the normal equations (QR by Givens rotations), so that columns of
    very different size (phi, phi³, phi⁵ …) cost no more accuracy than they do in a batch QR.

    Args:
        size: number of coefficients n.
        forgetting: lambda in (0, 1]; 1 forgets nothing.
    """

    def __init__(self, size: int, forgetting: float = 1.0) -> None:
        require(size >= 1, f"size: expected at least 1, got {size}")
        require(0.0 < forgetting <= 1.0, f"forgetting: expected a number in (0, 1], got {forgetting}")
        self.size = size
        self._root = forgetting**0.5
        self.reset()

    def reset(self) -> None:
        """Forget every row."""
        self._R = [[0.0] * (self.size + 1) for _ in range(self.size)]
        self._error = 0.0
        self._weight = 0.0
        self._rows = 0

    def update(self, row: FloatArray, value: float, weight: float = 1.0) -> None:
        """Take in one row J_j and its right-hand side r_j."""
        size, root = self.size, self._root
        gain = weight**0.5
        new = [gain * float(x) for x in row]
        new.append(gain * value)
        for i in range(size):
            old = self._R[i]
            head = new[i]
            if root != 1.0:
                for j in range(i, size + 1):
                    old[j] *= root
            if head == 0.0:
                continue
            norm = (old[i] * old[i] + head * head) ** 0.5
            c, s = old[i] / norm, head / norm
            for j in range(i, size + 1):
                x, y = old[j], new[j]
                old[j] = c * x + s * y
                new[j] = c * y - s * x
        self._error = root * root * self._error + new[size] * new[size]
        self._weight = root * root * self._weight + weight
        self._rows += 1

    @property
    def alpha(self) -> FloatArray:
        """Coefficients (n,); zero where the rows so far do not tell them."""
        alpha = np.zeros(self.size)
        largest = max(abs(self._R[i][i]) for i in range(self.size))
        if not largest > 0.0:
            return alpha
        for i in range(self.size - 1, -1, -1):
            diagonal = self._R[i][i]
            if diagonal > 0.0:
                rest = sum(self._R[i][j] * alpha[j] for j in range(i + 1, self.size))
                alpha[i] = (self._R[i][self.size] - rest) / diagonal
        return alpha

    @property
    def sum_of_squares(self) -> float:
        """The weighted sum of squared errors at `alpha`."""
        return self._error

    @property
    def covariance(self) -> FloatArray:
        """Covariance (n, n) of alpha if the rows' errors were independent; nan where it is not told."""
        triangle = np.array([row[: self.size] for row in self._R])
        if self._rows <= self.size or np.any(np.diag(triangle) == 0.0):
            return np.full((self.size, self.size), np.nan)
        inverse = np.linalg.inv(triangle)
        variance = self._error / (self._rows - self.size)
        return np.asarray(variance * inverse @ inverse.T)
