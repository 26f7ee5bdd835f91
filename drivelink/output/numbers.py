"""Numbers as people read them: digits that follow the uncertainty, units, effects with their parameters."""

import math
from collections.abc import Sequence

from estimator.model import ParameterValue
from estimator.sample import SIGMA_95

_OUTERMOST = 0.01  # fraction of the values, at each end, that sets no range


def number(value: float, digits: int = 4) -> str:
    """Return a number with so many significant digits; very large and small ones like 4.1e6."""
    if not math.isfinite(value):
        return "–"
    value += 0.0  # no negative zero
    if value != 0.0 and not 1e-3 <= abs(value) < 1e5:
        mantissa, exponent = f"{value:.{digits - 1}e}".split("e")
        return f"{mantissa}e{int(exponent)}".replace("-", "−")
    decimals = digits - 1 - (math.floor(math.log10(abs(value))) if value else 0)
    return f"{value:.{max(0, min(decimals, max(digits, 4)))}f}".replace("-", "−")


def usual_range(values: Sequence[float]) -> tuple[float, float]:
    """Return the range of a plot: that of all but the outermost values, extended to those by at most half.

    Returns:
        (low, high); (nan, nan) where there is nothing finite.
    """
    known = sorted(value for value in values if math.isfinite(value))
    if not known:
        return math.nan, math.nan
    out = math.ceil(_OUTERMOST * len(known)) if len(known) > 4 else 0
    low, high = known[out], known[-1 - out]
    reach = 0.5 * (high - low)
    low, high = max(known[0], low - reach), min(known[-1], high + reach)
    return (low, high) if math.isfinite(high - low) else (math.nan, math.nan)


def shared_range(valid: Sequence[float], doubtful: Sequence[float]) -> tuple[float, float]:
    """Return the range of a plot of both: what is valid keeps its share of the values, or a quarter, of it.

    Returns:
        (low, high); (nan, nan) where there is nothing finite.
    """
    low, high = usual_range(valid)
    least, most = usual_range(doubtful)
    if math.isnan(low) or math.isnan(least):
        return (low, high) if math.isnan(least) else (least, most)
    below, above = max(0.0, low - least), max(0.0, most - high)
    room = max(high - low, 0.2 * abs(high)) * min(3.0, len(doubtful) / len(valid))  # of a steady value a part
    share = min(1.0, room / (below + above)) if below + above else 0.0
    return low - share * below, high + share * above


def axis_ticks(low: float, high: float) -> list[tuple[float, str]]:
    """Return three to eight round places of an axis, with labels of one power of ten."""
    return next(ticks for step in _steps(low, high) if len(ticks := ticks_each(low, high, step)) >= 3)


def ticks_on_rows(low: float, high: float, rows: int) -> tuple[tuple[float, float], list[tuple[float, str]]]:
    """Return the least wider range whose round places lie on rows, evenly apart, and these places."""
    found = [((low, high), axis_ticks(low, high))]
    for step in _steps(low, high):
        for apart in range(1, rows // 2 + 1):
            row = step / apart
            top = math.ceil(high / row - 1e-9) * row
            bottom = top - (rows - 1) * row
            if bottom <= low + 1e-9 * row and 3 <= len(ticks := ticks_each(bottom, top, step)) <= 8:
                found.append(((bottom, top), ticks))
    return min(found[1:] or found, key=lambda axis: axis[0][1] - axis[0][0])


def _steps(low: float, high: float) -> list[float]:
    power = 10.0 ** math.ceil(math.log10(high - low))
    return [f * power for f in (0.5, 0.2, 0.1, 0.05, 0.02)]


def ticks_each(low: float, high: float, step: float) -> list[tuple[float, str]]:
    """Return the multiples of a step on an axis, with labels of one power of ten and as many decimals."""
    places = [k * step for k in range(math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9) + 1)]
    largest, last = max(map(abs, places), default=0.0), math.floor(math.log10(step) + 1e-9)
    return [(place, _to_place(place, largest, last) if place else "0") for place in places]


def among(value: float, largest: float, digits: int = 4) -> str:
    """Return one of a series of values to the last digit that the largest has: 0.0376, 0.0002."""
    if not (math.isfinite(value) and math.isfinite(largest) and largest > 0.0):
        return number(value, digits)
    return _to_place(value, largest, math.floor(math.log10(largest)) + 1 - digits)


def _to_place(value: float, largest: float, last: int) -> str:
    """Return a value to a place, by its power of ten, in the notation that the largest of its kind has."""
    power = 0 if 1e-3 <= largest < 1e5 else math.floor(math.log10(largest))
    text = f"{value / 10.0**power:.{max(0, power - last)}f}"
    text = text.removeprefix("-") if not text.strip("-0.") else text
    return f"{text}e{power}".replace("-", "−") if power else text.replace("-", "−")


def value_and_interval(value: float, half: float | None, beside: float = 0.0) -> tuple[str, str]:
    """Return a value to the last digit that its interval leaves, and half its interval with two digits.

    Args:
        half: half the width of its interval; None, zero or not finite: unknown.
        beside: the largest number that is read beside it, in whose notation it is.

    Returns:
        Both texts, the second empty where unknown: ("0.0974", "0.0064"), ("0.000", "0.027").
    """
    if not math.isfinite(value) or half is None or not math.isfinite(half) or half <= 0.0:
        return number(value), ""
    last = int(f"{half:.1e}".partition("e")[2]) - 1  # power of ten of the interval's second digit
    power, largest = 0, max(abs(value), half, beside)
    if not 1e-3 <= largest < 1e6:
        power = math.floor(math.log10(round(largest, -last)))
    decimals = power - last

    def shown(x: float) -> str:
        text = f"{round(x / 10.0**power, decimals):.{max(0, decimals)}f}"
        text = text.removeprefix("-") if not text.strip("-0.") else text.replace("-", "−")
        return f"{text}e{power}".replace("-", "−") if power else text

    return shown(value), shown(half)


def with_interval(value: float, half: float | None, unit: str = "") -> str:
    """`value ± half unit`, with the digits that the interval leaves."""
    text, interval = value_and_interval(value, half)
    return f"{text}{f' ± {interval}' if interval else ''} {unit}".rstrip()


_RAISED = str.maketrans("0123456789", "⁰¹²³⁴⁵⁶⁷⁸⁹")
_UNITS = (  # by the end of a parameter's name; the first match
    ("_nm_s2_rad2", "N·m·s²/rad²"), ("_nm_s_rad", "N·m·s/rad"), ("_nm_rad2", "N·m/rad²"),
    ("_nm_rad", "N·m/rad"), ("_per_nm2", "1/(N·m)²"), ("_kg_m2", "kg·m²"),
    ("_rad_s2", "rad/s²"), ("_rad_s", "rad/s"), ("_per_rev", "per rev"), ("_per_rad", "1/rad"),
    ("_nm", "N·m"), ("_rad", "rad"), ("_hz", "Hz"), ("_s", "s"), ("_error", "relative"),
    ("_change", "relative"),
)  # fmt: skip
_LINEAR = {  # of a linear axis: metres for rad, newtons for N·m
    "N·m·s/rad": "N·s/m", "N·m/rad": "N/m", "N·m·s²/rad²": "N·s²/m²", "kg·m²": "kg", "rad/s²": "m/s²",
    "rad/s": "m/s", "per rev": "per 2π m", "N·m/rad²": "N/m²", "1/(N·m)²": "1/N²", "N·m/s": "N/s",
    "1/rad": "1/m", "N·m": "N", "rad": "m",
}  # fmt: skip


def bare_name(name: str) -> str:
    """Return the name of a parameter in words, without its unit."""
    ending = next((end for end, _ in _UNITS if f"_{name}".endswith(end)), "")
    return name.removesuffix(ending).replace("_", " ") or name


class Units:
    """Units in reports of an axis."""

    def __init__(self, linear: bool) -> None:
        self._linear = linear

    def shown(self, unit: str) -> str:
        """Return the unit of this axis for one of a rotary axis."""
        return _LINEAR.get(unit, unit) if self._linear else unit

    def label(self, text: str) -> str:
        """Return an axis label "quantity / unit" as it is for this one."""
        quantity, _, unit = text.rpartition(" / ")
        bare = unit.strip("()")
        return f"{quantity} / {unit.replace(bare, self.shown(bare))}"

    def of(self, name: str) -> str:
        """Return the unit of a parameter by the end of its name, or empty."""
        return self.shown(next((unit for end, unit in _UNITS if f"_{name}".endswith(end)), ""))

    def value(self, name: str, value: ParameterValue, std: ParameterValue | None) -> str:
        """Return a parameter, or each coefficient of a polynomial, with 95 % interval and unit."""
        return ", ".join(
            f"{text}{f' ± {half}' if half else ''} {unit}".rstrip()
            for text, half, unit in self.parts(name, value, std)
        )

    def parts(
        self, name: str, value: ParameterValue, std: ParameterValue | None
    ) -> list[tuple[str, str, str]]:
        """Return (value, half its 95 % interval, unit) of a parameter, or of each coefficient."""
        unit, length = self.of(name), self.shown("rad")
        values = value if isinstance(value, tuple) else (value,)
        deviations = std if isinstance(std, tuple) else (std,) * len(values)
        found = []
        for k, (x, s) in enumerate(zip(values, deviations, strict=True)):
            power = str(2 * k + 1).translate(_RAISED) if k and unit.endswith(f"/{length}") else ""
            half = None if s is None else SIGMA_95 * s
            text, half_text = value_and_interval(x, half)
            if name.endswith("phase_rad") and half is not None and half >= math.pi:
                found.append(("not determined", "", ""))  # anywhere on the circle
                continue
            plain = f"{x:.5g}"
            if not half_text and "e" not in plain:
                text = plain.replace("-", "−")
            found.append((text, half_text, f"{unit}{power}"))
        return found
