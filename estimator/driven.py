"""Simulates a model whose motors follow a motion: what their drives would need, and what would be read."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from estimator.freerun import Bodies
from estimator.model import JointModel
from estimator.sample import FloatArray, Record

_PASSES = 3  # over effects with memory in the transmission, each along the link's motion of the one before
_NEWTON = 10
_STEP = 1e-6  # rad


class Path(NamedTuple):
    """Motions side by side, each (n, w, m): of m motors over n moments in w motions."""

    position: FloatArray  # rad
    velocity: FloatArray  # rad/s
    acceleration: FloatArray  # rad/s²
    period_s: float  # between two moments

    def one(self, k: int) -> Path:
        """Return one of the motions."""
        return self._each(lambda x: x[:, k : k + 1])

    def scaled(self, factor: float | FloatArray) -> Path:
        """Return the motions times a factor, or one for each."""
        by = np.reshape(np.asarray(factor, dtype=np.float64), (1, -1, 1))
        return self._each(lambda x: x * by)

    def _each(self, change: Callable[[FloatArray], FloatArray]) -> Path:
        return Path(change(self.position), change(self.velocity), change(self.acceleration), self.period_s)

    def moved(self, centre_rad: FloatArray) -> Path:
        """Return the motions about a position (m,) of the motors."""
        return self._replace(position=self.position + centre_rad)


def driven(path: Path, model: JointModel) -> list[Record]:
    """Return what is read while the motors follow each motion exactly.

    The link moves by its dynamics; without them it stays with the first motor.

    Args:
        path: the motions; they begin at rest.
        model: every flexible transmission has parameters.

    Raises:
        EstimatorError: a transmission has none.
    """
    n, w, m = path.position.shape
    theta, omega, alpha = (part.transpose(1, 0, 2).reshape(-1, m) for part in path[:3])
    order = np.arange(n * w)
    read = Record(
        period_s=path.period_s, sequence=order, motor_position_rad=theta,
        motor_torque_nm=np.zeros_like(theta), link_position_rad=theta[:, 0],
    )  # fmt: skip
    joint = Bodies(read, model)
    joint.state, joint.rate = np.column_stack([theta, theta[:, 0]]), np.column_stack([omega, omega[:, 0]])
    joint.given = joint.remembered_torques()
    rows = np.arange(w)[None, :] * n + np.arange(n)[:, None]
    if model.link is not None and not joint.carried:
        for _ in range(_PASSES if joint.remembered else 1):
            q, rate = _link(joint, rows)
            joint.state[:, -1], joint.rate[:, -1] = q.T.reshape(-1), rate.T.reshape(-1)
            joint.given = joint.remembered_torques()
    free = joint.acceleration(joint.state, joint.rate, order)[:, :m]
    acting = (alpha - free) * joint.inertia[:m]
    acting = 0.5 * (acting + acting[np.minimum(order + 1, n * w - 1)])  # held over the period
    torque = acting.copy()
    for i in range(m):
        for _ in range(_PASSES):
            torque[:, i] = acting[:, i] + joint.torque_error(i, torque[:, i])
    read_link = joint.state[:, -1] + joint.reading_error(joint.state[:, -1], joint.rate[:, -1])
    link = read_link if model.has_deflection else None
    parts = (slice(k * n, (k + 1) * n) for k in range(w))
    return [
        Record(
            period_s=path.period_s, sequence=np.arange(n), motor_position_rad=theta[part],
            motor_torque_nm=torque[part],
            link_position_rad=None if link is None else link[part],
        )
        for part in parts
    ]  # fmt: skip


def _link(joint: Bodies, rows: NDArray[np.int64]) -> tuple[FloatArray, FloatArray]:
    """Position and velocity of the link, each (n, w), from its equilibrium at rest; second order."""
    x, v = joint.state[rows[0]], np.zeros_like(joint.rate[rows[0]])
    x[:, -1] = _settled(joint, x, rows[0])
    q, rate = np.empty(rows.shape), np.empty(rows.shape)
    steps = joint.steps(driven=True)
    h = joint.record.period_s / steps
    for k, row in enumerate(rows):
        x[:, :-1], v[:, :-1] = joint.state[row, :-1], joint.rate[row, :-1]
        q[k], rate[k] = x[:, -1], v[:, -1]
        for _ in range(steps):
            x += 0.5 * h * v
            v[:, -1] += h * joint.acceleration(x, v, row)[:, -1]
            x += 0.5 * h * v
    return q, rate


def _settled(joint: Bodies, x: FloatArray, row: NDArray[np.int64]) -> FloatArray:
    """Positions (w,) of the link at which nothing moves it, by Newton's method."""
    x, still = x.copy(), np.zeros_like(x)
    for _ in range(_NEWTON):
        more = x.copy()
        more[:, -1] += _STEP
        a = joint.acceleration(x, still, row)[:, -1]
        slope = (joint.acceleration(more, still, row)[:, -1] - a) / _STEP
        x[:, -1] -= a / np.where(np.abs(slope) > _STEP, slope, -1.0)
    return x[:, -1]
