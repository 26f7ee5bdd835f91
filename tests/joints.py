"""Truth for the estimator's tests: many joints at once, by an integrator that sim/ does not use.

The classical fourth-order step, fixed, with the torque held over each period as a drive holds it. All
arrays carry the joint as their first axis, so a hundred random joints cost what one does.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from estimator import Effect, EstimatorSettings, JointModel, Motor, Record, Transmission, make_estimator

Array = np.ndarray

# (nodes, weights) of explicit Runge-Kutta methods whose stages each begin with the slope of the one before.
Method = tuple[tuple[float, ...], Array]
CLASSICAL: Method = ((0.0, 0.5, 0.5, 1.0), np.array((1 / 6, 1 / 3, 1 / 3, 1 / 6)))
HEUN: Method = ((0.0, 1.0), np.array((0.5, 0.5)))


def polynomial(coefficients: Array) -> tuple[Callable[[Array], Array], Callable[[Array], Array]]:
    """(torque, stiffness) for coefficients (N, m, p), phi (N, m)."""
    alpha = list(np.moveaxis(coefficients, -1, 0))
    slopes = [(2 * k + 1) * a for k, a in enumerate(alpha)]

    def even(by_power: list[Array], phi: Array) -> Array:
        square, total = phi * phi if len(alpha) > 1 else 0.0, by_power[-1]
        for coefficient in by_power[-2::-1]:
            total = coefficient + square * total
        return total

    def torque(phi: Array) -> Array:
        return phi * even(alpha, phi)

    def stiffness(phi: Array) -> Array:
        return even(slopes, phi) + 0.0 * phi

    return torque, stiffness


def vsa_ii(k: Array, c: Array) -> tuple[Callable[[Array], Array], Callable[[Array], Array]]:
    """(torque, stiffness) of eqs 19, 20, written out from the potential U = k beta²."""

    def torque(phi: Array) -> Array:
        sine = c * np.sin(phi / 2)
        beta = np.arcsin(sine) - phi / 2
        slope = c * np.cos(phi / 2) / (2 * np.sqrt(1 - sine**2)) - 0.5
        return 2 * k * beta * slope

    def stiffness(phi: Array) -> Array:
        h = 1e-5
        near, far = (torque(phi + d) - torque(phi - d) for d in (h, 2 * h))
        return (8 * near - far) / (12 * h)

    return torque, stiffness


More = Callable[[float, Array, Array, Array], None]


@dataclass
class Plants:
    """N joints with m motors; every number or array broadcasts against (N, m) or (N,).

    `more(t, state, rate, tau)` adds further physics to the rate of the state (theta, theta', q, q'), and sets
    that of its memories behind them.
    """

    torque: Callable[[Array], Array]
    stiffness: Callable[[Array], Array]
    B: Array | float
    D: Array | float
    M: Array | float
    Dq: Array | float
    gravity: Array | float
    coulomb: Array = field(default_factory=lambda: np.zeros(1))
    scale_at: tuple[float, float] = (np.inf, 1.0)  # (time, factor): a step of the stiffness
    more: More | None = None
    memories: int = 0


@dataclass
class Truth:
    theta: Array  # (n, N, m)
    omega: Array
    q: Array  # (n, N)
    q_rate: Array
    tau: Array
    tau_e: Array  # (n, N, m)
    sigma: Array


def simulate(
    plants: Plants,
    tau: Array | Callable[[int, Array], Array],
    period_s: float,
    substeps: int | None = None,
    *,
    size: tuple[int, int, int] | None = None,
    method: Method = CLASSICAL,
) -> Truth:
    """Integrate from rest; row k of tau (n, N, m) is held from t_k to t_(k+1).

    A controller's tau makes row k of the state and needs `size`. Without `substeps`, two steps a period where
    dry friction is steep or the joint stiff, else one.
    """
    n, N, m = size or tau.shape
    B, D, M, Dq, gravity = plants.B, plants.D, plants.M, plants.Dq, plants.gravity
    dry = bool(np.any(plants.coulomb))
    if substeps is None:
        eigen = np.sqrt(plants.stiffness(np.zeros((N, m))) * (1 / B + 1 / np.reshape(M, (-1, 1))))
        substeps = 2 if dry or np.max(eigen) * period_s > 0.1 else 1
    h, width = period_s / substeps, 2 * m + 2 + plants.memories
    nodes, weights = method[0], h * method[1]
    x, stages = np.zeros((N, width)), np.zeros((len(nodes), N, width))
    flat, dry_nm, load_rate = stages.reshape(len(nodes), -1), plants.coulomb, -1.0 / M
    (theta, omega, q, dq), *slopes = (
        (of[:, :m], of[:, m : 2 * m], of[:, 2 * m], of[:, 2 * m + 1]) for of in (x, *stages)
    )
    across = x[:, 2 * m : 2 * m + 1]
    states, held = np.empty((n, N, width)), np.empty((n, N, m))
    scales = np.where(np.arange(n) * period_s >= plants.scale_at[0], plants.scale_at[1], 1.0)

    def rate(t: float, scale: float, u: Array, stage: int) -> None:
        theta_out, omega_out, q_out, dq_out = slopes[stage]
        spring = plants.torque(across - theta)
        if scale != 1.0:
            spring = scale * spring
        theta_out[:], q_out[:] = omega, dq
        push = u + spring - D * omega
        if dry:
            push -= dry_nm * np.tanh(omega / 1e-3)
        np.divide(push, B, out=omega_out)
        load = (spring[:, 0] if m == 1 else spring.sum(1)) + Dq * dq + gravity * np.sin(q)
        np.multiply(load, load_rate, out=dq_out)
        if plants.more is not None:
            plants.more(t, x, stages[stage], u)

    for k in range(n):
        states[k] = x
        held[k] = u = tau(k, x) if callable(tau) else tau[k]
        for step in range(substeps):
            before, start = x.copy(), k * period_s + step * h
            for i, node in enumerate(nodes):
                if i:
                    np.add(before, node * h * stages[i - 1], out=x)
                rate(start + node * h, scales[k], u, i)
            np.add(before, (weights @ flat).reshape(N, width), out=x)
    q, phi, scales = states[..., 2 * m], states[..., 2 * m, None] - states[..., :m], scales[:, None, None]
    motors, q_rate = (states[..., :m], states[..., m : 2 * m]), states[..., 2 * m + 1]
    return Truth(*motors, q, q_rate, held, scales * plants.torque(phi), scales * plants.stiffness(phi))


def pulled(
    torque: Callable[[Array], Array], stiffness: Callable[[Array], Array], pull: float, n: int, seed: int = 0
) -> tuple[Truth, Record]:
    """A joint that goes from place to place, its link pulled by a weight or another spring: the deflection stays on one
    side. The truth, and what fine encoders and a noisy drive read."""
    places, load = np.random.default_rng(seed).uniform(-0.6, 0.6, n // 1000 + 2), 0.45

    def more(_t: float, _state: Array, rate: Array, _tau: Array) -> None:
        rate[:, 3] += pull / load

    def follow(k: int, state: Array) -> Array:
        at, share = k // 1000, min(k % 1000 / 600, 1.0)
        wanted = places[at] + (places[at + 1] - places[at]) * share**2 * (3.0 - 2.0 * share)
        return np.asarray(400.0 * (wanted - state[:, :1]) - 14.0 * state[:, 1:2])

    plants = Plants(torque, stiffness, 0.12, 0.8, load, 0.3, 3.0, more=more)
    return _controlled(plants, follow, n, 0.02, motor_counts=131072, link_bits=18)


def guided(
    torque: Callable[[Array], Array], stiffness: Callable[[Array], Array], n: int
) -> tuple[Truth, Record]:
    """A joint that a hand moves while its drive only damps: the truth, and what is read."""
    rng, load = np.random.default_rng(0), 0.55
    hz, phase = rng.uniform(0.2, 3.0, 8), rng.uniform(0.0, 2.0 * np.pi, 8)

    def hand(t: float, _state: Array, rate: Array, _tau: Array) -> None:
        rate[:, 3] += 5.0 * np.sum(np.sin(2.0 * np.pi * hz * t + phase)) / np.sqrt(8.0) / load

    def damp(_k: int, state: Array) -> Array:
        return np.asarray(-0.33 * state[:, 1:2])

    plants = Plants(torque, stiffness, 0.12, 0.8, load, 0.13, 0.02, more=hand)
    return _controlled(plants, damp, n, 0.0125, motor_counts=8192, link_bits=17)


def _controlled(
    plants: Plants, controller: Callable[[int, Array], Array], n: int, noise_nm: float, **counts: float
) -> tuple[Truth, Record]:
    truth = simulate(plants, controller, 1e-3, size=(n, 1, 1), method=HEUN)
    noise = np.random.default_rng(5).normal(0, noise_nm, (n, 1))
    return truth, record(truth, 0, 1e-3, velocity_rad_s=None, torque_noise=noise, **counts)


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
    return replace(
        recorded(theta, tau if torque_noise is None else tau + torque_noise, q, period_s),
        motor_velocity_rad_s=velocity,
    )


def recorded(theta: Array, tau: Array, q: Array | None = None, period_s: float = 1e-3) -> Record:
    """A recording without gaps of a joint's channels; of one motor (n,), of several (n, m)."""
    return Record(
        period_s=period_s,
        sequence=np.arange(len(theta)),
        motor_position_rad=np.ascontiguousarray(theta).reshape(len(theta), -1),
        motor_torque_nm=np.reshape(tau, (len(theta), -1)),
        link_position_rad=q,
    )


def of_world(rows: Mapping[str, Array], *, linked: bool = True, period_s: float = 1e-3) -> Record:
    """What `sim.world.record` gives, as a recording; without the link's encoder if need be."""
    motors = [name for name in ("motor1", "motor2") if f"{name}_position_rad" in rows]
    theta, tau = (
        np.stack([rows[f"{name}_{what}"] for name in motors], axis=1)
        for what in ("position_rad", "torque_nm")
    )
    return recorded(theta, tau, rows["link_position_rad"] if linked else None, period_s)


def part(whole: Record, rows: slice | Array) -> Record:
    link = whole.link_position_rad
    return replace(
        whole,
        sequence=whole.sequence[rows],
        motor_position_rad=whole.motor_position_rad[rows],
        motor_torque_nm=whole.motor_torque_nm[rows],
        link_position_rad=None if link is None else link[rows],
    )


def write_csv(record: Record, path: Path, digits: int = 17) -> Path:
    """The recording as a file, in a folder that is made if need be."""
    motors, link = range(1, record.motors + 1), record.link_position_rad
    names = ["time_s", *(f"motor{i}_{what}" for what in ("position_rad", "torque_nm") for i in motors)]
    columns = [record.time_s, record.motor_position_rad, record.motor_torque_nm]
    if link is not None:
        columns, names = [*columns, link], [*names, "link_position_rad"]
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savetxt(path, np.column_stack(columns), f"%.{digits}g", ",", header=",".join(names), comments="")
    return path


def sweep(
    rng: np.random.Generator, n: int, N: int, m: int, period_s: float, size: Array | float, top_hz: float
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
    D: float = 0.0,
    *,
    model: str = "polynomial",
    order: int | None = 2,
    m: int = 1,
    parameters: dict | None = None,
    covariance: tuple[tuple[float, ...], ...] = (),
    effects: tuple[Effect, ...] = (),
    motor: Mapping[str, Any] | None = None,
    **joint: Any,
) -> JointModel:
    """One or two motors that are alike, on a link; `order` is a polynomial's, `motor` and `joint` what else they have."""
    order = order if model == "polynomial" else None
    how = {} if not covariance else {"covariance": covariance}
    transmission = Transmission(model=model, order=order, parameters=parameters or {}, **how)
    made = Motor(
        inertia_kg_m2=B,
        viscous_damping_nm_s_rad=D,
        transmission=transmission,
        effects=effects,
        **(motor or {}),
    )
    return JointModel(arrangement="single" if m == 1 else "antagonistic", motors=(made,) * m, **joint)


def with_motor(model: JointModel, **changes: Any) -> JointModel:
    """The model whose first motor is another one in these."""
    return replace(model, motors=(replace(model.motors[0], **changes), *model.motors[1:]))


def estimates(model: JointModel, record: Record, **settings: Any) -> Array:
    """What an estimator says of a recording: sequence, status, torque, stiffness and its deviation, a row a sample."""
    estimator = make_estimator(model, EstimatorSettings(**settings), record.period_s)
    return np.array([estimator.step(sample)[:5] for sample in record.samples()])
