"""Model-based estimation from whole recordings: what `drivelink fit` does.

It is the hypothesis without missing effects of `estimator.diagnosis`: the declared joint at its best fit,
with the errors that every rig has, within the priors of `estimator.priors`. Optional errors (delays of the
readings, friction of a rigid joint) are kept only if the data support them.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from estimator.choices import choice, least_rows, log_odds
from estimator.diagnosis.bandwidth import choose_bandwidth, require_bandwidth
from estimator.diagnosis.covariance import design_effects, hac_covariance
from estimator.diagnosis.findings import DELAYS, stamped_wrongly
from estimator.diagnosis.frame import Frame
from estimator.diagnosis.heldout import Held, held_out
from estimator.diagnosis.hypothesis import Fitted
from estimator.diagnosis.misdeclared import asked_for, believed
from estimator.diagnosis.order import bare, ordered, sharp
from estimator.diagnosis.problem import Problem
from estimator.diagnosis.search import Search
from estimator.diagnosis.stiffness import middle
from estimator.effects import sharpened
from estimator.errors import EstimatorError
from estimator.gate import check, without_hold
from estimator.model import JointModel, ParameterValue
from estimator.sample import SIGMA_95, FloatArray, Record
from estimator.transmissions import MODELS, RIGID, TransmissionModel

_OF_RIGID = ("coulomb_friction", "torque_offset")
_NUISANCES = {  # everyday errors by the names of `TransmissionFit.nuisance_std`
    "inertia": "motor_inertia",
    "damping": "viscous_damping",
    "coulomb": "coulomb_friction",
    "offset": "torque_offset",
    "shift": "deflection_offset",
    "link_delay": "encoder_delay",
    "torque_delay": "torque_delay",
}

Key = tuple[str, int | None]  # an everyday error and its motor


@dataclass(frozen=True, slots=True, kw_only=True)
class TransmissionFit:
    """One motor and its transmission, fitted to recordings.

    Attributes:
        model: transmission model's name.
        parameters: by their names in the joint file; empty where it is rigid, or not determined.
        std: their standard deviations, by the same names.
        alpha: parameters as an array.
        covariance: of alpha.
        deflection_rad: (rows,) filtered deflections, for plots.
        deflection_rate_rad_s: (rows,) their derivatives.
        velocity_rad_s: (rows,) filtered motor velocities.
        torque_nm: (rows,) flexibility torque by the motor's balance there, nuisances removed.
        unexplained_nm: (rows,) residual of the motor's balance there, undeclared friction included.
        error_rms_nm: rms residual of the motor's balance.
        torque_rms_nm: of the flexibility torque; of the motor torque, where that is not determined.
        inertia_kg_m2: B, as fitted.
        viscous_damping_nm_s_rad: D, likewise.
        coulomb_nm: friction beyond what is declared; mean of the recordings.
        offset_nm: constant torque of a rigid joint, likewise.
        deflection_offset_rad: zero of the deflection against the encoders', likewise.
        link_delay_s: by which the link encoder is late, beyond what is declared.
        torque_delay_s: by which the torque acts later than reported, likewise.
        nuisance_std: standard deviations of the last seven: "inertia", "damping", "coulomb", "offset",
            "shift", "link_delay", "torque_delay".
        excited: whether the recordings determine the stiffness (`estimator.diagnosis.stiffness.Middle`).
    """

    model: str
    parameters: dict[str, ParameterValue] = field(default_factory=dict)
    std: dict[str, ParameterValue] = field(default_factory=dict)
    alpha: FloatArray
    covariance: FloatArray
    deflection_rad: FloatArray
    deflection_rate_rad_s: FloatArray
    velocity_rad_s: FloatArray
    torque_nm: FloatArray
    unexplained_nm: FloatArray
    error_rms_nm: float
    torque_rms_nm: float
    inertia_kg_m2: float
    viscous_damping_nm_s_rad: float
    coulomb_nm: float
    offset_nm: float
    deflection_offset_rad: float
    link_delay_s: float
    torque_delay_s: float
    nuisance_std: dict[str, float]
    excited: bool

    @property
    def stiffens(self) -> bool:
        """Whether the stiffness is positive, its 95 % interval too, at every deflection of the recordings."""
        law = MODELS[self.model]
        phi = np.abs(self.deflection_rad)
        slopes = law.stiffness_jacobian(phi, self.alpha)
        std = np.sqrt(np.maximum(np.einsum("ij,jk,ik->i", slopes, self.covariance, slopes), 0.0))
        return bool(np.all(law.stiffness(phi, self.alpha) > SIGMA_95 * std))


class JointFit(NamedTuple):
    """A fitted joint."""

    search: Search  # the effects that may be missing
    # mean square of the errors on held-out data over that on the fitted data, see `Held.surplus`
    surplus: float
    fitted: Fitted  # the hypothesis
    # (k, k) of its parameters; includes the uncertainty whether a reading has an error at all
    covariance: FloatArray
    absent: frozenset[Key] = frozenset()  # optional errors that the data do not support
    doubts: tuple[str, ...] = ()  # time stamps that may be wrong, one line each
    smoothing_rad_s: float | None = None  # see `estimator.diagnosis.order.sharp`

    @property
    def problem(self) -> Problem:
        """The recordings without rows that contain NaN, and the joint with its orders chosen."""
        return self.search.problem

    @property
    def held(self) -> Held:
        """Each recording in turn, or blocks of the only one."""
        return self.search.held

    def places(self, key: Key) -> list[int]:
        """Return the columns of an everyday error: its parts, or its values in each recording."""
        return [
            j for j, s in enumerate(self.fitted.slots) if s.kind == "everyday" and (s.name, s.motor) == key
        ]

    def spring(self, motor: int) -> list[int]:
        """Return the columns of a transmission's parameters."""
        return _spring_columns(self.fitted, motor)

    def values(self, key: Key) -> FloatArray:
        """Return the estimated error beyond the declared value, in the same order."""
        mine = self.places(key)
        return np.zeros(len(mine)) if key in self.absent else _totals(self.fitted)[mine]

    def supports(self, key: Key) -> bool:
        """Return whether the data support an everyday error beyond the declared value."""
        return key not in self.absent and _odds_of_zero(self, [key]) <= log_odds(choice("even"))

    def mean(self, name: str, motor: int | None) -> tuple[float, float]:
        """Return an error and its standard deviation, the mean of the recordings where each has its own."""
        mine = self.places((name, motor))
        if not mine:
            return 0.0, 0.0
        variance = float(np.sum(self.covariance[np.ix_(mine, mine)])) / len(mine) ** 2
        return float(np.mean(self.values((name, motor)))), math.sqrt(max(variance, 0.0))


def fit(
    record: Record | Sequence[Record], model: JointModel, bandwidth_rad_s: float | None = None
) -> list[TransmissionFit]:
    """Fit every transmission of a joint to recordings; one entry per motor.

    A rigid transmission's entry has no parameters; an unknown one is fitted by a polynomial.

    Args:
        record: measured data, of one or several runs.
        model: declared joint; its transmission parameters, if any, are not used, its effects are honoured.
        bandwidth_rad_s: of the filter that all channels share; left out: chosen from the data.

    Raises:
        EstimatorError: a recording lacks what is needed, is too short, or nothing moves in it.
    """
    return transmission_fits(fit_joint(record, model, bandwidth_rad_s))


def fit_joint(
    record: Record | Sequence[Record], model: JointModel, bandwidth_rad_s: float | None = None
) -> JointFit:
    """Fit the whole joint; arguments and errors as in `fit`."""
    records = [record] if isinstance(record, Record) else list(record)
    usable = [_whole(one, model) for one in records]
    for one in usable:
        check(one, model)
    model = asked_for(usable, without_hold(usable, model))
    if bandwidth_rad_s is None:
        bandwidth_hz = choose_bandwidth(usable, model)
    else:
        bandwidth_hz = bandwidth_rad_s / (2.0 * math.pi)
    require_bandwidth(bandwidth_hz, usable)

    def made(model: JointModel, like: Problem | None) -> Problem:
        return _joint_problem(usable, model, bandwidth_hz, like)

    open_ = bare(model)
    smoothing_rad_s = sharp(open_, made)
    problem, fitted = ordered(believed(sharpened(open_, smoothing_rad_s), made), made)
    held = held_out(problem)
    search = Search(problem, held, null=fitted)
    surplus = held.surplus(fitted)
    free = JointFit(search, surplus, fitted, _covariance(search, fitted, surplus))
    stamps = (_stamped_wrongly(free, key) for key in _optional(free))
    doubts = tuple(dict.fromkeys(one for one in stamps if one))
    return _aligned(free._replace(doubts=doubts, smoothing_rad_s=smoothing_rad_s))


def _joint_problem(
    records: Sequence[Record], model: JointModel, bandwidth_hz: float, like: Problem | None = None
) -> Problem:
    """The regression of a healthy joint.

    Raises:
        EstimatorError: too short for the bandwidth, or a deflection that does not change.
    """
    problem = Problem(records, model, bandwidth_hz, calibrating=True, least=least_rows(), like=like)
    for i, motor in enumerate(model.motors):
        if motor.flexible and not any(np.ptp(f.motors[i].deflection) > 0.0 for f in problem.frames):
            raise EstimatorError("recording: expected a deflection that changes, it stands still")
    return problem


def _whole(record: Record, model: JointModel) -> Record:
    """The recording without rows that contain NaN; they become gaps."""
    good = np.all(np.isfinite(record.motor_position_rad) & np.isfinite(record.motor_torque_nm), axis=1)
    if model.has_deflection and record.link_position_rad is not None:
        good &= np.isfinite(record.link_position_rad)

    return record if np.all(good) else record.rows(good)


def _aligned(free: JointFit) -> JointFit:
    """The fit without unsupported optional errors, removed one at a time, the least probable first.

    A delay beyond those of any drive or bus is none, whatever the data say. The covariance is that of the
    mixture of both hypotheses, weighted by their odds.
    """
    joint, problem = free, free.problem
    while True:
        odds = {
            key: math.inf if _stamped_wrongly(joint, key) else _odds_of_zero(joint, [key])
            for key in _optional(joint)
        }
        doubtful = [key for key in odds if odds[key] > log_odds(choice("even"))]
        if not doubtful:
            break
        absent = joint.absent | {max(doubtful, key=lambda key: odds[key])}
        pinned = dict.fromkeys(absent, (0.0,))
        fitted = problem.fit((), joint.fitted.base, joint.fitted.corrections, pinned=pinned)
        covariance = _covariance(joint.search, fitted, joint.surplus)
        joint = joint._replace(fitted=fitted, covariance=covariance, absent=absent)
    if not joint.absent:
        return joint
    weight = 1.0 / (1.0 + math.exp(min(_odds_of_zero(free, sorted(joint.absent, key=str)), 700.0)))
    apart = _totals(free.fitted) - _totals(joint.fitted)
    mixed = (1.0 - weight) * joint.covariance + weight * (free.covariance + np.outer(apart, apart))
    return joint._replace(covariance=mixed)


def _stamped_wrongly(joint: JointFit, key: Key) -> str | None:
    """One sentence on a delay beyond those of any drive or bus."""
    delay = max((float(x) for x in joint.values(key)), key=abs)
    return stamped_wrongly(key[0], delay, joint.problem.period_s)


def _covariance(search: Search, fitted: Fitted, surplus: float) -> FloatArray:
    """Covariance of the parameters, with what undeclared effects change that the data support.

    The springs' also has what others may contribute. One held at its bound by a sign constraint keeps its
    prior variance.
    """
    problem = search.problem
    covariance = hac_covariance(problem, fitted, surplus)
    springs = [mine for i in range(len(problem.model.motors)) if (mine := _spring_columns(fitted, i))]
    if springs:
        first = [mine[0] for mine in springs]
        effect = float(np.max(design_effects(problem, fitted, surplus)[first]))
        unseen, instead = search.unseen(fitted, first, effect)
        covariance = covariance + instead
        for mine in springs:
            covariance[np.ix_(mine, mine)] += unseen[np.ix_(mine, mine)]
    held = np.flatnonzero(fitted.posterior.bound & [s.kind in ("everyday", "base") for s in fitted.slots])
    covariance[held, held] = np.maximum(covariance[held, held], fitted.regression.std[held] ** 2)
    return covariance


def _optional(joint: JointFit) -> list[Key]:
    """Optional errors: delays, and friction and offset of a rigid joint; a zero is always there."""
    motors = joint.problem.model.motors
    keys = {(s.name, s.motor) for s in joint.fitted.slots if s.kind == "everyday"}
    rigid = {(name, i) for i, motor in enumerate(motors) if not motor.flexible for name in _OF_RIGID}
    return sorted((k for k in keys - joint.absent if k[0] in DELAYS or k in rigid), key=str)


def _odds_of_zero(joint: JointFit, keys: Sequence[Key]) -> float:
    """Log odds that there are no such errors: the Savage-Dickey density ratio.

    Posterior over prior density at zero (Dickey, Annals of Mathematical Statistics 42, 1971), with the
    covariance for correlated errors.
    """
    mine = [j for key in keys for j in joint.places(key)]
    wide = joint.fitted.regression.std[mine]
    x = _totals(joint.fitted)[mine] / wide
    covariance = joint.covariance[np.ix_(mine, mine)] / np.outer(wide, wide)
    covariance = covariance + 1e-12 * np.eye(len(mine))
    return float(-0.5 * x @ np.linalg.solve(covariance, x) - 0.5 * np.linalg.slogdet(covariance)[1])


def _totals(fitted: Fitted) -> FloatArray:
    """(k,) the quantity of each column, including corrections already applied."""
    return np.array([s.taken for s in fitted.slots]) + fitted.posterior.x


def _friction(joint: JointFit, motor: int) -> FloatArray:
    """(rows,) torque of the fitted, undeclared friction."""
    mine = joint.places(("coulomb_friction", motor))
    design, x = joint.fitted.regression.design, joint.fitted.posterior.x
    return np.asarray(design[:, mine] @ x[mine], dtype=np.float64)


def _rows_of(frames: Sequence[Frame], motor: int, coordinate: str) -> FloatArray:
    """(rows,) a motor's filtered coordinate over all recordings."""
    return np.concatenate([f.project(getattr(f.motors[motor], coordinate)) for f in frames])


def transmission_fits(joint: JointFit) -> list[TransmissionFit]:
    """Return the result of a fit for each motor and its transmission."""
    problem, fitted = joint.problem, joint.fitted
    frames = problem.at(fitted.corrections, fitted.base)
    base = fitted.moved_base(problem.frames[0])
    pairs = zip(base.models(frames[0]), base.alpha, strict=True)
    return [_transmission_fit(joint, frames, i, *one) for i, one in enumerate(pairs)]


def _spring_columns(fitted: Fitted, motor: int) -> list[int]:
    """Columns of a transmission's parameters."""
    return [j for j, s in enumerate(fitted.slots) if s.kind == "base" and s.motor == motor]


def _transmission_fit(
    joint: JointFit,
    frames: Sequence[Frame],
    i: int,
    law: TransmissionModel | None,
    alpha: FloatArray,
) -> TransmissionFit:
    """The result of a fit for the i-th motor."""
    problem, fitted, motor = joint.problem, joint.fitted, joint.problem.model.motors[i]
    rows, mine = problem.group % problem.equations == i, _spring_columns(fitted, i)
    covariance = joint.covariance[np.ix_(mine, mine)]
    left = fitted.regression.residual(fitted.posterior.x)
    spring = np.concatenate([fitted.base.torque(frame) for frame in frames])
    torque = (spring + fitted.regression.design[:, mine] @ fitted.posterior.x[mine])[rows]
    phi = np.concatenate([f.motors[i].deflection for f in frames])
    excited = law is not None and middle(law, alpha, covariance, phi).determined
    excited = excited and not any(fitted.posterior.bound[mine])
    error_rms_nm = float(np.sqrt(np.mean(left[rows] ** 2)))
    excited = excited and error_rms_nm <= float(np.std(torque))  # else it is of what is not explained
    std = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    errors = {
        name: joint.mean(error, None if error == "encoder_delay" else i) for name, error in _NUISANCES.items()
    }
    return TransmissionFit(
        model=RIGID if law is None else law.name,
        parameters=law.parameters(alpha) if law is not None and excited else {},
        std=law.parameters(std) if law is not None and excited else {},
        alpha=alpha,
        covariance=covariance,
        deflection_rad=_rows_of(frames, i, "deflection"),
        deflection_rate_rad_s=_rows_of(frames, i, "deflection_rate"),
        velocity_rad_s=_rows_of(frames, i, "velocity"),
        torque_nm=torque + left[rows],
        unexplained_nm=(left + _friction(joint, i))[rows],
        error_rms_nm=error_rms_nm,
        torque_rms_nm=float(np.std(torque if excited else problem.torque()[rows])),
        inertia_kg_m2=motor.inertia_kg_m2 + errors["inertia"][0],
        viscous_damping_nm_s_rad=max(motor.viscous_damping_nm_s_rad + errors["damping"][0], 0.0),
        coulomb_nm=errors["coulomb"][0],
        offset_nm=errors["offset"][0],
        deflection_offset_rad=errors["shift"][0],
        link_delay_s=errors["link_delay"][0] if motor.flexible else 0.0,
        torque_delay_s=errors["torque_delay"][0],
        nuisance_std={name: std for name, (_, std) in errors.items()},
        excited=excited,
    )
