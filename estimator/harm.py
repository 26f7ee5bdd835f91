"""Whether a model that is to be written does harm: it and the declared one over data that it was not made of.

Compared are the balance of the model as it stands, its free run, which also judges motions in which torques
cancel, and what the estimator does with it from tick to tick: how often it is valid, the external torque
against a sensor, and, where the declared model has no balance yet, what is left of the torque. Worse is what
is worse by more than its standard error over the blocks and `harm`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from estimator.choices import choice, whole
from estimator.errors import EstimatorError
from estimator.freerun import free_run, simulation_s
from estimator.model import JointModel
from estimator.model_monitor import can_monitor, seconds_of
from estimator.online import make_estimator
from estimator.reasons import percent
from estimator.sample import ExternalStatus, FloatArray, Record, Status
from estimator.settings import EstimatorSettings
from estimator.transmissions import transmission_model

_NOTHING = 1e-12  # rad: keeps a channel that stands still finite


class Unseen(NamedTuple):
    """A recording, and the sequence number from which on it took no part in making a model."""

    record: Record
    since: int

    @classmethod
    def whole(cls, record: Record) -> Unseen:
        """Return a recording of which no part did."""
        return cls(record, int(record.sequence[0]))


class _Figure(NamedTuple):
    """A mean square or a share in each block, of the declared model and of the written one; NaN: none."""

    declared: FloatArray
    written: FloatArray

    def roots(self, least: float) -> tuple[float, float]:
        """Return what `rises` compares, a root in the typical block: written, declared."""
        both = np.isfinite(self.declared + self.written)
        logs = (0.5 * np.log(each[both] + least) for each in (self.written, self.declared))
        written, declared = (math.exp(float(np.mean(each))) for each in logs)
        return written, declared

    def rises(self, least: float) -> bool:
        """Return whether the root of it rises; differences below the root of `least` are none."""
        return _above(0.5 * np.log((self.written + least) / (self.declared + least)), math.log1p)

    def falls(self) -> bool:
        """Return whether a share falls."""
        return _above(self.declared - self.written, float)


def _above(more: FloatArray, allowed: Callable[[float], float]) -> bool:
    """Whether the mean of the blocks exceeds its standard error by more than is allowed."""
    more = more[np.isfinite(more)]
    if len(more) < 2:  # no standard error
        return False
    scatter = float(np.std(more, ddof=1)) / math.sqrt(len(more))
    return float(np.mean(more)) - scatter > allowed(choice("harm"))


def harm(
    declared: JointModel,
    written: JointModel,
    unseen: Sequence[Unseen],
    settings: EstimatorSettings | None = None,
) -> str | None:
    """Say in one clause what a model makes worse than the declared one; None: nothing.

    Args:
        unseen: data that took no part in making it.
        settings: of the on-line estimator; left out: the defaults.
    """
    for number, motor in enumerate(written.motors, start=1):
        if motor.flexible and not motor.transmission.parameters:
            return f"these data do not determine the stiffness of motor {number}, and none is declared"
    return (
        _unexplained(written, unseen)
        or _balance(declared, written, unseen)
        or _free_run(declared, written, unseen)
        or _on_line(declared, written, unseen, settings or EstimatorSettings())
    )


def harm_of_parts(
    declared: JointModel,
    written: JointModel,
    records: Sequence[Record],
    make: Callable[[list[Record]], JointModel],
    settings: EstimatorSettings | None = None,
) -> str | None:
    """Say what a model makes worse in the last quarter of each recording, where it is made of the others.

    Args:
        written: made of all data; it is compared on them where a part determines no stiffness.
    """
    if not can_monitor(written):
        return harm(declared, written, [], settings)
    unseen = [Unseen(one, int(one.sequence[int((1.0 - choice("unseen")) * len(one))])) for one in records]
    try:
        part = make([one.record.rows(one.record.sequence < one.since) for one in unseen])
    except EstimatorError:  # too short to hold a part out
        part = None
    if part is None or not can_monitor(part):
        return harm(declared, written, [Unseen.whole(one) for one in records], settings)
    return harm(declared, part, unseen, settings)


def _unexplained(written: JointModel, unseen: Sequence[Unseen]) -> str | None:
    """What says that a motor's balance leaves more torque than its spring carries."""
    seconds = [second for one in unseen for second in seconds_of(one.record, written)]
    for i, motor in enumerate(written.motors):
        law = transmission_model(motor.transmission)
        if law is None or not motor.flexible or not seconds:
            continue
        alpha, carried = law.alpha(motor.transmission.parameters), []
        for record, _ in unseen:
            assert record.link_position_rad is not None
            phi = record.link_position_rad - record.motor_position_rad[:, i]
            carried.append(np.var(law.torque(phi, alpha)))
        spring = math.sqrt(float(np.mean(carried)))
        left = math.sqrt(float(np.mean([s.residual_nm[i] ** 2 for s in seconds])))
        if left > spring:
            which = f" of motor {i + 1}" if len(written.motors) > 1 else ""
            return (
                f"the balance{which} leaves {left:.3g} N·m, more than its spring carries ({spring:.3g} N·m)"
            )
    return None


def _balance(declared: JointModel, written: JointModel, unseen: Sequence[Unseen]) -> str | None:
    """What says that the model as it stands leaves more torque than the declared one, or than there is."""

    def squares(model: JointModel, name: str) -> FloatArray:
        seconds = [s for one in unseen for s in seconds_of(one.record, model) if _later(one, s.sequence)]
        return np.array([np.sum(np.square(getattr(s, name)[: len(model.motors)])) for s in seconds])

    known, torque = can_monitor(declared), squares(written, "torque_nm")
    if not len(torque):
        return None
    before = squares(declared, "residual_nm") if known else torque
    figure = _Figure(before, squares(written, "residual_nm"))
    least = choice("floor") ** 2 * float(np.mean(torque))
    if not figure.rises(least):
        return None
    after, before_nm = figure.roots(least)
    whose = "the declared one" if known else "no model"
    return f"on held-out data the new model leaves {after:.3g} N·m of the torque, {whose} {before_nm:.3g}"


def _free_run(declared: JointModel, written: JointModel, unseen: Sequence[Unseen]) -> str | None:
    """What says that the model foresees positions and deflections worse than the declared one."""
    squares: tuple[list[float], list[float]] = ([], [])
    for record, since in unseen:
        part = record.rows(record.sequence >= since)
        try:
            horizon_s = simulation_s(part)
            runs = [free_run(part, model, horizon_s) for model in (declared, written)]
        except EstimatorError:  # too short, or no stiffness is declared
            continue
        size = np.std(runs[0].measured_rad, axis=0) + _NOTHING
        for mine, run in zip(squares, runs, strict=True):
            error = np.mean((run.residual_rad / size) ** 2, axis=1)
            mine += [_mean(block) for block in np.array_split(error, whole("groups"))]
    figure = _Figure(*map(np.array, squares))
    if not figure.rises(choice("floor") ** 2):
        return None
    new, old = (percent(share, 1) for share in figure.roots(choice("floor") ** 2))
    return (
        f"free runs over held-out data err by {new} of the motion with the new model, {old} with the "
        "declared one"
    )


def _later(one: Unseen, sequence: int) -> bool:
    """Whether the second that ends with a sample is unseen."""
    return one.since == one.record.sequence[0] or (sequence - one.since) * one.record.period_s >= 1.0


def _on_line(
    declared: JointModel, written: JointModel, unseen: Sequence[Unseen], settings: EstimatorSettings
) -> str | None:
    """What says that the estimator is valid less often, errs by more where a sensor tells, or leaves more
    torque than with a model that has no balance yet.
    """
    blocks = np.concatenate(
        [_blocks([_replayed(model, one, settings) for model in (declared, written)]) for one in unseen]
    )
    valid, residual, external = (_Figure(*both) for both in blocks.T)
    replayed = "replayed over held-out data"
    if valid.falls():
        new, old = (percent(float(np.mean(x)), 0) for x in (valid.written, valid.declared))
        return f"{replayed} {new} of the new model's estimates are valid, {old} of the declared one's"
    torque = float(np.mean([np.var(one.record.motor_torque_nm) for one in unseen]))
    least = choice("floor") ** 2 * torque
    compared = [(external, least, "its external torque errs by")]
    if not can_monitor(declared):  # else the balances tell: the estimator adapts to a wrong number
        # Both adapt and leave less than the written model as it stands: a difference below that is none.
        left = sum(motor.fit_rms_nm[0] ** 2 for motor in written.motors if motor.fit_rms_nm)
        compared.append((residual, least + left, "valid estimates leave"))
    for figure, floor, what in compared:
        if figure.rises(floor):
            new, old = (f"{root:.3g} N·m" for root in figure.roots(least))
            return f"{replayed} {what} {new} with the new model, {old} with the declared one"
    return None


def _replayed(model: JointModel, one: Unseen, settings: EstimatorSettings) -> FloatArray:
    """(samples, 3) whether each is valid; squares of what that leaves, of the external torque's error."""
    estimator = make_estimator(model, settings, one.record.period_s)
    rows, valid, known = [], int(Status.VALID), int(ExternalStatus.VALID)  # a flag's & costs a step
    for sample in one.record.samples():
        good = bool(estimator.step(sample).status & valid)
        left = estimator.residual_nm if good else math.nan
        pushed, error = estimator.external, math.nan
        if pushed is not None and pushed.status & known:
            error = pushed.external_torque_nm - sample.external_torque_nm
        rows.append((float(good), left**2, error**2))
    return np.array(rows)[one.record.sequence >= one.since]


def _blocks(replayed: list[FloatArray]) -> FloatArray:
    """(blocks, 2, 3) means of two models; squares over the samples of which both are valid."""
    both = np.stack(replayed, axis=1)
    squares = both[:, :, 1:]
    both[:, :, 1:] = np.where(np.isnan(squares).any(axis=1, keepdims=True), np.nan, squares)
    parts = np.array_split(both, whole("groups"))
    return np.array([[[_mean(x) for x in model.T] for model in part.swapaxes(0, 1)] for part in parts])


def _mean(values: FloatArray) -> float:
    known = values[np.isfinite(values)]
    return float(np.mean(known)) if len(known) else math.nan
