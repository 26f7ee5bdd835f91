"""Preloaded by Dask in local workers, so that they ignore a terminal's Ctrl-C: the client handles it."""

from __future__ import annotations

import signal


def dask_setup(worker: object) -> None:
    """Leave Ctrl-C to the client, which ends the workers in order."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
