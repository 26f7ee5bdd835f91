"""Does the motion at hand tell the stiffness? From the rate of the deflection, filtered, over its noise."""

from __future__ import annotations

import math

from estimator.bank import FilterBank

__all__ = ["Excitation"]

_WINDOW_S = 0.3  # over which the rate's mean square is taken
_NOISE_MARGIN = 5.0
_SHARE = 0.02  # of the largest rate seen: what is slower teaches next to nothing
_PEAK_S = 60.0  # how long the largest rate is remembered


class Excitation:
    """The `observable` gate of one transmission.

    The noise of the filtered rate follows from that of the positions; the largest of late counts, as a
    quantised position at rest has none.

    Args:
        bank: the filters that the rate has passed.
        dt_s: time between two updates.
    """

    def __init__(self, bank: FilterBank, dt_s: float) -> None:
        response = bank.remember(math.ceil(12.0 * bank.delay_s / bank.main.period_s))[4]
        self._gain = float((response @ response) ** 0.5)
        self._average = min(1.0, dt_s / _WINDOW_S)
        self._fade = math.exp(-dt_s / _PEAK_S)
        self.reset()

    def reset(self) -> None:
        """Forget everything."""
        self._noise = 0.0
        self._square = 0.0
        self._peak = 0.0
        self.excited = False

    def update(self, rate: float, variance: float, usable: bool) -> bool:
        """Take in one update's filtered rate and the positions' noise; does the motion tell the stiffness?"""
        if not usable:
            self.excited = False
            self._square = 0.0
            return False
        self._square += self._average * (rate * rate - self._square)
        rms = math.sqrt(self._square)
        self._peak = max(self._fade * self._peak, rms)
        self._noise = max(self._fade * self._noise, variance)
        noise = self._gain * math.sqrt(self._noise)
        self.excited = rms > _NOISE_MARGIN * noise and rms > _SHARE * self._peak and rms > 0.0
        return self.excited
