"""Where an effect sits, whatever its law: the equations that an arbitrary signal at one place leaves alone.

A signal at a motor spoils that motor's balance only; one at the link, the link's; one in a transmission is
the same in both, so their difference does not have it. What is left of the untouched equations at the base
model's best fit to them alone, over the expected noise, says whether that place explains everything.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from estimator.diagnosis.base import Base
from estimator.diagnosis.candidates import Candidate, columns
from estimator.diagnosis.select import Tracer
from estimator.effects import LIBRARY
from estimator.sample import FloatArray

__all__ = ["Place", "places_left", "the_place"]

_ALONE = 12.0  # mean squared error over the noise that the right place may leave
_CLEAN = 1.5  # below this it leaves nothing but noise
_APART = 30.0  # times as much that any other place must leave
_NEAR = 3.0  # and where nothing but noise is left
_SKEW = 1.0  # periods that the link encoder may be late without being an effect
_ROUNDS = 3
_WORTH = 0.8  # squared error with a skew over that without


class Place(NamedTuple):
    """One place, and what an arbitrary signal there would leave.

    Attributes:
        location: motor, transmission or link.
        motor: index of the motor; None at the link.
        left: mean squared error of the untouched equations in units of the expected noise.
        skew_s: the link encoder's everyday delay that belongs to it.
    """

    location: str
    motor: int | None
    left: float
    skew_s: float


def places_left(tracer: Tracer) -> list[Place]:
    """Every place with what a signal there leaves, least first; empty without the link's equation."""
    frame = tracer.frame
    if not frame.linked:
        return []
    made = []
    for i in range(len(frame.motors)):
        made.append(_left(tracer, "motor", i))
        if frame.pulls[i]:
            made.append(_left(tracer, "transmission", i))
    made.append(_left(tracer, "link", None))
    return sorted(made, key=lambda place: place.left)


def the_place(places: list[Place]) -> Place | None:
    """The only place that explains the data, where there is one."""
    if not places or places[0].left > _ALONE:
        return None
    ratio = _NEAR if places[0].left < _CLEAN else _APART
    if len(places) > 1 and places[1].left < ratio * max(places[0].left, 1.0):
        return None
    return places[0]


def _left(tracer: Tracer, location: str, motor: int | None) -> Place:
    alone, _, _ = _fit(tracer, location, motor, skew=False)
    declared, period = tracer.frame.corrections, tracer.frame.signals.period_s
    late, about = 0.0, tracer
    for _ in range(_ROUNDS):
        _, step, base = _fit(about, location, motor, skew=True)
        moved = float(np.clip(late + step, -_SKEW * period, _SKEW * period))
        if abs(moved - late) < 1e-3 * period:
            break
        late = moved
        corrections = replace(declared, encoder_delay_s=declared.encoder_delay_s + late)
        about = tracer.at(corrections, base)
    error, _, _ = _fit(about, location, motor, skew=False)
    if error < _WORTH * alone:
        return Place(location, motor, error, late)
    return Place(location, motor, alone, 0.0)


def _fit(tracer: Tracer, location: str, motor: int | None, skew: bool) -> tuple[float, float, Base]:
    """Mean squared weighted error of the untouched equations, the encoder's delay, the base that belongs."""
    frame = tracer.frame
    own = tracer.base.design(frame)
    delay = columns(frame, Candidate(LIBRARY["encoder_delay"], None), {})
    design = np.column_stack((own, delay)) if skew else own
    rows, target = _untouched(tracer, design, tracer.balance(), location, motor)
    scale = np.linalg.norm(rows, axis=0)
    scale[scale == 0.0] = 1.0
    solution = np.linalg.lstsq(rows / scale, target, rcond=1e-9)[0] / scale
    error = float(np.mean((target - rows @ solution) ** 2))
    base = tracer.base if location == "transmission" else tracer.base.moved(frame, solution[: own.shape[1]])
    return error, float(solution[-1]) if skew else 0.0, base


def _untouched(
    tracer: Tracer, design: FloatArray, balance: FloatArray, location: str, motor: int | None
) -> tuple[FloatArray, FloatArray]:
    """Training rows of the equations that a signal at a place does not enter, weighted."""
    frame, index = tracer.frame, tracer.rows.blocks.index
    here = index >= 0
    weights = tracer.rows.weight.reshape(frame.equations, -1)[:, 0]
    parts = design.reshape(frame.equations, len(index), -1)[:, here]
    targets = balance.reshape(frame.equations, len(index))[:, here]
    last = frame.equations - 1
    gone = {last} if location == "link" else {motor}
    made = []
    for k in range(frame.equations):
        if k in gone or (location == "transmission" and k == last):
            continue
        made.append((parts[k] * weights[k], targets[k] * weights[k]))
    if location == "transmission":
        assert motor is not None
        weight = 1.0 / np.hypot(1.0 / weights[motor], 1.0 / weights[last])
        made.append(((parts[last] - parts[motor]) * weight, (targets[last] - targets[motor]) * weight))
    return np.concatenate([a for a, _ in made]), np.concatenate([y for _, y in made])
