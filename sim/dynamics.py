"""The joint of eqs 4-7 as accelerations, in plain scalars.

    M q'' + D_q q' + g(q) + tau_e + x_link = tau_k              (4), (6)
    B_i theta_i'' + D_i theta_i' - tau_e,i + x_i = tau_i        (5), (7)

with phi_i = q - theta_i and tau_e = tau_e,1 + tau_e,2 for two motors against each other (eq 9). In the
serial arrangement motor 1 carries the link through a spring whose lever motor 2 sets, as in the AwAS
(A. Jafari, N. Tsagarakis, B. Vanderborght, D. Caldwell: "A novel actuator with adjustable stiffness
(AwAS)", IROS 2010): U_e = rho(theta_2)² F(phi_1) with the lever ratio rho = 1 + l theta_2, so that
tau_e = tau_e,1 = rho² F'(phi_1) and motor 2 feels tau_e,2 = -dU_e/dtheta_2 = -2 l rho F(phi_1).
"""

from __future__ import annotations

import math
from collections.abc import Callable

from sim.plant import JointPlant, LinkPlant, Load, MotorPlant

State = list[float]
"""[q, q', theta_1, theta_1', theta_2, theta_2'], rad and rad/s."""

Pair = Callable[[float, float, float, float, float, float], tuple[float, float]]
"""(q, q', theta, theta', tau, tau_k) -> accelerations of link and motor."""
Triple = Callable[[float, float, float, float, float, float, float, float, float], tuple[float, float, float]]
"""(q, q', theta_1, theta_1', theta_2, theta_2', tau_1, tau_2, tau_k) -> three accelerations."""
Coupling = Callable[[float, float, float, float], tuple[float, float]]
"""(q, q', theta, theta') -> transmission torque on the link and on the motor (they differ by de/dtheta)."""


def spring_deflection(motor: MotorPlant) -> Load:
    """Return (q, theta) -> deflection of the spring: phi minus the gear's errors, rad."""
    kinematics = motor.terms.kinematics
    return lambda q, theta: q - theta - sum(error(theta)[0] for error in kinematics)


def _coupling(motor: MotorPlant) -> Coupling:
    torque, extras, kinematics = motor.law().torque, motor.terms.extras, motor.terms.kinematics

    def couple(q: float, v: float, theta: float, w: float) -> tuple[float, float]:
        phi, rate, slope = q - theta, v - w, 1.0
        for error in kinematics:
            e, de = error(theta)
            phi, rate, slope = phi - e, rate - de * w, slope + de
        te = torque(phi)
        for extra in extras:
            te += extra(phi, rate, theta)
        return te, te * slope

    return couple


def transmission_torques(plant: JointPlant) -> Callable[[State], tuple[float, ...]]:
    """State -> tau_e,i on each motor (N·m); zero at a rigid coupling, which has no law."""
    if plant.rigid:
        return lambda state: (0.0,)
    if plant.arrangement == "serial":
        couple, reaction = _coupling(plant.motors[0]), _reaction(plant)

        def serial(state: State) -> tuple[float, ...]:
            q, v, theta1, w1, theta2, _ = state
            ratio = 1.0 + plant.lever_per_rad * theta2
            return ratio * ratio * couple(q, v, theta1, w1)[1], reaction(q, theta1, ratio)

        return serial
    couplings = tuple(_coupling(motor) for motor in plant.motors)
    return lambda state: tuple(
        couple(state[0], state[1], state[2 + 2 * i], state[3 + 2 * i])[1]
        for i, couple in enumerate(couplings)
    )


def elasticity(plant: JointPlant) -> Callable[[State], tuple[tuple[float, float], ...]]:
    """State -> (tau_e,i, sigma_i) of each transmission, N·m and N·m/rad: its elastic part alone.

    A rigid coupling has no law: the torque is unknown (NaN), the stiffness infinite. Motor 2 of the serial
    arrangement has a torque but no stiffness.
    """
    if plant.rigid:
        return lambda state: ((math.nan, math.inf),)
    if plant.arrangement == "serial":
        law, phi, reaction = plant.motors[0].law(), spring_deflection(plant.motors[0]), _reaction(plant)

        def serial(state: State) -> tuple[tuple[float, float], ...]:
            ratio, seen = 1.0 + plant.lever_per_rad * state[4], phi(state[0], state[2])
            first = ratio * ratio * law.torque(seen), ratio * ratio * law.stiffness(seen)
            return first, (reaction(state[0], state[2], ratio), 0.0)

        return serial
    springs = [(motor.law(), spring_deflection(motor)) for motor in plant.motors]

    def parallel(state: State) -> tuple[tuple[float, float], ...]:
        seen = [phi(state[0], state[2 + 2 * i]) for i, (_, phi) in enumerate(springs)]
        return tuple((law.torque(x), law.stiffness(x)) for (law, _), x in zip(springs, seen, strict=True))

    return parallel


def _reaction(plant: JointPlant) -> Callable[[float, float, float], float]:
    """(q, theta_1, rho) -> tau_e,2 = -2 l rho F of the serial arrangement."""
    twice, potential = -2.0 * plant.lever_per_rad, plant.motors[0].law().potential
    phi = spring_deflection(plant.motors[0])
    return lambda q, theta1, ratio: twice * ratio * potential(phi(q, theta1))


def _motor_load(motor: MotorPlant) -> Load:
    return _load(motor.viscous_damping_nm_s_rad, motor.terms.loads)


def _load(damping: float, loads: list[Load]) -> Load:
    def load(position: float, velocity: float) -> float:
        total = damping * velocity
        for x in loads:
            total += x(position, velocity)
        return total

    return load


def _link_load(link: LinkPlant) -> Load:
    sin, d, g, phase = math.sin, link.viscous_damping_nm_s_rad, link.gravity_nm, link.gravity_phase_rad
    if not link.terms.loads:
        return lambda q, v: d * v + g * sin(q + phase)
    further = _load(d, link.terms.loads)
    return lambda q, v: further(q, v) + g * sin(q + phase)


def equations(plant: JointPlant) -> Pair | Triple:
    """Return accelerations of the joint as one closure."""
    if plant.rigid:
        return _rigid(plant)
    if plant.arrangement == "serial":
        return _serial(plant)
    return _single(plant) if plant.arrangement == "single" else _antagonistic(plant)


def _rigid(plant: JointPlant) -> Pair:
    """One body of inertia B + M: link and motor get the same acceleration."""
    motor_load, link_load = _motor_load(plant.motors[0]), _link_load(plant.link)
    inertia = plant.motors[0].inertia_kg_m2 + plant.link.inertia_kg_m2

    def acc(q: float, v: float, theta: float, w: float, tau: float, tau_k: float) -> tuple[float, float]:
        a = (tau + tau_k - motor_load(theta, w) - link_load(q, v)) / inertia
        return a, a

    return acc


def _single(plant: JointPlant) -> Pair:
    motor, link_load, m = plant.motors[0], _link_load(plant.link), plant.link.inertia_kg_m2
    couple, load, b = _coupling(motor), _motor_load(motor), motor.inertia_kg_m2

    def acc(q: float, v: float, theta: float, w: float, tau: float, tau_k: float) -> tuple[float, float]:
        on_link, on_motor = couple(q, v, theta, w)
        return (tau_k - on_link - link_load(q, v)) / m, (tau + on_motor - load(theta, w)) / b

    return acc


def _antagonistic(plant: JointPlant) -> Triple:
    link_load, m = _link_load(plant.link), plant.link.inertia_kg_m2
    couple1, couple2 = (_coupling(motor) for motor in plant.motors)
    load1, load2 = (_motor_load(motor) for motor in plant.motors)
    b1, b2 = (motor.inertia_kg_m2 for motor in plant.motors)

    def acc(
        q: float, v: float, theta1: float, w1: float, theta2: float, w2: float,
        tau1: float, tau2: float, tau_k: float,
    ) -> tuple[float, float, float]:  # fmt: skip
        on_link1, on_motor1 = couple1(q, v, theta1, w1)
        on_link2, on_motor2 = couple2(q, v, theta2, w2)
        return (
            (tau_k - on_link1 - on_link2 - link_load(q, v)) / m,
            (tau1 + on_motor1 - load1(theta1, w1)) / b1,
            (tau2 + on_motor2 - load2(theta2, w2)) / b2,
        )

    return acc


def _serial(plant: JointPlant) -> Triple:
    link_load, m, lever = _link_load(plant.link), plant.link.inertia_kg_m2, plant.lever_per_rad
    couple, reaction = _coupling(plant.motors[0]), _reaction(plant)
    load1, load2 = (_motor_load(motor) for motor in plant.motors)
    b1, b2 = (motor.inertia_kg_m2 for motor in plant.motors)

    def acc(
        q: float, v: float, theta1: float, w1: float, theta2: float, w2: float,
        tau1: float, tau2: float, tau_k: float,
    ) -> tuple[float, float, float]:  # fmt: skip
        ratio = 1.0 + lever * theta2
        square = ratio * ratio
        on_link, on_motor = couple(q, v, theta1, w1)
        return (
            (tau_k - square * on_link - link_load(q, v)) / m,
            (tau1 + square * on_motor - load1(theta1, w1)) / b1,
            (tau2 + reaction(q, theta1, ratio) - load2(theta2, w2)) / b2,
        )

    return acc
