"""Registry of transmission models by their names in the joint file."""

import inspect
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from estimator.errors import EstimatorError, expected
from estimator.flexibility import (
    RELATIVE_STEP,
    Exponential,
    Function,
    Linear,
    Polynomial,
    Table,
    VsaII,
)
from estimator.flexibility import TransmissionModel as TransmissionModel
from estimator.model import Transmission

RIGID = "none"  # no deflection: the torque is the residual of the motor's balance
UNKNOWN = "unknown"  # flexible, but no model of it: black-box estimation

MODELS: dict[str, TransmissionModel] = {
    model.name: model for model in (Linear(), Polynomial(), VsaII(), Exponential())
}


def register(
    name: str,
    torque: Callable[..., Any],
    stiffness: Callable[..., Any],
    shape: Mapping[str, tuple[float, float, float]] | None = None,
    *,
    phi_max_rad: float = 0.5,
) -> TransmissionModel:
    """Add the model f(phi) = k_nm_rad * torque(phi, *shape) under a name for the joint file.

    Args:
        torque: g(phi, *shape), odd in phi, on arrays.
        stiffness: dg/dphi, its analytic derivative, on arrays.
        shape: start, low and high of each nonlinear parameter, by name, in the order of the arguments.
        phi_max_rad: range in which oddness and derivative are checked.

    Raises:
        EstimatorError: the name is taken, the functions do not take these arguments, a start is out of
            bounds, g is not odd, or stiffness is not its derivative (against central differences).
    """
    shape = {} if shape is None else shape
    if name in MODELS or name in (RIGID, UNKNOWN):
        raise EstimatorError(f'transmission "{name}": expected a new name, this one is taken')
    for role, function in (("torque", torque), ("stiffness", stiffness)):
        try:
            inspect.signature(function).bind(0.0, *shape)
        except TypeError as error:
            raise EstimatorError(
                f'transmission "{name}": {role}: expected the arguments phi, {", ".join(shape)}'
            ) from error
    for parameter, (start, low, high) in shape.items():
        if not low <= start <= high:
            raise EstimatorError(
                f'transmission "{name}": {parameter}: expected (start, low, high) with low <= start <= high, '
                f"got ({start:g}, {low:g}, {high:g})"
            )
    model = Function(name, torque, stiffness, shape)
    phi = np.linspace(-phi_max_rad, phi_max_rad, 41)
    alpha = np.array([1.0, *model.shape_start])
    value, slope = model.torque(phi, alpha), model.stiffness(phi, alpha)
    step = RELATIVE_STEP * phi_max_rad
    difference = (model.torque(phi + step, alpha) - model.torque(phi - step, alpha)) / (2 * step)
    if not np.allclose(value, -value[::-1], rtol=1e-9, atol=1e-12 * float(np.max(np.abs(value)))):
        raise EstimatorError(f'transmission "{name}": torque: expected an odd function of phi (eq 2)')
    if not np.allclose(slope, difference, rtol=1e-6, atol=1e-7 * float(np.max(np.abs(difference)))):
        raise EstimatorError(f'transmission "{name}": stiffness: expected the derivative of torque (eq 18)')
    MODELS[name] = model
    return model


def register_table(
    name: str, deflection_rad: Sequence[float], torque_nm: Sequence[float]
) -> TransmissionModel:
    """Add a measured curve under a name for the joint file: k_nm_rad (1: as measured) times the table.

    Args:
        deflection_rad: increasing, all above 0; the curve is odd and passes through 0.
        torque_nm: the torque at each of them.

    Raises:
        EstimatorError: the name is taken, or the points are no curve.
    """
    if name in MODELS or name in (RIGID, UNKNOWN):
        raise EstimatorError(f'transmission "{name}": expected a new name, this one is taken')
    MODELS[name] = model = Table(name, deflection_rad, torque_nm)
    return model


def transmission_model(transmission: Transmission) -> TransmissionModel | None:
    """Return the model of a transmission; None if it is rigid or unknown.

    Raises:
        EstimatorError: no model has that name, or its parameters do not fit it.
    """
    if transmission.model in (RIGID, UNKNOWN):
        return None
    model = MODELS.get(transmission.model)
    if model is None:
        wanted = expected(transmission.model, [*MODELS, RIGID, UNKNOWN])
        raise EstimatorError(f'transmission.model "{transmission.model}": {wanted}')
    if transmission.parameters:
        alpha = model.alpha(transmission.parameters)
        stiffness = model.at(0.0, alpha.tolist())[1]
        if not stiffness >= 0.0 or not np.any(alpha):
            raise EstimatorError(
                f"transmission.parameters: expected a stiffness above 0 N·m/rad, "
                f"got {stiffness:g} at no deflection"
            )
        if transmission.order is not None and model.linear is None and alpha.size != transmission.order:
            raise EstimatorError(
                f"transmission.parameters: expected {transmission.order} coefficients_nm_rad "
                f"(order = {transmission.order}), got {alpha.size}"
            )
    return model
