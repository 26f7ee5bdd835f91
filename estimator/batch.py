"""Model-based estimation from a whole recording: what `drivelink fit` does.

The same balance as on line (see `regression`), every channel through the same filter, solved at once:
transmission parameters together with small errors of the motor's own ones, delays between channels
searched, nonlinear parameters by variable projection, standard deviations from the measured
autocorrelation of what is left.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from estimator.align import prepare
from estimator.declared import corrected
from estimator.errors import EstimatorError
from estimator.flexibility import Polynomial, TransmissionModel
from estimator.gate import refuse
from estimator.leastsquares import search_shape
from estimator.model import JointModel, Motor, ParameterValue
from estimator.sample import FloatArray, Record
from estimator.solver import NUISANCES, Solver
from estimator.transmissions import MODELS, RIGID, UNKNOWN, transmission_model

__all__ = ["TransmissionFit", "fit"]

_SIGMA_95 = 1.96
_LOOKED_AT = 33  # deflections from zero to the largest one
_SHAPE = 1e-7  # relative tolerance of a shape parameter: far below what noise leaves of it


@dataclass(frozen=True, slots=True, kw_only=True)
class TransmissionFit:
    """One transmission and its motor, fitted to a recording.

    Attributes:
        model: transmission model's name.
        parameters: by their names in the joint file.
        std: their standard deviations, by the same names.
        alpha: parameters as an array.
        covariance: of alpha.
        deflection_rad: (rows,) filtered deflections, for plots.
        torque_nm: (rows,) flexibility torque that the motor's balance gives there, nuisances removed.
        error_rms_nm: what is left of the balance.
        torque_rms_nm: of the flexibility torque.
        inertia_kg_m2: B, with what the recording says of it.
        viscous_damping_nm_s_rad: D, likewise.
        coulomb_nm: friction that the declared model lacks.
        offset_nm: constant torque.
        deflection_offset_rad: zero of the deflection against the encoders'.
        link_delay_s: by which the link encoder is late.
        torque_skew_s: by which the torque is.
        nuisance_std: standard deviations of the last seven, by name (`NUISANCES`, "link_delay" last).
        excited: whether the recording reveals the stiffness at all.
    """

    model: str
    parameters: dict[str, ParameterValue]
    std: dict[str, ParameterValue]
    alpha: FloatArray
    covariance: FloatArray
    deflection_rad: FloatArray
    torque_nm: FloatArray
    error_rms_nm: float
    torque_rms_nm: float
    inertia_kg_m2: float
    viscous_damping_nm_s_rad: float
    coulomb_nm: float
    offset_nm: float
    deflection_offset_rad: float
    link_delay_s: float
    torque_skew_s: float
    nuisance_std: dict[str, float]
    excited: bool

    @property
    def stiffens(self) -> bool:
        """Whether the stiffness is positive, its 95 % interval too, at every deflection of the recording."""
        law = MODELS[self.model]
        reach = float(np.max(np.abs(self.deflection_rad)))
        phi = np.linspace(0.0, reach, _LOOKED_AT)
        slopes = law.stiffness_jacobian(phi, self.alpha)
        std = np.sqrt(np.maximum(np.einsum("ij,jk,ik->i", slopes, self.covariance, slopes), 0.0))
        return bool(np.all(law.stiffness(phi, self.alpha) > _SIGMA_95 * std))


def fit(record: Record, model: JointModel, bandwidth_rad_s: float | None = None) -> list[TransmissionFit]:
    """Fit every flexible transmission of a joint to a recording; one entry a motor.

    A rigid transmission's entry has no parameters; an unknown one is fitted by a polynomial.

    Args:
        record: measured data.
        model: declared joint; its transmission parameters, if any, are not used, its effects are honoured.
        bandwidth_rad_s: of the filter that all channels share; left out: chosen for the sampling.

    Raises:
        EstimatorError: the recording lacks what is needed, is too short, or nothing moves in it.
        GateError: its units, signs, gear ratio or time do not fit the joint.
    """
    if record.motors != len(model.motors):
        raise EstimatorError(f"recording: expected {len(model.motors)} motor(s), got {record.motors}")
    if model.has_deflection and record.link_position_rad is None:
        raise EstimatorError("recording: expected link_position_rad, as the transmission is flexible")
    bandwidth = bandwidth_rad_s or min(60.0, 0.12 / record.period_s)
    refuse(record, model)
    record = corrected(record, model)
    return [_fit_motor(record, i, motor, bandwidth) for i, motor in enumerate(model.motors)]


def _fit_motor(record: Record, index: int, motor: Motor, bandwidth: float) -> TransmissionFit:
    if motor.transmission.model == RIGID:
        return _rigid(motor)
    channels = prepare(record, index, motor, bandwidth)
    declared = transmission_model(motor.transmission)
    transmission: TransmissionModel = declared or Polynomial()
    solver = Solver(channels, motor, transmission)
    delay = solver.search_delay()
    shape: tuple[float, ...] = ()
    if transmission.shape_names:
        reach = float(np.max(np.abs(channels.deflection(delay))))
        shape = search_shape(transmission, reach, lambda s: solver.cost(delay, s, 1), _SHAPE)
        if delay != 0.0:
            delay = solver.refine_delay(delay, shape)
            shape = search_shape(transmission, reach, lambda s: solver.cost(delay, s, 1), _SHAPE)
    order = solver.choose_order(delay)
    return _finish(
        solver, motor, delay, shape, order, UNKNOWN if motor.transmission.model == UNKNOWN else None
    )


def _rigid(motor: Motor) -> TransmissionFit:
    empty = np.zeros(0)
    return TransmissionFit(
        model=RIGID,
        parameters={},
        std={},
        alpha=empty,
        covariance=np.zeros((0, 0)),
        deflection_rad=empty,
        torque_nm=empty,
        error_rms_nm=math.nan,
        torque_rms_nm=math.nan,
        inertia_kg_m2=motor.inertia_kg_m2,
        viscous_damping_nm_s_rad=motor.viscous_damping_nm_s_rad,
        coulomb_nm=0.0,
        offset_nm=0.0,
        deflection_offset_rad=0.0,
        link_delay_s=0.0,
        torque_skew_s=0.0,
        nuisance_std={},
        excited=False,
    )


def _finish(
    solver: Solver, motor: Motor, delay: float, shape: tuple[float, ...], order: int, name: str | None
) -> TransmissionFit:
    """Parameters, honest covariance and what is left."""
    c, model = solver.channels, solver.model
    A, y, units, prior = solver.system(delay, shape, order)
    told = solver.solve(A, y, prior)
    x, noise = told.x, told.noise
    alpha = np.concatenate([x[:order] * units[:order], shape])
    if shape:
        sensitivity = c.sensitivity(model, delay, alpha) / solver.torque_unit
        full = np.column_stack([A[:, :order], sensitivity, A[:, order:]])
        units = np.concatenate([units[:order], np.ones(len(shape)), units[order:]])
        free = np.full(len(shape), 1e6)
        told = told._replace(prior=np.concatenate([told.prior[:order], free, told.prior[order:]]))
    else:
        full = A
    covariance = solver.covariance(full, told, delay, alpha)
    covariance *= np.outer(np.append(units, c.period_s), np.append(units, c.period_s))
    n = alpha.size
    std = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    nuisance = dict(zip(NUISANCES, (x[order:] * units[n:]).tolist(), strict=True))
    others = A[:, order:] @ x[order:] * solver.torque_unit
    stated = model if name is None else Polynomial()
    torque = float(np.std(A[:, :order] @ x[:order])) * solver.torque_unit
    return TransmissionFit(
        model=stated.name,
        parameters=stated.parameters(alpha),
        std=stated.parameters(std[:n]),
        alpha=alpha,
        covariance=covariance[:n, :n],
        deflection_rad=c.deflection(delay) + nuisance["shift"],
        torque_nm=c.balance - others,
        error_rms_nm=noise * solver.torque_unit,
        torque_rms_nm=torque,
        inertia_kg_m2=motor.inertia_kg_m2 + nuisance["inertia"],
        viscous_damping_nm_s_rad=motor.viscous_damping_nm_s_rad + nuisance["damping"],
        coulomb_nm=nuisance["coulomb"],
        offset_nm=nuisance["offset"],
        deflection_offset_rad=nuisance["shift"],
        link_delay_s=delay,
        torque_skew_s=nuisance["torque_skew"],
        nuisance_std=dict(zip((*NUISANCES, "link_delay"), std[n:].tolist(), strict=True)),
        excited=bool(std[0] < 0.25 * abs(alpha[0])),
    )
