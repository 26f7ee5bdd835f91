"""Compares estimates with the truth, matched by sequence number."""

from __future__ import annotations

import math
from typing import NamedTuple, TypeVar

from drivelink.monitor.history import TruePoint
from drivelink.pubsub.wire import EstimateMessage
from estimator.sample import SIGMA_95, Status

T = TypeVar("T")

_UNMATCHED = 5_000  # sequence numbers kept while waiting for the other side


class RmsErrors(NamedTuple):
    """Root-mean-square errors over the cycles whose estimate is valid, relative to the truth's rms."""

    cycles: int  # number of compared cycles
    stiffness: float  # relative error of the stiffness
    flexibility_torque: float  # relative error of the flexibility torque
    covered: float  # fraction of the cycles whose 95 % interval of the stiffness holds the truth


class Comparison:
    """Pairs received estimates with the truth.

    Attributes:
        latest: the last pair, for a view.
    """

    def __init__(self) -> None:
        self.latest: tuple[EstimateMessage, TruePoint] | None = None
        self._estimates: dict[int, EstimateMessage] = {}
        self._truth: dict[int, TruePoint] = {}
        self._cycles = self._covered = 0
        self._sums = [0.0, 0.0, 0.0, 0.0]  # squared errors and squared truths: stiffness, torque

    def received(self, estimate: EstimateMessage) -> None:
        """Enter a received estimate."""
        truth = self._truth.pop(estimate.sequence, None)
        if truth is not None:
            self._pair(estimate, truth)
        else:
            _keep(self._estimates, estimate.sequence, estimate)

    def known(self, truth: TruePoint) -> None:
        """Enter the truth at one SYNC."""
        estimate = self._estimates.pop(truth.sequence, None)
        if estimate is not None:
            self._pair(estimate, truth)
        else:
            _keep(self._truth, truth.sequence, truth)

    def errors(self) -> RmsErrors:
        """Return errors over all pairs so far; NaN before the first valid estimate."""
        if self._cycles == 0:
            return RmsErrors(0, math.nan, math.nan, math.nan)
        stiffness, true_stiffness, torque, true_torque = self._sums
        return RmsErrors(
            self._cycles,
            math.sqrt(stiffness / true_stiffness) if true_stiffness else math.nan,
            math.sqrt(torque / true_torque) if true_torque else math.nan,
            self._covered / self._cycles,
        )

    def _pair(self, estimate: EstimateMessage, truth: TruePoint) -> None:
        self.latest = estimate, truth
        if not estimate.status & Status.VALID:
            return
        off = estimate.stiffness_nm_rad - truth.stiffness_nm_rad
        self._cycles += 1
        self._covered += abs(off) <= SIGMA_95 * estimate.stiffness_std_nm_rad
        sums = self._sums
        sums[0] += off**2
        sums[1] += truth.stiffness_nm_rad**2
        sums[2] += (estimate.flexibility_torque_nm - truth.flexibility_torque_nm) ** 2
        sums[3] += truth.flexibility_torque_nm**2


def _keep(waiting: dict[int, T], sequence: int, item: T) -> None:
    waiting[sequence] = item
    if len(waiting) > _UNMATCHED:
        del waiting[next(iter(waiting))]
