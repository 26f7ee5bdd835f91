"""The service's exceptions. Each is one line for the user: what, where, what was expected."""

import math
from collections.abc import Iterator
from contextlib import contextmanager
from numbers import Real

from drivelink.plaintext import clean_text

_LONGEST = 900  # characters of a message: a file's own words may be longer


class DrivelinkError(Exception):
    """Root of everything a user can cause. `exit_status` is what the command line returns."""

    exit_status = 1

    def __str__(self) -> str:
        """Return the message as one line of plain text, cut off where it would fill a screen."""
        return clean_text(super().__str__(), _LONGEST)


@contextmanager
def raised_as(
    kind: type[Exception], what: str, caught: type[Exception] | tuple[type[Exception], ...] = OSError
) -> Iterator[None]:
    """Raise what the system or a library says as an error of this kind: what it is of, and the reason."""
    try:
        yield
    except caught as error:
        raise kind(f"{what}: {getattr(error, 'strerror', None) or error}") from error


class UsageError(DrivelinkError):
    """The command line is wrong."""

    exit_status = 2


class ArgumentError(UsageError, ValueError):
    """An argument of a Python call is wrong."""


def require(argument: str, value: object, good: bool, expected: str) -> None:
    """Refuse the value of an argument.

    Raises:
        ArgumentError: it is not good.
    """
    if not good:
        raise ArgumentError(f"{argument}: expected {expected}, got {value!r}")


def require_positive(argument: str, value: object) -> None:
    """Refuse what is neither None nor a finite number above zero.

    Raises:
        ArgumentError: it is neither.
    """
    good = value is None or (isinstance(value, Real) and 0.0 < float(value) < math.inf)
    require(argument, value, good, "a number above 0")


class JointFileError(DrivelinkError):
    """A joint file is wrong: file, key, what was expected."""

    exit_status = 2


class RecordingError(DrivelinkError):
    """A recording cannot be read, or lacks what is needed."""

    exit_status = 3


class HarmfulModelError(RecordingError):
    """A new model is worse on held-out data than the declared one, or undetermined: it is not written."""


class BusError(DrivelinkError):
    """The CAN interface is missing, down, or too slow."""

    exit_status = 4


class DriveError(DrivelinkError):
    """A drive is absent, refuses its configuration, or lacks a signal."""

    exit_status = 5


class ZenohError(DrivelinkError):
    """The zenoh session cannot be opened, or a key is taken."""

    exit_status = 6
