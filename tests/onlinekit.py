"""What the tests of the on-line estimator share: the project's simulated joints as samples, and their truth.

Everything goes through the public interface, `make_estimator(...).step`, so it holds for whatever is behind.
"""

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from functools import cache
from typing import Any, NamedTuple

import joints
import numpy as np

from drivelink._core import Assembler, JointPipeline
from estimator import Estimator, EstimatorSettings, JointModel, Motor, Record, Sample, Status, Transmission
from estimator import make_estimator as make_estimator
from estimator.model_monitor import ModelMonitor
from sim.cases import case
from sim.effects import PlantEffect
from sim.plant import JointPlant, Spring
from sim.world import World, record

VALID, OBSERVABLE, NODE_RESTARTED = int(Status.VALID), int(Status.OBSERVABLE), int(Status.NODE_RESTARTED)
PERIOD_S = 0.001
WRONG_RELATIVE, WRONG_STD = 0.10, 5.0  # off by more than both: wrong (issue 18)
WRONG_TORQUE = 0.25  # of the torque's rms (issue 32)


class Motion(NamedTuple):
    """A joint in motion: what its sensors said, and its true stiffness and torque at each sample."""

    samples: list[Sample]
    stiffness_nm_rad: np.ndarray
    torque_nm: np.ndarray


class Estimates(NamedTuple):
    """What an estimator said of a motion, one entry a sample that it was given."""

    status: np.ndarray
    torque_nm: np.ndarray
    stiffness_nm_rad: np.ndarray
    std_nm_rad: np.ndarray

    @property
    def valid(self) -> np.ndarray:
        return self.status & VALID > 0

    @property
    def torque_valid(self) -> np.ndarray:
        return self.status & (VALID | int(Status.TORQUE_VALID)) > 0


def motion(
    name: str,
    seconds: float,
    *,
    seed: int = 0,
    excitation: Mapping[str, Any] | None = None,
    bits: int | None = None,
    noise: bool = True,
    effects: Sequence[PlantEffect] = (),
    step: tuple[float, float] | None = None,
) -> Motion:
    """One of the paper's cases in rich motion.

    Args:
        name: of the case.
        seconds: how long.
        seed: of the noise.
        excitation: another motion than the case's rich one.
        bits: of the encoders at motor and link alike, per revolution of the joint; None: the case's own.
        noise: whether current and encoders have any besides their steps (one count where `bits` is given).
        effects: physics that the case does not have.
        step: (time, factor) of a change of the stiffness.
    """
    if excitation is None and not effects and step is None:
        return _begun(name, seed, bits, noise).first(seconds)
    world = _world(name, seed, excitation, bits, noise, effects)
    if step is None:
        return moved(record(world, seconds))
    before = record(world, step[0])
    world.advance()
    world.alter(plant=_stiffer(case(name).plant, step[1]))
    after = record(world, seconds - step[0])
    return moved({name: np.concatenate([before[name], after[name]]) for name in before})


class _Begun:
    """A motion that is simulated on as far as a test asks for it."""

    def __init__(self, world: World) -> None:
        self.world, self.motion = world, Motion([], np.empty(0), np.empty(0))

    def first(self, seconds: float) -> Motion:
        samples, *columns = self.motion
        more = round(seconds / PERIOD_S) - len(samples)
        if more > 0:
            if samples:
                self.world.advance()
            found, *others = moved(record(self.world, more * PERIOD_S))
            samples = samples + [s._replace(sequence=k) for k, s in enumerate(found, len(samples))]
            columns = [np.concatenate(pair) for pair in zip(columns, others, strict=True)]
            self.motion = Motion(samples, *columns)
        n = round(seconds / PERIOD_S)
        return Motion(samples[:n], *(column[:n].copy() for column in columns))


@cache
def _begun(name: str, seed: int, bits: int | None, noise: bool) -> _Begun:
    return _Begun(_world(name, seed, None, bits, noise, ()))


def _world(
    name: str,
    seed: int,
    excitation: Mapping[str, Any] | None,
    bits: int | None,
    noise: bool,
    effects: Sequence[PlantEffect],
) -> World:
    given = case(name)
    drives, encoder = given.drives, given.encoder
    if bits is not None:
        drives = tuple(replace(drive, counts_per_rev=2.0**bits / drive.gear_ratio) for drive in drives)
        encoder = replace(encoder, counts_per_rev=2.0**bits, noise_counts=1.0 if noise else 0.0)
    if not noise:
        drives = tuple(replace(d, current_noise_a=0.0, current_resolution_a=1e-9) for d in drives)
    rich = given.rich if excitation is None else excitation
    return replace(given, drives=drives, encoder=encoder).world(excitation=rich, effects=effects, seed=seed)


def moved(rows: Mapping[str, np.ndarray]) -> Motion:
    """The columns as samples, with the truth beside them."""
    motors = [
        name.removesuffix("_position_rad") for name in rows if re.fullmatch("motor._position_rad", name)
    ]

    def stacked(quantity: str) -> list[tuple[float, ...]]:
        return list(zip(*(rows[f"{motor}_{quantity}"].tolist() for motor in motors), strict=True))

    columns = map(stacked, ("position_rad", "velocity_rad_s", "torque_nm"))
    together = zip(*columns, rows["link_position_rad"].tolist(), strict=True)
    samples = [Sample(k, *values) for k, values in enumerate(together)]
    return Motion(samples, rows["truth_stiffness_nm_rad"], rows["truth_flexibility_torque_nm"])


def recorded(samples: Sequence[Sample], sign: float = 1.0) -> Record:
    """The samples as a recording; torque and link position may have the other sign."""
    theta, tau, q = (
        np.array(column)
        for column in zip(
            *((s.motor_position_rad, s.motor_torque_nm, s.link_position_rad) for s in samples), strict=True
        )
    )
    return joints.recorded(theta, sign * tau, sign * q)


def _stiffer(plant: JointPlant, factor: float) -> JointPlant:
    """The joint with springs that are stiffer by a factor."""
    motors = []
    for motor in plant.motors:
        parameters = dict(motor.spring.parameters)
        for key in ("k_nm_rad", "coefficients_nm_rad"):
            if key in parameters:
                scaled = factor * np.asarray(parameters[key])
                parameters[key] = tuple(scaled.tolist()) if scaled.ndim else float(scaled)
        motors.append(replace(motor, spring=Spring(model=motor.spring.model, parameters=parameters)))
    return replace(plant, motors=tuple(motors))


def declared(name: str, **transmission: Any) -> JointModel:
    """The model of a case as a joint file would declare it; `transmission` as for `Transmission`."""
    plant = case(name).plant
    spring = plant.motors[0].spring
    given: dict[str, Any] = {"model": spring.model, "parameters": spring.parameters}
    motors = tuple(
        Motor(
            inertia_kg_m2=motor.inertia_kg_m2,
            viscous_damping_nm_s_rad=motor.viscous_damping_nm_s_rad,
            transmission=Transmission(**{**given, **transmission}),
        )
        for motor in plant.motors
    )
    return JointModel(arrangement=plant.arrangement, motors=motors)


def play(
    model: JointModel,
    samples: Iterable[Sample],
    *,
    model_monitor: ModelMonitor | None = None,
    restarted: int | None = None,
    look: Callable[[int, Estimator], object] = lambda _k, _estimator: None,
    period_s: float = PERIOD_S,
    **settings: Any,
) -> tuple[Estimates, Estimator]:
    """An estimator's word on these samples, with a model monitor's as the service adds it, and the estimator.

    `look` is called after each sample, with its place; at the place `restarted` a node has begun anew.
    """
    estimator = make_estimator(model, EstimatorSettings(**settings), period_s)
    # What it is given are samples already.
    pipeline = JointPipeline(Assembler((), 0), estimator, model_monitor)
    rows = []
    for k, sample in enumerate(samples):
        e = pipeline.step(sample, NODE_RESTARTED if k == restarted else 0).estimate
        look(k, estimator)
        rows.append((e.status, e.flexibility_torque_nm, e.stiffness_nm_rad, e.stiffness_std_nm_rad))
    status, torque, stiffness, std = np.array(rows).T
    return Estimates(status.astype(int), torque, stiffness, std), estimator


def wrong(estimates: Estimates, truth: np.ndarray) -> np.ndarray:
    """Which samples are valid and wrong: off by more than 10 % and by more than five standard deviations."""
    off = np.abs(estimates.stiffness_nm_rad - truth)
    beyond = ~(off <= np.maximum(WRONG_RELATIVE * np.abs(truth), WRONG_STD * estimates.std_nm_rad))
    return np.asarray(estimates.valid & beyond)


def wrong_torque(estimates: Estimates, truth: np.ndarray) -> np.ndarray:
    """Which samples have a valid torque that is off by more than a quarter of the true one's rms."""
    off = np.abs(estimates.torque_nm - truth) <= WRONG_TORQUE * np.sqrt(np.mean(truth**2))
    return np.asarray(estimates.torque_valid & ~off)


def is_right(found: Estimates, motion: Motion, valid: np.ndarray, begin: int = 0) -> bool:
    """Whether from that sample on something is valid, and its torque within a quarter of the true one's rms."""
    off = np.abs(found.torque_nm - motion.torque_nm)[begin:][valid[begin:]]
    return bool(len(off) and np.all(off < WRONG_TORQUE * np.sqrt(np.mean(motion.torque_nm**2))))


def without(samples: Sequence[Sample], share: float, seed: int) -> tuple[list[Sample], np.ndarray]:
    """The samples with whole cycles lost at random, and the places of those that are left."""
    kept = np.flatnonzero(np.random.default_rng(seed).random(len(samples)) >= share)
    return [samples[k] for k in kept], kept
