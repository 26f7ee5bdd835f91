"""The service's part of the compiled core; one extension, `estimator._core`, holds both crates."""

from estimator._core import *  # noqa: F403 - drivelink/_core.pyi has names and types
