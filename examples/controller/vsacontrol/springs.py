"""A transmission as a control law needs it: torque, stiffness, and the stiffness's first two derivatives."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from typing import Any, NamedTuple

from estimator.errors import EstimatorError
from estimator.transmissions import MODELS

__all__ = ["Law", "Point", "spring", "springs_of"]

_EDGE = 0.995  # of the angle at which the VSA-II's linkage is stretched out; nothing is evaluated beyond
_STEP = 1e-3  # rad, of the differences for laws whose derivatives are not written here


class Point(NamedTuple):
    """A transmission at one deflection.

    Attributes:
        torque: tau_e(phi), N·m (eq 17).
        stiffness: sigma = d tau_e / d phi, N·m/rad (eq 18).
        slope: d sigma / d phi, N·m/rad².
        bend: d² sigma / d phi², N·m/rad³.
    """

    torque: float
    stiffness: float
    slope: float
    bend: float


Law = Callable[[float], Point]


def spring(model: str, parameters: Mapping[str, Any], scale: float = 1.0) -> Law:
    """The law of a transmission model by its name and parameters in the joint file.

    Args:
        model: a name in `estimator.transmissions.MODELS`.
        parameters: as in the joint file, or as the daemon's status says them.
        scale: factor on the torque, for a model that is wrong on purpose.

    Raises:
        EstimatorError: the parameters do not fit the model.
        KeyError: there is no such model.
    """
    known = MODELS[model]
    plain = {k: tuple(v) if isinstance(v, list) else v for k, v in parameters.items()}
    alpha = known.alpha(plain).tolist()
    if known.linear is None or model == "linear":
        return _polynomial([scale * a for a in alpha])
    if model == "vsa-ii":
        return _vsa_ii(scale * alpha[0], alpha[1])
    alpha[0] *= scale

    def differenced(phi: float) -> Point:
        torque, stiffness = known.at(phi, alpha)
        before, after = known.at(phi - _STEP, alpha)[1], known.at(phi + _STEP, alpha)[1]
        bend = (after - 2.0 * stiffness + before) / _STEP**2
        return Point(torque, stiffness, (after - before) / (2.0 * _STEP), bend)

    return differenced


def springs_of(transmissions: Sequence[Mapping[str, Any]]) -> tuple[Law, ...] | None:
    """Laws from the `transmissions` of the daemon's status; None where one is unknown or impossible."""
    if not transmissions or any(not entry.get("parameters") for entry in transmissions):
        return None
    with suppress(EstimatorError):  # an estimate on its way may leave the range where the law makes sense
        return tuple(spring(entry["model"], entry["parameters"]) for entry in transmissions)
    return None


def _polynomial(coefficients: Sequence[float]) -> Law:
    """Odd powers (eq 24): tau_e = sum_h a_h phi^(2h-1)."""
    powers = [2 * h + 1 for h in range(len(coefficients))]
    rows = [
        (a, a * n, a * n * (n - 1), a * n * (n - 1) * (n - 2))
        for a, n in zip(coefficients, powers, strict=True)
    ]
    rows.reverse()

    def at(phi: float) -> Point:
        square = phi * phi
        torque = stiffness = slope = bend = 0.0
        for a, b, c, d in rows:
            torque, stiffness = torque * square + a, stiffness * square + b
            slope, bend = slope * square + c, bend * square + d
        # slope belongs to phi^(2h-3), bend to phi^(2h-4): zero for h = 1, so both may be divided.
        if phi == 0.0:
            return Point(0.0, stiffness, 0.0, rows[-2][3] if len(rows) > 1 else 0.0)
        return Point(torque * phi, stiffness, slope / phi, bend / square)

    return at


def _vsa_ii(k: float, c: float) -> Law:
    """Eqs 19, 20: tau_e = 2 k beta beta', beta = arcsin(C sin(phi/2)) - phi/2, derivatives in closed form.

    With s = sin(phi/2), R = 1 - C² s²: beta'' = C (C²-1) s / (4 R^1.5), and so on by the chain rule;
    sigma = 2k (beta'² + beta beta''), sigma' = 2k (3 beta' beta'' + beta beta'''),
    sigma'' = 2k (3 beta''² + 4 beta' beta''' + beta beta'''').
    """
    stop = _EDGE * 2.0 * math.asin(1.0 / c)
    factor, c2 = c * (c * c - 1.0), c * c

    def at(phi: float) -> Point:
        half = 0.5 * max(-stop, min(stop, phi))
        s, cosine = math.sin(half), math.cos(half)
        r = 1.0 - c2 * s * s
        root = math.sqrt(r)
        grown, power = 1.0 + 2.0 * c2 * s * s, r * r * root
        b0 = math.asin(c * s) - half
        b1 = 0.5 * (c * cosine / root - 1.0)
        b2 = 0.25 * factor * s / (r * root)
        b3 = 0.125 * factor * cosine * grown / power
        inner = (2.5 * c2 * cosine * cosine - 0.5 * r) * grown + 2.0 * c2 * cosine * cosine * r
        b4 = 0.125 * factor * s * inner / (power * r)
        return Point(
            2.0 * k * b0 * b1,
            2.0 * k * (b1 * b1 + b0 * b2),
            2.0 * k * (3.0 * b1 * b2 + b0 * b3),
            2.0 * k * (3.0 * b2 * b2 + 4.0 * b1 * b3 + b0 * b4),
        )

    return at
