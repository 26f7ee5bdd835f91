"""Recorded cycles as input of the pipeline, for raw frames and MCAP files."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from itertools import islice
from typing import NamedTuple

from drivelink._core import JointPipeline, Tick
from drivelink.errors import DrivelinkError
from estimator.sample import Sample

_BATCH = 512


class Cycle(NamedTuple):
    """One recorded cycle."""

    sequence: int  # number of its SYNC
    stamp_ns: int  # UNIX time of its SYNC
    sample: Sample | None  # of this cycle, or None
    flags: int  # its service bits of `Status`


def estimated(cycles: Iterable[Cycle], pipeline: JointPipeline) -> Iterator[Tick]:
    """Pass the cycles through the pipeline; yield the output that the live loop publishes.

    Reading and estimating alternate in batches, which is faster than per cycle.
    """
    for batch in batches(cycles):
        for cycle in batch:
            sequence, stamp_ns, sample, flags = cycle
            if sample is not None:
                yield pipeline.take(sample, flags, stamp_ns)
            elif (tick := pipeline.carry_on(sequence, flags, stamp_ns)) is not None:
                yield tick


def batches(cycles: Iterable[Cycle]) -> Iterator[list[Cycle]]:
    """Yield lists of cycles; before an error of the recording, those up to it."""
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
