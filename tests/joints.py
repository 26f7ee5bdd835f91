"""Truth for the estimator's tests: many joints at once, by an integrator that sim/ does not use.

Dormand-Prince's fifth-order step, fixed, with the torque held over each period as a drive holds it. All
arrays carry the joint as their first axis, so a hundred random joints cost what one does.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from estimator import JointModel, Motor, Record, Transmission

Array = np.ndarray

_A = (
    (),
    (1 / 5,),
    (3 / 40, 9 / 40),
    (44 / 45, -56 / 15, 32 / 9),
    (19372 / 6561, -25360 / 2187, 64448 / 6561, -212 / 729),
    (9017 / 3168, -355 / 33, 46732 / 5247, 49 / 176, -5103 / 18656),
)
_B = (35 / 384, 0.0, 500 / 1113, 125 / 192, -2187 / 6784, 11 / 84)


def polynomial(coefficients: Array) -> tuple[Callable[[Array], Array], Callable[[Array], Array]]:
    """(torque, stiffness) for coefficients (N, m, p), phi (N, m)."""

    def torque(phi: Array) -> Array:
        return sum(coefficients[..., h] * phi ** (2 * h + 1) for h in range(coefficients.shape[-1]))

    def stiffness(phi: Array) -> Array:
        return sum((2 * h + 1) * coefficients[..., h] * phi ** (2 * h) for h in range(coefficients.shape[-1]))

    return torque, stiffness


def vsa_ii(k: Array, c: Array) -> tuple[Callable[[Array], Array], Callable[[Array], Array]]:
    """(torque, stiffness) of eqs 19, 20, written out from the potential U = k beta²."""

    def torque(phi: Array) -> Array:
        beta = np.arcsin(c * np.sin(phi / 2)) - phi / 2
        slope = c * np.cos(phi / 2) / (2 * np.sqrt(1 - (c * np.sin(phi / 2)) ** 2)) - 0.5
        return 2 * k * beta * slope

    def stiffness(phi: Array) -> Array:
        h = 1e-5
        return (8 * (torque(phi + h) - torque(phi - h)) - (torque(phi + 2 * h) - torque(phi - 2 * h))) / (
            12 * h
        )

    return torque, stiffness


@dataclass
class Plants:
    """N joints with m motors; every array broadcasts against (N, m) or (N,)."""

    torque: Callable[[Array], Array]
    stiffness: Callable[[Array], Array]
    B: Array
    D: Array
    M: Array
    Dq: Array
    gravity: Array
    coulomb: Array = field(default_factory=lambda: np.zeros(1))
    scale_at: tuple[float, float] = (np.inf, 1.0)  # (time, factor): a step of the stiffness


@dataclass
class Truth:
    theta: Array  # (n, N, m)
    omega: Array
    q: Array  # (n, N)
    q_rate: Array
    tau: Array
    tau_e: Array  # (n, N, m)
    sigma: Array


def simulate(plants: Plants, tau: Array, period_s: float, substeps: int = 2) -> Truth:
    """Integrate from rest; tau is (n, N, m), row k held from t_k to t_(k+1)."""
    n, N, m = tau.shape
    state = np.zeros((N, 2 * m + 2))
    states = np.empty((n, N, 2 * m + 2))
    h = period_s / substeps
    scale = 1.0

    def rate(x: Array, u: Array) -> Array:
        theta, omega, q, dq = x[:, :m], x[:, m : 2 * m], x[:, 2 * m], x[:, 2 * m + 1]
        spring = scale * plants.torque(q[:, None] - theta)
        friction = plants.coulomb * np.tanh(omega / 1e-3)
        out = np.empty_like(x)
        out[:, :m] = omega
        out[:, m : 2 * m] = (u + spring - plants.D * omega - friction) / plants.B
        out[:, 2 * m] = dq
        out[:, 2 * m + 1] = -(spring.sum(1) + plants.Dq * dq + plants.gravity * np.sin(q)) / plants.M
        return out

    scales = np.empty(n)
    for k in range(n):
        scale = plants.scale_at[1] if k * period_s >= plants.scale_at[0] else 1.0
        states[k], scales[k] = state, scale
        for _ in range(substeps):
            stages: list[Array] = []
            for row in _A:
                stages.append(
                    rate(
                        state + h * sum((a * s for a, s in zip(row, stages, strict=True)), 0 * state), tau[k]
                    )
                )
            state = state + h * sum(b * s for b, s in zip(_B, stages, strict=True))
    theta, omega = states[..., :m], states[..., m : 2 * m]
    q, dq = states[..., 2 * m], states[..., 2 * m + 1]
    phi = q[..., None] - theta
    scales = scales[:, None, None]
    return Truth(theta, omega, q, dq, tau, scales * plants.torque(phi), scales * plants.stiffness(phi))


def quantise(x: Array, step: float) -> Array:
    return np.floor(x / step) * step if step else x


def record(
    truth: Truth,
    joint: int,
    period_s: float,
    *,
    motor_counts: float = 0.0,
    link_bits: float = 0.0,
    velocity_rad_s: float | None = 0.0,
    torque_noise: Array | None = None,
    link_delay: int = 0,
) -> Record:
    """What a drive would have reported of one joint; counts per joint revolution, 0: exact."""
    theta = quantise(truth.theta[:, joint], 2 * np.pi / motor_counts if motor_counts else 0.0)
    q = truth.q[:, joint]
    if link_delay:
        q = np.concatenate([np.full(link_delay, q[0]), q[:-link_delay]])
    q = quantise(q, 2 * np.pi / 2**link_bits if link_bits else 0.0)
    velocity = None
    if velocity_rad_s is not None:
        velocity = truth.omega[:, joint]
        velocity = np.round(velocity / velocity_rad_s) * velocity_rad_s if velocity_rad_s else velocity
    tau = truth.tau[:, joint]
    return Record(
        period_s=period_s,
        sequence=np.arange(len(q)),
        motor_position_rad=np.ascontiguousarray(theta),
        motor_velocity_rad_s=velocity,
        motor_torque_nm=tau if torque_noise is None else tau + torque_noise,
        link_position_rad=q,
    )


def sweep(
    rng: np.random.Generator, n: int, N: int, m: int, period_s: float, size: Array, top_hz: float
) -> Array:
    """Rich excitation: a sum of sines from 0.2 Hz to top_hz with random phases, (n, N, m)."""
    t = np.arange(n)[:, None, None] * period_s
    out = np.zeros((n, N, m))
    for f in np.geomspace(0.2, top_hz, 7):
        f_i = f * rng.uniform(0.85, 1.15, (1, N, m))
        out += np.sin(2 * np.pi * f_i * t + rng.uniform(0, 2 * np.pi, (1, N, m)))
    return np.asarray(out * size / np.sqrt(7 / 2))


def joint_model(
    B: float,
    D: float,
    *,
    model: str = "polynomial",
    order: int | None = 2,
    m: int = 1,
    parameters: dict | None = None,
) -> JointModel:
    transmission = Transmission(model=model, order=order, parameters=parameters or {})
    motor = Motor(inertia_kg_m2=B, viscous_damping_nm_s_rad=D, transmission=transmission)
    return JointModel(arrangement="single" if m == 1 else "antagonistic", motors=(motor,) * m)
