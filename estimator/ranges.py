"""Hard ranges of declared numbers: one table, by the end of a name, which carries the unit.

They are far beyond any machine, and narrow enough that no number in them overflows, takes an estimator long
to prepare, or makes it large.
"""

import math
from typing import NamedTuple

from estimator.errors import EstimatorError


class Range(NamedTuple):
    """Range of a number."""

    least: float  # of a number that has to be above 0
    most: float  # largest amount
    unit: str  # of both; "" for a plain number

    def __str__(self) -> str:
        return f"{self.least:g} to {self.most:g} {self.unit}".rstrip()


RANGES: dict[str, Range] = {  # the longest end that fits counts
    "": Range(1e-12, 1e12, ""),
    "_rad": Range(1e-9, 1e6, "rad"),
    "_rad_s": Range(1e-9, 1e6, "rad/s"),
    "_rad_s2": Range(1e-9, 1e9, "rad/s²"),
    "_rad2_s2": Range(1e-9, 1e12, "rad²/s²"),
    "_s2_rad2": Range(1e-9, 1e12, "s²/rad²"),
    "bandwidth_rad_s": Range(0.5, 1e4, "rad/s"),
    "k_tau_rad_s": Range(0.5, 1e4, "rad/s"),
    "_rad_s_per_count": Range(1e-15, 1e6, "rad/s"),
    "_nm": Range(1e-12, 1e9, "N·m"),
    "_nm_rad": Range(1e-9, 1e12, "N·m/rad"),
    "coefficient": Range(1e-12, 1e30, ""),  # of a power of the deflection: the fifth of 1 mrad is 1e-15
    "coefficients_nm_rad": Range(1e-9, 1e30, "N·m/rad, N·m/rad³, …"),  # the ninth power of 1 mrad is 1e-27
    "_nm_rad2": Range(1e-9, 1e12, "N·m/rad²"),
    "_nm_s_rad": Range(1e-12, 1e9, "N·m·s/rad"),
    "_nm_s2_rad2": Range(1e-12, 1e9, "N·m·s²/rad²"),
    "_per_nm2": Range(1e-12, 1e12, "1/(N·m)²"),
    "_nm_a": Range(1e-9, 1e6, "N·m/A"),
    "_kg_m2": Range(1e-12, 1e9, "kg·m²"),
    "_a": Range(1e-12, 1e6, "A"),
    "_s": Range(1e-6, 100.0, "s"),
    "bias_s": Range(1e-3, 1e6, "s"),
    "time_constant_s": Range(1e-6, 1e6, "s"),
    "delay_s": Range(1e-6, 1.0, "s"),
    "read_back_s": Range(1e-3, 1e5, "s"),
    "_per_hour": Range(1e-9, 1e6, "1/h"),
    "_per_rev": Range(1e-6, 1e12, "per revolution"),
    # of these four, what the bits of a float would say is out of range
    "counts_per_rev": Range(1e-6, 2.0**29, "per revolution"),  # of the finest encoders
    "rated_torque_nm": Range(1e-12, 1e5, "N·m"),
    "rated_current_a": Range(1e-12, 1e5, "A"),
    "torque_constant_nm_a": Range(1e-9, 500.0, "N·m/A"),
    "gear_ratio": Range(1e-6, 1e6, ""),
    "exponent": Range(1e-3, 1e3, ""),
    "power": Range(1e-3, 99.0, ""),
    "bitrate": Range(1e3, 2e7, "bit/s"),
    "sdo_retries": Range(0.0, 100.0, ""),
    "elements": Range(1.0, 32.0, ""),  # numbers of a parameter: each costs time in every cycle
    "covariance": Range(0.0, 1e60, ""),  # of two parameters of up to 1e30 each
    "correlation": Range(1e-6, 1.0, ""),  # least: digits that a file may leave out
    "every": Range(1.0, 1e6, ""),
    "seed": Range(0.0, 2.0**63, ""),
}


def range_of(name: str) -> Range:
    """Return the range of a number of that name."""
    return RANGES[max((end for end in RANGES if name.endswith(end)), key=len)]


def require_in_range(name: str, value: float, *, positive: bool = False) -> None:
    """Refuse a number outside its range.

    Args:
        name: ends with the unit.
        value: in that unit.
        positive: it has to be above 0.

    Raises:
        EstimatorError: it is too large, too small, or not finite.
    """
    allowed = range_of(name)
    try:
        value = float(value)
    except OverflowError:  # a whole number that no float holds
        value = math.inf if value > 0 else -math.inf
    if not math.isfinite(value) or abs(value) > allowed.most or (positive and value < allowed.least):
        least = allowed.least if positive else -allowed.most
        raise EstimatorError(
            f"{name}: expected {least:g} to {allowed.most:g} {allowed.unit}".rstrip() + f", got {value:.6g}"
        )
