"""Designs the motion that tells rivals apart: the one to record next.

Each rival is simulated along a motion. All rivals are then fitted to what each would read, with the errors of
the recording at hand; the motion with the largest odds for the true one is searched (differential evolution).
A motion moves about as fast at each of its frequencies: what nobody thought of shows, too.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.optimize import Bounds, differential_evolution, lsq_linear
from scipy.special import softmax

from estimator.choices import choice, whole
from estimator.diagnosis.base import start
from estimator.diagnosis.hypothesis import Fitted, Problem, count_of
from estimator.diagnosis.result import Diagnosis
from estimator.diagnosis.search import Progress, Search
from estimator.diagnosis.shape import Limits, Shape
from estimator.driven import Path, driven
from estimator.errors import EstimatorError
from estimator.model import Effect, JointModel, LinkDynamics, Motor
from estimator.sample import FloatArray, Record

__all__ = ["NextMotion", "design"]

_POPULATION, _GENERATIONS = 12, 6
_STEPS = 16.0  # of the simulation in a period of the bandwidth

Name = tuple[str, int | None]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class NextMotion:
    """The motion to record next.

    Attributes:
        time_s: (n,).
        position_rad, velocity_rad_s, acceleration_rad_s2: (n, m) of the motors.
        torque_nm: (n, m) that the likeliest rival needs.
        rivals: in words, the likeliest first.
        now: probability of each by the recordings at hand.
        expected: probability that each is told, where it is the true one.
        odds: (r, r) expected log odds of the true rival (row) over each.
        limits: that it keeps.
    """

    time_s: FloatArray
    position_rad: FloatArray
    velocity_rad_s: FloatArray
    acceleration_rad_s2: FloatArray
    torque_nm: FloatArray
    rivals: tuple[str, ...]
    now: tuple[float, ...]
    expected: tuple[float, ...]
    odds: FloatArray
    limits: Limits

    @property
    def decides(self) -> float:
        """Probability that the true rival is told, by their present probabilities."""
        return float(np.dot(self.now, self.expected))


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
    progress("rivals")
    problem = Problem(records, model, outcome.bandwidth_hz)
    rivals = _Rivals(problem, outcome, seconds)
    inside = limits or Limits.declared(records)
    size, generation = Shape.size(len(model.motors)), iter(range(_GENERATIONS + 1))

    def loss(numbers: Any) -> Any:
        progress(f"motion {next(generation, _GENERATIONS)} of {_GENERATIONS}")
        return -rivals.score(Shape(np.atleast_2d(numbers.T), seconds, inside).path(rivals.period_s), inside)

    first = np.random.default_rng(0).uniform(-1.0, 1.0, (_POPULATION, size))
    best = differential_evolution(
        loss, Bounds(-np.ones(size), np.ones(size)), popsize=1, maxiter=_GENERATIONS, polish=False,
        vectorized=True, updating="deferred", rng=0, init=first,
    )  # fmt: skip
    return rivals.motion(Shape(best.x[None], seconds, inside))


class _Rivals:
    """What may be missing: each fitted to the recordings, and as a model to simulate."""

    def __init__(self, problem: Problem, outcome: Diagnosis, seconds: float) -> None:
        search = Search(problem)
        self.problem, self.fitted = problem, _fitted(search, outcome)
        if len(self.fitted) < 2:
            raise EstimatorError("the diagnosis leaves no rivals that a motion could tell apart")
        best = min(self.fitted, key=lambda one: float(np.sum(np.log(one.posterior.sigma))))
        scores = np.array([one.evidence(best) - search.held.price * len(one.terms) for one in self.fitted])
        order = np.argsort(-scores)
        self.fitted = [self.fitted[k] for k in order]
        self.now, self.price = softmax(scores[order]), search.held.price
        link = problem.model.link or _link(problem, best)
        self.models = [_model(problem, one, link) for one in self.fitted]
        step = 1.0 / (_STEPS * problem.bandwidth_hz * problem.period_s)
        self.period_s = problem.period_s * max(1, math.floor(step))
        each = (best.posterior.sigma, best.times * problem.signals[0].narrow.period_s)
        self.sigma, self.times_s = (x[: problem.equations] for x in each)
        self.noise = _noise(problem, round(self.period_s / problem.period_s), seconds)

    def score(self, path: Path, limits: Limits) -> FloatArray:
        """Return (w,) how far each motion tells the rivals apart: mean log of the least odds of each."""
        runs = [[self.read(run) for run in driven(path, model)] for model in self.models]
        made = []
        for k in range(path.position.shape[1]):
            if not all(np.all(np.isfinite(run[k].motor_torque_nm)) for run in runs):
                made.append(0.0)  # a rival that leaves the world
                continue
            least = np.min(self.odds([run[k] for run in runs], 0), axis=1)
            over = max(_over(run[k], limits) for run in runs)
            made.append(np.mean(np.log1p(np.maximum(least, 0.0))) / max(over, 1.0) ** 2)
        return np.array(made)

    def read(self, run: Record) -> Record:
        """Return a recording as the encoders read it."""
        theta, q = (noise[: len(run)] for noise in self.noise)
        link = None if run.link_position_rad is None else run.link_position_rad + q[:, 0]
        return replace(run, motor_position_rad=run.motor_position_rad + theta, link_position_rad=link)

    def odds(self, runs: Sequence[Record], steps: int | None = None) -> FloatArray:
        """Return (r, r) the log odds of the rival that made each recording over each; inf over itself."""
        made = np.full((len(runs),) * 2, np.inf)
        for i, run in enumerate(runs):
            problem = self.problem.alike([run])
            own = self._refitted(problem, i, steps)
            floor = np.maximum(own.regression.floor, self.sigma)
            times = np.maximum(self.times_s / problem.signals[0].narrow.period_s, 1.0)
            for j in range(len(runs)):
                if j != i:
                    other = self._refitted(problem, j, steps)
                    mine, theirs = (
                        replace(one.regression, floor=floor).solve(times, one.posterior).evidence
                        for one in (own, other)
                    )
                    price = self.price * (len(other.terms) - len(own.terms))
                    made[i, j] = mine - theirs + price
        return made

    def _refitted(self, problem: Problem, j: int, steps: int | None) -> Fitted:
        one = self.fitted[j]
        return problem.fit(one.terms, start(problem.frames[0]), one.corrections[:1], steps)

    def motion(self, shape: Shape) -> NextMotion:
        """Return one motion, small enough for the limits of torque."""
        limits, factor = shape.limits, 1.0
        for _ in range(whole("newton_steps")):
            path = shape.path(self.period_s).moved(-limits.centre_rad).scaled(factor).moved(limits.centre_rad)
            runs = [driven(path, model)[0] for model in self.models]
            over = max(_over(run, limits) for run in runs)
            if over <= 1.0:
                break
            factor *= choice("motion_margin") / over
        else:
            raise EstimatorError(
                "limits: expected a torque that holds the joint and moves it, it is too small"
            )
        odds = self.odds([self.read(run) for run in runs])
        fine = (
            shape.path(self.problem.period_s)
            .moved(-limits.centre_rad)
            .scaled(factor)
            .moved(limits.centre_rad)
        )
        time = np.asarray(np.arange(len(fine.position)) * fine.period_s, dtype=np.float64)
        torque = [np.interp(time, runs[0].time_s, x) for x in runs[0].motor_torque_nm.T]
        return NextMotion(
            time_s=time, position_rad=fine.position[:, 0], velocity_rad_s=fine.velocity[:, 0],
            acceleration_rad_s2=fine.acceleration[:, 0], torque_nm=np.column_stack(torque),
            rivals=tuple(map(_words, self.fitted)), now=tuple(self.now.tolist()),
            expected=tuple((1.0 / (1.0 + np.sum(np.exp(-np.clip(odds, -_most(), np.inf)), axis=1))).tolist()),
            odds=odds, limits=limits,
        )  # fmt: skip


def _most() -> float:
    return math.log(np.finfo(np.float64).max) / 2.0


def _noise(problem: Problem, every: int, seconds: float) -> tuple[FloatArray, FloatArray]:
    """Rounding of the motors' readings (n, m) and the link's (n, 1), as of so many samples' mean."""
    record, rows = problem.records[0], round(seconds / problem.period_s)
    draw = np.random.default_rng(0)
    link = record.link_position_rad
    read = (record.motor_position_rad, record.motor_position_rad if link is None else link[:, None])
    theta, q = (
        np.array([count_of(x) for x in each.T])
        * draw.normal(size=(rows, each.shape[1]))
        / math.sqrt(12.0 * every)
        for each in read
    )
    return theta, q


def _over(run: Record, limits: Limits) -> float:
    """Largest torque over its limit, of all motors."""
    return float(np.max(np.abs(run.motor_torque_nm) / limits.torque_nm))


def _words(fitted: Fitted) -> str:
    names = [term.candidate.kind.name for term in fitted.terms]
    return " and ".join(names) or "nothing"


def _fitted(search: Search, outcome: Diagnosis) -> list[Fitted]:
    """What was found, its alternatives, then single effects and nothing, fitted."""
    made: dict[frozenset[Name], Fitted] = {}
    for names in _sets(outcome):
        one = _with(search, names)
        if one is not None and len(made) < whole("motion_rivals"):
            made.setdefault(one.keys, one)
    return list(made.values())


def _sets(outcome: Diagnosis) -> Iterable[list[Name]]:
    """Sets of effects, the likeliest first."""
    found = [(f.name, f.motor) for f in outcome.effects if f.name != "unlisted"]
    yield found
    for k, finding in enumerate(outcome.effects):
        for name in finding.alternatives:
            yield [(name, finding.motor) if j == k else one for j, one in enumerate(found)]
    for rival in outcome.rivals[: whole("motion_rivals") - 1]:
        yield [(rival.name, rival.motor)]
    yield []


def _with(search: Search, names: Sequence[Name]) -> Fitted | None:
    """The declared model with these effects; None: the recording does not have one of them."""
    fitted = search.null
    for name, motor in names:
        grown = search.with_effect(fitted, name, motor)
        if grown is None:
            return None
        fitted = grown
    return search.problem.fit(fitted.terms, fitted.base, fitted.corrections)


def _model(problem: Problem, fitted: Fitted, link: LinkDynamics) -> JointModel:
    """A fitted hypothesis as a model; an effect is as large as its standard deviation at least."""
    std = np.sqrt(np.maximum(np.diag(fitted.posterior.covariance), 0.0))
    motors, at_link = [[*m.effects] for m in problem.model.motors], [*problem.model.link_effects]
    for k, term in enumerate(fitted.terms):
        kind = term.candidate.kind
        unsure = [std[j] for j, s in enumerate(fitted.slots) if s.kind == "term" and s.place == k]
        sizes = [math.copysign(max(abs(w), s), w) for w, s in zip(term.weights, unsure, strict=True)]
        effect = Effect(
            name=kind.name, parameters={**dict(zip(kind.linear, sizes, strict=True)), **term.values}
        )
        (at_link if kind.on_link else motors[term.candidate.motor or 0]).append(effect)
    fit = fitted.moved_base(problem).parameters(problem.frames[0])
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
    (frame, *_), motors = problem.at(fitted.corrections, fitted.moved_base(problem)), problem.model.motors
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
