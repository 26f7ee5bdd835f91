"""Which series of a fleet change, and since when, at a declared false discovery rate.

Level and drift. A series of estimates is compared with one that stays constant. The alternatives are a step
before any recording, a ramp that begins at any recording, and two steps before any two recordings (a repair
undoes a damage). Each is an F test in the regression weighted by the inverse variances (Chow 1960). The
largest over all of a kind is the sup-F statistic (Andrews 1993; Bai and Perron 1998 for two steps);
Bonferroni's inequality bounds its significance, one half of it for one change and one half for two. The bound
holds for every n and needs no simulation. Variances are those that the estimates state, plus the variance
between recordings that makes the median of successive differences (von Neumann 1941) as large as they say:
first ones, or second ones, which are small on a ramp. The scale is estimated from the residuals, so that only
the ratios of the variances matter. Positive correlation between successive residuals reduces the number of
independent ones (Bayley and Hammersley 1946). A change must stay significant whichever recording is left out:
one odd recording is none.

Appearance. Whether an effect is found more often after some recording than before: Fisher's exact test, the
smallest p over all recordings, with the same bound.

Fleet. Benjamini and Hochberg (1995) over all series of all joints. Further changes of a series that is
selected are looked for one after the other at the level of the selection (Benjamini and Bogomolov 2014).
"""

import json
import math
from datetime import UTC, datetime
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.stats import f as f_distribution
from scipy.stats import hypergeom

from drivelink.output.sentences import SURE
from estimator.sample import FloatArray
from estimator.transmissions import RIGID

LEAST = 6  # recordings: fewer leave no degrees of freedom once one is left out and a shape is fitted
_SEGMENT = 2  # recordings on either side of a step: one alone is an odd one
_RAMP = 3  # recordings on a ramp: two are a step
_CHI2_95 = 3.841  # of one degree of freedom: the interval of the place by the likelihood ratio
_MOST = 4  # changes looked for in one series
_FITTED = {  # parameters of every recording, and their standard deviations
    "viscous_damping_nm_s_rad": "viscous_damping_std_nm_s_rad",
    "deflection_offset_rad": "deflection_offset_std_rad",
}
_MAD = 1.4826  # standard deviation of a normal variable over its median absolute deviation


class SeriesChange(NamedTuple):
    """One change of a series."""

    kind: str  # "step" or "drift"
    first: int  # index of the first recording after it, or of the one where the drift begins
    earliest: int  # 95 % interval of `first`
    latest: int  # 95 % interval of `first`
    amount: float  # of the step, or of the drift up to the last recording; unit of the series
    amount_std: float  # its standard deviation
    shape: FloatArray  # (n,) amount as it comes about


class SeriesTest(NamedTuple):
    """A series against its being constant: p value, and the series without any change."""

    p_value: float
    scatter: float


class Point(NamedTuple):
    """An estimate, and the row of the table that it is of."""

    row: dict[str, Any]
    value: float
    std: float | None
    sure: bool = True  # of an effect that has this name for sure


class Appearance(NamedTuple):
    """An effect that is found more often from recording `first` on."""

    p_value: float
    first: int
    rate_before: float
    rate_after: float


class _Shapes(NamedTuple):
    kinds: list[str]
    first: NDArray[np.int64]
    values: FloatArray  # (shapes, n)


def series_test(time_s: FloatArray, value: FloatArray, std: FloatArray) -> SeriesTest:
    """Test one series for any change.

    Args:
        time_s: (n,) increasing.
        value: (n,) estimates.
        std: (n,) their standard deviations, as stated.

    Returns:
        p value, bounded as the module says; 1 for fewer than `LEAST` recordings. And the scatter: standard
        deviation of a typical recording about the constant or changing level.
    """
    if len(value) < LEAST:
        return SeriesTest(1.0, float(np.std(value)) if len(value) > 1 else math.nan)
    weight = _weights(value, std)
    shapes = _shapes(time_s)
    design = np.ones((1, len(value)))
    p_value, best = _strongest(shapes, value, weight, design)
    residual = _projected(np.vstack([design, shapes.values[best]]), value, weight)
    scatter = math.sqrt(float(weight @ residual**2) / float(weight.sum()) * len(value) / (len(value) - 2))
    return SeriesTest(p_value, scatter)


def changes(time_s: FloatArray, value: FloatArray, std: FloatArray, level: float) -> list[SeriesChange]:
    """Return the changes of a series, one after the other as long as the next is significant.

    Returns:
        Those of a series as of `series_test`, in order of time; empty where the first is not significant.
    """
    n = len(value)
    if n < LEAST:
        return []
    weight, shapes = _weights(value, std), _shapes(time_s)
    design = np.ones((1, n))
    chosen: list[int] = []
    while len(chosen) < _MOST and n - len(design) >= LEAST - 1:
        p_value, best = _strongest(shapes, value, weight, design, level)
        if p_value > level:
            break
        chosen += best
        design = np.vstack([design, shapes.values[best]])
    found = [_change(shapes, place, k, design, value, weight) for k, place in enumerate(chosen, start=1)]
    return sorted(found, key=lambda change: change.first)


def _weights(value: FloatArray, std: FloatArray) -> FloatArray:
    """Inverse variances: as stated, plus what first or second differences have beyond that, if less."""
    stated = np.square(std)
    between = []
    for order in ([1.0, -1.0], [1.0, -2.0, 1.0]):
        beyond = np.square(_MAD * np.convolve(value, order, "valid"))
        beyond -= np.convolve(stated, np.square(order), "valid")
        between.append(float(np.median(beyond) / np.sum(np.square(order))))
    variance = stated + max(min(between), 0.0)
    positive = variance[variance > 0.0]
    floor = float(np.median(positive)) if positive.size else 1.0
    return np.asarray(1.0 / np.maximum(variance, 1e-6 * floor))


def _shapes(time_s: FloatArray) -> _Shapes:
    """Steps before each recording, and ramps from each on, rising to 1."""
    n = len(time_s)
    even = float(np.min(np.diff(time_s))) <= 0.0
    t = np.arange(n, dtype=np.float64) if even else time_s - time_s[0]
    steps = [(k, (np.arange(n) >= k).astype(float)) for k in range(_SEGMENT, n - _SEGMENT + 1)]
    ramps = [(k, np.maximum(t - t[k], 0.0) / (t[-1] - t[k])) for k in range(n - _RAMP + 1)]
    kinds = ["step"] * len(steps) + ["drift"] * len(ramps)
    return _Shapes(kinds, np.array([k for k, _ in steps + ramps]), np.array([s for _, s in steps + ramps]))


def _projected(design: FloatArray, rows: FloatArray, weight: FloatArray) -> FloatArray:
    """Rows less their weighted regression on the design; (…, n)."""
    root = np.sqrt(weight)
    basis, _ = np.linalg.qr((design * root).T)
    scaled = rows * root
    return np.asarray((scaled - (scaled @ basis) @ basis.T) / root)


def _strongest(
    shapes: _Shapes, value: FloatArray, weight: FloatArray, design: FloatArray, enough: float = 0.0
) -> tuple[float, list[int]]:
    """Return the shape, or pair of steps, that is most significant beside a design, and its bounded p value.

    A pair is not looked for where one shape is significant at the level `enough`.
    """
    x, y = _projected(design, shapes.values, weight), _projected(design, value, weight)
    gram, c = (x * weight) @ x.T, (x * weight) @ y
    size = np.diag(gram)
    able = size > 1e-9 * (np.square(shapes.values) @ weight)  # a shape that is in the design already is not
    one = np.where(able, c**2 / np.where(able, size, 1.0), 0.0)
    best = [int(np.argmax(one))]
    p_one = _p_value(design, shapes.values[best], value, weight) * len(shapes.kinds)
    if 2.0 * p_one <= enough:
        return 2.0 * p_one, best
    steps = shapes.kinds.count("step")
    first = shapes.first[:steps]
    apart = (first[None, :] - first[:, None] >= _SEGMENT) & able[:steps, None] & able[None, :steps]
    gram, c, size = gram[:steps, :steps], c[:steps], size[:steps]
    determinant = np.outer(size, size) - gram**2
    apart &= determinant > 1e-9 * np.outer(size, size)
    if not apart.any() or len(value) - len(design) - 3 < 1:
        return min(1.0, 2.0 * p_one), best
    cross = np.outer(c**2, size) - 2.0 * np.outer(c, c) * gram + np.outer(size, c**2)
    two = np.where(apart, cross / np.where(apart, determinant, 1.0), -1.0)
    pair = [int(k) for k in np.unravel_index(int(np.argmax(two)), two.shape)]
    p_two = _p_value(design, shapes.values[pair], value, weight) * int(apart.sum())
    return (min(1.0, 2.0 * p_one), best) if p_one <= p_two else (min(1.0, 2.0 * p_two), pair)


def _p_value(design: FloatArray, added: FloatArray, value: FloatArray, weight: FloatArray) -> float:
    """Of the F test of some shapes beside a design, the largest over every recording left out and none."""
    (n,), extra = value.shape, len(added)
    whole = np.vstack([design, added])
    freedom = n - len(whole)
    before, after = _squares(design, value, weight), _squares(whole, value, weight)
    share = _independent(_projected(whole, value, weight))
    gain = np.maximum(before - after, 0.0) / np.maximum(after, 1e-12 * before[0] + 1e-300)
    degrees = np.append(freedom, np.full(n, freedom - 1))
    tails = f_distribution.sf(share * gain * degrees / extra, extra, degrees)
    return float(np.max(tails)) if before[0] > 1e-18 * float(weight @ value**2) else 1.0


def _squares(design: FloatArray, value: FloatArray, weight: FloatArray) -> FloatArray:
    """(1 + n,) weighted squares that a regression leaves: with all recordings, and without each of them."""
    basis, _ = np.linalg.qr((design * np.sqrt(weight)).T)
    leverage = np.minimum(np.square(basis).sum(axis=1), 1.0 - 1e-9)
    terms = weight * np.square(_projected(design, value, weight))
    total = float(terms.sum())
    return np.append(total, np.maximum(total - terms / (1.0 - leverage), 0.0))


def _independent(residual: FloatArray) -> float:
    """Share of independent ones among residuals with lag-1 correlation r > 0: (1 - r) / (1 + r)."""
    power = float(residual @ residual)
    if power <= 0.0:
        return 1.0
    r = max(float(residual[1:] @ residual[:-1]) / power, 0.0)
    return (1.0 - r) / (1.0 + r)


def _change(
    shapes: _Shapes, place: int, row: int, design: FloatArray, value: FloatArray, weight: FloatArray
) -> SeriesChange:
    """Return a chosen shape with its size beside the others, and the places that fit as well."""
    n, used = len(value), len(design)
    normal = (design * weight) @ design.T
    solution = np.linalg.solve(normal, (design * weight) @ value)
    residual = value - solution @ design
    scale = float(weight @ residual**2) / (n - used) / _independent(residual)
    std = math.sqrt(scale * float(np.linalg.inv(normal)[row, row]))
    others = np.delete(design, row, axis=0)
    x, y = _projected(others, shapes.values, weight), _projected(others, value, weight)
    wxx = np.square(x) @ weight
    explained = ((x * y) @ weight) ** 2 / np.where(wxx > 1e-12, wxx, np.inf)
    cost = float(np.square(y) @ weight) - explained
    kind = np.array([k == shapes.kinds[place] for k in shapes.kinds])
    near = shapes.first[kind & (cost <= cost[place] + _CHI2_95 * scale)]
    amount = float(solution[row])
    return SeriesChange(
        shapes.kinds[place],
        int(shapes.first[place]),
        int(near.min()),
        int(near.max()),
        amount,
        std,
        amount * shapes.values[place],
    )


def appearance(found: NDArray[np.bool_]) -> Appearance:
    """Test whether something is found more often from some recording on.

    Args:
        found: (n,) whether it was, in order of time.
    """
    n, total = len(found), int(found.sum())
    if n < 2 or total == 0 or total == n:
        return Appearance(1.0, 0, total / max(n, 1), total / max(n, 1))
    k = np.arange(1, n)
    after = total - np.cumsum(found)[:-1]
    p = np.asarray(hypergeom.sf(after - 1, n, total, n - k))
    first, least = int(k[np.argmin(p)]), float(np.min(p))
    rates = float(found[:first].mean()), float(found[first:].mean())
    return Appearance(min(1.0, least * (n - 1)), first, *rates)


def usable(row: dict[str, Any]) -> bool:
    """Return whether a row has a usable stiffness."""
    value, std = row["stiffness_middle_nm_rad"], row["stiffness_std_middle_nm_rad"]
    known = value is not None and value > 0.0 and std is not None
    return bool(row["status"] == "done" and row["excited"] and known)


def unusable(rows: list[dict[str, Any]], shown: set[tuple[str, int]]) -> list[dict[str, Any]]:
    """Return the recordings that show no stiffness of a transmission that has one, and why.

    Args:
        shown: report and transmission of those that do.
    """
    return [
        {
            "time": iso(row["time"]),
            "recording": row["recording"],
            "transmission": row["transmission"] if row["status"] == "done" else None,
            "reason": _reason(row),
            "report": row["report"] or "",
        }
        for row in rows
        if row["time"] is not None
        and (row["report"], row["transmission"]) not in shown
        and row["model"] != RIGID
    ]


def _reason(row: dict[str, Any]) -> str:
    if row["status"] != "done":
        return str(row["error"])
    value = row["stiffness_middle_nm_rad"]
    if row["excited"] and value is not None and value <= 0.0:
        return "the fitted stiffness is not above zero"
    return "its motion does not reveal the stiffness"


def lost(transmissions: list[dict[str, Any]], unusable: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return the latest recordings, as far as they show no stiffness where earlier ones do."""
    found = []
    for one in transmissions:
        last = one["series"][-1]["time"]
        found += [
            row for row in unusable
            if row["time"] > last and row["transmission"] in (None, one["transmission"])
        ]  # fmt: skip
    return list({row["recording"]: row for row in found}.values())


def parameters(rows: list[dict[str, Any]]) -> dict[tuple[str, int], list[Point]]:
    """Return damping, zero and parameters of the effects found over the recordings, by name and motor."""
    series: dict[tuple[str, int], list[Point]] = {}
    for row in rows:
        motor = int(row["transmission"])
        moves = row["excited"] or row["model"] == RIGID
        found = {(name, motor): (row[name], row[std], True) for name, std in _FITTED.items() if moves}
        for effect in json.loads(row["details"] or "{}").get("effects", ()) if motor == 1 else ():
            for name, value in effect["parameters"].items():
                key = f"{effect['name']}.{name}", effect.get("motor", 1)
                found[key] = value, effect["std"].get(name), effect.get("probability", 1.0) >= SURE
        for key, (value, std, sure) in found.items():
            if isinstance(value, int | float) and row["time"] is not None:
                known = std if isinstance(std, int | float) else None
                series.setdefault(key, []).append(Point(row, value, known, sure))
    return {key: points for key, points in sorted(series.items()) if len(points) > 1}


def iso(moment: datetime | None) -> str | None:
    """Write a time as in fleet.json."""
    return None if moment is None else moment.astimezone(UTC).isoformat(timespec="seconds")
