"""The estimator's exceptions: one root, raised at construction or by batch functions, never by a tick."""


class EstimatorError(ValueError):
    """What was wrong, where, and what was expected, in one line."""
