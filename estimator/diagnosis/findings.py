"""Converts a fitted hypothesis to findings: parameters with intervals, curves, transmissions, readings."""

from __future__ import annotations

from collections.abc import Sequence
from statistics import NormalDist

import numpy as np

from estimator.choices import choice
from estimator.diagnosis.candidates import columns
from estimator.diagnosis.covariance import design_effects, hac_covariance
from estimator.diagnosis.design_matrix import curve_columns
from estimator.diagnosis.hypothesis import Fitted
from estimator.diagnosis.joint_priors import longest_delay_s
from estimator.diagnosis.probabilities import Chances, Standing, accounts
from estimator.diagnosis.problem import Problem
from estimator.diagnosis.result import Curve, Finding, Refitted, Rival, Series
from estimator.diagnosis.search import Search
from estimator.diagnosis.stiffness import middle
from estimator.effects import LIBRARY
from estimator.flexibility import TransmissionModel
from estimator.model import ParameterValue
from estimator.sample import SIGMA_95, FloatArray

__all__ = [
    "DELAYS",
    "alignment_of",
    "curves_of",
    "findings_of",
    "rivals_of",
    "series_of",
    "stamped_wrongly",
    "transmissions_of",
]

DELAYS = ("encoder_delay", "torque_delay")
_CHANNELS = {
    "torque_delay": "torque_delay_s",
    "deflection_offset": "deflection_offset_rad",
    "torque_offset": "torque_offset_nm",
}


def findings_of(
    search: Search, found: Fitted, standings: Sequence[Standing], surplus: float
) -> list[Finding]:
    """Return the effects, the most important first, including delays of more than a sample."""
    problem, null = search.problem, search.null
    std = np.sqrt(np.maximum(np.diag(hac_covariance(problem, found, surplus)), 0.0))
    made = []
    total = float(np.sum(null.posterior.sigma**2))
    for k, term in enumerate(found.terms):
        kind = term.candidate.kind
        mine = [j for j, s in enumerate(found.slots) if s.kind == "term" and s.place == k]
        shapes = {
            s.name: float(std[j]) for j, s in enumerate(found.slots) if s.kind == "shape" and s.place == k
        }
        deviation: dict[str, ParameterValue] = dict(
            zip(kind.linear, (float(std[j]) for j in mine), strict=True)
        )
        deviation.update({name: _absolute(problem, found, k, name, x) for name, x in shapes.items()})
        whole = found.posterior.x[mine] + np.array([found.slots[j].taken for j in mine])
        torque = found.regression.design[:, mine] @ whole
        share = float(np.mean(torque**2)) / max(total, 1e-300)
        finding = Finding(
            name=kind.name,
            location=kind.location,
            motor=term.candidate.motor,
            parameters={**dict(zip(kind.linear, term.weights, strict=True)), **term.values},
            std=deviation,
            probability=standings[k].probability,
            alternatives=tuple(name for name, _ in standings[k].alternatives),
            alternative_probabilities=tuple(p for _, p in standings[k].alternatives),
            share=min(share, 1.0),
        )
        if not _everyday(problem, finding):
            made.append((share, finding))
    made += [(0.0, late) for late in _late(search, found, std)]
    made += [(0.0, f) for f in _offsets(problem, found, std)] if not made else []
    made.sort(key=lambda pair: -pair[0])
    return [finding for _, finding in made]


def _late(search: Search, found: Fitted, std: FloatArray) -> list[Finding]:
    """Delays of readings beyond a sample; each may also be what another effect would be in its place."""
    problem, made = search.problem, []
    for slot, x, sigma in zip(found.slots, found.posterior.x, std.tolist(), strict=True):
        value, beyond = slot.taken + float(x), abs(slot.taken + float(x)) - problem.period_s
        if slot.kind != "everyday" or slot.name not in DELAYS or beyond <= choice("sure") * sigma:
            continue
        key = slot.name, slot.motor
        each = search.children(problem.with_declared(found, key))
        instead = accounts(search.held, next((h for h in each if key in h.keys), found), each)
        others = [
            (weight, one.terms[-1].candidate)
            for weight, one in instead
            if key not in one.keys and one is not found
        ]
        listed = [(weight, c.kind.name) for weight, c in others if weight > choice("even")]
        made.append(Finding(
            name=slot.name, location=LIBRARY[slot.name].location, motor=slot.motor,
            parameters={"delay_s": value}, std={"delay_s": sigma},
            probability=NormalDist().cdf(beyond / sigma) * (1.0 - sum(weight for weight, _ in others)),
            alternatives=tuple(name for _, name in sorted(listed, reverse=True)),
            alternative_probabilities=tuple(weight for weight, _ in sorted(listed, reverse=True)),
        ))  # fmt: skip
    return made


def _offsets(problem: Problem, found: Fitted, std: FloatArray) -> list[Finding]:
    """A constant torque as the only finding: without link dynamics, an offset of torque or of encoders."""
    if problem.frames[0].linked:
        return []
    for i, flexible in enumerate(problem.frames[0].flexible):
        mine = [
            j for j, s in enumerate(found.slots)
            if s.kind == "everyday" and s.motor == i and s.name in ("torque_offset", "deflection_offset")
        ]  # fmt: skip
        constant = found.regression.design[:, mine] @ (
            found.posterior.x[mine] + np.array([found.slots[j].taken for j in mine])
        )
        left = found.regression.residual(found.posterior.x)
        if not flexible or float(np.mean(constant**2)) < choice("sure") ** 2 * float(np.mean(left**2)):
            continue
        size = -float(np.mean(constant[problem.group % problem.equations == i]))
        stiffness = problem.at(found.corrections, found.base)[0].motors[i].stiffness
        if abs(size) < float(np.mean(stiffness)) * problem.signals[0].resolution_rad[i]:
            continue
        deviation = float(np.hypot.reduce(std[[j for j in mine if found.slots[j].name == "torque_offset"]]))
        return [
            Finding(
                name="torque_offset", location="motor", motor=i, parameters={"torque_nm": size},
                std={"torque_nm": deviation}, probability=0.5,
                alternatives=("deflection_offset",), alternative_probabilities=(0.5,),
            )
        ]  # fmt: skip
    return []


def _everyday(problem: Problem, finding: Finding) -> bool:
    """Whether a delay is a skew of up to a sample, which is reported but not diagnosed."""
    if finding.name not in DELAYS:
        return False
    delay, std = (np.max(values["delay_s"]) for values in (finding.parameters, finding.std))
    return bool(abs(delay) <= problem.period_s + choice("sure") * std)


def _absolute(problem: Problem, found: Fitted, k: int, name: str, x: float) -> float:
    """Standard deviation of a nonlinear parameter in its unit."""
    return x * problem.unit_of(found.terms[k], name)


def stamped_wrongly(name: str, delay_s: float, period_s: float) -> str | None:
    """Return one sentence on a delay that no drive and no bus has."""
    longest = longest_delay_s(period_s)
    if name not in DELAYS or abs(delay_s) <= longest:
        return None
    return (
        f"the best fit has {name} of {delay_s:.3g} s, more than the {longest:.2g} s of drives and buses: "
        "check the time stamps of the channels, or declare it"
    )


def alignment_of(
    problem: Problem,
    after: Fitted,
    effects: list[Finding],
    surplus: float,
    transmissions: Sequence[Refitted],
) -> dict[str, tuple[float, float]]:
    """Return everyday corrections of the readings with their standard deviations, by channel.

    A constant torque of a flexible joint may as well be a zero of its encoders: it is taken for one, as in a
    fit.
    """
    flexible = problem.frames[0].flexible
    named = {(f.name, f.motor) for f in effects}
    pairs: dict[str, tuple[float, float]] = {}
    covariance = hac_covariance(problem, after, surplus)
    totals = after.posterior.x + np.array([slot.taken for slot in after.slots])
    zeros = _constants_as_zeros(problem, after, transmissions)
    totals, std = zeros @ totals, np.sqrt(np.maximum(np.diag(zeros @ covariance @ zeros.T), 0.0))
    for slot, value, sigma in zip(after.slots, totals.tolist(), std.tolist(), strict=True):
        if abs(value) < choice("sure") * sigma or stamped_wrongly(slot.name, value, problem.period_s):
            continue
        if (
            slot.kind not in ("everyday", "term")
            or slot.run not in (None, 0)
            or (slot.name, slot.motor) in named
        ):
            continue
        if slot.name == "encoder_delay":
            pairs["link_position_delay_s"] = value, sigma
        elif slot.name in _CHANNELS and (slot.name != "torque_offset" or not flexible[slot.motor or 0]):
            pairs[f"motor{(slot.motor or 0) + 1}_{_CHANNELS[slot.name]}"] = value, sigma
    return pairs


def _constants_as_zeros(problem: Problem, after: Fitted, transmissions: Sequence[Refitted]) -> FloatArray:
    """(k, k) what adds a motor's constant torque to the zero of its encoders where nothing ties either, and
    the stiffness is known.
    """
    made, frame = np.eye(len(after.slots)), problem.at(after.corrections, after.base)[0]
    own = {(s.name, s.motor, s.run): j for j, s in enumerate(after.slots) if s.kind == "everyday"}
    for (name, motor, run), j in own.items() if not frame.linked else ():
        zero = own.get(("deflection_offset", motor, run))
        if name == "torque_offset" and zero is not None and transmissions[motor or 0].parameters:
            made[zero, j] = 1.0 / float(np.mean(frame.motors[motor or 0].stiffness))
    return made


def transmissions_of(
    search: Search,
    after: Fitted,
    accounts: Sequence[tuple[float, Fitted]],
    surplus: float,
    left: Sequence[float],
) -> tuple[tuple[Refitted, ...], list[str]]:
    """Return each motor's transmission, and doubts about them.

    The covariance is that of the fit plus that between explanations (Bayesian model averaging; Hoeting et
    al., Statistical Science 14, 1999), because another set of effects may imply another stiffness, plus the
    possible contribution of rejected effects. The information of the data counts as much less as the error on
    held-out data is larger (`surplus`). An undetermined stiffness has no parameters, and a doubt; nor has one
    whose balance leaves more than the spring carries (`left`: rms in N·m per motor).
    """
    problem = search.problem
    covariance = hac_covariance(problem, after, surplus)
    effects = design_effects(problem, after, surplus)
    made: list[Refitted] = []
    doubts = []
    for i, model in enumerate(after.base.models(problem.frames[0])):
        mine = [j for j, s in enumerate(after.slots) if s.kind == "base" and s.motor == i]
        if model is None:
            made.append(Refitted("none", {}, {}))
            continue
        alpha = np.array([after.slots[j].taken + after.posterior.x[j] for j in mine])
        unseen, instead = search.unseen(after, mine[:1], float(effects[mine[0]]))
        own = (covariance + unseen + instead)[np.ix_(mine, mine)]
        own = own + _between(after, accounts, i, alpha)
        phi = problem.frames[0].motors[i].deflection
        found = middle(model, alpha, own, phi)
        more = left[i] > float(np.std(problem.frames[0].project(model.torque(phi, alpha))))
        std_of_alpha = np.sqrt(np.maximum(np.diag(own), 0.0))
        ends = _ends(model, alpha, std_of_alpha)
        if more or ends or not found.determined or any(after.posterior.bound[mine]):
            value = f"{found.stiffness_nm_rad:.4g} ± {SIGMA_95 * found.std_nm_rad:.2g} N·m/rad (95 %)"
            if any(after.posterior.bound[mine]):
                value = "no positive one fits better than none"
            elif ends:
                value = "its shape leaves the range that the law has"
            elif more:
                value = "the balance leaves more torque than the spring carries"
            doubts.append(f"these data do not determine the stiffness of motor {i + 1}: {value}")
            made.append(Refitted(model.name, {}, {}))
            continue
        rows = tuple(map(tuple, own.tolist()))
        numbers = _motor(problem, after, i)
        made.append(
            Refitted(model.name, model.parameters(alpha), model.parameters(std_of_alpha), rows, numbers)
        )
    return tuple(made), doubts


def _ends(model: TransmissionModel, alpha: FloatArray, std: FloatArray) -> bool:
    """Whether a shape may, within its standard deviation, leave the range that the law has."""
    low, high = np.array(model.shape_bounds).reshape(-1, 2).T
    shape, off = (x[len(x) - len(low) :] for x in (alpha, std))
    return bool(np.any((shape - off <= low) | (shape + off >= high)))


def _motor(problem: Problem, after: Fitted, i: int) -> dict[str, float]:
    """Inertia and damping that go with the transmission; an effect of that name is written as one."""
    declared, made = problem.model.motors[i], {}
    for name, key in (
        ("motor_inertia", "inertia_kg_m2"),
        ("viscous_damping", "viscous_damping_nm_s_rad"),
    ):
        more = after.total("everyday", name, i)
        if more:
            made[key] = max(float(getattr(declared, key)) + more[0], 0.0)
    return made


def _between(
    after: Fitted, accounts: Sequence[tuple[float, Fitted]], motor: int, alpha: FloatArray
) -> FloatArray:
    """Second moment of a transmission's parameters about those reported, over the accounts of the data."""
    total = np.zeros((len(alpha),) * 2)
    for chance, other in accounts:
        there = np.array(
            [
                s.taken + x
                for s, x in zip(other.slots, other.posterior.x, strict=True)
                if s.kind == "base" and s.motor == motor
            ]
        )
        total += chance * np.outer(there - alpha, there - alpha)
    return total


def rivals_of(search: Search, effects: Sequence[Finding], chance: Chances) -> list[Rival]:
    """Return the relative error with each promising effect alone, and each that was found, best first."""
    alone = {
        (one.terms[-1].candidate.kind.name, one.terms[-1].candidate.motor): one for one in search.singles()
    }
    for finding in effects:
        if (key := (finding.name, finding.motor)) not in alone:
            fitted = next((one for one in search.seen if one.keys == {key}), None)
            if (fitted := fitted or search.with_effect(search.null, *key)) is not None:
                alone[key] = fitted
    # A late reading is no term: what may be in its place is known to its finding only.
    late = {
        name: p for f in effects if (f.name, f.motor) not in chance
        for name, p in zip(f.alternatives, f.alternative_probabilities, strict=True)
    }  # fmt: skip
    motors = search.problem.group % search.problem.equations < len(search.problem.model.motors)
    made = []
    for (name, motor), one in alone.items():
        left = one.regression.residual(one.posterior.x)
        error = float(np.sqrt(np.mean(left[motors] ** 2))) / search.problem.torque_rms
        p = max(chance.get((name, motor), 0.0), late.get(name, 0.0))
        made.append(Rival(name, one.terms[-1].candidate.kind.location, motor, error, p))
    return sorted(made, key=lambda rival: rival.error_relative)


def curves_of(problem: Problem, after: Fitted) -> tuple[Curve, ...]:
    """Return the residual without each effect over its revealing coordinate, with the effect,
    on the first recording.
    """
    frame = problem.at(after.corrections, after.base)[0]
    rows = np.arange(frame.rows)
    left = after.regression.residual(after.posterior.x)
    made = []
    for k, term in enumerate(after.terms):
        kind, motor = term.candidate.kind, term.candidate.motor
        mine = [j for j, s in enumerate(after.slots) if s.kind == "term" and s.place == k]
        fitted = columns(frame, term.candidate, term.values, term.weights) @ np.array(term.weights)
        own = after.regression.design[: len(fitted), mine] @ after.posterior.x[mine]
        on_link = kind.location == "link" and not frame.carried
        pick = rows + (frame.equations - 1 if on_link else motor or 0) * frame.rows
        sign = 1.0 if on_link or kind.location not in ("motor", "link") else -1.0
        made.append(
            Curve(
                name=kind.name,
                coordinates=kind.coordinates[:1],
                x=frame.project(getattr(frame.motors[motor or 0], kind.coordinates[0])),
                residual_nm=sign * (left[pick] + own[pick]),
                fitted_nm=sign * (own[pick] if kind.channel != "torque" else fitted[pick]),
            )
        )
    if after.extra is not None:
        extra = after.extra
        mine = [j for j, s in enumerate(after.slots) if s.kind == "curve"]
        own = curve_columns(frame, extra) @ after.posterior.x[mine]
        equation = frame.equations - 1 if extra.location == "link" else extra.motor or 0
        pick = rows + equation * frame.rows
        sign = -1.0 if extra.location == "motor" else 1.0
        x = [frame.project(getattr(frame.motors[extra.motor or 0], name)) for name in extra.coordinates]
        made = [
            Curve(
                name="unlisted",
                coordinates=extra.coordinates,
                x=x[0],
                second=x[1] if len(x) > 1 else None,
                residual_nm=sign * (left[pick] + own[pick]),
                fitted_nm=sign * own[pick],
            )
        ]
    return tuple(made)


def series_of(problem: Problem, before: Fitted, after: Fitted) -> Series:
    """Return the torque of the first motor and its residual over time."""
    frame = problem.frames[0]
    keep = frame.signals.keep
    return Series(
        time_s=np.flatnonzero(keep).astype(np.float64) * frame.signals.narrow.period_s,
        torque_nm=frame.project(frame.motors[0].torque),
        before_nm=before.regression.residual(before.posterior.x)[: frame.rows],
        after_nm=after.regression.residual(after.posterior.x)[: frame.rows],
    )
