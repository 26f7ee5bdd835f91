"""Zero-phase filters, exact derivatives, delays and decimation of whole recordings, by Fourier transform.

A recording is extended at both ends by point reflection and detrended, so that value and slope are periodic;
results near the ends are not used.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from estimator.choices import whole
from estimator.sample import FloatArray

__all__ = ["Band", "Spectrum", "lowpass"]

Spectrum = tuple[NDArray[np.complex128], FloatArray, FloatArray]


def lowpass(frequency_hz: FloatArray, bandwidth_hz: float) -> FloatArray:
    """Return the magnitude 1/sqrt(1 + (f/fc)^16): -3 dB at fc, no phase."""
    return np.asarray(1.0 / np.sqrt(1.0 + (frequency_hz / bandwidth_hz) ** (2 * whole("order"))))


class Band:
    """Filters arrays of one length and decimates them.

    Args:
        samples: n, length of the arrays.
        period_s: their sampling period.
        step: every step-th sample is kept.
        margin_s: least extension at each end.

    Attributes:
        frequency_hz: of the transform's bins.
        kept: number of samples after decimation.
        period_s: after decimation.
        length: of the transform.
    """

    def __init__(self, samples: int, period_s: float, step: int, margin_s: float) -> None:
        self._samples = samples
        self._step = step
        pad = min(int(np.ceil(margin_s / period_s / step)) * step, (samples - 1) // step * step)
        self._pad = pad
        self.length = fft.next_fast_len(-(-(samples + 2 * pad) // step), real=True) * step
        self._right = self.length - samples - pad
        self._input_period_s = period_s
        self._cut = self.length // step // 2 + 1
        self.frequency_hz: FloatArray = fft.rfftfreq(self.length, period_s)
        self.kept = -(-samples // step)
        self.period_s = period_s * step
        self._omega = 2j * np.pi * self.frequency_hz[: self._cut]
        self._steps = np.arange(self.length)
        self._times = np.arange(self.kept) * self.period_s

    def transform(self, x: FloatArray) -> Spectrum:
        """Return spectra of extended, detrended arrays (..., n), with each trend's value at
        sample 0 and slope.
        """
        pad, n = self._pad, self._samples
        right = min(self._right, n - 1)
        extended = np.empty((*x.shape[:-1], self.length))
        extended[..., :pad] = 2.0 * x[..., :1] - x[..., pad:0:-1]
        extended[..., pad : pad + n] = x
        end = pad + n + right
        extended[..., pad + n : end] = 2.0 * x[..., -1:] - x[..., -2 : -right - 2 : -1]
        extended[..., end:] = extended[..., end - 1 : end]
        start = extended[..., 0].copy()
        slope = (extended[..., -1] - start) / (self.length - 1)
        extended -= start[..., None] + slope[..., None] * self._steps
        bins = fft.rfft(extended, overwrite_x=True)
        return bins, start + slope * pad, slope / self._input_period_s

    def apply(
        self,
        spectrum: Spectrum,
        response: NDArray[Any],
        derivative: int = 0,
        delay_s: float = 0.0,
    ) -> FloatArray:
        """Return the arrays back in time, decimated: the filtered arrays, or their
        derivatives, delay_s earlier or later.

        Args:
            spectrum: as `transform` gives it.
            response: of the filter at `frequency_hz`; 1 at zero frequency.
            derivative: order of the derivative.
            delay_s: x(t - delay_s) is returned.
        """
        bins, start, slope = spectrum
        factor = response[: self._cut]
        if derivative:
            factor = factor * self._omega**derivative
        if delay_s:
            factor = factor * np.exp(-self._omega * delay_s)
        values = fft.irfft(bins[..., : self._cut] * factor, self.length // self._step, overwrite_x=True)
        values = values[..., self._pad // self._step :][..., : self.kept] / self._step
        if derivative == 0:
            values += start[..., None] + slope[..., None] * (self._times - delay_s)
        elif derivative == 1:
            values += slope[..., None]
        return np.asarray(values)

    def filter(self, x: FloatArray, response: NDArray[Any]) -> FloatArray:
        """Filter and decimate arrays (..., n)."""
        return self.apply(self.transform(x), response)
