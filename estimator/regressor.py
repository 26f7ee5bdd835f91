"""The regressor of the black-box estimator: stiffness from r_sigma and phi', without dividing (eqs 31-33)."""

from __future__ import annotations

from estimator.sample import FloatArray

__all__ = ["regressor", "regressor_step"]


def regressor_step(
    stiffness: float, residual: float, rate: float, k_r: float, k_max: float | None = None
) -> float:
    """One step of eq 32, with the saturation of eq 33 where k_max is given.

    sigma(k+1) = sigma(k) + K_R (r_sigma phi' - sigma(k) phi'²). Eq 33 limits the product K_R phi'² of this
    step only: K_R itself is kept (read literally, (33) would lower it for good).

    Args:
        stiffness: sigma(k) in N·m/rad.
        residual: r_sigma(k) in N·m/s.
        rate: phi'(k) in rad/s.
        k_r: K_R in s²/rad².
        k_max: K_max < 2, or None for eq 32 alone.
    """
    energy = rate * rate
    if k_max is not None and k_r * energy > k_max:
        k_r = k_max / energy
    return stiffness + k_r * (residual * rate - stiffness * energy)


def regressor(
    residual: FloatArray, rate: FloatArray, k_r: float, k_max: float | None = None, start: float = 0.0
) -> FloatArray:
    """Eq 32 (and 33) over a recording; element k is the estimate that used samples up to k.

    Without k_max the recursion may diverge, as in the paper's figure 2: the result then holds inf or nan.
    """
    out = residual.copy()
    stiffness = start
    for k, (r, v) in enumerate(zip(residual.tolist(), rate.tolist(), strict=True)):
        stiffness = regressor_step(stiffness, r, v, k_r, k_max)
        out[k] = stiffness
    return out
