"""The declared model brought into line with a healthy run, so that a suspect run is judged against that.

All declared numbers are fitted together: both balances share the transmission, the motor torque's scale is
the anchor. So are the small errors that every rig's readings have: channels that are not taken at the same
instant, encoders with different zeros. What the recording does not tell stays near what was declared.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from estimator.diagnosis.bandwidth import choose_bandwidth, rough_stiffness, torque_rms, weights
from estimator.diagnosis.candidates import Candidate
from estimator.diagnosis.frame import Corrections, Frame, Signals
from estimator.diagnosis.known import declared_corrections
from estimator.diagnosis.regression import Blocks, Rows
from estimator.diagnosis.search import corrected
from estimator.diagnosis.select import Selection, Term, Tracer
from estimator.effects import LIBRARY
from estimator.gate import check
from estimator.model import Effect, JointModel
from estimator.sample import FloatArray, Record

__all__ = ["calibrate"]

_BLOCKS = 10
_ROUNDS = 3
_TRUST = 0.05  # standard deviation of a declared number, as a share of it
_MOTOR = ("motor_inertia", "viscous_damping")
_LINK = ("link_inertia", "link_viscous_damping", "gravity")
_SURE = 4.0  # standard deviations from zero at which an error of the readings is kept
_SKEW_S = 2e-5  # and how much of it at least


def calibrate(record: Record, model: JointModel, bandwidth_hz: float | None = None) -> JointModel:
    """The model that fits a healthy recording best.

    Args:
        record: a run without a fault.
        model: as declared; its effects stay as they are.
        bandwidth_hz: of the filter that all channels share; None: chosen from the data.

    Returns:
        The model with inertias, dampings, gravity and transmission parameters refitted, and with the skews
        and the zeros between its readings as effects, where there are any.

    Raises:
        EstimatorError: the recording does not allow it.
    """
    check(record, model)
    signals = Signals(record, bandwidth_hz or choose_bandwidth(record, model))
    corrections = declared_corrections(model)
    for _ in range(_ROUNDS):
        frame = Frame.make(model, signals, corrections)
        trust = weights(frame, rough_stiffness(record, model), torque_rms(record))
        rows = Rows(Blocks.make(frame.rows, _BLOCKS, 0), frame.equations, trust)
        tracer = Tracer(frame, rows, 1.0)
        terms = tuple(Term(candidate, {}) for candidate in _free(frame))
        solution = _solve(tracer, terms)
        model = _applied(model, tracer, terms, solution)
        selection = tracer.evaluate(terms)
        selection = replace(selection, fit=selection.fit._replace(coefficients=solution))
        corrections, _ = corrected(frame, selection)
    return _with_readings(model, corrections, _deviations(selection))


def _free(frame: Frame) -> list[Candidate]:
    """What is fitted beside the transmissions: declared numbers, and the readings' offsets and skews."""
    free = [Candidate(LIBRARY[name], i) for i in range(len(frame.motors)) for name in _MOTOR]
    flexible = [i for i, here in enumerate(frame.flexible) if here]
    free += [Candidate(LIBRARY["deflection_offset"], i) for i in flexible]
    if frame.linked:
        free += [Candidate(LIBRARY[name], None) for name in _LINK]
        free += [Candidate(LIBRARY["torque_delay"], i) for i in flexible]
        free.append(Candidate(LIBRARY["encoder_delay"], None))
    return free


def _solve(tracer: Tracer, terms: tuple[Term, ...]) -> FloatArray:
    """Least squares with the declared numbers as weak prior knowledge."""
    selection = tracer.evaluate(terms)
    design, width = selection.design, tracer.base_design.shape[1]
    prior = np.zeros(design.shape[1])
    place = width
    for term in terms:
        for k, scale in enumerate(_declared(tracer.frame.model, term)):
            prior[place + k] = 1.0 / (_TRUST * scale) if scale > 0.0 else 0.0
        place += term.width
    stacked = np.vstack((design, np.diag(prior)))
    target = np.concatenate((tracer.target, np.zeros(len(prior))))
    scale = np.linalg.norm(stacked, axis=0)
    scale[scale == 0.0] = 1.0
    return np.asarray(np.linalg.lstsq(stacked / scale, target, rcond=1e-12)[0] / scale)


def _declared(model: JointModel, term: Term) -> tuple[float, ...]:
    """Size of the declared numbers that a term corrects; zero: nothing is declared."""
    name, motor = term.candidate.kind.name, model.motors[term.candidate.motor or 0]
    link = model.link
    if name == "motor_inertia":
        return (motor.inertia_kg_m2,)
    if name == "viscous_damping":
        return (max(motor.viscous_damping_nm_s_rad, 0.0),)
    if link is None or name not in _LINK:
        return (0.0,) * term.width
    if name == "link_inertia":
        return (link.inertia_kg_m2,)
    if name == "link_viscous_damping":
        return (link.viscous_damping_nm_s_rad,)
    return (abs(link.gravity_nm), abs(link.gravity_nm))


def _applied(model: JointModel, tracer: Tracer, terms: tuple[Term, ...], solution: FloatArray) -> JointModel:
    """The model with the fitted corrections added to what it declares."""
    width = tracer.base_design.shape[1]
    parameters = tracer.base.moved(tracer.frame, solution[:width]).parameters(tracer.frame)
    found: dict[tuple[str, int | None], FloatArray] = {}
    place = width
    for term in terms:
        found[term.candidate.key] = solution[place : place + term.width]
        place += term.width
    motors = []
    for i, motor in enumerate(model.motors):
        inertia = motor.inertia_kg_m2 + float(found["motor_inertia", i][0])
        damping = motor.viscous_damping_nm_s_rad + float(found["viscous_damping", i][0])
        transmission = motor.transmission
        if parameters[i]:
            transmission = replace(transmission, parameters=parameters[i])
        motors.append(
            replace(
                motor,
                inertia_kg_m2=max(inertia, 1e-3 * motor.inertia_kg_m2),
                viscous_damping_nm_s_rad=max(damping, 0.0),
                transmission=transmission,
            )
        )
    link = model.link
    if link is not None and ("link_inertia", None) in found:
        sine, cosine = found["gravity", None]
        a = link.gravity_nm * np.cos(link.gravity_phase_rad) + sine
        b = link.gravity_nm * np.sin(link.gravity_phase_rad) + cosine
        sign = -1.0 if link.gravity_nm < 0.0 else 1.0
        inertia = link.inertia_kg_m2 + float(found["link_inertia", None][0])
        damping = link.viscous_damping_nm_s_rad + float(found["link_viscous_damping", None][0])
        link = replace(
            link,
            inertia_kg_m2=max(inertia, 1e-3 * link.inertia_kg_m2),
            viscous_damping_nm_s_rad=max(damping, 0.0),
            gravity_nm=sign * float(np.hypot(a, b)),
            gravity_phase_rad=float(np.arctan2(sign * b, sign * a)),
        )
    return replace(model, motors=tuple(motors), link=link)


def _deviations(selection: Selection) -> dict[tuple[str, int | None], float]:
    """Standard deviation of each term's first parameter."""
    std = np.sqrt(np.maximum(np.diag(selection.fit.covariance), 0.0))
    place = selection.design.shape[1] - sum(term.width for term in selection.terms)
    found = {}
    for term in selection.terms:
        found[term.candidate.key] = float(std[place])
        place += term.width
    return found


def _with_readings(
    model: JointModel, corrections: Corrections, std: dict[tuple[str, int | None], float]
) -> JointModel:
    """The model with the errors of its readings as effects; what is not sure stays as declared."""

    def sure(name: str, motor: int | None, now: float, declared: float, least: float) -> bool:
        return abs(now - declared) > max(_SURE * std.get((name, motor), np.inf), least)

    before = declared_corrections(model)
    motors = []
    for i, motor in enumerate(model.motors):
        effects = motor.effects
        delay, offset = corrections.torque_delay_s[i], corrections.offset_rad[i]
        if sure("torque_delay", i, delay, before.torque_delay_s[i], _SKEW_S):
            effects = _with_effect(effects, "torque_delay", delay_s=delay)
        if sure("deflection_offset", i, offset, before.offset_rad[i], 0.0):
            effects = _with_effect(effects, "deflection_offset", offset_rad=offset)
        motors.append(replace(motor, effects=effects))
    at_link, delay = model.link_effects, corrections.encoder_delay_s
    if sure("encoder_delay", None, delay, before.encoder_delay_s, _SKEW_S):
        at_link = _with_effect(at_link, "encoder_delay", delay_s=delay)
    return replace(model, motors=tuple(motors), link_effects=at_link)


def _with_effect(effects: tuple[Effect, ...], name: str, **parameters: float) -> tuple[Effect, ...]:
    """The effects with one of them as given now, whether or not it was there."""
    return (*(e for e in effects if e.name != name), Effect(name=name, parameters=parameters))
