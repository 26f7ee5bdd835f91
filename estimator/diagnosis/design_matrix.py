"""The columns of one linearised hypothesis: meaning and prior of each."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from estimator.choices import choice
from estimator.diagnosis.candidates import Candidate, bounds_of, columns, reach_of, sign_smoothing, spread_of
from estimator.diagnosis.corrections import read
from estimator.diagnosis.declared import known_effects
from estimator.diagnosis.frame import Corrections, Frame
from estimator.diagnosis.joint_priors import OF_RUN, effect_std, everyday, everyday_std, least
from estimator.diagnosis.law_parameters import Base
from estimator.diagnosis.regression import Scale
from estimator.effects import LIBRARY, STOP_EXPONENT, Coordinates
from estimator.priors import PRIORS
from estimator.sample import FloatArray

__all__ = ["Extra", "Pinned", "Slot", "Stack", "Term", "curve_columns", "step_of", "stepped"]


_SIGNED = ("position_rad",)  # nonlinear parameters of either sign

# Relative change of the acting torque per unit of the parameter.
_TORQUE_SCALES: dict[str, Callable[[Coordinates, dict[str, float]], FloatArray]] = {
    "torque_constant": lambda c, p: np.ones_like(c.torque),
    "torque_saturation": lambda c, p: -3.0 * c.torque**2,
    "torque_drift": lambda c, p: 1.0 - np.exp(-c.time / p["time_constant_s"]),
}


@dataclass(frozen=True, slots=True)
class Term:
    """A missing effect with its nonlinear and last fitted linear parameters."""

    candidate: Candidate
    values: dict[str, float]
    weights: tuple[float, ...] = ()

    @property
    def free(self) -> list[str]:
        """Nonlinear parameters that are fitted; once a turn is once a turn."""
        law = ("exponent", "shape") if self.values.get("exponent", 1.0) >= STOP_EXPONENT else ()
        once = ("periods_per_rev",) if self.values.get("periods_per_rev") == 1.0 else ()
        return [name for name in self.values if name not in ("side", "power", *law, *once)]


class Extra(NamedTuple):
    """Columns of a free curve beside a hypothesis: basis on coordinates, at a place."""

    location: str
    motor: int | None
    coordinates: tuple[str, ...]
    basis: Callable[..., FloatArray]


# Fixed values of everyday errors, by name and motor.
Pinned = Mapping[tuple[str, int | None], tuple[float, ...]]


class Slot(NamedTuple):
    """Meaning of one column of the regression.

    Attributes:
        kind: "base", "everyday", "term", "shape" (a nonlinear parameter), "curve".
        name: of effect or parameter. motor: where it is. run: of which recording; None: of all.
        place: index of the motor's alpha, of the term, or of the parameter of an effect.
        taken: correction already applied; the quantity is taken + x.
    """

    kind: str
    name: str
    motor: int | None
    run: int | None
    place: int
    part: int
    taken: float


class Stack:
    """Collects columns, their slots and priors.

    Args:
        frames: of all recordings, flexibility torques filled in.
        corrections: of the readings, one a recording.
        declared: corrections by the model's own effects.
        torque_rms: of the motor torque without its mean, N·m.
        calibrating: the recordings are of a healthy joint.
    """

    def __init__(
        self,
        frames: Sequence[Frame],
        corrections: Sequence[Corrections],
        declared: Corrections,
        torque_rms: float,
        calibrating: bool,
    ) -> None:
        self.slots: list[Slot] = []
        self.mean: list[float] = []
        self.std: list[float] = []
        self.low: list[float] = []
        self._columns: list[FloatArray] = []
        self._frames, self._model = frames, frames[0].model
        self._corrections, self._declared = corrections, declared
        self._torque_rms, self._calibrating = torque_rms, calibrating

    @property
    def design(self) -> FloatArray:
        """(n, k) the columns."""
        rows = sum(f.rows * f.equations for f in self._frames)
        return np.stack(self._columns, axis=1) if self._columns else np.zeros((rows, 0))

    def _add(
        self, column: FloatArray, slot: Slot, width: float, centre: float = 0.0, low: float = -np.inf
    ) -> None:
        self._columns.append(column)
        self.slots.append(slot)
        self.mean.append(centre - slot.taken)
        self.std.append(width)
        self.low.append(low - slot.taken)

    def transmissions(self, base: Base) -> None:
        """Add transmission parameters; the first of each, the stiffness, is not negative.

        The prior of a shape is about where it is, that of the other coefficients about zero.
        """
        design = np.concatenate([base.design(f) for f in self._frames])
        wide = PRIORS["transmission"].std * self._torque_rms
        j = 0
        for i, (alpha, law) in enumerate(zip(base.alpha, base.models(self._frames[0]), strict=True)):
            shapes = len(law.shape_names) if law is not None else 0
            for p, value in enumerate(alpha.tolist()):
                slot = Slot("base", "", i, None, p, 0, value)
                centre, low = value * (p >= len(alpha) - shapes), 0.0 if p == 0 else -np.inf
                self._add(design[:, j], slot, wide / _rms_of(design[:, j]), centre, low)
                j += 1

    def lever(self, base: Base) -> None:
        """Add the lever of a serial joint, which no file declares, about its mean in the first recording."""
        if self._model.arrangement == "serial" and self._frames[0].flexible[0]:
            held = float(np.mean(self._frames[0].motors[1].position))
            column = np.concatenate([base.lever(f, held) for f in self._frames])
            width = PRIORS["transmission"].std * self._torque_rms / _rms_of(column)
            self._add(column, Slot("everyday", "lever", 1, None, 0, 0, 0.0), width)

    def turns(self) -> None:
        """Add the moment at which undeclared dry friction changes its sign, s times its torque."""
        for i in np.flatnonzero(self._frames[0].flexible).tolist():
            friction = Candidate(LIBRARY["coulomb_friction"], i)
            if not any(everyday_std(self._frames, friction, self._torque_rms, self._calibrating)):
                continue
            speed, period_s = sign_smoothing(self._frames, i), self._frames[0].signals.light.period_s
            signs = [np.gradient(np.tanh(f.motors[i].velocity / speed), period_s) for f in self._frames]
            column = np.concatenate([f.column(i, x, None) for f, x in zip(self._frames, signs, strict=True)])
            width = PRIORS["undeclared_effect"].std * self._torque_rms / _rms_of(column)
            self._add(column, Slot("everyday", "friction_turns", i, None, 0, 0, 0.0), width)

    def everyday(self, without: set[tuple[str, int | None]], pinned: Pinned) -> None:
        """Add the everyday errors that are not terms."""
        known = known_effects(self._model)
        for candidate in everyday(self._frames[0]):
            values, std = known.get(candidate, ({}, None))
            widths = everyday_std(self._frames, candidate, self._torque_rms, self._calibrating, std)
            if candidate.key in without or not any(widths):
                continue
            name, motor = candidate.key
            held = pinned.get(candidate.key)
            positive = any(one.positive for one in candidate.kind.parameters if one.linear)
            lows = [least(self._model, candidate)] * len(widths)
            if values and positive:
                lows = [-values[one] for one in candidate.kind.linear]
            if candidate.kind.nonlinear and not values:
                values = {"smoothing_rad_s": sign_smoothing(self._frames, motor or 0)}
            parts = [columns(f, candidate, values) for f in self._frames]
            for run in range(len(self._frames)) if name in OF_RUN else (None,):
                taken = self._taken(candidate, run or 0)
                for p, width in enumerate(widths):
                    slot = Slot("everyday", name, motor, run, p, p, float(taken[p]))
                    column = _of_run(parts, p, run)
                    if held is None:
                        self._add(column, slot, width, low=lows[p])
                    else:
                        self._add(column, slot, choice("exact") * width, centre=held[p])

    def term(self, k: int, term: Term) -> None:
        """Add an effect and, once its size is not zero, its nonlinear parameters."""
        candidate = term.candidate
        parts = [columns(f, candidate, term.values, term.weights) for f in self._frames]
        taken = self._taken(candidate, 0)
        made = [_of_run(parts, p, None) for p in range(parts[0].shape[1])]
        sizes = np.array([_rms_of(column) for column in made])
        width = PRIORS["effect"].std * self._torque_rms / np.sqrt(len(made)) / sizes
        for p, std in enumerate(effect_std(self._frames, candidate, width).tolist()):
            slot = Slot("term", candidate.kind.name, candidate.motor, None, k, p, float(taken[p]))
            self._add(made[p], slot, std, low=least(self._model, candidate))
        if term.weights:
            for name in term.free:
                slot = Slot("shape", name, candidate.motor, None, k, 0, 0.0)
                width = choice("exact") if self._ends(term, name) else 1.0
                self._add(self._derivative(term, name), slot, width)

    def curve(self, extra: Extra) -> None:
        """Build a free curve."""
        shaped = np.concatenate([curve_columns(f, extra) for f in self._frames])
        width = choice("curve_width") * PRIORS["effect"].std * self._torque_rms
        for p, column in enumerate(shaped.T):
            self._add(column, Slot("curve", "", extra.motor, None, p, 0, 0.0), width)

    def scales(self, terms: Sequence[Term]) -> tuple[Scale, ...]:
        """Return the motors' balances against the measured torque, and the link's against its inertia."""
        first, made = self._frames[0], []
        motors = len(first.motors)
        for i in range(motors + first.linked):
            mine = [j for j, slot in enumerate(self.slots) if self._scales(slot, i)]
            if not mine:
                continue
            slopes = np.stack([self._torque_scale(self.slots[j], terms) for j in mine], axis=1)
            same = bool(np.all(slopes == slopes[0]))
            groups = tuple(k * first.equations + i for k in range(len(self._frames)))
            made.append(Scale(groups, np.array(mine), slopes[:1] if same else slopes, i < motors))
        return tuple(made)

    def _scales(self, slot: Slot, balance: int) -> bool:
        """Whether a slot scales a balance.

        An inertia that the file knows the deviation of does where nothing else has a scale: a stiffness
        follows it. No torque is measured of the link's: with its inertia all of it may shrink.
        """
        if balance == len(self._model.motors):
            return slot.name == "link_inertia"
        motor = self._model.motors[slot.motor or 0]
        known = motor.inertia_std_relative is not None and not self._frames[0].linked
        alone = known and slot.name == "motor_inertia" and slot.kind == "term"
        return slot.motor == balance and (slot.name in _TORQUE_SCALES or alone)

    def _torque_scale(self, slot: Slot, terms: Sequence[Term]) -> FloatArray:
        """(m,) relative change of the acting torque per unit of a slot."""
        values = terms[slot.place].values if slot.kind == "term" else {}
        if slot.name in ("motor_inertia", "link_inertia"):
            link = self._model.link if slot.name == "link_inertia" else None
            inertia = (link or self._model.motors[slot.motor or 0]).inertia_kg_m2
            return np.full(sum(len(f.motors[0].torque[:: f.rows_step]) for f in self._frames), 1.0 / inertia)
        slope = _TORQUE_SCALES[slot.name]
        return np.concatenate(
            [slope(f.motors[slot.motor or 0], values)[:: f.rows_step] for f in self._frames]
        )

    def _taken(self, candidate: Candidate, run: int) -> FloatArray:
        now, before = read(self._corrections[run], candidate), read(self._declared, candidate)
        return np.subtract(now, before)

    def _ends(self, term: Term, name: str) -> bool:
        """Whether a place is at an end of the motion, beyond which the effect is none."""
        low, high = bounds_of(self._frames[0], term.candidate, name, term.values)
        step, _ = step_of(term, name, self._frames[0])
        return name in _SIGNED and not low + step < term.values[name] < high - step

    def _derivative(self, term: Term, name: str) -> FloatArray:
        """Column of a nonlinear parameter, by a difference."""
        step, scale = step_of(term, name, self._frames[0])
        up = {**term.values, name: term.values[name] + step}
        change = [
            columns(f, term.candidate, up, term.weights)
            - columns(f, term.candidate, term.values, term.weights)
            for f in self._frames
        ]
        return np.asarray(np.concatenate(change) @ np.array(term.weights) * (scale / step))


def curve_columns(frame: Frame, extra: Extra) -> FloatArray:
    """Return stacked columns (rows, k) of a free curve."""
    waves = np.ascontiguousarray(extra.basis(frame.motors[extra.motor or 0]).T)
    if extra.location == "motor":
        return frame.column(extra.motor, -waves, None).T
    if extra.location == "transmission":
        return frame.column(extra.motor, waves, waves if frame.pulls[extra.motor or 0] else None).T
    return frame.column(None, None, waves).T


def step_of(term: Term, name: str, frame: Frame) -> tuple[float, float]:
    """(step of a difference, prior standard deviation) of a nonlinear parameter, in its unit."""
    value = term.values[name]
    scale = reach_of(frame, term.candidate, name)
    if scale is None:
        return 1e-3 * abs(value), abs(value)
    step = 1e-3 * min(scale, spread_of(frame, term.candidate, name))
    return (step if name in _SIGNED else min(step, 0.5 * value)), scale


def stepped(term: Term, name: str, x: float, frame: Frame) -> dict[str, float]:
    """Return the nonlinear parameters after a step; positive ones change by factors of at most two."""
    value, scale = term.values[name], reach_of(frame, term.candidate, name)
    low, high = bounds_of(frame, term.candidate, name, term.values)
    if scale is None:
        moved = value * float(np.exp(np.clip(x, -0.7, 0.7)))
        return {**term.values, name: float(np.clip(moved, min(low, value), max(high, value)))}
    most = spread_of(frame, term.candidate, name)
    moved = value + float(np.clip(x * scale, -most, most))
    least = low if name in _SIGNED else 0.5 * value
    return {**term.values, name: min(max(moved, least), high)}


def _of_run(parts: list[FloatArray], p: int, run: int | None) -> FloatArray:
    return np.concatenate(
        [part[:, p] if run in (None, k) else np.zeros(len(part)) for k, part in enumerate(parts)]
    )


def _rms_of(column: FloatArray) -> float:
    """rms over the non-zero rows of a column, or one."""
    used = column[np.abs(column) > 1e-100]
    return float(np.sqrt(np.mean(used**2))) if len(used) else 1.0
