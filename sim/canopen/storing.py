"""Store and restore parameters: 0x1010, 0x1011 (CiA 301, 7.5.2.13, 7.5.2.14)."""

from __future__ import annotations

from collections.abc import Callable

from sim.canopen.aborts import Abort, SdoAbortedError
from sim.canopen.dictionary import Dictionary, Entry

_GROUPS = (
    (0x1000, 0xFFFF),
    (0x1000, 0x1FFF),
    (0x2000, 0xFFFF),
)
"""Indices of sub-index 1 (all), 2 (communication), 3 (application)."""
_ON_COMMAND = 1  # value of the objects on reading


def watch_storing(dictionary: Dictionary) -> None:
    """Connect the two objects of a dictionary, if present."""
    for index, text, act in (
        (0x1010, "save", dictionary.store),
        (0x1011, "load", dictionary.restore_defaults),
    ):
        for group, bounds in enumerate(_GROUPS, start=1):
            entry = dictionary.get(index, group)
            if entry is not None:
                entry.check = _signed(int.from_bytes(text.encode(), "little"))
                entry.changed = _acting(entry, bounds, act)


def _signed(expected: int) -> Callable[[int], None]:
    def check(value: int) -> None:
        if value != expected:
            raise SdoAbortedError(Abort.DATA_TRANSFER)

    return check


def _acting(entry: Entry, bounds: tuple[int, int], act: Callable[[int, int], None]) -> Callable[[], None]:
    def changed() -> None:
        entry.value = _ON_COMMAND
        act(*bounds)

    return changed
