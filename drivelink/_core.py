"""The service's part of the compiled core; one extension, `estimator._core`, holds both crates."""

from estimator._core import (
    LATE,
    LATEST,
    MESSAGES,
    STATUS_BITS,
    SYNC_COB_ID,
    Assembler,
    History,
    JointPipeline,
    LatencyHistogram,
    NodeCounters,
    Tick,
    __version__,
    encode_estimate,
    encode_external,
    encode_sample,
)

__all__ = [
    "LATE",
    "LATEST",
    "MESSAGES",
    "STATUS_BITS",
    "SYNC_COB_ID",
    "Assembler",
    "History",
    "JointPipeline",
    "LatencyHistogram",
    "NodeCounters",
    "Tick",
    "__version__",
    "encode_estimate",
    "encode_external",
    "encode_sample",
]
