"""The newest items of a black box, packed second by second: objects take ten times the memory and more."""

from __future__ import annotations

import pickle
import zlib
from collections import deque
from collections.abc import Iterator
from typing import Any, NamedTuple

_BLOCK_S = 1.0
_BLOCK_ITEMS = 25_000  # of a full bus at 1 Mbit/s in that time, samples and estimates: bounds the memory

Item = tuple[float, str, tuple[Any, ...]]
"""When it came in s, its kind, its values."""


class _Block(NamedTuple):
    first_s: float
    last_s: float
    packed: bytes


class Ring:
    """Keeps the items of some time.

    Args:
        reach_s: how far back, at least.
    """

    def __init__(self, reach_s: float) -> None:
        self._reach_s = reach_s
        self._open: list[Item] = []  # of the block that is not complete
        self._blocks: deque[_Block] = deque(maxlen=int(reach_s / _BLOCK_S) + 1)

    def take(self, item: Item) -> None:
        """Add the newest item; forget what is too old."""
        if self._open and (item[0] - self._open[0][0] >= _BLOCK_S or len(self._open) == _BLOCK_ITEMS):
            self._blocks.append(_pack(self._open))
            self._open = []
            while self._blocks[0].last_s < item[0] - self._reach_s:
                self._blocks.popleft()
        self._open.append(item)

    def between(self, first_s: float, last_s: float) -> Iterator[Item]:
        """Return the items of a time; those that are taken later are not among them."""
        blocks = [block for block in self._blocks if block.last_s >= first_s and block.first_s <= last_s]
        if self._open:
            blocks.append(_pack(self._open))
        return (item for block in blocks for item in _unpack(block) if first_s <= item[0] <= last_s)


def _pack(items: list[Item]) -> _Block:
    packed = zlib.compress(pickle.dumps(items, pickle.HIGHEST_PROTOCOL), level=1)
    return _Block(items[0][0], items[-1][0], packed)


def _unpack(block: _Block) -> list[Item]:
    items: list[Item] = pickle.loads(zlib.decompress(block.packed))
    return items
