"""Transmission parameters of the declared model, and their linearisation."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from estimator.choices import whole
from estimator.diagnosis.frame import Frame
from estimator.errors import EstimatorError
from estimator.model import HIGHEST_ORDER, ParameterValue
from estimator.sample import FloatArray
from estimator.transmissions import TransmissionModel, transmission_model

__all__ = ["Base", "start", "with_flexibility"]


@dataclass(frozen=True, slots=True, eq=False)
class Base:
    """Transmission parameters alpha, one array per motor (empty where the transmission is rigid)."""

    alpha: tuple[FloatArray, ...]

    def models(self, frame: Frame) -> list[TransmissionModel | None]:
        """Return the transmission models, None where rigid."""
        return [
            transmission_model(motor.transmission) if flexible else None
            for motor, flexible in zip(frame.model.motors, frame.flexible, strict=True)
        ]

    def design(self, frame: Frame) -> FloatArray:
        """Return the columns d tau_e / d alpha of all motors, stacked."""
        made = []
        for i, model in enumerate(self.models(frame)):
            if model is None:
                continue
            jacobian = model.jacobian(frame.motors[i].deflection, self.alpha[i])
            slopes = np.ascontiguousarray(jacobian.T)
            made.append(frame.column(i, slopes, slopes if frame.pulls[i] else None))
        return np.concatenate(made).T if made else np.zeros((frame.rows * frame.equations, 0))

    def torque(self, frame: Frame) -> FloatArray:
        """Return tau_e at alpha in all equations, stacked."""
        total = np.zeros(frame.rows * frame.equations)
        for i, model in enumerate(self.models(frame)):
            if model is not None:
                torque = model.torque(frame.motors[i].deflection, self.alpha[i])
                total = total + frame.column(i, torque, torque if frame.pulls[i] else None)
        return total

    def lever(self, frame: Frame, held_rad: float) -> FloatArray:
        """Return the column of a serial joint's lever, 1/rad at one position of the second motor.

        From U = (1 + l (theta_2 - held))² F(phi), to the first order in l: tau_e grows by
        2 (theta_2 - held) f, and the second motor bears -2 F. The quadrature of F, the integral of f, is
        exact for every polynomial of a joint file.
        """
        model, (first, second) = self.models(frame)[0], frame.motors
        assert model is not None
        nodes, weights = np.polynomial.legendre.leggauss(HIGHEST_ORDER)
        phi = first.deflection
        energy = sum(
            0.5 * w * phi * model.torque(0.5 * (1.0 + x) * phi, self.alpha[0])
            for x, w in zip(nodes.tolist(), weights.tolist(), strict=True)
        )
        more = 2.0 * (second.position - held_rad) * model.torque(phi, self.alpha[0])
        return np.asarray(frame.column(0, more, more) - frame.column(1, 2.0 * np.asarray(energy), None))

    def moved(self, frame: Frame, step: FloatArray) -> Base:
        """Return alpha plus a step, so much of it that the shape goes half of the way to a bound.

        The first coefficient of a law with a shape follows from the torque at the rms deflection, which is
        nearly linear in a step along the ridge that the two form.
        """
        alpha, begin = [], 0
        for i, (model, old) in enumerate(zip(self.models(frame), self.alpha, strict=True)):
            mine, share = step[begin : begin + len(old)], 1.0
            begin += len(old)
            bounds = () if model is None else model.shape_bounds
            for at, by, (low, high) in zip(old[::-1], mine[::-1], bounds[::-1], strict=False):
                least, most = 0.5 * (at + low), min(0.5 * (at + high), 1.5 * at)
                if by and at + by != np.clip(at + by, least, most):
                    share = min(share, max(((least if by < 0.0 else most) - at) / by, 0.0))
            new = old + share * mine
            if model is not None and bounds:
                phi = np.sqrt(np.mean(frame.motors[i].deflection ** 2, keepdims=True))
                torque = model.torque(phi, old) + model.jacobian(phi, old) @ (share * mine)
                unit = float(model.torque(phi, np.array([1.0, *new[1:]]))[0])
                new[0] = torque[0] / unit if unit else new[0]  # nothing is deflected
            alpha.append(new)
        return replace(self, alpha=tuple(alpha))

    def parameters(self, frame: Frame) -> list[dict[str, ParameterValue]]:
        """Return alpha by its names in the joint file, one mapping per motor."""
        return [
            {} if model is None else model.parameters(alpha)
            for model, alpha in zip(self.models(frame), self.alpha, strict=True)
        ]


def start(frame: Frame) -> Base:
    """Start values of alpha: declared, or by a search over the shape for each motor."""
    alpha = []
    for i, motor in enumerate(frame.model.motors):
        model = transmission_model(motor.transmission) if frame.flexible[i] else None
        if model is None:
            alpha.append(np.zeros(0))
        elif motor.transmission.parameters:
            alpha.append(np.asarray(model.alpha(motor.transmission.parameters), dtype=np.float64).copy())
        else:
            alpha.append(_search(frame, i, model, motor.transmission.order or 1))
    return Base(tuple(alpha))


def _search(frame: Frame, i: int, model: TransmissionModel, order: int) -> FloatArray:
    phi = frame.motors[i].deflection
    target = frame.project(frame.motor_balance(i))
    most = float(np.max(np.abs(phi)))
    shapes: list[tuple[float, ...]] = [()]
    if model.shape_bounds:
        low, high = model.shape_bounds[0]
        rest = model.shape_start[1:]
        first = 1.02 * low if low > 0.5 else 0.02 / max(most, 1e-9)
        near = np.geomspace(first, min(high, max(20.0 / max(most, 1e-9), 1.1 * first)), whole("points"))
        shapes = [(float(x), *rest) for x in near if model.reach((float(x), *rest)) > most * 1.001]
    if not shapes:
        raise EstimatorError(
            f"recording: a deflection of {most:.3g} rad is more than a transmission of model "
            f'"{model.name}" can have: check its units, or declare another model'
        )
    # A link read late adds its rate to the deflection, on a stiff spring more than all else.
    beside = np.column_stack((frame.project(frame.motors[i].link_velocity), np.ones(len(target))))
    best, found = np.inf, np.zeros(0)
    for shape in shapes:
        columns = frame.project(np.ascontiguousarray(np.asarray(model.basis(phi, shape, order)).T)).T
        design = np.column_stack((columns, beside))
        solution, *_ = np.linalg.lstsq(design, target, rcond=None)
        error = float(np.sum((target - design @ solution) ** 2))
        if error < best:
            best, found = error, np.array([*solution[: columns.shape[1]], *shape])
    return found


def with_flexibility(frame: Frame, base: Base) -> Frame:
    """Return the frame with tau_e and stiffness in its coordinates."""
    motors = []
    for c, model, alpha in zip(frame.motors, base.models(frame), base.alpha, strict=True):
        if model is None:
            # Rigid: the transmitted torque is unknown; the motor's torque stands for it.
            motors.append(c)
            continue
        motors.append(
            c._replace(
                flexibility_torque=np.asarray(model.torque(c.deflection, alpha)),
                stiffness=np.asarray(model.stiffness(c.deflection, alpha)),
            )
        )
    return replace(frame, motors=tuple(motors))
