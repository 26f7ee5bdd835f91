"""A model of the joint, fitted to recordings: as declared, everyday errors within their priors, effects.

Everything is fitted at once: transmission parameters, the declared numbers and the readings within what
`estimator.priors` says of them, and the effects of the hypothesis. What enters nonlinearly (shapes of springs
and of friction, delays, zeros of readings) is followed by Gauss-Newton steps.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from estimator.diagnosis.base import Base, start, with_flexibility
from estimator.diagnosis.candidates import Candidate, bounds_of, columns, reach_of, spread_of
from estimator.diagnosis.evidence import Posterior, Regression, Scale
from estimator.diagnosis.frame import Corrections, Frame, Signals
from estimator.diagnosis.known import declared_corrections, declared_torque
from estimator.effects import LIBRARY, STOP_EXPONENT, Coordinates
from estimator.model import JointModel
from estimator.priors import PRIORS
from estimator.sample import FloatArray, Record

__all__ = ["Extra", "Fitted", "Problem", "Slot", "Term", "effect_std"]

_EVERYDAY = ("motor_inertia", "viscous_damping", "torque_offset", "torque_delay", "deflection_offset")
_AT_LINK = ("encoder_delay", "link_inertia", "link_viscous_damping", "gravity")
_OF_RUN = ("torque_offset", "deflection_offset")  # belong to a run, all else to the machine
_READINGS = (
    "torque_delay",
    "torque_lag",
    "deflection_offset",
    "encoder_delay",
    "encoder_scale",
    "encoder_eccentricity",
)
_FLOOR = 0.002  # of the torque: what filters, sampling and rounding leave; no model is better
_LAW = (
    0.08  # of an effect's torque: by so much textbook laws of friction, play and slip differ among themselves
)
_PIN = 1e-4  # of a prior's width: held
_STEPS = 6  # of Gauss-Newton
_CONVERGED = 0.02  # standard deviations
_NEGATIVE_INERTIA = -0.8  # of the declared inertia: what may be missing of it

# Effects that take energy, never give it.
POSITIVE = {
    "coulomb_friction",
    "presliding_friction",
    "load_dependent_friction",
    "quadratic_damping",
    "hysteresis",
    "backlash",
    "transmission_damping",
    "link_coulomb_friction",
    "contact",
    "back_driving_loss",
    "torque_saturation",
    "stribeck_friction",
    "asymmetric_friction",
}


# How much more torque acts per unit of what is measured, for one unit of the parameter, on average.
TORQUE_SCALES: dict[str, Callable[[Coordinates, dict[str, float]], float]] = {
    "torque_constant": lambda c, p: 1.0,
    "torque_saturation": lambda c, p: -3.0 * float(np.mean(c.torque**2)),
    "torque_drift": lambda c, p: 1.0 - float(np.mean(np.exp(-c.time / p["time_constant_s"]))),
}


@dataclass(frozen=True, slots=True)
class Term:
    """A missing effect with its nonlinear parameters, and its linear ones as last fitted."""

    candidate: Candidate
    values: dict[str, float]
    weights: tuple[float, ...] = ()

    @property
    def free(self) -> list[str]:
        """Nonlinear parameters that are fitted."""
        law = ("exponent", "shape") if self.values.get("exponent", 1.0) >= STOP_EXPONENT else ()
        return [name for name in self.values if name not in ("side", "power", *law)]


class Extra(NamedTuple):
    """Columns of a free curve beside a hypothesis: basis on coordinates, at a place."""

    location: str
    motor: int | None
    coordinates: tuple[str, ...]
    basis: Callable[..., FloatArray]


# Everyday errors held at values, one for each part, by name and motor.
Pinned = Mapping[tuple[str, int | None], tuple[float, ...]]


class Slot(NamedTuple):
    """What one column of the regression stands for.

    Attributes:
        kind: "base", "everyday", "term", "shape" (a nonlinear parameter), "curve".
        name: of effect or parameter. motor: where it is. run: of which recording; None: of all.
        place: index of the motor's alpha, of the term, or of the parameter of an effect.
        taken: what has already been corrected, so that taken + x is the quantity.
    """

    kind: str
    name: str
    motor: int | None
    run: int | None
    place: int
    part: int
    taken: float


@dataclass(frozen=True, slots=True, eq=False)
class Fitted:
    """A hypothesis at its best fit.

    Attributes:
        terms: its effects.
        base: transmission parameters about which it was linearised.
        corrections: of the readings, one a recording.
        slots: what the columns are.
        regression: the rows.
        times: autocorrelation times of what is left.
        posterior: of the columns.
        extra: a free curve, where there is one.
        pinned: everyday errors that were held at a value, by name and motor.
    """

    terms: tuple[Term, ...]
    base: Base
    corrections: tuple[Corrections, ...]
    slots: tuple[Slot, ...]
    regression: Regression
    times: FloatArray
    posterior: Posterior
    extra: Extra | None = None
    pinned: Pinned = field(default_factory=dict)

    def evidence(self, like: Fitted) -> float:
        """Logarithm of the marginal likelihood, errors as correlated and as small as another one's can be."""
        if like is self:
            return self.posterior.evidence
        regression = replace(self.regression, floor=like.regression.floor)
        return regression.solve(like.times, self.posterior.sigma).evidence

    @property
    def real(self) -> bool:
        """Whether every effect takes part: no friction held at zero, no spring without stiffness."""
        return not any(
            held
            for slot, held in zip(self.slots, self.posterior.bound, strict=True)
            if slot.kind in ("term", "base")
        )

    def moved_base(self, problem: Problem) -> Base:
        """The transmission parameters as fitted."""
        own = np.array(
            [x for slot, x in zip(self.slots, self.posterior.x, strict=True) if slot.kind == "base"]
        )
        return self.base.moved(problem.frames[0], own)

    def total(self, kind: str, name: str, motor: int | None, run: int | None = None) -> list[float]:
        """The quantity that slots stand for, with what had been corrected before."""
        return [
            slot.taken + float(x)
            for slot, x in zip(self.slots, self.posterior.x, strict=True)
            if (slot.kind, slot.name, slot.motor) == (kind, name, motor) and slot.run in (None, run)
        ]


class Problem:
    """Recordings of one joint, the declared model, and models tried on them.

    Args:
        records: of one joint.
        model: as declared.
        bandwidth_hz: of the filter that all channels share.
        held: share of each recording, in blocks, that takes no part.
        blocks: of time, for cross-validation.
        calibrating: the recordings are of a healthy joint, and show what its declared numbers should be.
    """

    def __init__(
        self,
        records: Sequence[Record],
        model: JointModel,
        bandwidth_hz: float,
        held: int,
        blocks: int,
        calibrating: bool = False,
    ) -> None:
        self.model = model
        self.calibrating = calibrating
        self.signals = [Signals(record, bandwidth_hz) for record in records]
        declared = declared_corrections(model)
        self.declared = declared
        self._frames: dict[Corrections, dict[int, Frame]] = {}
        frames = [self._frame(k, declared) for k in range(len(records))]
        self.frames = frames
        self.rows = [frame.rows for frame in frames]
        group, block = [], []
        equations = frames[0].equations
        for k, frame in enumerate(frames):
            index = _blocks(frame.rows, blocks, held)
            for e in range(equations):
                group.append(np.full(frame.rows, k * equations + e))
                block.append(index)
        self.group = np.concatenate(group)
        self.block = np.concatenate(block)
        torque = np.concatenate(
            [
                np.concatenate([f.project(c.torque) - f.project(c.torque).mean() for c in f.motors])
                for f in frames
            ]
        )
        self.torque_rms = float(np.sqrt(np.mean(torque**2)))
        self.smoothing_rad_s = max(
            signals.velocity_noise(i) for signals in self.signals for i in range(len(model.motors))
        )

    @property
    def period_s(self) -> float:
        """The longest sampling period."""
        return max(signals.period_s for signals in self.signals)

    def unit_of(self, term: Term, name: str) -> float:
        """A nonlinear parameter's unit per unit of its slot."""
        return _step(term, name, self.frames[0])[1]

    @property
    def equations(self) -> int:
        """Number of balances of one recording."""
        return self.frames[0].equations

    def _frame(self, k: int, corrections: Corrections) -> Frame:
        made = self._frames.setdefault(corrections, {})
        if k not in made:
            made[k] = Frame.make(self.model, self.signals[k], corrections)
            while len(self._frames) > 24:
                self._frames.pop(next(iter(self._frames)))
        return made[k]

    def at(self, corrections: Sequence[Corrections], base: Base) -> list[Frame]:
        """Frames of all recordings, readings corrected, flexibility torques filled in."""
        return [with_flexibility(self._frame(k, c), base) for k, c in enumerate(corrections)]

    # -- fitting ------------------------------------------------------------------------------------------

    def null(self, pinned: Pinned | None = None) -> Fitted:
        """The declared model at its best fit, everyday errors within their priors or pinned."""
        corrections = tuple(self.declared for _ in self.signals)
        base = start(self._frame(0, self.declared))
        return self.fit((), base, corrections, pinned=pinned)

    def numbers(self, like: Fitted | None = None) -> Pinned:
        """The declared numbers, pinned as they are declared or as another hypothesis has them."""
        made = {}
        for candidate in self._everyday():
            name, motor = candidate.key
            if name in _READINGS or name in _OF_RUN:
                continue
            parts = [] if like is None else like.total("everyday", name, motor)
            made[candidate.key] = tuple(parts) or (0.0,) * len(candidate.kind.linear)
        return made

    def fit(
        self,
        terms: tuple[Term, ...],
        base: Base,
        corrections: tuple[Corrections, ...],
        steps: int = _STEPS,
        extra: Extra | None = None,
        pinned: Pinned | None = None,
    ) -> Fitted:
        """Gauss-Newton from a given point; the best point on the way."""
        best: Fitted | None = None
        for _ in range(steps + 1):
            now = self._linearised(terms, base, corrections, extra, pinned or {})
            if best is not None and now.posterior.evidence < best.evidence(now):
                break
            best = now
            if not self._curved(now) or _converged(now):
                break
            terms, base, corrections = self._moved(now)
        assert best is not None
        return best

    def added(self, fitted: Fitted, term: Term, steps: int = _STEPS) -> Fitted:
        """A hypothesis with one term more."""
        return self.fit((*fitted.terms, term), fitted.base, fitted.corrections, steps)

    def without(self, fitted: Fitted, k: int, pinned: Pinned | None = None) -> Fitted:
        """The same less one term; a reading it corrected is as it was."""
        term = fitted.terms[k]
        terms = fitted.terms[:k] + fitted.terms[k + 1 :]
        restored = tuple(_restored(c, self.declared, term.candidate) for c in fitted.corrections)
        return self.fit(terms, fitted.base, restored, extra=fitted.extra, pinned=pinned)

    def with_curve(self, fitted: Fitted, extra: Extra) -> Fitted:
        """The same with a free curve."""
        return self.fit(fitted.terms, fitted.base, fitted.corrections, 1, extra=extra)

    def transferred(self, fitted: Fitted, corrections: Corrections) -> Fitted:
        """A model that was fitted to other recordings, on the only one here, parameters as they were."""
        bare = tuple(replace(t, weights=()) for t in fitted.terms)
        kept = [(s, x) for s, x in zip(fitted.slots, fitted.posterior.x, strict=True) if s.kind != "shape"]
        there = self._linearised(bare, fitted.base, (corrections,), fitted.extra, fitted.pinned)
        values = {(s.kind, s.name, s.motor, s.place, s.part): float(x) + s.taken for s, x in kept}
        x = np.array([values[s.kind, s.name, s.motor, s.place, s.part] - s.taken for s in there.slots])
        return replace(there, posterior=there.posterior._replace(x=x))

    def torque(self) -> FloatArray:
        """Measured torque of each row without its mean, as declared; zero in the link's balance."""
        made = []
        for frame in self.frames:
            made += [frame.project(c.torque) - float(np.mean(frame.project(c.torque))) for c in frame.motors]
            made += [np.zeros(frame.rows)] * (frame.equations - len(frame.motors))
        return np.concatenate(made)

    def _curved(self, fitted: Fitted) -> bool:
        return any(
            slot.kind == "shape" or slot.name in _READINGS for slot in fitted.slots if slot.kind != "base"
        ) or any(m is not None and m.shape_names for m in fitted.base.models(self.frames[0]))

    def _linearised(
        self,
        terms: tuple[Term, ...],
        base: Base,
        corrections: tuple[Corrections, ...],
        extra: Extra | None,
        pinned: Pinned,
    ) -> Fitted:
        frames = self.at(corrections, base)
        target = np.concatenate([f.target() - declared_torque(f) - base.torque(f) for f in frames])
        made: list[FloatArray] = []
        slots: list[Slot] = []
        mean, std, low = [], [], []

        def add(column: FloatArray, slot: Slot, centre: float, width: float, bound: float) -> None:
            made.append(column)
            slots.append(slot)
            mean.append(centre - slot.taken)
            std.append(width)
            low.append(bound - slot.taken)

        tau = self.torque_rms
        wide = PRIORS["transmission"].std * tau
        design = np.concatenate([base.design(f) for f in frames])
        j = 0
        for i, model in enumerate(base.models(frames[0])):
            for p, value in enumerate(base.alpha[i]):
                width = wide / _rms_of(design[:, j])
                leading = p == 0 and model is not None
                add(
                    design[:, j],
                    Slot("base", "", i, None, p, 0, float(value)),
                    0.0,
                    width,
                    0.0 if leading else -np.inf,
                )
                j += 1
        named = {t.candidate.key for t in terms}
        for candidate in self._everyday():
            if candidate.key in named:
                continue
            runs = range(len(frames)) if candidate.kind.name in _OF_RUN else (None,)
            widths = self._everyday_std(frames, candidate)
            if not any(widths):
                continue
            held = pinned.get(candidate.key)
            parts = [columns(f, candidate, {}) for f in frames]
            for run in runs:
                c = corrections[run or 0]
                taken = np.subtract(_read(c, candidate), _read(self.declared, candidate))
                for p in range(parts[0].shape[1]):
                    column = _of_run(parts, p, run)
                    slot = Slot("everyday", candidate.kind.name, candidate.motor, run, p, p, float(taken[p]))
                    centre, width = (0.0, widths[p]) if held is None else (held[p], _PIN * widths[p])
                    add(column, slot, centre, width, self._least(candidate, p) if held is None else -np.inf)
        for k, term in enumerate(terms):
            candidate = term.candidate
            parts = [columns(f, candidate, term.values) for f in frames]
            taken = np.subtract(_read(corrections[0], candidate), _read(self.declared, candidate))
            width = PRIORS["effect"].std * tau / np.sqrt(parts[0].shape[1])
            for p in range(parts[0].shape[1]):
                column = np.concatenate([part[:, p] for part in parts])
                slot = Slot("term", candidate.kind.name, candidate.motor, None, k, p, float(taken[p]))
                add(
                    column,
                    slot,
                    0.0,
                    effect_std(self.model, candidate, width / _rms_of(column)),
                    self._least(candidate, p),
                )
            if not term.weights:
                continue
            for name in term.free:
                step, scale = _step(term, name, frames[0])
                up = [columns(f, candidate, {**term.values, name: term.values[name] + step}) for f in frames]
                down = [
                    columns(f, candidate, {**term.values, name: term.values[name] - step}) for f in frames
                ]
                column = np.concatenate(
                    [(u - d) @ np.array(term.weights) for u, d in zip(up, down, strict=True)]
                ) * (scale / (2.0 * step))
                slot = Slot("shape", name, candidate.motor, None, k, 0, 0.0)
                add(column, slot, 0.0, 1.0, -np.inf)
        if extra is not None:
            shaped = np.concatenate([curve_columns(f, extra) for f in frames])
            width = PRIORS["effect"].std * tau * 3.0
            for p in range(shaped.shape[1]):
                add(
                    shaped[:, p],
                    Slot("curve", "", extra.motor, None, p, 0, 0.0),
                    0.0,
                    width,
                    -np.inf,
                )
        stacked = np.stack(made, axis=1) if made else np.zeros((len(target), 0))
        regression = Regression.make(
            stacked,
            target,
            np.array(mean),
            np.array(std),
            np.array(low),
            self.group,
            self.block,
            np.full(self.equations * len(frames), _FLOOR * tau),
            self._scales(frames, slots, terms),
        )
        times = np.ones(self.equations * len(frames))
        posterior = regression.solve(times)
        for _ in range(2):
            times = regression.autocorrelation_times(posterior.x)
            posterior = regression.solve(times, posterior.sigma)
        if terms:
            regression = replace(regression, floor=self._floor(regression, slots, posterior.x))
            posterior = regression.solve(times, posterior.sigma)
        terms = _weighed(terms, slots, posterior.x)
        return Fitted(terms, base, corrections, tuple(slots), regression, times, posterior, extra, pinned)

    def _floor(self, regression: Regression, slots: list[Slot], x: FloatArray) -> FloatArray:
        """(groups,) what no model gets below: rounding, and the share by which an effect's law differs."""
        effect = [j for j, s in enumerate(slots) if s.kind == "term" and LIBRARY[s.name].nonlinear]
        square = np.full(len(regression.floor), (_FLOOR * self.torque_rms) ** 2)
        torque = regression.design[:, effect] @ x[effect]
        for g in range(len(square)):
            square[g] += _LAW**2 * float(np.mean(torque[self.group == g] ** 2))
        return np.asarray(np.sqrt(square))

    def _scales(
        self, frames: Sequence[Frame], slots: list[Slot], terms: tuple[Term, ...]
    ) -> tuple[Scale, ...]:
        """The motors' balances against the measured torque."""
        made = []
        for i in range(len(self.model.motors)):
            direction = np.zeros(len(slots))
            for j, slot in enumerate(slots):
                if slot.motor == i and slot.name in TORQUE_SCALES:
                    values = terms[slot.place].values if slot.kind == "term" else {}
                    direction[j] = TORQUE_SCALES[slot.name](frames[0].motors[i], values)
            if direction.any():
                groups = tuple(k * self.equations + i for k in range(len(frames)))
                made.append(Scale(groups, direction, 1.0))
        return tuple(made)

    def _moved(self, fitted: Fitted) -> tuple[tuple[Term, ...], Base, tuple[Corrections, ...]]:
        """Where the linearised model says that the best point is."""
        x = fitted.posterior.x
        own = np.array([v for slot, v in zip(fitted.slots, x, strict=True) if slot.kind == "base"])
        base = fitted.base.moved(self.frames[0], own)
        corrections = list(fitted.corrections)
        terms = list(fitted.terms)
        for slot, value in zip(fitted.slots, x.tolist(), strict=True):
            if slot.kind == "shape":
                term = terms[slot.place]
                terms[slot.place] = replace(term, values=_stepped(term, slot.name, value, self.frames[0]))
            elif slot.name in _READINGS:
                for run in range(len(corrections)) if slot.run is None else (slot.run,):
                    corrections[run] = _corrected(corrections[run], slot, value)
        return tuple(terms), base, tuple(corrections)

    # -- priors -------------------------------------------------------------------------------------------

    def _everyday(self) -> list[Candidate]:
        frame = self.frames[0]
        made = []
        for i, flexible in enumerate(frame.flexible):
            names = [n for n in _EVERYDAY if flexible or n not in ("deflection_offset", "torque_delay")]
            made += [Candidate(LIBRARY[name], i) for name in names]
        if frame.linked:
            made += [Candidate(LIBRARY["torque_constant"], i) for i in range(len(frame.motors))]
        for name in _AT_LINK:
            if (frame.linked or name == "encoder_delay") and any(frame.flexible):
                made.append(Candidate(LIBRARY[name], None))
        return made

    def _everyday_std(self, frames: Sequence[Frame], candidate: Candidate) -> tuple[float, ...]:
        """Prior standard deviations of the errors that every rig has, by the table of priors."""
        name, motor = candidate.kind.name, self.model.motors[candidate.motor or 0]
        link, std, linked = self.model.link, PRIORS[name].std, frames[0].linked
        if name in ("torque_delay", "encoder_delay"):
            return (std * frames[0].signals.period_s,)
        if name == "torque_offset":
            # A healthy joint's constant is the zero between its encoders: the two cannot be separated.
            return (0.0,) if linked or self.calibrating else (std * self.torque_rms,)
        if name == "deflection_offset":
            phi = frames[0].motors[candidate.motor or 0].deflection
            return (0.0,) if linked and not self.calibrating else (std * float(np.ptp(phi)),)
        if name == "torque_constant" and self.calibrating:
            return (0.0,)  # the anchor
        if linked and not self.calibrating:
            # Both balances show a declared number that is off: then it is an effect, and has a name.
            std = PRIORS["declared"].std
        if name == "torque_constant":
            return (std,)
        if name == "motor_inertia":
            return (std * motor.inertia_kg_m2,)
        if name == "viscous_damping":
            fast = max(float(np.max(np.abs(f.motors[candidate.motor or 0].velocity))) for f in frames)
            floor = (
                0.0 if linked else PRIORS["viscous_damping_floor"].std * self.torque_rms / max(fast, 1e-300)
            )
            return (float(np.hypot(std * motor.viscous_damping_nm_s_rad, floor)),)
        assert link is not None
        if name == "link_inertia":
            return (std * link.inertia_kg_m2,)
        if name == "link_viscous_damping":
            return (std * link.viscous_damping_nm_s_rad,)
        return (std * abs(link.gravity_nm),) * 2

    def _least(self, candidate: Candidate, part: int) -> float:
        """The bound that physics sets an effect's linear parameter, beyond what is declared."""
        name = candidate.kind.name
        motor, link = self.model.motors[candidate.motor or 0], self.model.link
        if name in POSITIVE:
            return 0.0
        if name == "motor_inertia":
            return _NEGATIVE_INERTIA * motor.inertia_kg_m2
        if name == "viscous_damping":
            return -motor.viscous_damping_nm_s_rad
        if name == "link_inertia" and link is not None:
            return _NEGATIVE_INERTIA * link.inertia_kg_m2
        if name == "link_viscous_damping" and link is not None:
            return -link.viscous_damping_nm_s_rad
        return -np.inf


def effect_std(model: JointModel, candidate: Candidate, by_torque: float) -> float:
    """Prior standard deviation of an effect's linear parameter: by torque, or by what a reading is off."""
    name = candidate.kind.name
    if name == "motor_inertia":
        return PRIORS["anchor"].std * model.motors[candidate.motor or 0].inertia_kg_m2
    if name == "link_inertia" and model.link is not None:
        return PRIORS["anchor"].std * model.link.inertia_kg_m2
    if name in ("torque_constant", "torque_drift"):
        return PRIORS["torque_scale"].std
    if name in ("torque_delay", "torque_lag", "encoder_delay"):
        return min(PRIORS["late"].std, by_torque)
    return (
        min(PRIORS[name].std, by_torque) if name in ("encoder_scale", "encoder_eccentricity") else by_torque
    )


def curve_columns(frame: Frame, extra: Extra) -> FloatArray:
    """Stacked columns of a free curve."""
    made = []
    for wave in extra.basis(frame.motors[extra.motor or 0]).T:
        if extra.location == "motor":
            made.append(frame.column(extra.motor, -wave, None))
        elif extra.location == "transmission":
            made.append(frame.column(extra.motor, wave, wave if frame.pulls[extra.motor or 0] else None))
        else:
            made.append(frame.column(None, None, wave))
    return np.stack(made, axis=1)


def _blocks(rows: int, count: int, held: int) -> np.ndarray:
    """Contiguous blocks of time; `held` of them, spread over the recording, take no part (-1)."""
    total = count + held
    place = np.minimum(np.arange(rows) * total // max(rows, 1), total - 1)
    out = {int((k + 0.7) * total / held) for k in range(held)} if held else set()
    order = np.full(total, -1)
    order[[k for k in range(total) if k not in out]] = np.arange(count)
    return np.asarray(order[place])


def _of_run(parts: list[FloatArray], p: int, run: int | None) -> FloatArray:
    return np.concatenate(
        [part[:, p] if run in (None, k) else np.zeros(len(part)) for k, part in enumerate(parts)]
    )


def _rms_of(column: FloatArray) -> float:
    """rms over the rows that a column enters; one where it enters none."""
    used = column[np.abs(column) > 1e-100]
    return float(np.sqrt(np.mean(used**2))) if len(used) else 1.0


def _weighed(terms: tuple[Term, ...], slots: list[Slot], x: FloatArray) -> tuple[Term, ...]:
    made = []
    for k, term in enumerate(terms):
        weights = tuple(
            s.taken + float(v) for s, v in zip(slots, x, strict=True) if s.kind == "term" and s.place == k
        )
        made.append(replace(term, weights=weights))
    return tuple(made)


def _converged(fitted: Fitted) -> bool:
    std = np.sqrt(np.maximum(np.diag(fitted.posterior.covariance), 0.0))
    moves = [
        abs(x) > _CONVERGED * s
        for slot, x, s in zip(fitted.slots, fitted.posterior.x, std, strict=True)
        if slot.kind in ("shape", "base") or slot.name in _READINGS
    ]
    first = any(t.free and not _has_shapes(fitted, k) for k, t in enumerate(fitted.terms))
    return not first and not any(moves)


def _has_shapes(fitted: Fitted, k: int) -> bool:
    return any(s.kind == "shape" and s.place == k for s in fitted.slots)


def _step(term: Term, name: str, frame: Frame) -> tuple[float, float]:
    """(step of a difference, prior standard deviation) of a nonlinear parameter, in its unit."""
    value = term.values[name]
    scale = reach_of(frame, term.candidate, name)
    width = abs(value) if scale is None else scale
    return 1e-3 * (abs(value) if scale is None else min(scale, spread_of(frame, term.candidate, name))), width


def _stepped(term: Term, name: str, x: float, frame: Frame) -> dict[str, float]:
    """The nonlinear parameters after a step; what is positive moves by factors, at most by two."""
    value, scale = term.values[name], reach_of(frame, term.candidate, name)
    if scale is None:
        low, high = bounds_of(frame, term.candidate, name)
        moved = value * float(np.exp(np.clip(x, -0.7, 0.7)))
        return {**term.values, name: float(np.clip(moved, min(low, value), max(high, value)))}
    most = spread_of(frame, term.candidate, name)
    return {**term.values, name: value + float(np.clip(x * scale, -most, most))}


def _read(c: Corrections, candidate: Candidate) -> tuple[float, ...]:
    """What of an effect the readings are corrected by."""
    motor = candidate.motor or 0
    return {
        "torque_delay": (c.torque_delay_s[motor],),
        "torque_lag": (c.torque_lag_s[motor],),
        "deflection_offset": (c.offset_rad[motor],),
        "encoder_delay": (c.encoder_delay_s,),
        "encoder_scale": (c.encoder_scale,),
        "encoder_eccentricity": (c.encoder_sin_rad, c.encoder_cos_rad),
    }.get(candidate.kind.name, (0.0,) * len(candidate.kind.linear))


def _corrected(c: Corrections, slot: Slot, value: float) -> Corrections:
    motor = slot.motor or 0

    def put(values: tuple[float, ...]) -> tuple[float, ...]:
        everywhere = slot.motor is None
        return tuple(v + value if everywhere or i == motor else v for i, v in enumerate(values))

    if slot.name == "torque_delay":
        return replace(c, torque_delay_s=put(c.torque_delay_s))
    if slot.name == "torque_lag":
        return replace(c, torque_lag_s=put(c.torque_lag_s))
    if slot.name == "deflection_offset":
        return replace(c, offset_rad=put(c.offset_rad))
    if slot.name == "encoder_delay":
        return replace(c, encoder_delay_s=c.encoder_delay_s + value)
    if slot.name == "encoder_scale":
        return replace(c, encoder_scale=c.encoder_scale + value)
    if slot.part == 0:
        return replace(c, encoder_sin_rad=c.encoder_sin_rad + value)
    return replace(c, encoder_cos_rad=c.encoder_cos_rad + value)


def _restored(c: Corrections, declared: Corrections, candidate: Candidate) -> Corrections:
    """Corrections with those of one effect as declared."""
    now, before = _read(c, candidate), _read(declared, candidate)
    name = candidate.kind.name
    if name not in _READINGS:
        return c
    for p, (x, x0) in enumerate(zip(now, before, strict=True)):
        c = _corrected(c, Slot("term", name, candidate.motor, None, 0, p, 0.0), x0 - x)
    return c
