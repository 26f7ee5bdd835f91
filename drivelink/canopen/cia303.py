"""Units written as numbers: 0x60A8 and 0x60A9 (CiA 303-2; CiA 402-2).

Byte 3 is a signed power of ten, byte 2 the numerator, byte 1 the denominator.
"""

from __future__ import annotations

import math

# CiA 303-2, notation of units as numbers: angle and time.
_ANGLES_RAD = {0x10: 1.0, 0x41: math.pi / 180, 0x42: math.pi / 10800, 0x43: math.pi / 648000, 0xB4: math.tau}
_TIMES_S = {0x03: 1.0, 0x47: 60.0, 0x48: 3600.0}
_DIMENSIONLESS, _INCREMENTS = 0x00, 0xB5


def angle_unit_rad(unit: int) -> float | None:
    """Return radians per count of a position in the unit of 0x60A8; None where that is no
    angle (increments).
    """
    angle = _ANGLES_RAD.get(unit >> 16 & 0xFF)
    return None if angle is None else float(angle * 10.0 ** _signed8(unit >> 24))


def _signed8(byte: int) -> int:
    return (byte & 0xFF) - 0x100 if byte & 0x80 else byte & 0xFF


def velocity_unit_rad_s(unit: int, counts_per_rev: float | None) -> float | None:
    """Return radians per second and count of 0x606C, from 0x60A9.

    Byte 3 is the power of ten, byte 2 the numerator, byte 1 the denominator (CiA 303-2): 0x00B44700 is
    revolutions per minute, 0x00B50300 increments per second.

    Args:
        unit: value of 0x60A9.
        counts_per_rev: counts per revolution, for a unit of increments.

    Returns:
        The unit, or None where it is none of an angle per time.
    """
    numerator, denominator = unit >> 16 & 0xFF, unit >> 8 & 0xFF
    angle = _ANGLES_RAD.get(numerator)
    if numerator in (_INCREMENTS, _DIMENSIONLESS) and counts_per_rev:
        angle = math.tau / counts_per_rev
    time_s = _TIMES_S.get(denominator)
    if angle is None or time_s is None:
        return None
    return float(angle * 10.0 ** _signed8(unit >> 24) / time_s)
