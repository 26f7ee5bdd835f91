"""Designs the motion that tells rivals apart: the one to record next.

Each rival is simulated along a motion. All rivals are then fitted to what each would read, and judged as
`diagnose` judges them: by blocks that are left out. The motion by which the true one gains most over each
other is searched (differential evolution). It has many frequencies, begins slowly and reaches a limit: what
nobody thought of shows, too.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.optimize import Bounds, differential_evolution, lsq_linear

from estimator.choices import choice, whole
from estimator.diagnosis.candidates import Candidate, grid
from estimator.diagnosis.design_matrix import Term
from estimator.diagnosis.fourier import Limits, Shape
from estimator.diagnosis.frame import count_of
from estimator.diagnosis.heldout import Held
from estimator.diagnosis.hypothesis import Fitted
from estimator.diagnosis.law_parameters import start
from estimator.diagnosis.problem import Problem
from estimator.diagnosis.result import Diagnosis
from estimator.diagnosis.search import Progress, Search
from estimator.driven import driven
from estimator.errors import EstimatorError
from estimator.model import Effect, JointModel, LinkDynamics, Motor
from estimator.sample import FloatArray, Record

__all__ = ["NextMotion", "design"]

_POPULATION, _GENERATIONS = 16, 3
_STEPS = 16.0  # of the simulation in a period of the bandwidth


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class NextMotion:
    """The motion to record next.

    Attributes:
        time_s: (n,).
        position_rad, velocity_rad_s, acceleration_rad_s2: (n, m) of the motors.
        torque_nm: (n, m) that the likeliest rival needs.
        rivals: in words, the likeliest first.
        now: probability of each by the recordings at hand.
        told: (r, r) probability of each (column) that a diagnosis of this motion is expected to state, where
            one (row) is the true one.
        limits: that it keeps.
    """

    time_s: FloatArray
    position_rad: FloatArray
    velocity_rad_s: FloatArray
    acceleration_rad_s2: FloatArray
    torque_nm: FloatArray
    rivals: tuple[str, ...]
    now: tuple[float, ...]
    told: FloatArray
    limits: Limits

    @property
    def decides(self) -> float:
        """Probability that the true rival is told, by their present probabilities."""
        return float(np.dot(self.now, np.diag(self.told)))

    @property
    def decided(self) -> float:
        """The same of the recordings at hand."""
        return float(np.dot(self.now, self.now))


def design(
    records: Sequence[Record],
    model: JointModel,
    outcome: Diagnosis,
    limits: Limits | None = None,
    seconds: float = 12.0,
    progress: Progress = lambda _: None,
) -> NextMotion:
    """Design the motion that tells apart what a diagnosis leaves open.

    Args:
        records: the diagnosed ones.
        model: as it was declared.
        outcome: of the diagnosis.
        limits: of the motors; None: what the recordings reach.
        seconds: its length.
        progress: called with the current step.

    Raises:
        EstimatorError: there are no rivals, or no motion within the limits.
    """
    from scipy.stats import qmc  # takes as long to load as all the rest

    progress("rivals")
    problem = Problem(records, model, outcome.bandwidth_hz)
    inside = limits or Limits.declared(records)
    rivals = _Rivals(problem, outcome, seconds, inside)
    size, generation = Shape.size(len(model.motors)), iter(range(_GENERATIONS + 1))

    def loss(numbers: Any) -> Any:
        progress(f"motion {next(generation, _GENERATIONS)} of {_GENERATIONS}")
        return -rivals.score(Shape(np.atleast_2d(numbers.T), seconds, inside))

    first = 2.0 * qmc.LatinHypercube(size, rng=0).random(_POPULATION) - 1.0
    best = differential_evolution(
        loss, Bounds(-np.ones(size), np.ones(size)), popsize=1, maxiter=_GENERATIONS, polish=False,
        vectorized=True, updating="deferred", rng=0, init=first,
    )  # fmt: skip
    return rivals.motion(Shape(best.x[None], seconds, inside))


class _Rivals:
    """What may be missing: each fitted to the recordings, and as a model to simulate."""

    def __init__(self, problem: Problem, outcome: Diagnosis, seconds: float, limits: Limits) -> None:
        search = Search(problem)
        found, fitted = _fitted(search, outcome)
        now = search.held.weights(fitted, found)
        order = np.argsort(-now, kind="stable")[: whole("motion_rivals")]
        likely = int(np.sum(now[order] > choice("even") * now[order[0]]))
        order = order[: max(2, likely)]  # others the recordings have ruled out
        self.problem, self.limits = problem, limits
        link = problem.model.link or _link(problem, found)
        step = 1.0 / (_STEPS * problem.bandwidth_hz * problem.period_s)
        self.period_s = problem.period_s * max(1, math.floor(step))
        models = [_model(problem, fitted[k], link) for k in order]
        plain = Shape(np.zeros((1, Shape.size(len(problem.model.motors)))), seconds, limits)
        path = self.within(plain, models[:1], whole("newton_steps")).path(self.period_s)
        steady = [math.isfinite(_over(driven(path, model)[0], limits)) for model in models]
        self.models = [model for model, holds in zip(models, steady, strict=True) if holds]
        order = order[steady]  # the law of another one does not hold as far as the joint is to move
        if len(order) < 2:
            raise EstimatorError("the diagnosis leaves no rivals that a motion could tell apart")
        self.fitted = [fitted[k] for k in order]
        self.now = now[order] / np.sum(now[order])
        self.noise = _noise(problem, self.fitted[0], self.period_s, seconds)

    def score(self, shape: Shape) -> FloatArray:
        """Return (w,) how far each motion tells the rivals apart: mean of how surely each is told."""
        path = self.within(shape, self.models[:1], 1).path(self.period_s)
        runs = [[self.read(run) for run in driven(path, model)] for model in self.models]
        made = []
        for k in range(len(shape.numbers)):
            each = [run[k] for run in runs]
            over = max(_over(run, self.limits) for run in each)
            if not math.isfinite(over):
                made.append(0.0)  # a rival that leaves the world
                continue
            least = np.array([self.least(i, run) for i, run in enumerate(each)])
            made.append(float(np.mean(least / (1.0 + least))) / max(over, 1.0) ** 2)
        return np.array(made)

    def within(self, shape: Shape, models: Sequence[JointModel], passes: int) -> Shape:
        """Return the motions, smaller where one of the models needs more torque than the limits have."""
        for _ in range(passes):
            path = shape.path(self.period_s)
            over = np.max([[_over(run, self.limits) for run in driven(path, one)] for one in models], axis=0)
            if np.all(over <= 1.0):
                break
            less = np.where(over > 1.0, choice("motion_margin") / over, 1.0)
            shape = shape._replace(share=shape.share * less)
        return shape

    def read(self, run: Record) -> Record:
        """Return a recording as it is read: rounded, and with what the fit leaves of the one at hand."""
        theta, q, torque = self.noise
        link = None if run.link_position_rad is None else run.link_position_rad + q[:, 0]
        return replace(
            run, motor_position_rad=run.motor_position_rad + theta, link_position_rad=link,
            motor_torque_nm=run.motor_torque_nm + torque,
        )  # fmt: skip

    def least(self, i: int, run: Record) -> float:
        """Return how many times more than `diagnose` asks for the i-th rival, which made a recording, gains
        over the best of the others; none where it is a ripple that this motion is too short for.
        """
        held, fitted = self._judged(run, 0)
        if not all(_shown(held.problem, term) for term in fitted[i].terms):
            return 0.0
        return max(min(held.margin(fitted[i], one) for j, one in enumerate(fitted) if j != i), 0.0)

    def _judged(self, run: Record, steps: int | None) -> tuple[Held, list[Fitted]]:
        """What decides about a recording, and all rivals fitted to it."""
        problem = self.problem.alike([run])
        base = start(problem.frames[0])
        fitted = [problem.fit(one.terms, base, one.corrections[:1], steps) for one in self.fitted]
        return Held(problem), fitted

    def motion(self, shape: Shape) -> NextMotion:
        """Return one motion, small enough for the limits of torque whatever is the true rival."""
        shape = self.within(shape, self.models, whole("newton_steps"))
        runs = [driven(shape.path(self.period_s), model)[0] for model in self.models]
        if not all(_over(run, self.limits) <= 1.0 for run in runs):
            raise EstimatorError(
                "limits: expected a torque that holds the joint and moves it, it is too small"
            )
        judged = [self._judged(self.read(run), None) for run in runs]
        path = shape.path(self.problem.period_s)
        time = np.asarray(np.arange(len(path.position)) * path.period_s, dtype=np.float64)
        torque = [np.interp(time, runs[0].time_s, x) for x in runs[0].motor_torque_nm.T]
        return NextMotion(
            time_s=time, position_rad=path.position[:, 0], velocity_rad_s=path.velocity[:, 0],
            acceleration_rad_s2=path.acceleration[:, 0], torque_nm=np.column_stack(torque),
            rivals=tuple(map(_words, self.fitted)), now=tuple(self.now.tolist()),
            told=np.array([held.weights(fitted, fitted[i]) for i, (held, fitted) in enumerate(judged)]),
            limits=self.limits,
        )  # fmt: skip


def _noise(
    problem: Problem, likeliest: Fitted, period_s: float, seconds: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Rounding of the motors' readings (n, m) and the link's (n, 1), as of so many samples' mean; and (n, m)
    of torque, what the likeliest rival leaves of the first recording, repeated.
    """
    record, rows = problem.records[0], round(seconds / period_s)
    draw, every = np.random.default_rng(0), round(period_s / problem.period_s)
    link = record.link_position_rad
    read = (record.motor_position_rad, record.motor_position_rad if link is None else link[:, None])
    theta, q = (
        np.array([count_of(x) for x in each.T])
        * draw.normal(size=(rows, each.shape[1]))
        / math.sqrt(12.0 * every)
        for each in read
    )
    left, step_s = likeliest.regression.residual(likeliest.posterior.x), problem.signals[0].narrow.period_s
    at = np.arange(rows) * period_s / step_s
    torque = [
        np.interp(at % (len(mine) - 1), np.arange(len(mine)), mine)
        for mine in (left[problem.group == i] for i in range(record.motor_position_rad.shape[1]))
    ]
    return theta, q, np.column_stack(torque)


def _over(run: Record, limits: Limits) -> float:
    """Largest torque over its limit, of all motors."""
    return float(np.max(np.abs(run.motor_torque_nm) / limits.torque_nm))


def _shown(problem: Problem, term: Term) -> bool:
    """Whether a motion is long enough for a ripple to be one."""
    if "periods_per_rev" not in term.values:
        return True
    slowest = grid(problem.frames[0], term.candidate, problem.smoothing_rad_s, 1)
    return any(values["periods_per_rev"] <= term.values["periods_per_rev"] for values in slowest)


def _words(fitted: Fitted) -> str:
    names = [term.candidate.kind.name for term in fitted.terms]
    return " and ".join(names) or "nothing"


def _fitted(search: Search, outcome: Diagnosis) -> tuple[Fitted, list[Fitted]]:
    """What was found, and with it what a diagnosis holds against it: the declared model, and for each effect
    nothing or another one, also of a law that the motion hides.
    """
    found = search.null
    for effect in outcome.effects:
        found = search.with_effect(found, effect.name, effect.motor) or found
    made = {search.null.keys: search.null, found.keys: found}
    near: list[tuple[Fitted, Candidate | None]] = [
        (search.problem.without(found, k), term.candidate) for k, term in enumerate(found.terms)
    ]
    for rest, like in near or [(search.null, None)]:
        for one in [rest, *search.grown(rest, like)]:
            seen = one is rest or one.is_real_beside(rest)
            made.setdefault(one.keys, one if seen else _hidden(search.problem, rest, one.terms[-1].candidate))
    return found, list(made.values())


def _hidden(problem: Problem, rest: Fitted, candidate: Candidate) -> Fitted:
    """An effect that the motion holds at zero, with the shape that it hides best."""
    each = [
        problem.added(rest, Term(candidate, values), 0)
        for values in grid(problem.frames[0], candidate, problem.smoothing_rad_s, whole("ripples"))
    ]
    return max(each, key=lambda one: float(np.sum(_std(one)[[s.kind == "term" for s in one.slots]])))


def _std(fitted: Fitted) -> FloatArray:
    """(k,) standard deviations, free of bounds."""
    free = replace(fitted.regression, low=np.full_like(fitted.regression.low, -np.inf))
    return np.sqrt(np.maximum(np.diag(free.solve(fitted.times, fitted.posterior).covariance), 0.0))


def _model(problem: Problem, fitted: Fitted, link: LinkDynamics) -> JointModel:
    """A fitted hypothesis as a model; an effect is as large as its standard deviation at least."""
    std = _std(fitted)
    motors, at_link = [[*m.effects] for m in problem.model.motors], [*problem.model.link_effects]
    for k, term in enumerate(fitted.terms):
        kind = term.candidate.kind
        unsure = [std[j] for j, s in enumerate(fitted.slots) if s.kind == "term" and s.place == k]
        sizes = [math.copysign(max(abs(w), s), w) for w, s in zip(term.weights, unsure, strict=True)]
        effect = Effect(
            name=kind.name, parameters={**dict(zip(kind.linear, sizes, strict=True)), **term.values}
        )
        (at_link if kind.on_link else motors[term.candidate.motor or 0]).append(effect)
    fit = fitted.moved_base(problem.frames[0]).parameters(problem.frames[0])
    declared = [dict(motor.transmission.parameters) for motor in problem.model.motors]
    parameters = [
        known or own for known, own in zip(declared, fit, strict=True)
    ]  # a poor motion reveals no spring
    made: list[Motor] = [
        replace(
            motor,
            effects=tuple(mine),
            transmission=replace(motor.transmission, parameters=own, covariance=None),
        )
        for motor, mine, own in zip(problem.model.motors, motors, parameters, strict=True)
    ]
    return replace(problem.model, motors=tuple(made), link=link, link_effects=tuple(at_link))


def _link(problem: Problem, fitted: Fitted) -> LinkDynamics:
    """The dynamics of a link that nobody declared, by eq 4 and the fitted spring."""
    (frame, *_), motors = (
        problem.at(fitted.corrections, fitted.moved_base(problem.frames[0])),
        problem.model.motors,
    )
    c = frame.motors[0]
    q = c.link_position
    columns = [c.link_acceleration, c.link_velocity, np.sin(q), np.cos(q)]
    carried = sum(m.flexibility_torque for m, pulls in zip(frame.motors, frame.pulls, strict=True) if pulls)
    rows = np.stack([frame.project(x) for x in columns], axis=1)
    low = [choice("least_link") * motors[0].inertia_kg_m2, 0.0, -np.inf, -np.inf]
    inertia, damping, sine, cosine = lsq_linear(
        rows, frame.project(frame.external - carried), (low, np.inf)
    ).x
    return LinkDynamics(
        inertia_kg_m2=float(inertia), viscous_damping_nm_s_rad=float(damping),
        gravity_nm=float(np.hypot(sine, cosine)), gravity_phase_rad=float(np.arctan2(cosine, sine)),
    )  # fmt: skip
