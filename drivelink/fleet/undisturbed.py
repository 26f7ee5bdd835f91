"""Dask preloads this in the workers of a local cluster: a terminal sends Ctrl-C to them too, it is ours."""

from __future__ import annotations

import signal

__all__ = ["dask_setup"]


def dask_setup(worker: object) -> None:
    """Leave Ctrl-C to the client, which ends the workers in order."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
