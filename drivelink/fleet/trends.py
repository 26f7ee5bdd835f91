"""Stiffness and other parameters of a joint over its recordings: what changes, and what the change is of."""

import json
import math
from collections import Counter
from typing import Any, NamedTuple

import numpy as np

from drivelink.fleet.analysis import stiffness_at
from drivelink.fleet.changes import (
    LEAST,
    Point,
    SeriesChange,
    SeriesTest,
    changes,
    iso,
    parameters,
    series_test,
    usable,
)
from drivelink.output.numbers import Units
from estimator.diagnosis.stiffness import Middle
from estimator.sample import SIGMA_95, FloatArray
from estimator.transmissions import MODELS

_DAY_S = 86400.0


class Series(NamedTuple):
    """Stiffness of one transmission over its usable recordings, or another parameter."""

    name: str
    transmission: int
    deflection_rad: float
    points: list[Point]
    time_s: FloatArray
    value: FloatArray
    std: FloatArray
    test: SeriesTest | None  # None: too few, or no intervals

    @property
    def units(self) -> Units:
        """Those of the joint's axis."""
        return Units(self.points[-1].row["axis"] == "linear")


def stiffnesses(rows: list[dict[str, Any]]) -> list[Series]:
    """Return the stiffness of each transmission at one deflection, where a recording determines it there."""
    made = []
    able = [row for row in rows if usable(row)]
    for number in sorted({int(row["transmission"]) for row in able}):
        own = [row for row in able if row["transmission"] == number]
        phi = float(np.median([row["deflection_middle_rad"] for row in own]))
        points = [Point(row, *_stiffness(row, phi)) for row in own]
        known = [p for p in points if Middle(p.value, p.std or 0.0, np.empty(0)).determined]
        made += [_tested("stiffness_nm_rad", number, phi, known)] if known else []
    return made


def others(rows: list[dict[str, Any]]) -> list[Series]:
    """Return damping, zero and the parameters of the effects found."""
    done = [row for row in rows if row["status"] == "done"]
    return [_tested(*key, math.nan, points) for key, points in parameters(done).items()]


def _tested(name: str, motor: int, phi: float, points: list[Point]) -> Series:
    time_s = np.array([p.row["time"].timestamp() for p in points])
    value, std = np.array([p.value for p in points]), np.array([p.std or 0.0 for p in points])
    sure = 2 * sum(p.sure for p in points) > len(points)  # most
    able = sure and len(points) >= LEAST and all(p.std for p in points)
    test = series_test(time_s, value, std) if able else None
    return Series(name, motor, phi, points, time_s, value, std, test)


def _stiffness(row: dict[str, Any], phi: float) -> tuple[float, float]:
    """Stiffness at the joint's common deflection; as recorded for an unknown model."""
    if row["model"] not in MODELS:
        return row["stiffness_middle_nm_rad"], row["stiffness_std_middle_nm_rad"]
    return stiffness_at(row["model"], json.loads(row["parameters"]), row["covariance"], phi)


def transmission(series: Series, q: float, level: float) -> dict[str, Any]:
    """Return a stiffness for fleet.json; its changes are looked for at a level, 0: it does not change."""
    found, fitted, base = _changes(series, level)
    inertias = _inertia(series, found) if found else []
    p_value, scatter = series.test or (1.0, float(np.std(series.value)))
    return {
        "transmission": series.transmission,
        "deflection_rad": series.deflection_rad,
        "unit": series.units.shown("N·m/rad"),
        "deflection_unit": series.units.shown("rad"),
        "p_value": p_value,
        "q_value": q,
        "significant": bool(level),
        "stiffness_nm_rad": float(fitted[-1]),
        "scatter_relative": scatter / base,
        "changes": [
            _changed(series, one)
            | _relative(series, one, base)
            | {"causes": _causes(series, one, base, *inertia)}
            for one, inertia in zip(found, inertias, strict=True)
        ],
        "series": _named(series, fitted, "stiffness_nm_rad", "std_nm_rad", "fitted_nm_rad"),
    }


def parameter(series: Series, q: float, level: float) -> dict[str, Any]:
    """Return another parameter, likewise; `share` of the largest value is the size of a change."""
    found, fitted, _ = _changes(series, level)
    most = float(np.max(np.abs(fitted)))
    return {
        "name": series.name,
        "motor": series.transmission,
        "unit": series.units.of(series.name),
        "q_value": q,
        "changes": [
            _changed(series, c)
            | {"amount": c.amount, "amount_std": c.amount_std, "share": abs(c.amount) / most}
            for c in found
        ],
        "series": _named(series, fitted, "value", "std", "fitted"),
    }


def _named(series: Series, fitted: FloatArray, *names: str) -> list[dict[str, Any]]:
    """Name value, standard deviation and level of each recording."""
    return [
        {"time": iso(row["time"]), **dict(zip(names, (value, std, float(now)), strict=True))}
        | {key: row[key] for key in ("verdict", "recording", "report")}
        for (row, value, std, _), now in zip(series.points, fitted, strict=True)
    ]


def _changes(series: Series, level: float) -> tuple[list[SeriesChange], FloatArray, float]:
    """Return the changes of a series, the series without scatter, and its level before any change."""
    found = changes(series.time_s, series.value, series.std, level) if level else []
    change = sum((one.shape for one in found), np.zeros(len(series.value)))
    base = float(np.median(series.value - change))
    return found, base + change, base


def _inertia(series: Series, found: list[SeriesChange]) -> list[tuple[float, float]]:
    """Return by what share the motor's inertia changes with each change of the stiffness, and the deviation.

    The declared inertia may pull all of them alike, so many make it no smaller than one's own.
    """
    value, std = (
        np.array([math.nan if p.row[key] is None else p.row[key] for p in series.points])
        for key in ("inertia_kg_m2", "inertia_std_kg_m2")
    )
    design = np.array([np.ones(len(value)), *(one.shape / one.amount for one in found)])
    inverse = np.linalg.inv(design @ design.T)
    solution = inverse @ design @ value
    left = np.sum(np.square(value - solution @ design)) / (len(value) - len(design))
    variance = left * np.diag(inverse) + np.median(std) ** 2
    return [
        (float(a / solution[0]), float(s / solution[0]))
        for a, s in zip(solution[1:], np.sqrt(variance[1:]), strict=True)
    ]


def _causes(
    series: Series, change: SeriesChange, base: float, inertia: float, inertia_std: float
) -> list[str]:
    """Return what a change of the stiffness may be of.

    Where the inertia changes alike, or may, the torque's scale; and an effect of the transmission that most
    recordings after it show: beside it a stiffness is not the spring's alone.
    """
    apart = abs(change.amount / base - inertia) > SIGMA_95 * math.hypot(change.amount_std / base, inertia_std)
    moves = abs(inertia) > SIGMA_95 * inertia_std
    scales = ["stiffness", "torque_scale"] if apart == moves else ["stiffness"] if apart else ["torque_scale"]
    places = ("@transmission", f"@transmission{series.transmission}")
    rows = [p.row for p in series.points[change.first :]]
    seen = Counter(n.partition("@")[0] for row in rows for n in row["effects"] or () if n.endswith(places))
    return scales + [name for name, count in seen.items() if 2 * count > len(rows)]


def _changed(series: Series, change: SeriesChange) -> dict[str, Any]:
    places = {"since": change.first, "since_earliest": change.earliest, "since_latest": change.latest}
    return {"kind": change.kind} | {key: iso(series.points[k].row["time"]) for key, k in places.items()}


def _relative(series: Series, change: SeriesChange, base: float) -> dict[str, Any]:
    days = (series.time_s[-1] - series.time_s[change.first]) / _DAY_S
    document = {"amount_nm_rad": change.amount, "amount_std_nm_rad": change.amount_std}
    document |= {"amount_relative": change.amount / base, "amount_std_relative": change.amount_std / base}
    if change.kind == "drift" and days > 0.0:
        document["per_30_days_relative"] = change.amount / base / days * 30.0
    return document
