"""The search for missing effects: add, refine, swap, prune, until nothing significant is left."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from estimator.diagnosis.candidates import Candidate
from estimator.diagnosis.frame import Corrections, Frame
from estimator.diagnosis.known import declared_corrections
from estimator.diagnosis.plausible import plausible
from estimator.diagnosis.select import Selection, Term, Tracer
from estimator.effects import LIBRARY
from estimator.sample import FloatArray

__all__ = [
    "Found",
    "additions",
    "best_addition",
    "preferred",
    "search",
    "significant",
    "taken_out",
    "without",
]

_FALL = 0.07  # relative fall of the cross-validated error that a term must bring
_LEAST = 0.0025  # and of the torque's rms that it must explain beyond what the others can
_SCATTER = 1.8  # and mean gain over its standard error between blocks
_SIMPLER = 0.18  # share of the error that a richer term must take off what a simpler one leaves
_NEAR = 0.95  # share of the best term's gain that the simpler one must reach
_KIN = 0.12  # rms of a term over that of the strongest one, if it is of the same family
_FAR = 0.03  # and if it is not: less than this is how the first term's law differs from the real one
_SWAP = 0.02
_NO_WORSE = 1.05  # squared error with readings corrected over that with a term that is linear in the error
_LITTLE = 0.002  # or so much of what is left without any term
_SKEWED = 0.15  # fall of the squared error for which a skew of less than a sample is taken out
_PAIRED = 3.0  # rms of what is left over the expected noise, from which pairs are tried
_PAIRS = 3  # first terms that are tried
_DEARER = 1.1  # squared error over which one term more is not worth another start
_NOISY = 2.0  # rms of what is left over the expected noise, from which other starts are tried
_MUCH = 0.1  # and so much of what is left without any term, or more than two terms
_FIRST = 5  # first terms that are tried
_GROWN = 2  # pairs that are grown
_ZERO = "deflection_offset"
_WAVES = 0.15  # relative fall that a ripple must bring: its frequency was searched for among hundreds
_TERMS = 4
_APART = 0.8  # squared error with offset and skew between the encoders over that without
_ALIGN = 3  # rounds of correcting readings and fitting again

# Effects whose laws resemble each other.
FAMILIES = (
    {
        "coulomb_friction",
        "stribeck_friction",
        "asymmetric_friction",
        "presliding_friction",
        "load_dependent_friction",
    },
    {"hysteresis", "backlash", "presliding_friction", "transmission_damping", "higher_order_stiffness"},
    {"cogging", "kinematic_error"},
    {"link_coulomb_friction", "link_viscous_damping"},
    {"viscous_damping", "quadratic_damping"},
)

Progress = Callable[[str], None]


class Found(NamedTuple):
    """A model: the tracer with readings corrected, and the selection on it."""

    tracer: Tracer
    selection: Selection


def significant(tracer: Tracer, before: Selection, after: Selection, torque_rms: float) -> bool:
    """Whether a term's gain is real: large enough, everywhere, and not due to one block."""
    total = before.error - after.error
    if total <= _FALL * before.error:
        return False
    gains = before.fit.inner - after.fit.inner
    best = int(np.argmax(gains))
    if gains.sum() - gains[best] <= 0.5 * _FALL * (before.fit.inner.sum() - before.fit.inner[best]):
        return False
    if max(_sureness(gains), _sureness(np.delete(gains, best))) < _SCATTER and np.mean(gains > 0) < 0.9:
        return False
    least = _LEAST * torque_rms * float(tracer.rows.weight.max())
    return total / int(tracer.rows.train.sum()) > least**2


def _sureness(gains: FloatArray) -> float:
    """Mean over its standard error."""
    return float(gains.mean() * np.sqrt(len(gains)) / max(float(np.std(gains, ddof=1)), 1e-300))


def search(tracer: Tracer, torque_rms: float, progress: Progress = lambda _: None) -> Found:
    """Forward selection with swaps and pruning.

    Args:
        tracer: the recording.
        torque_rms: rms of the motor torque, N·m.
        progress: told what is being done.
    """
    nothing = Found(tracer, tracer.evaluate(()))
    grown = [_grown(start, torque_rms, progress) for start in _starts(nothing)]
    best = _thriftiest(grown)
    if _doubtful(nothing, best):
        progress("pairs")
        grown += [_grown(pair, torque_rms, progress) for pair in _first_pairs(nothing, best)]
    return _thriftiest(grown)


def _thriftiest(grown: list[Found]) -> Found:
    return min(grown, key=lambda found: found.selection.error * _DEARER ** len(found.selection.terms))


def _doubtful(nothing: Found, best: Found) -> bool:
    """Whether the way may have been wrong from the first term on: many terms, or much left."""
    rows = int(best.tracer.rows.train.sum())
    if not best.tracer.frame.linked or best.tracer.within is not None or not best.selection.terms:
        return False
    if best.selection.error / rows < _NOISY**2:
        return False
    return len(best.selection.terms) > 2 or best.selection.error > _MUCH**2 * nothing.selection.error


def _first_pairs(nothing: Found, best: Found) -> list[Found]:
    """The best pairs to begin with whose first term has not been tried."""
    tried = {term.candidate.key for term in best.selection.terms[:1]}
    pairs = []
    for first in sorted(additions(nothing), key=lambda found: found.selection.error)[:_FIRST]:
        if first.selection.terms[-1].candidate.key in tried:
            continue
        pair = best_addition(first)
        if pair is not None and pair.selection.error < nothing.selection.error:
            pairs.append(pair)
    return [_settled(pair) for pair in sorted(pairs, key=lambda found: found.selection.error)[:_GROWN]]


def _grown(start: Found, torque_rms: float, progress: Progress) -> Found:
    """Terms added to a start, swapped and pruned, while they are worth it."""
    current = start
    most = _TERMS + len(current.selection.terms)
    while len(current.selection.terms) < most:
        progress(f"term {len(current.selection.terms) + 1}")
        best = best_addition(current)
        if best is None or not _worth(current, best, torque_rms):
            best = _best_pair(current, torque_rms)
        if best is None:
            break
        current = _settled(best)
        if current.tracer.frame.linked:
            current = _with_free_skew(current)
        if len(current.selection.terms) > 1:
            current = _pruned(_swapped(current), torque_rms)
    current = _with_free_skew(current)
    if not current.tracer.frame.linked:
        current = _pruned(current, torque_rms)
    return current if len(current.selection.terms) != 1 else _swapped(current)


def _starts(start: Found) -> list[Found]:
    """Where to begin: with zeros and clocks of the two encoders apart, where nothing else ties them.

    Without the link's dynamics the encoders' offset and skew look like everything else, and hide it; so
    does the friction that every gear has.
    """
    frame = start.tracer.frame
    if frame.linked or not any(frame.flexible):
        return [start]
    zeros = _zeros(frame.flexible)
    delay = Term(Candidate(LIBRARY["encoder_delay"], None), {})
    free = _corrected_readings(Found(start.tracer, start.tracer.evaluate((*zeros, delay))))
    period = frame.signals.period_s
    skew = float(np.clip(free.tracer.frame.corrections.encoder_delay_s, -period, period))
    skewed = _skewed(free.tracer, skew)
    best = start
    for tracer in (start.tracer, skewed):
        found = _corrected_readings(Found(tracer, tracer.evaluate(zeros)))
        if found.selection.error < _APART * best.selection.error:
            best = found
    if best is start:
        return [start]
    friction = Term(
        Candidate(LIBRARY["coulomb_friction"], 0), {"smoothing_rad_s": best.tracer.smoothing_rad_s}
    )
    rubbing = _corrected_readings(Found(skewed, skewed.evaluate((*zeros, friction))))
    return [best, _settled(rubbing)] if believable(rubbing) else [best]


def _best_pair(current: Found, torque_rms: float) -> Found | None:
    """Two terms that explain together what neither does alone; None where there is too little to explain."""
    rows = int(current.tracer.rows.train.sum())
    if current.selection.error / rows < _PAIRED**2:
        return None
    pairs = []
    for first in sorted(additions(current), key=lambda found: found.selection.error)[:_PAIRS]:
        pair = best_addition(first)
        if pair is not None and significant(current.tracer, current.selection, pair.selection, torque_rms):
            pairs.append(pair)
    if not pairs:
        return None
    pair = min(pairs, key=lambda found: found.selection.error)
    best = _pruned(pair, torque_rms)
    if not current.tracer.frame.linked and len(best.selection.terms) < len(pair.selection.terms):
        return None
    kept = significant(current.tracer, current.selection, best.selection, torque_rms)
    return best if kept and best.selection.terms else None


def _zeros(flexible: tuple[bool, ...]) -> tuple[Term, ...]:
    """A zero between the encoders for each transmission."""
    kind = LIBRARY[_ZERO]
    return tuple(Term(Candidate(kind, i), {}) for i, here in enumerate(flexible) if here)


def _skewed(tracer: Tracer, delay_s: float) -> Tracer:
    """The same with nothing corrected but the skew."""
    declared = declared_corrections(tracer.frame.model)
    return tracer.at(replace(declared, encoder_delay_s=declared.encoder_delay_s + delay_s))


def _with_free_skew(found: Found) -> Found:
    """The encoders' skew fitted beside all else: where it was set at the start, or is too small to alarm."""
    frame = found.tracer.frame
    taken = frame.corrections.encoder_delay_s - declared_corrections(frame.model).encoder_delay_s
    term = Term(Candidate(LIBRARY["encoder_delay"], None), {})
    known = any(t.candidate.key == term.candidate.key for t in found.selection.terms)
    if known or not any(frame.flexible) or (taken == 0.0 and not frame.linked):
        return found
    free = _corrected_readings(Found(found.tracer, found.tracer.evaluate((*found.selection.terms, term))))
    skew = float(taken_out(free.tracer.frame, term)[0] + free.selection.fit.coefficients[-1])
    if taken == 0.0:
        gains = found.selection.fit.inner - free.selection.fit.inner
        fall = 1.0 - free.selection.error / max(found.selection.error, 1e-300)
        small = abs(skew) <= frame.signals.period_s
        return free if small and fall > _SKEWED and _sureness(gains) > 3.0 else found
    return free if believable(free) else found


def _worth(before: Found, after: Found, torque_rms: float, k: int = -1) -> bool:
    """Whether a term is significant and more than a flaw in the law of a stronger one."""
    if not significant(before.tracer, before.selection, after.selection, torque_rms):
        return False
    name = after.selection.terms[k].candidate.kind.name
    waves = name in ("cogging", "kinematic_error")
    if waves and after.selection.error > (1.0 - _WAVES) * before.selection.error:
        return False
    gain = before.selection.error - after.selection.error
    for i, other in enumerate(before.selection.terms):
        size = without(before, i).selection.error - before.selection.error
        kin = any(name in family and other.candidate.kind.name in family for family in FAMILIES)
        if gain < (_KIN if kin else _FAR) ** 2 * size:
            return False
    return True


def best_addition(current: Found) -> Found | None:
    """The best term to add, simpler ones preferred where they do nearly as well."""
    tried = additions(current)
    return preferred(tried, current.selection.error) if tried else None


def additions(current: Found) -> list[Found]:
    """The most promising terms, each refined and added."""
    tracer, terms = current.tracer, current.selection.terms
    taken = {t.candidate.key for t in terms}
    tried = []
    for term in tracer.screen(current.selection):
        if term.candidate.key in taken:
            continue
        refined = tracer.refine(current.selection, term)
        found = _corrected_readings(Found(tracer, tracer.evaluate((*terms, refined))))
        if believable(found):
            tried.append(found)
    return tried


def believable(found: Found) -> bool:
    """Whether all parameters of a model can be true."""
    selection, frame = found.selection, found.tracer.frame
    place = found.tracer.base_design.shape[1]
    for term in selection.terms:
        weights = selection.fit.coefficients[place : place + term.width] + taken_out(frame, term)
        place += term.width
        if not plausible(frame, term.candidate.kind.name, term.candidate.motor, weights):
            return False
    return True


def taken_out(frame: Frame, term: Term) -> FloatArray:
    """What the readings have already been corrected by for a term, beyond the declared."""
    now, declared = _part(frame.corrections, term), _part(declared_corrections(frame.model), term)
    return np.subtract(now, declared)


def _part(c: Corrections, term: Term) -> tuple[float, ...]:
    motor = term.candidate.motor or 0
    return {
        "torque_delay": (c.torque_delay_s[motor],),
        "deflection_offset": (c.offset_rad[motor],),
        "encoder_delay": (c.encoder_delay_s,),
        "encoder_scale": (c.encoder_scale,),
        "encoder_eccentricity": (c.encoder_sin_rad, c.encoder_cos_rad),
    }.get(term.candidate.kind.name, (0.0,) * term.width)


def preferred(tried: list[Found], before: float) -> Found:
    """The best of several, or a simpler one that gains nearly as much."""
    best = min(tried, key=lambda found: found.selection.error)
    gain = max(before - best.selection.error, 0.0)
    near = [
        found
        for found in tried
        if best.selection.error >= (1.0 - _SIMPLER) * found.selection.error
        and before - found.selection.error >= _NEAR * gain
    ]
    return min(near or [best], key=_rank)


def _rank(found: Found) -> tuple[int, float, bool]:
    """Simple first, then what leaves less, by whole percents; at a draw what sits at the motor."""
    term = found.selection.terms[-1]
    percents = round(100.0 * float(np.log(max(found.selection.error, 1e-300))))
    return term.complexity, percents, term.candidate.kind.location != "motor"


def _corrected_readings(found: Found) -> Found:
    """Measurement terms applied to the readings themselves, about the base they belong to, to convergence."""
    for _ in range(_ALIGN):
        tracer, selection = found.tracer, found.selection
        corrections, changed = corrected(tracer.frame, selection)
        if not changed:
            return found
        base = tracer.moved(selection)
        about = tracer.at(tracer.frame.corrections, base)
        corrections, _ = corrected(about.frame, about.evaluate(selection.terms))
        moved = about.at(corrections, base)
        after = Found(moved, moved.evaluate(selection.terms))
        nothing = tracer.evaluate(()).error
        if after.selection.error > _NO_WORSE * selection.error + _LITTLE * nothing:
            return found
        fall = 1.0 - after.selection.error / selection.error
        found = after
        if fall < 1e-3:
            break
    return found


def _settled(found: Found) -> Found:
    """Nonlinear parameters refined beside each other."""
    linked = found.tracer.frame.linked
    for k in range(len(found.selection.terms)):
        terms = found.selection.terms
        memory = linked and terms[k].candidate.kind.law is not None
        if len(terms) < 2 and not memory:
            return found
        rest = found.tracer.evaluate(terms[:k] + terms[k + 1 :])
        term = found.tracer.refine(rest, terms[k], law=memory)
        refined = found.tracer.evaluate((*terms[:k], term, *terms[k + 1 :]))
        if refined.error < found.selection.error:
            found = Found(found.tracer, refined)
    return _corrected_readings(found)


def corrected(frame: Frame, selection: Selection) -> tuple[Corrections, bool]:
    """Corrections with the selection's measurement terms added, and whether there are any."""
    c = frame.corrections
    changed = False
    place = selection.design.shape[1] - sum(t.width for t in selection.terms)
    for term in selection.terms:
        kind, motor = term.candidate.kind, term.candidate.motor or 0
        coefficients = selection.fit.coefficients[place : place + term.width]
        place += term.width
        if kind.name == "torque_delay":
            c = replace(c, torque_delay_s=_added(c.torque_delay_s, motor, float(coefficients[0])))
        elif kind.name == "deflection_offset":
            places = range(len(c.offset_rad)) if term.candidate.motor is None else (motor,)
            for place_of in places:
                c = replace(c, offset_rad=_added(c.offset_rad, place_of, float(coefficients[0])))
        elif kind.name == "encoder_delay":
            c = replace(c, encoder_delay_s=c.encoder_delay_s + float(coefficients[0]))
        elif kind.name == "encoder_scale":
            c = replace(c, encoder_scale=c.encoder_scale + float(coefficients[0]))
        elif kind.name == "encoder_eccentricity":
            sine, cosine = c.encoder_sin_rad + coefficients[0], c.encoder_cos_rad + coefficients[1]
            c = replace(c, encoder_sin_rad=float(sine), encoder_cos_rad=float(cosine))
        else:
            continue
        changed = True
    return c, changed


def _added(values: tuple[float, ...], place: int, step: float) -> tuple[float, ...]:
    return tuple(v + step if i == place else v for i, v in enumerate(values))


def without(found: Found, k: int) -> Found:
    """The same model less one term; a reading it corrected is as it was."""
    terms = found.selection.terms[:k] + found.selection.terms[k + 1 :]
    corrections = restored(found.tracer.frame.corrections, found.selection.terms[k])
    tracer = found.tracer if corrections is None else found.tracer.at(corrections, found.tracer.base)
    return Found(tracer, tracer.evaluate(terms))


def restored(c: Corrections, term: Term) -> Corrections | None:
    """The corrections less those that belong to a term; None where it has none."""
    name, motor = term.candidate.kind.name, term.candidate.motor or 0
    if name == "torque_delay":
        return replace(c, torque_delay_s=_added(c.torque_delay_s, motor, -c.torque_delay_s[motor]))
    if name == "deflection_offset":
        if term.candidate.motor is None:
            return replace(c, offset_rad=tuple(o - c.offset_rad[0] for o in c.offset_rad))
        return replace(c, offset_rad=_added(c.offset_rad, motor, -c.offset_rad[motor]))
    if name == "encoder_delay":
        return replace(c, encoder_delay_s=0.0)
    if name == "encoder_scale":
        return replace(c, encoder_scale=0.0)
    if name == "encoder_eccentricity":
        return replace(c, encoder_sin_rad=0.0, encoder_cos_rad=0.0)
    return None


def _swapped(current: Found) -> Found:
    """Each term in turn replaced where another one does better."""
    for k in range(len(current.selection.terms)):
        if not current.tracer.frame.linked and current.selection.terms[k].candidate.kind.name == _ZERO:
            continue
        other = best_addition(without(current, k))
        if (
            other is None
            or other.selection.terms[-1].candidate.key == current.selection.terms[k].candidate.key
        ):
            continue
        if other.selection.error < (1.0 - _SWAP) * current.selection.error:
            current = _settled(other)
    return current


def _pruned(current: Found, torque_rms: float) -> Found:
    """Without the terms that are no longer needed."""
    for k in range(len(current.selection.terms)):
        rest = without(current, k)
        if not _worth(rest, current, torque_rms, k):
            return _pruned(rest, torque_rms)
    return current
