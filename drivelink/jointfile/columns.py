"""Names of the columns of a recording, and the units that columns of others may have."""

import math

_REVOLUTION = 2.0 * math.pi

OF_MOTOR = ("position_rad", "velocity_rad_s", "torque_nm", "current_a")
OF_LINK = ("link_position_rad", "link_velocity_rad_s", "external_torque_nm")
COLUMNS = frozenset({"time_s", *(f"motor{i}_{name}" for i in (1, 2) for name in OF_MOTOR), *OF_LINK})

UNITS: dict[str, dict[str, float]] = {
    "_rad_s": {
        "rad/s": 1.0,
        "mrad/s": 1e-3,
        "deg/s": _REVOLUTION / 360.0,
        "rpm": _REVOLUTION / 60.0,
        "rev/s": _REVOLUTION,
        "m/s": 1.0,
        "mm/s": 1e-3,
    },
    "_rad": {
        "rad": 1.0,
        "mrad": 1e-3,
        "urad": 1e-6,
        "deg": _REVOLUTION / 360.0,
        "rev": _REVOLUTION,
        "m": 1.0,
        "mm": 1e-3,
        "um": 1e-6,
    },
    "_nm": {"Nm": 1.0, "mNm": 1e-3, "kNm": 1e3, "Ncm": 1e-2, "N": 1.0, "mN": 1e-3, "kN": 1e3},
    "_a": {"A": 1.0, "mA": 1e-3},
    "_s": {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "min": 60.0, "h": 3600.0},
}
"""Accepted units with their SI values, by the ending of a column's name; a linear axis has m and N."""

_LINEAR = frozenset({"m", "mm", "um", "m/s", "mm/s", "N", "mN", "kN"})


def suits(unit: str | float, axis: str) -> bool:
    """Return whether a unit may be of that axis; SI by our names, factors, times and currents are of both."""
    known = unit in UNITS["_rad"] | UNITS["_rad_s"] | UNITS["_nm"]
    return not known or unit in {"rad", "rad/s", "Nm"} or (unit in _LINEAR) == (axis == "linear")


def si_factor(column: str, unit: str | float) -> float:
    """Return SI value of one unit of a column; a number, also as text, is a factor; "" is SI.

    Raises:
        ValueError: no such unit.
    """
    units = next(units for ending, units in UNITS.items() if column.endswith(ending))
    if isinstance(unit, str) and unit in units:
        return units[unit]
    try:
        factor = float(unit or 1.0) if isinstance(unit, str) else unit
    except ValueError:
        factor = 0.0
    if factor == 0.0 or not math.isfinite(factor):
        got = unit[:40] if isinstance(unit, str) else unit
        raise ValueError(f"expected one of {', '.join(units)}, or a factor; got {got!r}")
    return factor
