"""Integrates a joint over one fixed step: Runge-Kutta of order four, dry friction, memories.

Smooth torques act inside the stages. Dry friction is not a function of the velocity at standstill, so it acts
as an impulse at the end of each step: it removes at most the momentum of the body, which then sticks (J. J.
Moreau's time stepping). Terms with memory (hysteresis, presliding) are evaluated in the stages and updated
once per step.
"""

import math
from collections.abc import Callable

from sim.dynamics import State, accelerations, carried, spring_deflection
from sim.errors import SimError
from sim.plant import Dry, JointPlant

Step = Callable[[State, float, float, float], None]
"""(state, tau_1, tau_2, tau_k): moves the state by one step, in place."""
Settle = Callable[[State, float], None]
"""(state, time): update between two steps."""


def integrator(plant: JointPlant, step_s: float) -> Step:
    """Return Runge-Kutta of order four over one step, torques held.

    For x" = a(x, x') the four classical stages read, with one acceleration each,
        x+ = x + h v + h²/6 (a1 + a2 + a3),  v+ = v + h/6 (a1 + 2 a2 + 2 a3 + a4).
    """
    acc, h = accelerations(plant), step_s
    half, quarter, whole, sixth, sixth2 = h / 2, h * h / 4, h * h / 2, h / 6, h * h / 6

    def step(state: State, tau1: float, tau2: float, tau_k: float) -> None:
        q, v, p, w, r, s = state
        a1, b1, c1 = acc(q, v, p, w, r, s, tau1, tau2, tau_k)
        qm, pm, rm = q + half * v, p + half * w, r + half * s
        a2, b2, c2 = acc(
            qm, v + half * a1, pm, w + half * b1, rm, s + half * c1, tau1, tau2, tau_k
        )  # fmt: skip
        a3, b3, c3 = acc(
            qm + quarter * a1, v + half * a2, pm + quarter * b1, w + half * b2,
            rm + quarter * c1, s + half * c2, tau1, tau2, tau_k,
        )  # fmt: skip
        q += h * v
        p += h * w
        r += h * s
        a4, b4, c4 = acc(
            q + whole * a2, v + h * a3, p + whole * b2, w + h * b3,
            r + whole * c2, s + h * c3, tau1, tau2, tau_k,
        )  # fmt: skip
        state[0] = q + sixth2 * (a1 + a2 + a3)
        state[1] = v + sixth * (a1 + 2.0 * (a2 + a3) + a4)
        state[2] = p + sixth2 * (b1 + b2 + b3)
        state[3] = w + sixth * (b1 + 2.0 * (b2 + b3) + b4)
        state[4] = r + sixth2 * (c1 + c2 + c3)
        state[5] = s + sixth * (c1 + 2.0 * (c2 + c3) + c4)

    return step


def whole_fraction(period_s: float, step_s: float | None, plant: JointPlant, fine: bool = False) -> int:
    """Return steps in a control period.

    Args:
        step_s: the step; None: at most a tenth of a radian of the fastest oscillation that the springs
            allow at twice their stiffness at rest, 1 ms, and 0.5 ms with dry friction or memories.
        fine: whether it has dry friction or memories.

    Raises:
        SimError: the step is no whole fraction of the period.
    """
    if not (math.isfinite(period_s) and period_s > 0.0):
        raise SimError(f"period_s: expected a number > 0, got {period_s!r}")
    if step_s is None:
        most = 0.0005 if fine else 0.001
        return max(1, math.ceil(period_s / min(most, 0.1 / max(_fastest(plant), 1e-9)) - 1e-9))
    if not (math.isfinite(step_s) and step_s > 0.0):
        raise SimError(f"plant_step_s: expected a number > 0, got {step_s!r}")
    count = round(period_s / step_s)
    if count < 1 or abs(count * step_s - period_s) > 1e-9 * period_s:
        raise SimError(
            f"plant_step_s: expected a whole fraction of the period {period_s:g} s, got {step_s:g} s"
        )
    return count


def _fastest(plant: JointPlant) -> float:
    """Return a bound on the joint's fastest natural frequency (rad/s) at twice the stiffness at rest."""
    if plant.rigid:
        return 0.0
    springs = plant.motors if plant.arrangement == "antagonistic" else plant.motors[:1]
    square = sum(
        motor.law().stiffness(0.0) * (1.0 / motor.inertia_kg_m2 + 1.0 / plant.link.inertia_kg_m2)
        for motor in springs
    )
    return math.sqrt(2.0 * max(square, 0.0))


def settling(plant: JointPlant, step_s: float) -> Settle | None:
    """Return dry friction and memories between two steps; None if the joint has neither."""
    bodies = _dry_bodies(plant, step_s)
    commits = [
        (2 + 2 * i, spring_deflection(motor), commit)
        for i, motor in enumerate(plant.motors)
        for commit in motor.terms.commits
    ]
    if not bodies and not commits:
        return None
    torques, rigid = carried(plant), plant.rigid

    def settle(state: State, time_s: float) -> None:
        if bodies:
            loads = torques(*state)
            for body, dry, per_inertia in bodies:
                index = 2 * body
                position, velocity = state[index], state[index + 1]
                level = 0.0
                for friction in dry:
                    level += friction(position, velocity, loads[body], time_s)
                after = _braked(velocity, level * per_inertia)
                # Friction acted all along the step: half its change of velocity belongs in the position.
                state[index] = position + 0.5 * step_s * (after - velocity)
                state[index + 1] = after
            if rigid:
                state[0], state[1] = state[2], state[3]
        for index, phi, commit in commits:
            commit(state[index], phi(state[0], state[index]))

    return settle


def _braked(velocity: float, most: float) -> float:
    if velocity > most:
        return velocity - most
    return velocity + most if velocity < -most else 0.0


def _dry_bodies(plant: JointPlant, step_s: float) -> list[tuple[int, list[Dry], float]]:
    """Bodies with friction: (0 the link, 1 and 2 the motors; levels; step over inertia)."""
    link, motors = plant.link, plant.motors
    if plant.rigid:
        inertia = motors[0].inertia_kg_m2 + link.inertia_kg_m2
        found = [(1, motors[0].terms.dry + link.terms.dry, step_s / inertia)]
    else:
        found = [(k, motor.terms.dry, step_s / motor.inertia_kg_m2) for k, motor in enumerate(motors, 1)]
        found.append((0, link.terms.dry, step_s / link.inertia_kg_m2))
    return [body for body in found if body[1]]
