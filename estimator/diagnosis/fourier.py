"""Shapes of a motion: finite Fourier series within limits.

Swevers, Ganseman, Tükel, De Schutter and Van Brussel, IEEE Trans. Robotics and Automation 13, 1997.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from estimator.choices import choice
from estimator.driven import Path
from estimator.filters import smoothed
from estimator.sample import FloatArray, Record

__all__ = ["Limits", "Shape"]

_HARMONICS = np.array([1, 2, 3, 5, 8, 13, 21, 34])  # of the length: as many slow ones as fast ones
_CUBIC = 3


@dataclass(frozen=True, slots=True, kw_only=True)
class Limits:
    """What the motion may reach, (m,) of each motor.

    Attributes:
        low_rad, high_rad: positions.
        velocity_rad_s, acceleration_rad_s2, torque_nm: amounts.
    """

    low_rad: FloatArray
    high_rad: FloatArray
    velocity_rad_s: FloatArray
    acceleration_rad_s2: FloatArray
    torque_nm: FloatArray

    @classmethod
    def declared(
        cls,
        records: Sequence[Record],
        position_rad: tuple[float, float] | None = None,
        velocity_rad_s: float | None = None,
        acceleration_rad_s2: float | None = None,
        torque_nm: float | None = None,
    ) -> Limits:
        """Return declared limits of every motor, each left out as the recordings reach it."""
        theta = [record.motor_position_rad for record in records]
        rates = [_rates(record) for record in records]
        low, high = (f([f(x, axis=0) for x in theta], axis=0) for f in (np.min, np.max))
        torque = np.max([np.max(np.abs(record.motor_torque_nm), axis=0) for record in records], axis=0)
        speed, acceleration = (np.max([rate[k] for rate in rates], axis=0) for k in (0, 1))
        one = np.ones_like(low)
        return cls(
            low_rad=low if position_rad is None else one * position_rad[0],
            high_rad=high if position_rad is None else one * position_rad[1],
            velocity_rad_s=speed if velocity_rad_s is None else one * velocity_rad_s,
            acceleration_rad_s2=acceleration if acceleration_rad_s2 is None else one * acceleration_rad_s2,
            torque_nm=torque if torque_nm is None else one * torque_nm,
        )

    @property
    def centre_rad(self) -> FloatArray:
        """Where the motion begins and ends."""
        return 0.5 * (self.low_rad + self.high_rad)


class Shape(NamedTuple):
    """Motions that reach a limit.

    Attributes:
        numbers: (w, 2 + 16 m), each from -1 to 1: how much slower the motion begins than it ends; whether its
            sines are alike in acceleration (-1), velocity (0) or position (1); then logarithms of amplitudes,
            and phases, of each motor's sines.
        seconds: of the motion.
        limits: of the motors.
        share: (w,) of what the limits allow.
    """

    numbers: FloatArray
    seconds: float
    limits: Limits
    share: FloatArray | float = 1.0

    @staticmethod
    def size(motors: int) -> int:
        """Return how many numbers a motion has."""
        return 2 + 2 * len(_HARMONICS) * motors

    def path(self, period_s: float) -> Path:
        """Return the motions within the limits of position, velocity and acceleration."""
        time = np.arange(round(self.seconds / period_s)) * period_s
        omega = 2.0 * np.pi * _HARMONICS / self.seconds
        s, c = (f(np.outer(time, omega)) for f in (np.sin, np.cos))
        count, motors = len(self.numbers), len(self.limits.low_rad)
        (growth, tilt), numbers = self.numbers.T[:2], self.numbers[:, 2:]
        size, turn = np.moveaxis(numbers.reshape(count, motors, 2, -1), 2, 0)
        even = np.power.outer(_HARMONICS.astype(float), tilt - 1.0).T[:, None]
        amplitude, phase = even * np.exp(choice("motion_uneven") * size), np.pi * turn
        a, b = amplitude * np.cos(phase), amplitude * np.sin(phase)
        series = [
            np.einsum("tk,wmk->twm", left * rate, a) + np.einsum("tk,wmk->twm", right * rate, b)
            for left, right, rate in ((s, c, omega**0), (c, -s, omega), (-s, -c, omega**2))
        ]
        growth = -0.5 * np.log(choice("motion_begin")) * (1.0 + growth)
        position, velocity, acceleration = _shaped(series, time, self.seconds, growth)
        path = Path(position, velocity, acceleration, period_s)
        limits, half = self.limits, 0.5 * (self.limits.high_rad - self.limits.low_rad)
        each = zip(path[:3], (half, limits.velocity_rad_s, limits.acceleration_rad_s2), strict=True)
        reach = [np.max(np.abs(x), axis=0) / limit for x, limit in each]
        return path.scaled(self.share / np.max(reach, axis=(0, 2))).moved(limits.centre_rad)


def _shaped(
    series: Sequence[FloatArray], time: Any, seconds: float, growth: FloatArray
) -> Iterator[FloatArray]:
    """Value, rate and second derivative of a series that grows (w,), times a smooth step at both ends."""
    span, rate = choice("motion_taper") * seconds, growth / seconds
    ends = [(np.clip(time / span, 0.0, 1.0), 1.0), (np.clip((seconds - time) / span, 0.0, 1.0), -1.0)]
    grown = np.exp(np.outer(time - seconds, rate))
    factors = [(grown, rate * grown, rate**2 * grown)] + [
        tuple(
            x[:, None]
            for x in (
                x**3 * (10 - 15 * x + 6 * x**2),
                way * 30 * (x * (1 - x)) ** 2 / span,
                60 * x * (1 - x) * (1 - 2 * x) / span**2,
            )
        )
        for x, way in ends
    ]
    for w, dw, ddw in factors:
        y, dy, ddy = series
        w, dw, ddw = w[..., None], dw[..., None], ddw[..., None]
        series = w * y, dw * y + w * dy, ddw * y + 2 * dw * dy + w * ddy
    return iter(series)


def _rates(record: Record) -> list[FloatArray]:
    """Largest velocity and acceleration (m,), of a smoothed motion."""
    theta, period = record.motor_position_rad, record.period_s
    rows = max(round(choice("motion_smoothing") / period) // 2 * 2 + 1, _CUBIC + 2)
    rows = min(rows, (len(theta) - 1) // 2 * 2 + 1)
    return [np.max(np.abs(smoothed(theta, rows, order, period)), axis=0) for order in (1, 2)]
