"""The regressor of the black-box estimator: stiffness from r_sigma and phi', without dividing (eqs 31-33)."""

from __future__ import annotations

import math

import numpy as np

from estimator import _core
from estimator.sample import FloatArray

__all__ = ["regressor"]


def regressor(
    residual: FloatArray, rate: FloatArray, k_r: float, k_max: float | None = None, start: float = 0.0
) -> FloatArray:
    """Eq 32 (and 33) over a recording; element k is the estimate that used samples up to k.

    sigma(k+1) = sigma(k) + K_R (r_sigma phi' - sigma(k) phi'²). Eq 33 limits the product K_R phi'² of each
    step only: K_R itself is kept (read literally, (33) would lower it for good).

    Without k_max the recursion may diverge, as in the paper's figure 2: the result then holds inf or nan.
    """
    out = np.empty(len(residual))
    limit = math.inf if k_max is None else k_max
    _core.regressor(np.ravel(residual), np.ravel(rate), k_r, limit, start, out)
    return out
