"""How noisy are the encoders? From the third differences of what they read."""

from __future__ import annotations

import math

import numpy as np

from estimator.sample import FloatArray

__all__ = ["NoiseMeter"]

_NOISE_S = 2.0  # over which the noise is measured
_OUTLIER = 100.0  # times the variance: no noise
_THIRD = 0.05  # the third difference of white noise has 20 times its variance


class NoiseMeter:
    """Variance of the noise of smooth signals.

    Args:
        channels: how many.
        period_s: T.

    Attributes:
        variance: (channels,) rad²; zeros before anything is known.
    """

    def __init__(self, channels: int, period_s: float) -> None:
        self._channels, self._T = channels, period_s
        self.reset()

    def reset(self) -> None:
        """Forget everything."""
        self.variance: list[float] = [0.0] * self._channels
        self.restart()

    def restart(self) -> None:
        """The signals go on elsewhere."""
        self._last = np.zeros((0, self._channels))
        self._seen = 0

    def see(self, block: FloatArray) -> None:
        """Consecutive samples, (n, channels)."""
        signal = np.concatenate([self._last, block])
        self._last = signal[-3:]
        n = len(signal) - 3
        if n < 1:
            return
        first = signal[1:] - signal[:-1]
        third = first[2:] - 2.0 * first[1:-1] + first[:-2]
        third *= third
        self._seen += n
        gain = min(1.0, n * self._T / _NOISE_S)
        limits = [_OUTLIER / _THIRD * old or math.inf for old in self.variance]
        means = np.minimum(third, limits).sum(axis=0).tolist()
        for i, mean in enumerate(means):
            old = self.variance[i]
            weight = gain if old else max(gain, min(1.0, n / self._seen))
            self.variance[i] = old + weight * (_THIRD / n * mean - old)
