"""Free curves at each location over each coordinate, for effects outside the library."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from scipy.interpolate import BSpline
from scipy.linalg import solve_banded

from estimator.choices import choice, whole
from estimator.diagnosis.candidates import reverses
from estimator.diagnosis.design_matrix import Extra
from estimator.diagnosis.frame import Frame
from estimator.diagnosis.hypothesis import Fitted
from estimator.diagnosis.search import Search
from estimator.effects import Coordinates
from estimator.sample import FloatArray

__all__ = ["best_curve"]

_DEGREE = 3  # cubic

Basis = Callable[[Coordinates], FloatArray]


class _Splines:
    """Cubic B-splines over the range of x, knots halfway between evenly spaced ones and quantiles."""

    def __init__(self, x: FloatArray, knots: int) -> None:
        self._low, self._high = float(np.min(x)), float(np.max(x))
        share = np.linspace(0.0, 1.0, knots)
        inner = 0.5 * np.quantile(x, share) + 0.5 * (self._low + (self._high - self._low) * share)
        inner[0], inner[-1] = self._low, self._high
        self._t = np.concatenate(([self._low] * _DEGREE, inner, [self._high] * _DEGREE))

    def __call__(self, x: FloatArray) -> FloatArray:
        """(n, k) at x, constant beyond the range."""
        inside = np.clip(x, self._low, self._high)
        return np.asarray(BSpline.design_matrix(inside, self._t, _DEGREE).toarray())


def best_curve(search: Search, beside: Fitted, place: tuple[str, int | None] | None = None) -> Fitted | None:
    """Return the free curve with the most evidence when added to a model, over all places and coordinates.

    Args:
        search: the recordings.
        beside: the model.
        place: location and motor of a certain deficit: choose the curve with the least residual there.
    """
    problem = search.problem
    frame = problem.at(beside.corrections, beside.base)[0]
    best: Fitted | None = None
    for location, motor in [place] if place else _places(frame):
        for coordinates, basis in _bases(frame, beside, location, motor or 0):
            curve = problem.with_curve(beside, Extra(location, motor, coordinates, basis), steps=0)
            if best is None:
                best = curve
            elif place:
                best = min(best, curve, key=lambda c: float(np.sum(np.log(c.posterior.sigma))))
            elif np.mean(search.held.scores(curve)) > np.mean(search.held.scores(best)):
                best = curve
    if best is None or best.extra is None:
        return None
    return problem.with_curve(beside, best.extra, steps=1)


def _places(frame: Frame) -> list[tuple[str, int | None]]:
    places: list[tuple[str, int | None]] = [("motor", i) for i in range(len(frame.motors))]
    places += [("transmission", i) for i, flexible in enumerate(frame.flexible) if flexible]
    return places + ([("link", None)] if frame.linked else [])


def _bases(frame: Frame, beside: Fitted, location: str, motor: int) -> list[tuple[tuple[str, ...], Basis]]:
    """Bases for one place, with the names of their coordinates."""
    c = frame.motors[motor]
    place, rate, *others = {
        "motor": ("position", "velocity"),
        "transmission": ("deflection", "deflection_rate", "position"),
        "link": ("link_position", "link_velocity"),
    }[location]
    reversing = reverses(c.velocity)  # a one-way motion is a function of time
    made: list[tuple[tuple[str, ...], Basis]] = [
        ((name,), _over(name, _Splines(getattr(c, name), whole("points")))) for name in (place, rate, *others)
    ]
    v = getattr(c, rate)
    slow = _Splines(c.time, whole("groups"))
    if location == "motor" and frame.linked:
        made.append((("torque",), _beyond_scale(_over("torque", _Splines(c.torque, whole("points"))))))
        made.append(
            (
                ("position", "torque"),
                _beyond_scale(_scaled("torque", "position", _Splines(c.position, whole("points")), c)),
            )
        )
    smoothing = max(choice("smoothing") * float(np.sqrt(np.mean(v * v))), 1e-12)
    made.append(
        (
            (place, rate),
            _both_ways(place, rate, smoothing, _Splines(getattr(c, place), whole("groups"))),
        )
    )
    if location == "motor" and reversing:
        made.append((("velocity", "time"), _fading(slow, smoothing, c)))
    if location == "transmission":
        if reversing:
            made.append((("deflection", "time"), _scaled("deflection", "time", slow, c)))
        longest_s = float(c.time[-1]) / whole("groups")
        lags = _creeping(1.0 / frame.signals.bandwidth_hz, longest_s)
        made.append((("deflection", "deflection_rate"), lags))
        path = _Splines(c.link_position, whole("groups"))
        made.append((("deflection", "link_position"), _scaled("deflection", "link_position", path, c, True)))
    made.append((("time",), _waves(frame, beside, *_line(frame, beside, location, motor))))
    if reversing:
        made.append((("time",), _over("time", slow)))
    return made


def _over(name: str, splines: _Splines) -> Basis:
    return lambda c: splines(getattr(c, name))


def _beyond_scale(whole_basis: Basis) -> Basis:
    """Functions without the part that is proportional to the torque, which would explain anything."""

    def basis(c: Coordinates) -> FloatArray:
        path = whole_basis(c)
        return np.asarray(path - np.outer(c.torque, c.torque @ path) / (c.torque @ c.torque))

    return basis


def _both_ways(place: str, rate: str, smoothing: float, splines: _Splines) -> Basis:
    def basis(c: Coordinates) -> FloatArray:
        path = splines(getattr(c, place))
        return np.column_stack((path, np.tanh(getattr(c, rate) / smoothing)[:, None] * path))

    return basis


def _scaled(factor: str, over: str, splines: _Splines, c: Coordinates, alone: bool = False) -> Basis:
    """Terms proportional to one coordinate, with a factor that depends on another."""
    size = max(float(np.sqrt(np.mean(getattr(c, factor) ** 2))), 1e-300)

    def basis(c: Coordinates) -> FloatArray:
        path = splines(getattr(c, over))
        product = getattr(c, factor)[:, None] / size * path
        return np.column_stack((product, path)) if alone else np.asarray(product)

    return basis


def _creeping(shortest_s: float, longest_s: float) -> Basis:
    """Terms that follow the deflection with a lag: creep and relaxation, time constants an octave apart."""
    lags_s = shortest_s * 2.0 ** np.arange(max(math.log2(longest_s / shortest_s), 0.0) + 1.0)

    def basis(c: Coordinates) -> FloatArray:
        period, made = float(c.time[1] - c.time[0]), []
        for lag in lags_s:
            keep = math.exp(-period / lag)
            pulled = (1.0 - keep) * c.deflection
            pulled[0] = c.deflection[0]
            steps = np.array([[1.0], [-keep]]) + np.zeros(len(pulled))  # y[k] - keep y[k-1] = pulled[k]
            made.append(solve_banded((1, 0), steps, pulled))
        return np.stack(made, axis=1)

    return basis


def _fading(splines: _Splines, smoothing: float, c: Coordinates) -> Basis:
    """Friction and damping that change over time."""
    size = max(float(np.sqrt(np.mean(c.velocity**2))), 1e-300)

    def basis(c: Coordinates) -> FloatArray:
        slow = splines(c.time)
        sign, speed = np.tanh(c.velocity / smoothing), c.velocity / size
        return np.column_stack((sign[:, None] * slow, speed[:, None] * slow))

    return basis


def _waves(frame: Frame, beside: Fitted, frequency: float, resolution: float, equation: int) -> Basis:
    """A line and its harmonics, the line refined; both in rad/s."""
    count = int(np.clip(2.0 * np.pi * frame.signals.bandwidth_hz / frequency, 1, whole("points") // 2))

    def made(time: FloatArray, w: float) -> FloatArray:
        return np.stack([f(k * w * time) for k in range(1, count + 1) for f in (np.sin, np.cos)], axis=1)

    residual = _residual(frame, beside, equation)
    time = frame.motors[0].time[:: frame.rows_step][: len(frame.signals.keep)][frame.signals.keep]

    def left(w: float) -> float:
        columns = np.column_stack((made(time, w), np.ones(len(time))))
        solution = np.linalg.lstsq(columns, residual, rcond=None)[0]
        return float(np.sum((residual - columns @ solution) ** 2))

    near = frequency + resolution * np.linspace(-1.0, 1.0, 2 * whole("points") + 1)
    best = float(min(near, key=left))
    return lambda c: made(c.time, best)


def _residual(frame: Frame, beside: Fitted, equation: int) -> FloatArray:
    """Residual of one balance of the first recording."""
    left = beside.regression.residual(beside.posterior.x)
    return left[equation * frame.rows : (equation + 1) * frame.rows]


def _line(frame: Frame, beside: Fitted, location: str, motor: int) -> tuple[float, float, int]:
    """The strongest spectral line of one equation's residual, for a curve with harmonics.

    Returns:
        Its frequency and the resolution, rad/s, and the equation.
    """
    equation = frame.equations - 1 if location == "link" else motor
    part = _residual(frame, beside, equation)
    period = frame.signals.narrow.period_s
    window = np.hanning(len(part))
    size = 4 * len(part)
    power = np.abs(np.fft.rfft((part - part.mean()) * window, size)) ** 2
    first = int(np.ceil(3.0 * size / len(part)))
    harmonic = power[first:].copy()
    index = np.arange(first, len(power))
    for k in range(2, whole("harmonics") + 1):
        ok = k * index < len(power)
        harmonic[ok] += power[k * index[ok]]
    unit = 2.0 * np.pi / (size * period)
    return (first + int(np.argmax(harmonic))) * unit, unit, equation
