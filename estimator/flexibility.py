"""Models of a transmission's flexibility torque, tau_e = f(phi, alpha) (eqs 17-21, 24).

Every model is odd in phi (eq 2) and gives torque, stiffness sigma = df/dphi (eq 18) and the Jacobian
df/dalpha (eq 25). The laws are those of `estimator._core`, which the on-line estimator uses as well.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from estimator._core import TransmissionLaw
from estimator.errors import EstimatorError
from estimator.model import ParameterValue
from estimator.sample import FloatArray

RELATIVE_STEP = np.finfo(float).eps ** (1.0 / 3.0)  # of central differences


class TransmissionModel:
    """f(phi, alpha) = sum_h basis_h(phi, shape) * alpha_h, with alpha = (linear coefficients, shape).

    One linear coefficient k unless a subclass says otherwise: f = k g(phi, shape).
    """

    name: str  # as in the joint file
    law: TransmissionLaw  # its evaluation over arrays
    linear: int | None = 1  # number of leading entries of alpha that enter linearly; None: all
    shape_names: tuple[str, ...] = ()  # names of the remaining entries ("shape"), which enter nonlinearly

    @property
    def shape_bounds(self) -> tuple[tuple[float, float], ...]:
        """(low, high) of each shape parameter."""
        return tuple((low, high) for low, high, _ in self.law.shapes)

    @property
    def shape_start(self) -> tuple[float, ...]:
        """Where a search without prior knowledge starts."""
        return tuple(start for *_, start in self.law.shapes)

    def basis(self, phi: ArrayLike, shape: Sequence[float] = (), order: int = 1) -> FloatArray:
        """Return the regressors of the linear coefficients, (..., order) for phi of shape
        (...), in rad-powers.
        """
        return self.torque(phi, (1.0, *shape))[..., None]

    def torque(self, phi: ArrayLike, alpha: ArrayLike) -> FloatArray:
        """Return tau_e = f(phi, alpha) in N·m (eq 17)."""
        return self.both(phi, alpha)[0]

    def stiffness(self, phi: ArrayLike, alpha: ArrayLike) -> FloatArray:
        """Return sigma = df/dphi in N·m/rad (eq 18)."""
        return self.both(phi, alpha)[1]

    def both(self, phi: ArrayLike, alpha: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Return the (torque, stiffness)."""
        phi = np.asarray(phi, dtype=np.float64)
        torque, stiffness = np.empty(phi.shape), np.empty(phi.shape)
        self.law.evaluate(phi.ravel(), _listed(alpha), torque.reshape(-1), stiffness.reshape(-1))
        return torque, stiffness

    def jacobian(self, phi: ArrayLike, alpha: ArrayLike) -> FloatArray:
        """Return df/dalpha, (..., n) (eq 25)."""
        return _by_alpha(self.law.jacobian, phi, alpha)

    def stiffness_jacobian(self, phi: ArrayLike, alpha: ArrayLike) -> FloatArray:
        """Return dsigma/dalpha, (..., n), which maps the covariance of alpha to sigma."""
        return _by_alpha(self.law.stiffness_jacobian, phi, alpha)

    def at(self, phi: float, alpha: Sequence[float]) -> tuple[float, float]:
        """Return the (torque, stiffness) at one deflection, for a tick."""
        return self.law.at(phi, alpha)

    def reach(self, shape: Sequence[float] = ()) -> float:
        """Return the largest |phi| for which the model is defined (arcsine, exponential, table), rad."""
        return self.law.reach(shape) if shape or not self.shape_names else math.inf

    def parameters(self, alpha: ArrayLike) -> dict[str, ParameterValue]:
        """Return alpha by its names in the joint file."""
        return dict(zip(("k_nm_rad", *self.shape_names), np.asarray(alpha).tolist(), strict=True))

    def alpha(self, parameters: Mapping[str, ParameterValue]) -> FloatArray:
        """Return alpha from its names in the joint file.

        Raises:
            EstimatorError: a name is unknown or missing, or a value is impossible.
        """
        values = _by_name(self.name, parameters, ("k_nm_rad", *self.shape_names))
        for name, value, (low, high) in zip(self.shape_names, values[1:], self.shape_bounds, strict=True):
            if not low < value < high:
                raise EstimatorError(f"{self.name}: {name}: expected {low:g} to {high:g}, got {value:g}")
        return values


class Polynomial(TransmissionModel):
    """Odd powers up to phi^(2p-1) (eqs 21, 24); alpha = coefficients in N·m/rad^(2h-1)."""

    name = "polynomial"
    linear: int | None = None
    law = TransmissionLaw("polynomial")

    def basis(self, phi: ArrayLike, shape: Sequence[float] = (), order: int = 1) -> FloatArray:
        """See TransmissionModel."""
        return self.jacobian(phi, np.zeros(order))

    def parameters(self, alpha: ArrayLike) -> dict[str, ParameterValue]:
        """Return alpha by name."""
        return {"coefficients_nm_rad": tuple(np.asarray(alpha, dtype=np.float64).tolist())}

    def alpha(self, parameters: Mapping[str, ParameterValue]) -> FloatArray:
        """Return alpha from names."""
        _expect_names(self.name, parameters, ("coefficients_nm_rad",))
        return _finite(self.name, "coefficients_nm_rad", parameters["coefficients_nm_rad"])


class Linear(Polynomial):
    """tau_e = K phi; alpha = (K,)."""

    name = "linear"
    linear = 1
    law = TransmissionLaw("linear")

    def parameters(self, alpha: ArrayLike) -> dict[str, ParameterValue]:
        """Return alpha by name."""
        return {"k_nm_rad": float(np.asarray(alpha)[..., 0])}

    def alpha(self, parameters: Mapping[str, ParameterValue]) -> FloatArray:
        """Return alpha from names."""
        return _by_name(self.name, parameters, ("k_nm_rad",))


class VsaII(TransmissionModel):
    """One transmission of the VSA-II (eqs 19, 20): f = 2 k beta beta', beta = arcsin(C sin(phi/2)) - phi/2.

    alpha = (k, C), C > 1; defined for |phi| < 2 arcsin(1/C).
    """

    name = "vsa-ii"
    shape_names = ("c",)
    law = TransmissionLaw("vsa-ii")


class Exponential(TransmissionModel):
    """f = sign(phi) (k/b) (exp(b|phi|) - 1), so sigma = k exp(b|phi|); alpha = (k, b)."""

    name = "exponential"
    shape_names = ("b_per_rad",)
    law = TransmissionLaw("exponential")


class Table(TransmissionModel):
    """f = k g(phi), g an odd table with a cubic between its points; alpha = (k,). Made by `register_table`.

    Args:
        name: as in the joint file.
        deflection_rad: growing from above 0.
        torque_nm: the torque at each of them.
    """

    def __init__(self, name: str, deflection_rad: Sequence[float], torque_nm: Sequence[float]) -> None:
        self.name = name
        self.law = TransmissionLaw.table(list(map(float, deflection_rad)), list(map(float, torque_nm)))


class Function(TransmissionModel):
    """A model from plain functions g(phi, *shape), dg/dphi: f = k g. Made by `register`."""

    def __init__(
        self,
        name: str,
        torque: Callable[..., Any],
        stiffness: Callable[..., Any],
        shape: Mapping[str, tuple[float, float, float]],
    ) -> None:
        self.name = name
        self.shape_names = tuple(shape)
        self.law = TransmissionLaw.of(
            torque, stiffness, [(low, high, start) for start, low, high in shape.values()]
        )


def _by_alpha(
    evaluate: Callable[[FloatArray, list[float], FloatArray], None], phi: ArrayLike, alpha: ArrayLike
) -> FloatArray:
    phi, listed = np.asarray(phi, dtype=np.float64), _listed(alpha)
    out = np.empty((*phi.shape, len(listed)))
    evaluate(phi.ravel(), listed, out.reshape(-1))
    return out


def _listed(alpha: ArrayLike) -> list[float]:
    listed: list[float] = np.asarray(alpha, dtype=np.float64).ravel().tolist()
    return listed


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
