"""The cycles of a recording as pipeline input: the common part of raw frames and MCAP files."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from itertools import islice
from typing import NamedTuple

from drivelink._core import JointPipeline, Tick
from drivelink.errors import DrivelinkError
from estimator.sample import Sample

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


def estimated(cycles: Iterable[Cycle], pipeline: JointPipeline) -> Iterator[Tick]:
    """What the pipeline makes of the cycles, as the live loop would have published it.

    Reading and estimating take turns of many cycles: a processor that does one thing for a while is quicker
    than one that changes between them every cycle.
    """
    for batch in batches(cycles):
        for cycle in batch:
            sequence, stamp_ns, sample, flags = cycle
            if sample is not None:
                yield pipeline.take(sample, flags, stamp_ns)
            elif (tick := pipeline.carry_on(sequence, flags, stamp_ns)) is not None:
                yield tick


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
