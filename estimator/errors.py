"""The estimator's exceptions: one root, raised at construction or by batch functions, never by a tick."""

import difflib
from collections.abc import Collection


class EstimatorError(ValueError):
    """What was wrong, where, and what was expected, in one line."""


def expected(name: str, known: Collection[str]) -> str:
    """Return what was expected instead of an unknown name: the nearest, or one of all."""
    close = difflib.get_close_matches(name, known, n=1)
    return f"did you mean {close[0]}?" if close else f"expected one of {', '.join(known)}"
