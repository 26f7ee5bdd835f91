"""Models of a transmission's flexibility torque, tau_e = f(phi, alpha) (eqs 17-21, 24).

Every model is odd in phi (eq 2) and gives torque, stiffness sigma = df/dphi (eq 18) and the Jacobian
df/dalpha (eq 25).
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from estimator.errors import EstimatorError
from estimator.model import ParameterValue
from estimator.sample import FloatArray

__all__ = ["Exponential", "Function", "Linear", "Polynomial", "TransmissionModel", "VsaII"]

_STEP = 6.0e-6  # relative step of central differences, about eps**(1/3)
_STEEPEST = 50.0  # largest exponent of an exponential spring
_EDGE = 1.0 - 1e-9  # how near to its end the arcsine of the VSA-II is taken


class TransmissionModel(ABC):
    """f(phi, alpha) = sum_h basis_h(phi, shape) * alpha_h, with alpha = (linear coefficients, shape).

    Attributes:
        name: as in the joint file.
        linear: how many leading entries of alpha enter linearly; None: all, and as many as there are.
        shape_names: names of the remaining entries ("shape"), which enter nonlinearly.
        shape_bounds: (low, high) of each shape parameter.
        shape_start: where a search without prior knowledge starts.
    """

    name: str
    linear: int | None = 1
    shape_names: tuple[str, ...] = ()
    shape_bounds: tuple[tuple[float, float], ...] = ()
    shape_start: tuple[float, ...] = ()

    @abstractmethod
    def basis(self, phi: ArrayLike, shape: Sequence[float] = (), order: int = 1) -> FloatArray:
        """Regressors of the linear coefficients, (..., order) for phi of shape (...), in rad-powers."""

    @abstractmethod
    def torque(self, phi: ArrayLike, alpha: ArrayLike) -> FloatArray:
        """tau_e = f(phi, alpha) in N·m (eq 17)."""

    @abstractmethod
    def stiffness(self, phi: ArrayLike, alpha: ArrayLike) -> FloatArray:
        """Sigma = df/dphi in N·m/rad (eq 18)."""

    def both(self, phi: ArrayLike, alpha: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """(torque, stiffness), in one go where that is faster."""
        return self.torque(phi, alpha), self.stiffness(phi, alpha)

    def tangent(self, phi: ArrayLike, alpha: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """(Jacobian, stiffness), in one go where that is faster."""
        return self.jacobian(phi, alpha), self.stiffness(phi, alpha)

    @abstractmethod
    def jacobian(self, phi: ArrayLike, alpha: ArrayLike) -> FloatArray:
        """df/dalpha, (..., n) (eq 25)."""

    def stiffness_jacobian(self, phi: ArrayLike, alpha: ArrayLike) -> FloatArray:
        """dsigma/dalpha, (..., n); it carries the covariance of alpha over to sigma."""
        phi = np.asarray(phi, dtype=np.float64)
        step = _STEP * np.maximum(np.abs(phi), 1e-3)[..., None]
        after = self.jacobian(phi + step[..., 0], alpha)
        before = self.jacobian(phi - step[..., 0], alpha)
        return np.asarray((after - before) / (2.0 * step))

    def at(self, phi: float, alpha: Sequence[float]) -> tuple[float, float]:
        """(torque, stiffness) at one deflection: what a tick needs, without arrays where that is faster."""
        return float(self.torque(phi, alpha)), float(self.stiffness(phi, alpha))

    def stiffness_slopes(self, phi: float, alpha: Sequence[float]) -> tuple[list[float], float]:
        """(dsigma/dalpha, dsigma/dphi) at one deflection, by differences: what sigma's variance needs."""
        step = _STEP * max(abs(phi), 1e-3)
        by_phi = (self.at(phi + step, alpha)[1] - self.at(phi - step, alpha)[1]) / (2.0 * step)
        by_alpha = []
        for i, value in enumerate(alpha):
            step = _STEP * max(abs(value), 1e-3)
            more, less = [*alpha], [*alpha]
            more[i], less[i] = value + step, value - step
            by_alpha.append((self.at(phi, more)[1] - self.at(phi, less)[1]) / (2.0 * step))
        return by_alpha, by_phi

    def reach(self, shape: Sequence[float] = ()) -> float:
        """Largest |phi| for which the model is defined, rad."""
        return math.inf

    def shapes(self, reach_rad: float, points: int) -> FloatArray:
        """Values of a single shape parameter that a search begins with, at most so many; each reaches |phi|.

        Geometrically from the lower bound: from a thousandth of what the usual start is above it.
        """
        (low, high), (start,) = self.shape_bounds[0], self.shape_start
        least = 1e-3 * (start - low if start > low else high - low)
        values = low + np.geomspace(least, high - low, points)
        return values[[self.reach((value,)) > reach_rad for value in values.tolist()]]

    @abstractmethod
    def parameters(self, alpha: ArrayLike) -> dict[str, ParameterValue]:
        """Alpha by its names in the joint file."""

    @abstractmethod
    def alpha(self, parameters: Mapping[str, ParameterValue]) -> FloatArray:
        """Alpha from its names in the joint file.

        Raises:
            EstimatorError: a name is unknown or missing, or a value is impossible.
        """


class Polynomial(TransmissionModel):
    """Odd powers up to phi^(2p-1) (eqs 21, 24); alpha = coefficients in N·m/rad^(2h-1)."""

    name = "polynomial"
    linear: int | None = None

    def basis(self, phi: ArrayLike, shape: Sequence[float] = (), order: int = 1) -> FloatArray:
        """See TransmissionModel."""
        phi = np.asarray(phi, dtype=np.float64)
        columns = np.empty((*phi.shape, order))
        power, square = phi, phi * phi
        for h in range(order):
            columns[..., h] = power
            power = power * square
        return columns

    def torque(self, phi: ArrayLike, alpha: ArrayLike) -> FloatArray:
        """Flexibility torque (eq 17)."""
        phi = np.asarray(phi, dtype=np.float64)
        return np.asarray(_horner(phi * phi, np.asarray(alpha, dtype=np.float64)) * phi)

    def stiffness(self, phi: ArrayLike, alpha: ArrayLike) -> FloatArray:
        """Its derivative (eq 18)."""
        phi, alpha = np.asarray(phi, dtype=np.float64), np.asarray(alpha, dtype=np.float64)
        return _horner(phi * phi, alpha * (2.0 * np.arange(alpha.shape[-1]) + 1.0))

    def jacobian(self, phi: ArrayLike, alpha: ArrayLike) -> FloatArray:
        """Its Jacobian (eq 25)."""
        return self.basis(phi, order=np.asarray(alpha).shape[-1])

    def stiffness_jacobian(self, phi: ArrayLike, alpha: ArrayLike) -> FloatArray:
        """Jacobian of the stiffness."""
        order = np.asarray(alpha).shape[-1]
        square = np.square(np.asarray(phi, dtype=np.float64))[..., None]
        return np.asarray(square ** np.arange(order) * (2.0 * np.arange(order) + 1.0))

    def at(self, phi: float, alpha: Sequence[float]) -> tuple[float, float]:
        """Both by Horner's rule."""
        square, torque, stiffness = phi * phi, 0.0, 0.0
        for h in range(len(alpha) - 1, -1, -1):
            torque = torque * square + alpha[h]
            stiffness = stiffness * square + (2 * h + 1) * alpha[h]
        return torque * phi, stiffness

    def stiffness_slopes(self, phi: float, alpha: Sequence[float]) -> tuple[list[float], float]:
        """Both in closed form."""
        power, by_alpha, by_phi = 1.0, [], 0.0
        for h, value in enumerate(alpha):
            by_alpha.append((2 * h + 1) * power * power)
            by_phi += (2 * h + 1) * 2 * h * value * power * power / (phi or 1.0)
            power *= phi
        return by_alpha, by_phi

    def parameters(self, alpha: ArrayLike) -> dict[str, ParameterValue]:
        """Alpha by name."""
        return {"coefficients_nm_rad": tuple(np.asarray(alpha, dtype=np.float64).tolist())}

    def alpha(self, parameters: Mapping[str, ParameterValue]) -> FloatArray:
        """Alpha from names."""
        _expect_names(self.name, parameters, ("coefficients_nm_rad",))
        return _finite(self.name, "coefficients_nm_rad", parameters["coefficients_nm_rad"])


class Linear(Polynomial):
    """tau_e = K phi; alpha = (K,)."""

    name = "linear"
    linear = 1

    def parameters(self, alpha: ArrayLike) -> dict[str, ParameterValue]:
        """Alpha by name."""
        return {"k_nm_rad": float(np.asarray(alpha)[..., 0])}

    def alpha(self, parameters: Mapping[str, ParameterValue]) -> FloatArray:
        """Alpha from names."""
        return _by_name(self.name, parameters, ("k_nm_rad",))


class _Shaped(TransmissionModel):
    """Shared by models with one linear coefficient k and shape parameters: f = k * g(phi, shape)."""

    def basis(self, phi: ArrayLike, shape: Sequence[float] = (), order: int = 1) -> FloatArray:
        """See TransmissionModel."""
        return self.torque(phi, (1.0, *shape))[..., None]

    def parameters(self, alpha: ArrayLike) -> dict[str, ParameterValue]:
        """Alpha by name."""
        return dict(zip(("k_nm_rad", *self.shape_names), np.asarray(alpha).tolist(), strict=True))

    def alpha(self, parameters: Mapping[str, ParameterValue]) -> FloatArray:
        """Alpha from names."""
        values = _by_name(self.name, parameters, ("k_nm_rad", *self.shape_names))
        for name, value, (low, high) in zip(self.shape_names, values[1:], self.shape_bounds, strict=True):
            if not low < value < high:
                raise EstimatorError(f"{self.name}: {name}: expected {low:g} to {high:g}, got {value:g}")
        return values


class VsaII(_Shaped):
    """One transmission of the VSA-II (eqs 19, 20): f = 2 k beta beta', beta = arcsin(C sin(phi/2)) - phi/2.

    alpha = (k, C), C > 1; defined for |phi| < 2 arcsin(1/C).
    """

    name = "vsa-ii"
    shape_names = ("c",)
    shape_bounds = ((1.0, 20.0),)
    shape_start = (1.1,)

    @staticmethod
    def _parts(phi: FloatArray, c: float) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """(C sin(phi/2) kept inside its domain, cos(phi/2), sqrt(1 - (C sin)²), beta)."""
        half = 0.5 * phi
        sine = np.minimum(np.maximum(c * np.sin(half), -_EDGE), _EDGE)
        root = np.sqrt(1.0 - sine * sine)
        return sine, np.cos(half), root, np.arcsin(sine) - half

    def torque(self, phi: ArrayLike, alpha: ArrayLike) -> FloatArray:
        """Flexibility torque (eq 17)."""
        k, c = _split(alpha)
        _, cosine, root, beta = self._parts(np.asarray(phi, dtype=np.float64), c)
        return np.asarray(k * beta * (c * cosine / root - 1.0))

    def stiffness(self, phi: ArrayLike, alpha: ArrayLike) -> FloatArray:
        """Its derivative (eq 18)."""
        return self.both(phi, alpha)[1]

    def both(self, phi: ArrayLike, alpha: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """See TransmissionModel."""
        k, c = _split(alpha)
        sine, cosine, root, beta = self._parts(np.asarray(phi, dtype=np.float64), c)
        slope = 0.5 * (c * cosine / root - 1.0)
        return np.asarray(2.0 * k * beta * slope), self._stiffness(k, c, sine, root, beta, slope)

    @staticmethod
    def _stiffness(
        k: float, c: float, sine: FloatArray, root: FloatArray, beta: FloatArray, slope: FloatArray
    ) -> FloatArray:
        """2 k (beta'² + beta beta''); slope is beta'."""
        bend = (0.25 * (c * c - 1.0)) * sine / (root * root * root)
        return np.asarray((2.0 * k) * (slope * slope + beta * bend))

    def jacobian(self, phi: ArrayLike, alpha: ArrayLike) -> FloatArray:
        """Its Jacobian (eq 25)."""
        k, c = _split(alpha)
        sine, cosine, root, beta = self._parts(np.asarray(phi, dtype=np.float64), c)
        return self._jacobian(k, c, sine, cosine, root, beta)[0]

    def tangent(self, phi: ArrayLike, alpha: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """See TransmissionModel."""
        k, c = _split(alpha)
        sine, cosine, root, beta = self._parts(np.asarray(phi, dtype=np.float64), c)
        jacobian, slope = self._jacobian(k, c, sine, cosine, root, beta)
        return jacobian, self._stiffness(k, c, sine, root, beta, slope)

    @staticmethod
    def _jacobian(
        k: float, c: float, sine: FloatArray, cosine: FloatArray, root: FloatArray, beta: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """(Jacobian, beta')."""
        slope = 0.5 * (c * cosine / root - 1.0)
        slope_c = 0.5 * cosine / (root * root * root)
        out = np.empty((*sine.shape, 2))
        out[..., 0] = 2.0 * beta * slope
        out[..., 1] = (2.0 * k) * (sine / (c * root) * slope + beta * slope_c)
        return out, slope

    def at(self, phi: float, alpha: Sequence[float]) -> tuple[float, float]:
        """Both from one evaluation of the arcsine."""
        k, c = alpha
        sine = min(max(c * math.sin(0.5 * phi), -_EDGE), _EDGE)
        root = math.sqrt(1.0 - sine * sine)
        beta = math.asin(sine) - 0.5 * phi
        slope = 0.5 * (c * math.cos(0.5 * phi) / root - 1.0)
        bend = 0.25 * sine * (c * c - 1.0) / root**3
        return 2.0 * k * beta * slope, 2.0 * k * (slope * slope + beta * bend)

    def reach(self, shape: Sequence[float] = ()) -> float:
        """Where the arcsine ends."""
        return 2.0 * math.asin(1.0 / shape[0]) if shape and shape[0] > 1.0 else math.pi


class Exponential(_Shaped):
    """f = sign(phi) (k/b) (exp(b|phi|) - 1), so sigma = k exp(b|phi|); alpha = (k, b)."""

    name = "exponential"
    shape_names = ("b_per_rad",)
    shape_bounds = ((1e-6, 1e6),)
    shape_start = (1.0,)

    def torque(self, phi: ArrayLike, alpha: ArrayLike) -> FloatArray:
        """Flexibility torque (eq 17)."""
        k, b = _split(alpha)
        phi = np.asarray(phi, dtype=np.float64)
        return np.asarray(np.sign(phi) * (k / b) * np.expm1(_exponent(b, phi)))

    def stiffness(self, phi: ArrayLike, alpha: ArrayLike) -> FloatArray:
        """Its derivative (eq 18)."""
        k, b = _split(alpha)
        return np.asarray(k * np.exp(_exponent(b, np.asarray(phi, dtype=np.float64))))

    def reach(self, shape: Sequence[float] = ()) -> float:
        """Beyond this the torque is no spring's, and soon no number."""
        return _STEEPEST / shape[0] if shape and shape[0] > 0.0 else math.inf

    def jacobian(self, phi: ArrayLike, alpha: ArrayLike) -> FloatArray:
        """Its Jacobian (eq 25)."""
        k, b = _split(alpha)
        phi = np.asarray(phi, dtype=np.float64)
        x = _exponent(b, phi)
        by_b = np.sign(phi) * (k / b**2) * (x * np.exp(x) - np.expm1(x))
        return np.stack([np.sign(phi) * np.expm1(x) / b, by_b], axis=-1)


class Function(_Shaped):
    """A model from plain functions g(phi, *shape), dg/dphi: f = k g. Made by `register`."""

    def __init__(
        self,
        name: str,
        torque: Callable[..., Any],
        stiffness: Callable[..., Any],
        shape: Mapping[str, tuple[float, float, float]],
    ) -> None:
        self.name = name
        self._torque, self._stiffness = torque, stiffness
        self.shape_names = tuple(shape)
        self.shape_start = tuple(start for start, _, _ in shape.values())
        self.shape_bounds = tuple((low, high) for _, low, high in shape.values())

    def torque(self, phi: ArrayLike, alpha: ArrayLike) -> FloatArray:
        """Flexibility torque (eq 17)."""
        k, *shape = np.asarray(alpha, dtype=np.float64)
        return np.asarray(k * self._torque(np.asarray(phi, dtype=np.float64), *shape))

    def stiffness(self, phi: ArrayLike, alpha: ArrayLike) -> FloatArray:
        """Its derivative (eq 18)."""
        k, *shape = np.asarray(alpha, dtype=np.float64)
        return np.asarray(k * self._stiffness(np.asarray(phi, dtype=np.float64), *shape))

    def jacobian(self, phi: ArrayLike, alpha: ArrayLike) -> FloatArray:
        """Its Jacobian (eq 25)."""
        alpha = np.asarray(alpha, dtype=np.float64)
        columns = [self.torque(phi, (1.0, *alpha[1:]))]
        for i in range(1, alpha.size):
            step = np.zeros_like(alpha)
            step[i] = _STEP * max(abs(alpha[i]), 1e-3)
            columns.append((self.torque(phi, alpha + step) - self.torque(phi, alpha - step)) / (2 * step[i]))
        return np.stack(columns, axis=-1)


def _horner(square: FloatArray, coefficients: FloatArray) -> FloatArray:
    value = np.zeros_like(square) + coefficients[..., -1]
    for h in range(coefficients.shape[-1] - 2, -1, -1):
        value = value * square + coefficients[..., h]
    return value


def _exponent(b: float, phi: FloatArray) -> FloatArray:
    return np.minimum(b * np.abs(phi), 600.0)


def _split(alpha: ArrayLike) -> tuple[float, float]:
    k, shape = alpha if isinstance(alpha, tuple) else np.asarray(alpha, dtype=np.float64)
    return float(k), float(shape)


def _expect_names(model: str, parameters: Mapping[str, Any], names: tuple[str, ...]) -> None:
    if set(parameters) != set(names):
        got = ", ".join(parameters) or "none"
        raise EstimatorError(f"{model}: parameters: expected {', '.join(names)}, got {got}")


def _finite(model: str, name: str, value: ParameterValue) -> FloatArray:
    array = np.atleast_1d(np.asarray(value, dtype=np.float64))
    if array.size == 0 or not np.all(np.isfinite(array)):
        raise EstimatorError(f"{model}: {name}: expected finite numbers, got {value}")
    return array


def _by_name(model: str, parameters: Mapping[str, ParameterValue], names: tuple[str, ...]) -> FloatArray:
    _expect_names(model, parameters, names)
    values = [_finite(model, name, parameters[name]) for name in names]
    if any(value.size != 1 for value in values):
        raise EstimatorError(f"{model}: parameters: expected one number each for {', '.join(names)}")
    return np.concatenate(values)
