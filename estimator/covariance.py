"""The covariance of [theta, theta', phi, phi', phi''], written out entry by entry.

Fifteen numbers: at this size plain arithmetic costs a third of what arrays do.
"""

from __future__ import annotations

import math
from typing import NamedTuple

__all__ = ["Covariance"]


class Covariance(NamedTuple):
    """Symmetric; `ij` is the entry of states i and j, counted from 0: theta, theta', phi, phi', phi''."""

    e00: float
    e01: float
    e02: float
    e03: float
    e04: float
    e11: float
    e12: float
    e13: float
    e14: float
    e22: float
    e23: float
    e24: float
    e33: float
    e34: float
    e44: float

    @classmethod
    def diagonal(cls, a: float, b: float, c: float, d: float, e: float) -> Covariance:
        """Independent states."""
        return cls(a, 0.0, 0.0, 0.0, 0.0, b, 0.0, 0.0, 0.0, c, 0.0, 0.0, d, 0.0, e)

    @property
    def phi_phi(self) -> float:
        """Variance of phi."""
        return self.e22

    def move(self, T: float, pull: float, damped: float, drift: float, jerk: float) -> Covariance:
        """F P F' + Q over one period.

        F: theta += T theta' + (T/2) pull phi, theta' = damped theta' + pull phi,
        phi += T phi' + (T²/2) phi'', phi' += T phi''.

        Args:
            T: the period. pull: sigma T / B. damped: 1 - T D / B.
            drift: variance that theta' gains. jerk: variance that phi'' gains.
        """
        p00, p01, p02, p03, p04, p11, p12, p13, p14, p22, p23, p24, p33, p34, p44 = self
        push, half = 0.5 * T * pull, 0.5 * T * T
        a01 = p01 + T * p11 + push * p12
        a02 = p02 + T * p12 + push * p22
        a03 = p03 + T * p13 + push * p23
        a04 = p04 + T * p14 + push * p24
        a11 = damped * p11 + pull * p12
        a12 = damped * p12 + pull * p22
        a13 = damped * p13 + pull * p23
        a14 = damped * p14 + pull * p24
        a23 = p23 + T * p33 + half * p34
        a24 = p24 + T * p34 + half * p44
        a34 = p34 + T * p44
        return Covariance(
            p00 + T * p01 + push * p02 + T * a01 + push * a02,
            damped * a01 + pull * a02,
            a02 + T * a03 + half * a04,
            a03 + T * a04,
            a04,
            damped * a11 + pull * a12 + drift,
            a12 + T * a13 + half * a14,
            a13 + T * a14,
            a14,
            p22 + T * p23 + half * p24 + T * a23 + half * a24,
            a23 + T * a24,
            a24,
            p33 + T * p34 + T * a34,
            a34,
            p44 + jerk,
        )

    def gains(self, theta_noise: float, phi_noise: float) -> tuple[list[float], list[float]] | None:
        """Kalman gains for measured theta and phi = q - theta, whose noises share theta's; None: singular.

        Args:
            theta_noise: variance of theta's. phi_noise: of phi's, theta's included.
        """
        theta = (self.e00, self.e01, self.e02, self.e03, self.e04)
        phi = (self.e02, self.e12, self.e22, self.e23, self.e24)
        s00, s01, s11 = self.e00 + theta_noise, self.e02 - theta_noise, self.e22 + phi_noise
        determinant = s00 * s11 - s01 * s01
        if not 0.0 < determinant < math.inf:
            return None
        a, b, d = s11 / determinant, s01 / determinant, s00 / determinant
        by_theta = [a * x - b * y for x, y in zip(theta, phi, strict=True)]
        by_phi = [d * y - b * x for x, y in zip(theta, phi, strict=True)]
        return by_theta, by_phi

    def measure(self, by_theta: list[float], by_phi: list[float]) -> Covariance:
        """What is left once theta and phi have been measured with these gains."""
        p00, p01, p02, p03, p04, p11, p12, p13, p14, p22, p23, p24, p33, p34, p44 = self
        g0, g1, g2, g3, g4 = by_theta
        h0, h1, h2, h3, h4 = by_phi
        return Covariance(
            p00 - g0 * p00 - h0 * p02,
            p01 - g0 * p01 - h0 * p12,
            p02 - g0 * p02 - h0 * p22,
            p03 - g0 * p03 - h0 * p23,
            p04 - g0 * p04 - h0 * p24,
            p11 - g1 * p01 - h1 * p12,
            p12 - g1 * p02 - h1 * p22,
            p13 - g1 * p03 - h1 * p23,
            p14 - g1 * p04 - h1 * p24,
            p22 - g2 * p02 - h2 * p22,
            p23 - g2 * p03 - h2 * p23,
            p24 - g2 * p04 - h2 * p24,
            p33 - g3 * p03 - h3 * p23,
            p34 - g3 * p04 - h3 * p24,
            p44 - g4 * p04 - h4 * p24,
        )
