"""The joint of eqs 4-7 as accelerations, in plain scalars.

    M q'' + D_q q' + g(q) + tau_e + x_link = tau_k              (4), (6)
    B_i theta_i'' + D_i theta_i' - tau_e,i + x_i = tau_i        (5), (7)

with phi_i = q - theta_i and tau_e = tau_e,1 + tau_e,2 for two motors against each other (eq 9). In the
serial arrangement motor 1 carries the link through a spring whose lever motor 2 sets, as in the AwAS
(A. Jafari, N. Tsagarakis, B. Vanderborght, D. Caldwell: "A novel actuator with adjustable stiffness
(AwAS)", IROS 2010): U_e = rho(theta_2)² F(phi_1) with the lever ratio rho = 1 + l theta_2, so that
tau_e = tau_e,1 = rho² F'(phi_1) and motor 2 feels tau_e,2 = -dU_e/dtheta_2 = -2 l rho F(phi_1).
"""

import math
from collections.abc import Callable

from sim.plant import JointPlant, Load, MotorPlant

State = list[float]
"""[q, q', theta_1, theta_1', theta_2, theta_2'], rad and rad/s; a second motor that is not there rests."""

Triple = tuple[float, float, float]
Carried = Callable[[float, float, float, float, float, float], Triple]
"""(q, q', theta_1, theta_1', theta_2, theta_2') -> torque of the transmissions on link and motors, N·m."""
Accelerations = Callable[[float, float, float, float, float, float, float, float, float], Triple]
"""(q, q', theta_1, theta_1', theta_2, theta_2', tau_1, tau_2, tau_k) -> accelerations of each, rad/s²."""
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


def carried(plant: JointPlant) -> Carried:
    """Return the torque of the transmissions on each body; zero at a rigid coupling, which has no law."""
    if plant.rigid:
        return lambda q, v, theta1, w1, theta2, w2: (0.0, 0.0, 0.0)
    couple1, couple2 = (_coupling(motor) for motor in (plant.motors[0], plant.motors[-1]))
    lever = plant.lever_per_rad

    def single(q: float, v: float, theta1: float, w1: float, theta2: float, w2: float) -> Triple:
        on_link, on_motor = couple1(q, v, theta1, w1)
        return -on_link, on_motor, 0.0

    def antagonistic(q: float, v: float, theta1: float, w1: float, theta2: float, w2: float) -> Triple:
        on_link1, on_motor1 = couple1(q, v, theta1, w1)
        on_link2, on_motor2 = couple2(q, v, theta2, w2)
        return -on_link1 - on_link2, on_motor1, on_motor2

    if plant.arrangement != "serial":
        return single if plant.arrangement == "single" else antagonistic
    reaction = _reaction(plant)

    def serial(q: float, v: float, theta1: float, w1: float, theta2: float, w2: float) -> Triple:
        ratio = 1.0 + lever * theta2
        square = ratio * ratio
        on_link, on_motor = couple1(q, v, theta1, w1)
        return -square * on_link, square * on_motor, reaction(q, theta1, ratio)

    return serial


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


def _load(damping: float, loads: list[Load]) -> Load:
    if not loads:
        return lambda position, velocity: damping * velocity

    def load(position: float, velocity: float) -> float:
        total = damping * velocity
        for x in loads:
            total += x(position, velocity)
        return total

    return load


def accelerations(plant: JointPlant) -> Accelerations:
    """Return accelerations of link and motors; a rigid joint is one body of inertia B + M."""
    link, sin, torques = plant.link, math.sin, carried(plant)
    g, phase, m = link.gravity_nm, link.gravity_phase_rad, link.inertia_kg_m2
    on_link = _load(link.viscous_damping_nm_s_rad, link.terms.loads)
    on1, on2 = (_load(x.viscous_damping_nm_s_rad, x.terms.loads) for x in (plant.motors[0], plant.motors[-1]))
    b1, b2 = plant.motors[0].inertia_kg_m2, plant.motors[1].inertia_kg_m2 if plant.motors[1:] else math.inf
    rigid, whole = plant.rigid, b1 + m

    def accelerated(
        q: float, v: float, theta1: float, w1: float, theta2: float, w2: float,
        tau1: float, tau2: float, tau_k: float,
    ) -> Triple:  # fmt: skip
        te, te1, te2 = torques(q, v, theta1, w1, theta2, w2)
        at_link = tau_k + te - on_link(q, v) - g * sin(q + phase)
        at_motor = tau1 + te1 - on1(theta1, w1)
        if rigid:
            a = (at_link + at_motor) / whole
            return a, a, 0.0
        return at_link / m, at_motor / b1, (tau2 + te2 - on2(theta2, w2)) / b2

    return accelerated
