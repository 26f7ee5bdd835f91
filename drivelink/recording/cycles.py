"""The cycles of a recording, as they go into a chain: what raw frames and MCAP files have in common."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from itertools import islice
from typing import NamedTuple

from drivelink.cycle.chain import Chain
from drivelink.errors import DrivelinkError
from estimator.sample import Estimate, Sample

__all__ = ["Cycle", "batches", "estimated"]

_BATCH = 512


class Cycle(NamedTuple):
    """One recorded cycle.

    Attributes:
        sequence: number of its SYNC.
        stamp_ns: UNIX time of its SYNC.
        sample: None where there was none.
        flags: service bits of `Status` that hold for it.
    """

    sequence: int
    stamp_ns: int
    sample: Sample | None
    flags: int


def estimated(cycles: Iterable[Cycle], chain: Chain) -> Iterator[tuple[Cycle, Estimate]]:
    """The cycles with what the chain makes of them, as the live loop would have published it.

    Reading and estimating take turns of many cycles: a processor that does one thing for a while is quicker
    than one that changes between them every cycle.
    """
    for batch in batches(cycles):
        for cycle in batch:
            sequence, _, sample, flags = cycle
            if sample is not None:
                yield cycle, chain.take(sample, flags)
            elif (estimate := chain.carry_on(sequence, flags)) is not None:
                yield cycle, estimate


def batches(cycles: Iterable[Cycle]) -> Iterator[list[Cycle]]:
    """Lists of cycles; where the recording turns out to be broken, first those up to there."""
    source = iter(cycles)
    error: DrivelinkError | None = None
    while error is None:
        batch: list[Cycle] = []
        try:
            batch.extend(islice(source, _BATCH))
        except DrivelinkError as broken:
            error = broken
        if batch:
            yield batch
        elif error is None:
            return
    raise error
