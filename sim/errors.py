"""The simulated world's exceptions: one root, raised when a world is built, never while it runs."""

import difflib
import math
from collections.abc import Collection
from numbers import Real


class SimError(ValueError):
    """What was wrong, where, and what was expected, in one line."""


def expected(name: str, known: Collection[str]) -> str:
    """Return what was expected instead of an unknown name: the nearest, or one of all."""
    close = difflib.get_close_matches(name, known, n=1)
    return f"did you mean {close[0]}?" if close else f"expected one of {', '.join(known)}"


def require(name: str, value: object, *, positive: bool) -> float:
    """Return a value that is finite and > 0, or >= 0.

    Raises:
        SimError: it is not.
    """
    number = float(value) if isinstance(value, Real) else math.nan
    if not (math.isfinite(number) and (number > 0.0 if positive else number >= 0.0)):
        raise SimError(f"{name}: expected a finite number {'> 0' if positive else '>= 0'}, got {value!r}")
    return number
