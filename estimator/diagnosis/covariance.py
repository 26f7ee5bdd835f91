"""How sure a fitted hypothesis is where errors are correlated and change with the motion.

Heteroscedasticity and autocorrelation consistent (HAC) covariance by sums over blocks of time
(Bester, Conley and Hansen, J. of Econometrics 165, 2011).
"""

from __future__ import annotations

import numpy as np

from estimator.diagnosis.hypothesis import Fitted
from estimator.sample import FloatArray

__all__ = ["hac_covariance"]

_BLOCKS = 10  # of time: scores of different ones are independent
_T_FREEDOM = 8.0  # what so few blocks leave for the variance of a mean


def hac_covariance(fitted: Fitted) -> FloatArray:
    """(k, k) covariance of the posterior's parameters.

    The scores of each balance are summed over blocks of time longer than the errors' memory, so neither their
    correlation nor a variance that changes with the motion has to be modelled; ten blocks leave a t
    distribution, whose variance is used. It is never less than the posterior's own.
    """
    regression, posterior = fitted.regression, fitted.posterior
    free = ~posterior.bound
    used = regression.block >= 0
    left = regression.residual(posterior.x)
    weight = 1.0 / (fitted.times * posterior.sigma**2)
    scores = regression.design * (left * weight[regression.group])[:, None]
    middle = np.zeros((len(posterior.x),) * 2)
    for g in range(int(regression.group.max()) + 1):
        rows = np.flatnonzero(used & (regression.group == g))
        pieces = np.array_split(rows, _BLOCKS)
        sums = np.array([scores[piece].sum(axis=0) for piece in pieces])
        sums -= sums.mean(axis=0)
        middle += sums.T @ sums * (_BLOCKS / (_BLOCKS - 1))
    middle *= _T_FREEDOM / (_T_FREEDOM - 2.0)
    strain = np.where(np.isfinite(regression.std), 1.0 / regression.std**2, 0.0)
    bread = posterior.covariance
    own = bread @ middle @ bread + bread @ np.diag(strain * free) @ bread
    floor = np.diag(bread)
    scale = np.sqrt(np.maximum(floor / np.maximum(np.diag(own), 1e-300), 1.0))
    scale[~free] = 1.0
    return np.asarray(own * np.outer(scale, scale))
