"""A selection as findings: parameters with intervals, alternatives, curves, errors."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from estimator.diagnosis.candidates import columns
from estimator.diagnosis.curves import FreeCurve
from estimator.diagnosis.frame import Frame
from estimator.diagnosis.result import Curve, Errors, Finding, Rival
from estimator.diagnosis.search import Found, additions, taken_out, without
from estimator.diagnosis.select import Term
from estimator.model import ParameterValue
from estimator.sample import FloatArray

__all__ = ["curve_of", "curve_of_free", "errors", "findings", "rivals"]

FloatMask = NDArray[np.bool_]

_TIE = 1.18  # squared error of an alternative over that of the chosen effect
_SCATTER = 2.0  # or within so many standard errors of the blocks' differences
_STEP = 1e-3
_FIXED = ("side", "power", "exponent", "shape")


def findings(found: Found) -> list[Finding]:
    """The terms as findings, the one that explains most first."""
    deviations = _deviations(found)
    made = []
    for k, term in enumerate(found.selection.terms):
        rest = without(found, k)
        share = (rest.selection.error - found.selection.error) / max(rest.selection.error, 1e-300)
        parameters, std = _parameters(found, k, deviations)
        made.append(
            (
                rest.selection.error - found.selection.error,
                Finding(
                    name=term.candidate.kind.name,
                    location=term.candidate.kind.location,
                    motor=term.candidate.motor,
                    parameters=parameters,
                    std=std,
                    alternatives=_alternatives(found, rest, term),
                    share=float(share),
                ),
            )
        )
    made.sort(key=lambda pair: -pair[0])
    return [finding for _, finding in made]


def _alternatives(found: Found, rest: Found, term: Term) -> tuple[str, ...]:
    """Other effects that leave as little."""
    names = []
    for other in sorted(additions(rest), key=lambda o: o.selection.error):
        candidate = other.selection.terms[-1].candidate
        if candidate.key == term.candidate.key:
            continue
        more = other.selection.fit.cross - found.selection.fit.cross
        spread = float(np.std(more, ddof=1) * np.sqrt(len(more)))
        fall = rest.selection.error - found.selection.error
        close = other.selection.error < _TIE * found.selection.error
        if (close or more.sum() < _SCATTER * spread) and more.sum() < 0.1 * fall:
            names.append(candidate.kind.name)
    return tuple(dict.fromkeys(n for n in names if n != term.candidate.kind.name))


def _deviations(found: Found) -> list[tuple[FloatArray, dict[str, float]]]:
    """Per term: standard deviations of its linear, and of its nonlinear parameters."""
    tracer, selection = found.tracer, found.selection
    extra, owners = [], []
    place = tracer.base_design.shape[1]
    for k, term in enumerate(selection.terms):
        weights = selection.fit.coefficients[place : place + term.width]
        place += term.width
        for name in term.values:
            if name in _FIXED:
                continue
            step = _STEP * (abs(term.values[name]) or 1.0)
            up = tracer.columns(term.candidate, {**term.values, name: term.values[name] + step})
            down = tracer.columns(term.candidate, {**term.values, name: term.values[name] - step})
            extra.append(((up - down) @ weights) / (2 * step))
            owners.append((k, name))
    design = np.column_stack([selection.design, *extra]) if extra else selection.design
    std = np.sqrt(np.maximum(np.diag(tracer.rows.fit(design, tracer.target).covariance), 0.0))
    made = []
    place = tracer.base_design.shape[1]
    for k, term in enumerate(selection.terms):
        nonlinear = {
            name: float(std[selection.design.shape[1] + j]) for j, (o, name) in enumerate(owners) if o == k
        }
        made.append((std[place : place + term.width], nonlinear))
        place += term.width
    return made


def _parameters(
    found: Found, k: int, deviations: list[tuple[FloatArray, dict[str, float]]]
) -> tuple[dict[str, ParameterValue], dict[str, ParameterValue]]:
    selection, term = found.selection, found.selection.terms[k]
    place = found.tracer.base_design.shape[1] + sum(t.width for t in selection.terms[:k])
    linear = selection.fit.coefficients[place : place + term.width] + taken_out(found.tracer.frame, term)
    parameters: dict[str, ParameterValue] = dict(
        zip(term.candidate.kind.linear, (float(x) for x in linear), strict=True)
    )
    parameters.update(term.values)
    std: dict[str, ParameterValue] = dict(
        zip(term.candidate.kind.linear, (float(x) for x in deviations[k][0]), strict=True)
    )
    std.update(deviations[k][1])
    return parameters, std


def rivals(singles: list[Found], scale: float) -> list[Rival]:
    """Where each candidate stands alone, best first, as error relative to `scale` (weighted)."""
    standing = []
    for found in singles:
        rows = found.tracer.rows.train.sum()
        candidate = found.selection.terms[-1].candidate
        error = float(np.sqrt(found.selection.error / rows)) / scale
        standing.append(Rival(candidate.kind.name, candidate.kind.location, candidate.motor, error))
    return sorted(standing, key=lambda rival: rival.error_relative)


def errors(frame: Frame, before: FloatArray, after: FloatArray, rows: FloatMask, demean: bool) -> Errors:
    """Errors of the motors' balances over some rows, and relative to their torques.

    Args:
        frame: the recording.
        before: what the declared model leaves, all rows, stacked.
        after: what the augmented model leaves.
        rows: (n,) which rows of one equation.
        demean: whether a constant is free, and taken off all.
    """
    motors = len(frame.motors)
    torque = np.stack([frame.project(c.torque) for c in frame.motors])
    parts = [x.reshape(frame.equations, -1)[:motors] for x in (before, after)]
    sizes = []
    for part in (*parts, torque):
        chosen = part[:, rows]
        if demean:
            chosen = chosen - chosen.mean(axis=1, keepdims=True)
        sizes.append(float(np.sqrt(np.mean(chosen**2))))
    scale = max(sizes[2], 1e-300)
    return Errors(sizes[0], sizes[1], sizes[0] / scale, sizes[1] / scale)


def curve_of_free(found: Found, free: FreeCurve) -> Curve:
    """Residual of the declared model against the coordinates of a free curve, with the curve."""
    tracer, frame = found.tracer, found.tracer.frame
    columns_of = free.columns(frame)
    fitted = columns_of @ free.selection.fit.coefficients[-columns_of.shape[1] :]
    residual = tracer.left(free.selection, free.columns) + fitted
    equation = frame.equations - 1 if free.location == "link" else free.motor or 0
    sign = -1.0 if free.location == "motor" else 1.0
    c = frame.motors[free.motor or 0]
    pick = slice(equation * frame.rows, (equation + 1) * frame.rows)
    x = [frame.project(getattr(c, name)) for name in free.coordinates]
    return Curve(
        name="unlisted",
        coordinates=free.coordinates,
        x=x[0],
        second=x[1] if len(x) > 1 else None,
        residual_nm=sign * residual[pick],
        fitted_nm=sign * fitted[pick],
    )


def curve_of(found: Found, k: int) -> Curve:
    """Residual without a term against the coordinate that reveals it, with the term, on the rows."""
    tracer, selection = found.tracer, found.selection
    frame, term = tracer.frame, selection.terms[k]
    made = columns(frame, term.candidate, term.values)
    place = tracer.base_design.shape[1] + sum(t.width for t in selection.terms[:k])
    fitted = made @ (
        selection.fit.coefficients[place : place + term.width] + taken_out(found.tracer.frame, term)
    )
    residual = tracer.left(selection) + fitted
    equation = frame.equations - 1 if term.candidate.kind.location == "link" else term.candidate.motor or 0
    sign = -1.0 if term.candidate.kind.location == "motor" else 1.0
    coordinate = getattr(frame.motors[term.candidate.motor or 0], term.candidate.kind.coordinate)
    pick = slice(equation * frame.rows, (equation + 1) * frame.rows)
    return Curve(
        name=term.candidate.kind.name,
        coordinates=(term.candidate.kind.coordinate,),
        x=frame.project(coordinate),
        residual_nm=sign * residual[pick],
        fitted_nm=sign * fitted[pick],
    )
