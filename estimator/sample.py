"""Inputs and outputs of the estimator: one tick as tuples, one recording as arrays.

SI units, joint side, the paper's signs: phi = q - theta, and tau_e = f(phi) acts on the motor as +tau_e.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, fields, replace
from enum import IntFlag
from functools import partial
from itertools import repeat
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from estimator.errors import EstimatorError
from estimator.ranges import require_in_range

FloatArray = NDArray[np.float64]
SIGMA_95 = 1.959963984540054  # half a 95 % interval of a normal distribution, in standard deviations


class Sample(NamedTuple):
    """Measured values at one SYNC; NaN: not available.

    Attributes:
        sequence: number of the SYNC; a jump by more than one is a gap of whole periods.
        motor_position_rad: theta_i, one per motor.
        motor_velocity_rad_s: measured velocity per motor (NaN: none).
        motor_torque_nm: tau_i, which acts from this SYNC to the next one.
        link_position_rad: q.
        link_velocity_rad_s: measured link velocity.
        external_torque_nm: tau_k of eq 4.
    """

    sequence: int
    motor_position_rad: tuple[float, ...]
    motor_velocity_rad_s: tuple[float, ...]
    motor_torque_nm: tuple[float, ...]
    link_position_rad: float = math.nan
    link_velocity_rad_s: float = math.nan
    external_torque_nm: float = math.nan


class Bits(IntFlag):
    """Bits of a status: value, meaning, roles."""

    meaning: str  # in one line, for people
    # "unusable": no controller may act on an estimate with it; "replayed": it belongs to the sample, so
    # that a replay of samples sets it again
    roles: frozenset[str]

    def __new__(cls, value: int, meaning: str = "", *roles: str) -> Self:  # noqa: D102
        bit = int.__new__(cls, value)
        bit._value_, bit.meaning, bit.roles = value, meaning, frozenset(roles)
        return bit

    @classmethod
    def having(cls, role: str) -> int:
        """Return all bits of a role."""
        return sum(int(bit) for bit in cls if role in bit.roles)


class Status(Bits):
    """Quality of one estimate. Bits 0-7 and 15 are the estimator's, bits 8-14 the service's."""

    VALID = 1 << 0, "all numbers may be used"
    OBSERVABLE = 1 << 1, "the motion reveals the stiffness; otherwise it is held, with a wider interval"
    GAP = 1 << 2, "samples were missing before this one and have been bridged"
    CHANGED = 1 << 3, "innovation alarm: the joint changed, the estimate is following"
    MODEL_ALARM = (
        1 << 4,
        "the residual is above the model's own baseline: the model is not sufficient",
        "unusable",
    )
    INPUT_REJECTED = 1 << 5, "this sample was not finite, jumped or froze, and was not used"
    RESTARTED = 1 << 6, "the estimator restarted at or shortly before this sample", "unusable"
    TORQUE_VALID = 1 << 7, "the flexibility torque may be used, also where the stiffness may not"
    DRIVE_FAULT = 1 << 8, "a drive reports a fault or is not operational", "unusable", "replayed"
    BUS_FAULT = 1 << 9, "frames of this cycle were late or missing", "replayed"
    STALE = 1 << 10, "the estimate is carried on without fresh measurements", "unusable"
    UNTIMED = (
        1 << 11,
        "another master produced SYNC: values may be of another moment; no parameter is updated",
        "unusable",
        "replayed",
    )
    NODE_RESTARTED = (
        1 << 12,
        "positions may count from anywhere: their zeros are unknown until motion shows them",
        "unusable",
        "replayed",
    )
    PARTIAL = 1 << 13, "not given where NaN: stiffness of a rigid joint, standard deviation in mode paper"
    CONTRADICTED = (
        1 << 14,
        "two readings of one quantity contradict each other; no parameter is updated",
        "unusable",
        "replayed",
    )
    STIFFNESS_VALID = 1 << 15, "the stiffness may be used, also where the flexibility torque may not"


class TransmissionEstimate(NamedTuple):
    """One transmission: flexibility torque, stiffness and its standard deviation, deflection."""

    flexibility_torque_nm: float
    stiffness_nm_rad: float
    stiffness_std_nm_rad: float
    deflection_rad: float


class Estimate(NamedTuple):
    """The joint at one SYNC: totals (eqs 9, 11) and each transmission."""

    sequence: int
    status: int
    flexibility_torque_nm: float
    stiffness_nm_rad: float
    stiffness_std_nm_rad: float
    transmissions: tuple[TransmissionEstimate, ...]


class ExternalStatus(Bits):
    """Quality of one external torque."""

    VALID = 1 << 0, "the numbers may be used; never where the estimate of the same cycle is not valid"
    CONTACT = 1 << 1, "something touches the link; only where valid"


class External(NamedTuple):
    """External torque on the link at one SYNC; NaN: unknown.

    Attributes:
        sequence: as in `Sample`.
        status: bits of `ExternalStatus`.
        external_torque_nm: +tau_k of eqs 4, 6, from the motor side's flexibility torque.
        external_torque_std_nm: its standard deviation.
        link_flexibility_torque_nm: tau_e,t from the link side, -r of eqs 12, 13.
        difference_nm: tau_e,t of the motor side minus that of the link side, filtered alike: a model error,
            or an unmeasured torque on the link.
    """

    sequence: int
    status: int
    external_torque_nm: float
    external_torque_std_nm: float
    link_flexibility_torque_nm: float
    difference_nm: float


class Consistency(NamedTuple):
    """Flexibility torque from the motor side and from the link's, over the last ten seconds or so."""

    # rms of their difference; small against the second if the model is right and no unmeasured torque acts
    # on the link
    difference_rms_nm: float
    link_flexibility_torque_rms_nm: float  # of the link side's


@dataclass(frozen=True, slots=True, weakref_slot=True, kw_only=True, eq=False)
class Record:
    """A recording: n samples of m motors on a grid of whole periods.

    Attributes:
        period_s: the sampling period T.
        sequence: (n,) integers, strictly increasing; a jump by more than one is a gap.
        motor_position_rad: (n, m).
        motor_torque_nm: (n, m); row k acts from t_k to t_{k+1}.
        motor_velocity_rad_s: (n, m), or None.
        link_position_rad: (n,), or None where the transmission is "none".
        link_velocity_rad_s: (n,), or None.
        external_torque_nm: (n,), or None.
        start_s: time of sequence 0.
    """

    period_s: float
    sequence: NDArray[np.int64]
    motor_position_rad: FloatArray
    motor_torque_nm: FloatArray
    motor_velocity_rad_s: FloatArray | None = None
    link_position_rad: FloatArray | None = None
    link_velocity_rad_s: FloatArray | None = None
    external_torque_nm: FloatArray | None = None
    start_s: float = 0.0

    def __post_init__(self) -> None:
        n = len(self.sequence)
        require_in_range("period_s", self.period_s, positive=True)
        if self.motor_position_rad.ndim != 2 or self.motor_position_rad.shape[1] not in (1, 2):
            raise EstimatorError(
                f"motor_position_rad: expected (n, 1 or 2), got {self.motor_position_rad.shape}"
            )
        wide = self.motor_position_rad.shape
        shapes = {
            "motor_torque_nm": wide,
            "motor_velocity_rad_s": wide,
            "link_position_rad": (n,),
            "link_velocity_rad_s": (n,),
            "external_torque_nm": (n,),
        }
        for name, shape in shapes.items():
            array = getattr(self, name)
            if array is not None and array.shape != shape:
                raise EstimatorError(f"{name}: expected shape {shape}, got {array.shape}")
        if n and wide[0] != n:
            raise EstimatorError(f"motor_position_rad: expected {n} rows, got {wide[0]}")
        if np.any(np.diff(self.sequence) < 1):
            raise EstimatorError("sequence: expected strictly increasing integers")

    def __len__(self) -> int:
        return len(self.sequence)

    @property
    def motors(self) -> int:
        """Number of motors m."""
        return int(self.motor_position_rad.shape[1])

    @property
    def time_s(self) -> FloatArray:
        """(n,) time of each row, start_s + sequence * period_s."""
        return np.asarray(self.start_s + self.sequence * self.period_s, dtype=np.float64)

    def rows(self, chosen: NDArray[np.bool_]) -> Record:
        """Return some rows, (n,) booleans; the others become gaps."""
        channels = {each.name: getattr(self, each.name) for each in fields(self)}
        kept: dict[str, Any] = {k: x[chosen] for k, x in channels.items() if isinstance(x, np.ndarray)}
        return replace(self, **kept)

    def samples(self) -> Iterator[Sample]:
        """Yield the recording tick by tick, as in the live loop."""

        def column(array: FloatArray | None) -> Iterable[float]:
            return repeat(math.nan) if array is None else array.tolist()

        def rows(array: FloatArray | None) -> Iterable[tuple[float, ...]]:
            return repeat((math.nan,) * self.motors) if array is None else zip(*array.T.tolist(), strict=True)

        columns: tuple[Iterable[Any], ...] = (
            self.sequence.tolist(),
            rows(self.motor_position_rad),
            rows(self.motor_velocity_rad_s),
            rows(self.motor_torque_nm),
            column(self.link_position_rad),
            column(self.link_velocity_rad_s),
            column(self.external_torque_nm),
        )
        yield from map(partial(tuple.__new__, Sample), zip(*columns, strict=False))
