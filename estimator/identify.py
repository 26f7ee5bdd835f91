"""Identifies a joint's model from healthy recordings, for `drivelink fit`."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
from scipy.special import chdtrc

from estimator.batch import JointFit, TransmissionFit, fit_joint, transmission_fits
from estimator.choices import chance, choice
from estimator.diagnosis.candidates import sign_smoothing
from estimator.diagnosis.heldout import Residual, residual_of, wider
from estimator.diagnosis.misdeclared import moved_link
from estimator.effects import elements, sharpened
from estimator.model import Effect, JointModel, LinkDynamics, Motor, Transmission
from estimator.sample import SIGMA_95, Record
from estimator.transmissions import RIGID

_PARAMETER = {
    "encoder_delay": "delay_s",
    "torque_delay": "delay_s",
    "deflection_offset": "offset_rad",
    "coulomb_friction": "torque_nm",
    "torque_offset": "torque_nm",
}


class Left(NamedTuple):
    """Residual of the motors' balances: rms in N·m, and relative to the measured torque."""

    rms_nm: float
    relative: float


class RecordingFit(NamedTuple):
    """Residual of one recording: fitted, and under a fit of the others alone (of blocks of the only one)."""

    train: Left
    validation: Left


@dataclass(frozen=True, slots=True, kw_only=True)
class Identified:
    """A joint, fitted to recordings."""

    fits: list[TransmissionFit]  # of each motor; its numbers agree with those in `model`
    model: JointModel  # the joint with fitted transmissions, inertias, dampings, link and readings
    # standard deviations of the link's dynamics, by name
    link_std: dict[str, float] = field(default_factory=dict)
    recordings: tuple[RecordingFit, ...] = ()  # residual of each recording
    surplus: float = 1.0  # mean square of the errors on held-out data over that on the fitted data
    notes: tuple[str, ...] = ()  # remarks on the numbers, one line each


def identify(
    record: Record | Sequence[Record], model: JointModel, bandwidth_rad_s: float | None = None
) -> Identified:
    """Fit all numbers of a joint to healthy recordings.

    Recordings share the machine's parameters (stiffness, inertias, dampings, link, delays). Each recording
    has its own encoder zeros, offset and level of friction.

    Args:
        record: measured data, of one or several runs.
        model: declared joint; its effects are kept, those of the readings are refitted.
        bandwidth_rad_s: of the filter that all channels of `fit` share; left out: chosen from the data.

    Raises:
        EstimatorError: a recording lacks what is needed, is too short, or nothing moves in it.
    """
    joint = fit_joint(record, model, bandwidth_rad_s)
    model = sharpened(model, joint.smoothing_rad_s)
    fits = transmission_fits(joint)
    notes = [*joint.doubts, *joint.problem.clipped, *wider(joint.surplus)]
    motors = tuple(
        replace(_fitted(motor, one), effects=motor.effects)
        if motor.flexible and not one.excited  # the readings' errors show through the spring
        else replace(_fitted(motor, one), effects=_effects(joint, motor.effects, i, notes))
        for i, (motor, one) in enumerate(zip(model.motors, fits, strict=True))
    )
    link, link_std = _link(joint, notes)
    pairs = zip(motors, joint.problem.model.motors, model.motors, strict=True)
    notes += [
        f"the declared inertia of motor {i} is not that of these recordings: [[motor]] should have "
        f"inertia_kg_m2 = {one.inertia_kg_m2:.4g} ± {SIGMA_95 * fits[i - 1].nuisance_std['inertia']:.2g}, "
        f"95 % (now {declared.inertia_kg_m2:.4g})"
        for i, (one, used, declared) in enumerate(pairs, start=1)
        if used.inertia_kg_m2 != declared.inertia_kg_m2
    ]
    notes += _link_to_paste(link, model.link) if link is not None and model.link is not None else []
    notes += _believed(joint, model)
    link_effects = model.link_effects
    if all(one.excited for motor, one in zip(model.motors, fits, strict=True) if motor.flexible):
        link_effects = _effects(joint, link_effects, None, notes)
    found = replace(model, motors=motors, link=link or model.link, link_effects=link_effects)
    return Identified(
        fits=fits,
        model=found,
        link_std=link_std,
        recordings=_recordings(joint),
        surplus=joint.surplus,
        notes=tuple(notes),
    )


def _fitted(motor: Motor, one: TransmissionFit) -> Motor:
    transmission = motor.transmission
    if one.model != RIGID:
        order = int(one.alpha.size) if one.model == "polynomial" else transmission.order
        transmission = Transmission(
            model=one.model,
            order=order,
            parameters=one.parameters,
            covariance=tuple(map(tuple, one.covariance.tolist())) if one.parameters else None,
        )
    inertia = one.inertia_kg_m2 or motor.inertia_kg_m2  # none explains a torque that does not move the joint
    return replace(
        motor,
        inertia_kg_m2=inertia,
        viscous_damping_nm_s_rad=one.viscous_damping_nm_s_rad,
        inertia_std_relative=min(one.nuisance_std["inertia"] / inertia, 1.0),
        viscous_damping_std_nm_s_rad=one.nuisance_std["damping"],
        transmission=transmission,
    )


def _effects(
    joint: JointFit, declared: tuple[Effect, ...], motor: int | None, notes: list[str]
) -> tuple[Effect, ...]:
    """Effects with the readings' errors, and a rigid joint's friction, as found."""
    flexible = motor is None or joint.problem.model.motors[motor].flexible
    for name, parameter in _PARAMETER.items():
        mine = joint.places((name, motor))
        zero, supported = name == "deflection_offset", joint.supports((name, motor))
        if not mine or not (supported or zero) or (flexible and name == "coulomb_friction"):
            continue
        # At the deflections that were seen the torque is known better than a curve and its zero.
        more = _shared(joint, mine, joint.spring(motor or 0) if zero else [])
        if more is None:
            each = ", ".join(f"{x:.3g}" for x in joint.values((name, motor)))
            notes.append(f"{name} differs between the recordings ({parameter} {each}) and stays as declared")
            continue
        if not supported:  # a zero is somewhere: how near to the declared one, is written all the same
            more = 0.0, math.hypot(*more)
        before = sum(v[parameter] for e in declared if e.name == name for v in elements(e)[1])
        values_of, std = {parameter: before + more[0]}, {parameter: more[1]}
        if name == "coulomb_friction":
            values_of["smoothing_rad_s"] = sign_smoothing(joint.problem.frames, motor or 0)
        declared = (
            *(e for e in declared if e.name != name),
            Effect(name=name, parameters=values_of, std=std),
        )
    return declared


def _believed(joint: JointFit, model: JointModel) -> list[str]:
    """Say which declared inertias are stated because they are declared: of which the data say less."""
    fitted, places = joint.fitted, [(f"motor {i + 1}", "motor_inertia", i) for i in range(len(model.motors))]
    said = [
        where
        for where, name, motor in [*places, ("the link", "link_inertia", None)]
        for j in joint.places((name, motor))
        if 2.0 * fitted.posterior.covariance[j, j] > fitted.regression.std[j] ** 2
    ]
    if not said:
        return []
    return [f"the inertia of {' and '.join(said)} is the declared one: these recordings say less about it"]


def _shared(joint: JointFit, mine: list[int], given: list[int]) -> tuple[float, float] | None:
    """The common value of all recordings, and its standard deviation beside what other columns tell of it;
    None if the recordings contradict each other.
    """
    values = np.array([joint.fitted.slots[j].taken + joint.fitted.posterior.x[j] for j in mine])
    known = joint.fitted.posterior.covariance
    both = known[np.ix_(mine, given)]
    told = np.diag(both @ np.linalg.pinv(known[np.ix_(given, given)], hermitian=True) @ both.T)
    share = np.sqrt(np.maximum(1.0 - told / np.diag(known)[mine], 0.0))
    covariance = joint.covariance[np.ix_(mine, mine)] * np.outer(share, share)
    precision = np.linalg.pinv(covariance, hermitian=True)
    mean = float(np.sum(precision @ values) / np.sum(precision))
    apart = values - mean
    freedom = len(mine) - 1
    if freedom and chdtrc(freedom, float(apart @ precision @ apart)) < chance():
        return None
    return mean, float(np.sum(precision)) ** -0.5


def _link(joint: JointFit, notes: list[str]) -> tuple[LinkDynamics | None, dict[str, float]]:
    """The link's dynamics as found, and their standard deviations."""
    link = joint.problem.model.link
    gravity = joint.places(("gravity", None))
    if link is None or not joint.places(("link_inertia", None)):
        return link, {}
    inertia, inertia_std = joint.mean("link_inertia", None)
    damping, damping_std = joint.mean("link_viscous_damping", None)
    moved = moved_link(link, inertia, damping, tuple(joint.values(("gravity", None)).tolist()))
    if moved is None:
        notes.append(
            "the link's balance leaves no inertia above 0: its dynamics are kept as declared; "
            "check sign and unit of the link position"
        )
        return link, {}
    std = {"inertia_kg_m2": inertia_std, "viscous_damping_nm_s_rad": damping_std}
    link = replace(moved, inertia_std_kg_m2=inertia_std, viscous_damping_std_nm_s_rad=damping_std)
    if gravity:
        size, phase = max(abs(link.gravity_nm), 1e-300), link.gravity_phase_rad
        both = joint.covariance[np.ix_(gravity, gravity)]
        along = np.array([math.cos(phase), math.sin(phase)])
        across = np.array([-math.sin(phase), math.cos(phase)]) / size
        std["gravity_nm"] = math.sqrt(max(float(along @ both @ along), 0.0))
        std["gravity_phase_rad"] = math.sqrt(max(float(across @ both @ across), 0.0))
        link = replace(link, gravity_std_nm=max(std["gravity_nm"], size * std["gravity_phase_rad"]))
    return link, std


def _link_to_paste(found: LinkDynamics, declared: LinkDynamics) -> list[str]:
    """Say which link dynamics are further from the declared ones than a declaration is."""

    def gravity(link: LinkDynamics) -> complex:
        return link.gravity_nm * complex(math.cos(link.gravity_phase_rad), math.sin(link.gravity_phase_rad))

    off = (
        abs(found.inertia_kg_m2 - declared.inertia_kg_m2),
        abs(found.viscous_damping_nm_s_rad - declared.viscous_damping_nm_s_rad),
        abs(gravity(found) - gravity(declared)),
    )
    names = (("inertia_kg_m2",), ("viscous_damping_nm_s_rad",), ("gravity_nm", "gravity_phase_rad"))
    lines = [
        f"{name} = {getattr(found, name):.4g} (now {getattr(declared, name):.4g})"
        for each, more, std, left in zip(names, off, declared.std, found.std, strict=True)
        for name in each
        if more > choice("sure") * math.hypot(std, left)
    ]
    wrong = "the declared link dynamics are not those of these recordings: [link.dynamics] should have"
    return [f"{wrong} {', '.join(lines)}"] if lines else []


def _recordings(joint: JointFit) -> tuple[RecordingFit, ...]:
    """Residual of each recording, fitted and held out."""
    recording = joint.problem.group // joint.problem.equations
    return tuple(
        RecordingFit(_left(residual_of(joint.problem, joint.fitted, recording == k)), _left(one))
        for k, one in enumerate(joint.held.residuals(joint.fitted))
    )


def _left(residual: Residual) -> Left:
    return Left(residual.rms_nm, residual.relative)
