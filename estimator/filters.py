"""The filter of the balance over whole recordings; `estimator/core/src/filters.rs` has its discretisation."""

import math

import numpy as np

from estimator import _core
from estimator.model import require_finite
from estimator.sample import FloatArray

_CUBIC = 3


def smoothed(signal: FloatArray, rows: int, derivative: int, period_s: float) -> FloatArray:
    """Return a derivative of the cubic that fits best around each sample (Savitzky and Golay).

    Args:
        signal: (n, c).
        rows: samples of a cubic, an odd number; the first and the last one reach to the ends.
        derivative: 0: the signal itself.
        period_s: of the samples.

    Returns:
        (n, c), in the signal's unit per s^derivative.
    """
    from scipy.signal import savgol_filter  # takes as long to load as all the rest

    return np.asarray(savgol_filter(signal, rows, _CUBIC, derivative, delta=period_s, axis=0))


class StateVariableFilter:
    """F(s) = w^n / (s + w)^n with the derivatives s^i F as its states, i = 0 … n-1.

    The states are x_i = s^i F(s) u, in the input's unit per s^i. As the derivatives come from one filter
    on one interpolated signal, their ratios are those of (j omega)^i exactly; only the interpolation
    itself acts on the amplitude, by 1 - (omega T)²/12, the same for every derivative.

    Args:
        order: n, 1 to 8.
        bandwidth_rad_s: w; kept below what the sampling can represent.
        period_s: T.
    """

    def __init__(self, order: int, bandwidth_rad_s: float, period_s: float) -> None:
        require_finite(0.0, strict=True, bandwidth_rad_s=bandwidth_rad_s, period_s=period_s)
        self.order = order
        self.period_s = period_s
        self.bandwidth_rad_s = min(bandwidth_rad_s, 1.0 / period_s)

    @property
    def settling_periods(self) -> int:
        """Periods after which less than 1e-6 of an initial state is left."""
        return math.ceil((14.0 + 3.0 * (self.order - 1)) / (self.bandwidth_rad_s * self.period_s))

    def impulse(self, periods: int, *, held: bool = False) -> FloatArray:
        """Return impulse responses of all states, (periods, n), newest first."""
        unit = np.zeros(periods)
        unit[0] = 1.0
        return self._states(unit, held).T

    def apply(self, signal: FloatArray, derivatives: int = 0, *, held: bool = False) -> list[FloatArray]:
        """Filter a whole recording.

        Args:
            signal: (n,); starts at rest at its first sample.
            derivatives: highest derivative wanted.
            held: whether the signal is held between samples (a torque) rather than smooth (a position).

        Returns:
            F u, s F u, …, each shaped like the signal.
        """
        signal = np.asarray(signal, dtype=np.float64)
        states = self._states(signal - signal[0], held)
        states[0] += signal[0]
        return list(states[: derivatives + 1])

    def _states(self, signal: FloatArray, held: bool) -> FloatArray:
        out = np.empty((self.order, len(signal)))
        _core.state_variable_filter(
            self.order, self.bandwidth_rad_s, self.period_s, signal, held, out.reshape(-1)
        )
        return out
