"""The simulated world's exceptions: one root, raised when a world is built, never while it runs."""


class SimError(ValueError):
    """What was wrong, where, and what was expected, in one line."""
