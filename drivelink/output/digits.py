"""Numbers as people read them: the digits follow the uncertainty."""

from __future__ import annotations

import math


def number(value: float, digits: int = 4) -> str:
    """Return a number in few characters, with so many significant digits; very large and
    small ones like 4.1e6.
    """
    if not math.isfinite(value):
        return "–"
    if value != 0.0 and not 1e-3 <= abs(value) < 1e5:
        mantissa, exponent = f"{value:.{digits - 1}e}".split("e")
        return f"{mantissa}e{int(exponent)}".replace("-", "−")
    decimals = digits - 1 - (math.floor(math.log10(abs(value))) if value else 0)
    return f"{value:.{max(0, min(decimals, max(digits, 4)))}f}".replace("-", "−")


def value_and_interval(value: float, half: float | None, digits: int = 4) -> tuple[str, str]:
    """Return a value to the last digit that its interval leaves, and half its interval with two digits.

    Args:
        half: half the width of its interval; None, zero or not finite: unknown.
        digits: significant ones of the value where the interval is unknown.

    Returns:
        Both texts, the second empty where unknown: ("0.0974", "0.0064"), ("0.000", "0.027").
    """
    if not math.isfinite(value) or half is None or not math.isfinite(half) or half <= 0.0:
        return number(value, digits), ""
    last = int(f"{half:.1e}".partition("e")[2]) - 1  # power of ten of the interval's second digit
    power, largest = 0, max(abs(value), half)
    if not 1e-3 <= largest < 1e6:
        power = math.floor(math.log10(largest))
    decimals = power - last

    def shown(x: float) -> str:
        text = f"{round(x / 10.0**power, decimals):.{max(0, decimals)}f}"
        text = text.removeprefix("-") if not text.strip("-0.") else text.replace("-", "−")
        return f"{text}e{power}".replace("-", "−") if power else text

    return shown(value), shown(half)


def with_interval(value: float, half: float | None, unit: str = "", digits: int = 4) -> str:
    """`value ± half unit`, with the digits that the interval leaves."""
    text, interval = value_and_interval(value, half, digits)
    return f"{text}{f' ± {interval}' if interval else ''} {unit}".rstrip()
