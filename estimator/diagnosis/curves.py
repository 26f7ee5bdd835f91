"""The fallback: a free curve at each location, over each coordinate, for what is in no library."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy.interpolate import BSpline
from scipy.signal import lfilter

from estimator.diagnosis.frame import Frame
from estimator.diagnosis.regression import Rows
from estimator.diagnosis.select import Selection, Tracer
from estimator.effects import Coordinates
from estimator.sample import FloatArray

__all__ = ["FreeCurve", "any_time", "best_curve", "trusting"]

_DEGREE = 3
_KNOTS = 20
_COARSE = 8
_LEAST_HARMONICS = 3
_MOST_HARMONICS = 15
_FINE = 24  # steps in which a line's frequency is refined
_SLOW = 10
_LAGS_S = (0.05, 0.1, 0.2, 0.4, 0.8)
_PIECE_S = 0.25  # between the knots of a free function of time
_SIGN = 0.02  # smoothing of a direction, of the rms velocity

Basis = Callable[[Coordinates], FloatArray]


class FreeCurve(NamedTuple):
    """A free curve beside a model.

    Attributes:
        location: motor, transmission or link.
        motor: index of the motor; None at the link.
        coordinates: what it depends on.
        basis: the curve's basis (n, k) on a grid's coordinates.
        selection: base and curve, fitted.
        error: its cross-validated error; no block counts more than without the curve, as one that goes
            where no other block has been says nothing against it.
    """

    location: str
    motor: int | None
    coordinates: tuple[str, ...]
    basis: Basis
    selection: Selection
    error: float

    def columns(self, frame: Frame) -> FloatArray:
        """Stacked columns on a recording."""
        return _stacked(frame, self.location, self.motor, self.basis(frame.motors[self.motor or 0]))


class _Splines:
    """Cubic B-splines over the range of x, knots between its even spread and its quantiles."""

    def __init__(self, x: FloatArray, knots: int) -> None:
        self._low, self._high = float(np.min(x)), float(np.max(x))
        share = np.linspace(0.0, 1.0, knots)
        inner = 0.5 * np.quantile(x, share) + 0.5 * (self._low + (self._high - self._low) * share)
        inner[0], inner[-1] = self._low, self._high
        self._t = np.concatenate(([self._low] * _DEGREE, inner, [self._high] * _DEGREE))

    def __call__(self, x: FloatArray) -> FloatArray:
        """(n, k) on x, beyond the range as at its ends."""
        inside = np.clip(x, self._low, self._high)
        return np.asarray(BSpline.design_matrix(inside, self._t, _DEGREE).toarray())


def best_curve(tracer: Tracer, beside: Selection) -> FreeCurve | None:
    """The location and coordinates whose free curve leaves the least beside a model."""
    best: FreeCurve | None = None
    for location, motor in [tracer.within] if tracer.within else _places(tracer.frame):
        for coordinates, basis in _bases(tracer, location, motor or 0):
            curve = _fitted(tracer, beside, location, motor, coordinates, basis)
            if best is None or curve.error < best.error:
                best = curve
    return best


def trusting(tracer: Tracer, beside: Selection, curve: FreeCurve) -> FreeCurve:
    """The same curve, the base fitted to the equations in which nothing else is left.

    What a curve leaves at a motor or at the link is not noise; without this it would bend the stiffness.
    """
    if curve.location == "transmission":
        return curve
    rows, last = tracer.rows, tracer.frame.equations - 1
    touched = last if curve.location == "link" else curve.motor or 0
    left = tracer.left(curve.selection, curve.columns).reshape(tracer.frame.equations, -1)[touched]
    noise = float(np.sqrt(np.mean(left[rows.blocks.index >= 0] ** 2))) * rows.weights[touched]
    if noise <= 1.0:
        return curve
    weights = rows.weights.copy()
    weights[touched] /= noise
    doubting = Tracer(
        tracer.frame,
        Rows(rows.blocks, tracer.frame.equations, weights),
        tracer.smoothing_rad_s,
        tracer.base,
        tracer.within,
    )
    again = _fitted(
        doubting, doubting.evaluate(beside.terms), curve.location, curve.motor, curve.coordinates, curve.basis
    )
    return again._replace(error=curve.error)


def _fitted(
    tracer: Tracer,
    beside: Selection,
    location: str,
    motor: int | None,
    coordinates: tuple[str, ...],
    basis: Basis,
) -> FreeCurve:
    columns = _stacked(tracer.frame, location, motor, basis(tracer.frame.motors[motor or 0]))
    design = np.column_stack((beside.design, tracer.rows.weighted(columns)))
    selection = Selection(beside.terms, tracer.rows.fit(design, tracer.target, columns.shape[1]), design)
    error = float(np.minimum(selection.fit.cross, beside.fit.cross).sum())
    return FreeCurve(location, motor, coordinates, basis, selection, error)


def _places(frame: Frame) -> list[tuple[str, int | None]]:
    places: list[tuple[str, int | None]] = [("motor", i) for i in range(len(frame.motors))]
    places += [("transmission", i) for i, flexible in enumerate(frame.flexible) if flexible]
    return places + ([("link", None)] if frame.linked else [])


def _bases(tracer: Tracer, location: str, motor: int) -> list[tuple[tuple[str, ...], Basis]]:
    """Bases for one place, with the names of their coordinates."""
    c = tracer.frame.motors[motor]
    place, rate, *others = {
        "motor": ("position", "velocity"),
        "transmission": ("deflection", "deflection_rate", "position"),
        "link": ("link_position", "link_velocity"),
    }[location]
    made: list[tuple[tuple[str, ...], Basis]] = [
        ((name,), _over(name, _Splines(getattr(c, name), _KNOTS))) for name in (place, rate, *others)
    ]
    v = getattr(c, rate)
    slow = _Splines(c.time, _SLOW)
    if location == "motor" and tracer.frame.linked:
        made.append((("torque",), _beyond_scale(_Splines(c.torque, _KNOTS))))
        made.append((("position", "torque"), _scaled("torque", "position", _Splines(c.position, _KNOTS), c)))
    smoothing = max(_SIGN * float(np.sqrt(np.mean(v * v))), 1e-12)
    made.append(((place, rate), _both_ways(place, rate, smoothing, _Splines(getattr(c, place), _COARSE))))
    if location == "motor":
        made.append((("velocity", "time"), _fading(slow, smoothing, c)))
    if location == "transmission":
        made.append((("deflection", "time"), _scaled("deflection", "time", slow, c)))
        made.append((("deflection", "deflection_rate"), _creeping))
        path = _Splines(c.link_position, _COARSE)
        made.append((("deflection", "link_position"), _scaled("deflection", "link_position", path, c, True)))
    made.append((("time",), _waves(tracer, *_line(tracer, location, motor))))
    made.append((("time",), _over("time", slow)))
    return made


def any_time(tracer: Tracer, beside: Selection, location: str, motor: int | None) -> FreeCurve:
    """A free function of time at a place: it explains what is there whatever it is, and predicts nothing."""
    time = tracer.frame.motors[motor or 0].time
    basis = _over("time", _Splines(time, max(_SLOW, int((time[-1] - time[0]) / _PIECE_S))))
    return _fitted(tracer, beside, location, motor, ("time",), basis)


def _over(name: str, splines: _Splines) -> Basis:
    return lambda c: splines(getattr(c, name))


def _beyond_scale(splines: _Splines) -> Basis:
    """Functions of the torque without what is proportional to it: that would explain anything."""

    def basis(c: Coordinates) -> FloatArray:
        path = splines(c.torque)
        return np.asarray(path - np.outer(c.torque, c.torque @ path) / (c.torque @ c.torque))

    return basis


def _both_ways(place: str, rate: str, smoothing: float, splines: _Splines) -> Basis:
    def basis(c: Coordinates) -> FloatArray:
        path = splines(getattr(c, place))
        return np.column_stack((path, np.tanh(getattr(c, rate) / smoothing)[:, None] * path))

    return basis


def _scaled(factor: str, over: str, splines: _Splines, c: Coordinates, alone: bool = False) -> Basis:
    """What is proportional to one coordinate, by a factor that depends on another."""
    size = max(float(np.sqrt(np.mean(getattr(c, factor) ** 2))), 1e-300)

    def basis(c: Coordinates) -> FloatArray:
        path = splines(getattr(c, over))
        product = getattr(c, factor)[:, None] / size * path
        return np.column_stack((product, path)) if alone else np.asarray(product)

    return basis


def _creeping(c: Coordinates) -> FloatArray:
    """What follows the deflection with a lag: creep and relaxation, several time constants."""
    period = float(c.time[1] - c.time[0])
    made = []
    for lag in _LAGS_S:
        keep = float(np.exp(-period / lag))
        start = np.array([keep * c.deflection[0]])
        made.append(lfilter([1.0 - keep], [1.0, -keep], c.deflection, zi=start)[0])
    return np.stack(made, axis=1)


def _fading(splines: _Splines, smoothing: float, c: Coordinates) -> Basis:
    """Friction and damping that change over time."""
    size = max(float(np.sqrt(np.mean(c.velocity**2))), 1e-300)

    def basis(c: Coordinates) -> FloatArray:
        slow = splines(c.time)
        sign, speed = np.tanh(c.velocity / smoothing), c.velocity / size
        return np.column_stack((sign[:, None] * slow, speed[:, None] * slow))

    return basis


def _waves(tracer: Tracer, frequency: float, resolution: float, equation: int) -> Basis:
    """A line and its harmonics, the line refined; both in rad/s."""
    frame = tracer.frame
    most = 2.0 * np.pi * frame.signals.bandwidth_hz / frequency
    count = int(np.clip(most, _LEAST_HARMONICS, _MOST_HARMONICS))

    def made(time: FloatArray, w: float) -> FloatArray:
        return np.stack([f(k * w * time) for k in range(1, count + 1) for f in (np.sin, np.cos)], axis=1)

    residual = tracer.balance().reshape(frame.equations, -1)[equation]
    time = frame.motors[0].time[:: _step_of(frame)][: len(frame.signals.keep)][frame.signals.keep]

    def left(w: float) -> float:
        columns = np.column_stack((made(time, w), np.ones(len(time))))
        solution = np.linalg.lstsq(columns, residual, rcond=None)[0]
        return float(np.sum((residual - columns @ solution) ** 2))

    near = frequency + resolution * np.linspace(-1.0, 1.0, 2 * _FINE + 1)
    best = float(min(near, key=left))
    return lambda c: made(c.time, best)


def _step_of(frame: Frame) -> int:
    return round(frame.signals.narrow.period_s / frame.signals.light.period_s)


def _stacked(frame: Frame, location: str, motor: int | None, basis: FloatArray) -> FloatArray:
    columns = []
    for wave in basis.T:
        if location == "motor":
            columns.append(frame.column(motor, -wave, None))
        elif location == "transmission":
            columns.append(frame.column(motor, wave, wave if frame.pulls[motor or 0] else None))
        else:
            columns.append(frame.column(None, None, wave))
    return np.stack(columns, axis=1)


def _line(tracer: Tracer, location: str, motor: int) -> tuple[float, float, int]:
    """The strongest spectral line of one equation's residual that harmonics may belong to.

    Returns:
        Its frequency and the resolution, rad/s, and the equation.
    """
    frame = tracer.frame
    equation = frame.equations - 1 if location == "link" else motor
    part = tracer.balance().reshape(frame.equations, -1)[equation]
    period = frame.signals.narrow.period_s
    window = np.hanning(len(part))
    size = 4 * len(part)
    power = np.abs(np.fft.rfft((part - part.mean()) * window, size)) ** 2
    first = int(np.ceil(3.0 * size / len(part)))
    harmonic = power[first:].copy()
    index = np.arange(first, len(power))
    for k in range(2, _LEAST_HARMONICS + 5):
        ok = k * index < len(power)
        harmonic[ok] += power[k * index[ok]]
    unit = 2.0 * np.pi / (size * period)
    return (first + int(np.argmax(harmonic))) * unit, unit, equation
