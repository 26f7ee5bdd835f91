"""The motion that identifies the springs: small at first, then with the motors pulled apart."""

from __future__ import annotations

import math
from dataclasses import dataclass

__all__ = ["Excitation"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Excitation:
    """Open-loop torques: a pretension that both motors pull against, and a sum of tones on top.

    An unknown curve is identified near the middle first, as a polynomial, and handed over to the
    transmission's own model; so the pretension stays at `small_nm` for `small_s` and swings between `low_nm`
    and `high_nm` afterwards.

    Attributes:
        small_nm: pretension at first.
        small_s: for how long.
        low_nm: least pretension afterwards.
        high_nm: largest pretension; with it and the tones, errors of the curve fall in proportion.
        swing_hz: of the pretension between the two.
        tones_nm: rms of a sine of this amplitude have all tones together.
        tones_hz: of motor 1; motor 2 has them a little higher, so that the two can be separated.
        fade_s: in which everything sets in.
    """

    small_nm: float = 0.04
    small_s: float = 4.0
    low_nm: float = 0.06
    high_nm: float = 0.2
    swing_hz: float = 0.25
    tones_nm: float = 0.09
    tones_hz: tuple[float, ...] = (0.7, 1.3, 2.1, 3.4, 5.0)
    fade_s: float = 0.5

    def torques(self, time_s: float, *, again: bool) -> tuple[float, float]:
        """Torque of each motor at a time since the begin, N·m.

        Args:
            time_s: since the begin.
            again: the curve is known already: no need to start small.
        """
        grown = 1.0 if again else min(1.0, max(0.0, 0.5 * (time_s - self.small_s)))
        swing = 0.5 * (1.0 - math.cos(2.0 * math.pi * self.swing_hz * time_s))
        wide = self.low_nm + (self.high_nm - self.low_nm) * swing
        pretension = self.small_nm + grown * (wide - self.small_nm)
        fade = min(1.0, time_s / self.fade_s)
        one, two = self._tones(time_s, 1.0, 0.0), self._tones(time_s, 1.07, 1.0)
        return fade * (one - pretension), fade * (two + pretension)

    def _tones(self, time_s: float, shift: float, phase: float) -> float:
        each = self.tones_nm / math.sqrt(len(self.tones_hz))
        # Schroeder's phases keep the peaks of the sum low
        total = sum(
            math.sin(2.0 * math.pi * shift * f * time_s + phase - math.pi * k * k / len(self.tones_hz))
            for k, f in enumerate(self.tones_hz)
        )
        return each * total
