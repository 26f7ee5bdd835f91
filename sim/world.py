"""One joint with its drives, encoders and rig, advanced by whole control periods.

At t_k everything is sampled; the torque that a drive reports at t_k acts from t_k to t_{k+1}. So does a drive
whose current loop is updated at the SYNC: it latches the last set-point at SYNC k, reports it with SYNC k,
and holds it until SYNC k+1.
"""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sim.dynamics import elasticity
from sim.effects import PlantEffect, assemble
from sim.errors import SimError
from sim.excitation import Excitation
from sim.integration import integrator, settling, whole_fraction
from sim.plant import JointPlant
from sim.sensors import Amplifier, DriveHardware, DriveSignals, LinkEncoder, LinkScale, noise


class MotorTruth(NamedTuple):
    """True state of one motor and its transmission, joint side."""

    position_rad: float  # theta
    velocity_rad_s: float  # theta'
    torque_nm: float  # the acting torque, which may differ from the reported one
    deflection_rad: float  # phi = q - theta
    flexibility_torque_nm: float  # tau_e(phi), the elastic part of the transmission's torque
    stiffness_nm_rad: float  # sigma = d tau_e / d phi


class Truth(NamedTuple):
    """True state of the joint at one sampling instant."""

    time_s: float  # t_k
    link_position_rad: float  # q
    link_velocity_rad_s: float  # q'
    external_torque_nm: float  # tau_k, held over the period
    flexibility_torque_nm: float  # tau_e,t (eq 9)
    stiffness_nm_rad: float  # sigma_t (eq 11)
    motors: tuple[MotorTruth, ...]  # one per motor


class World:
    """A joint in motion, in lockstep with its caller."""

    def __init__(
        self,
        plant: JointPlant,
        drives: Sequence[DriveHardware],
        encoder: LinkEncoder | None = None,
        *,
        excitation: Excitation | None = None,
        effects: Sequence[PlantEffect] = (),
        period_s: float = 0.001,
        plant_step_s: float | None = None,
        seed: int = 0,
        initial_rad: Sequence[float] = (),
    ) -> None:
        """Build the joint, at rest.

        Args:
            encoder: the link encoder; None: a fine one.
            excitation: the rig's torque while no master commands; None: no torque.
            plant_step_s: integration step, a whole fraction of the period; None: chosen from the plant.
            initial_rad: q, theta_1 (, theta_2) at the start; empty: zero.

        Raises:
            SimError: the step is no whole fraction, or the parts do not fit each other.
        """
        if len(drives) != len(plant.motors):
            raise SimError(f"drives: expected {len(plant.motors)}, got {len(drives)}")
        self.motors = len(drives)
        self.drives = tuple(drives)
        self.encoder = encoder or LinkEncoder()
        self.excitation = excitation
        self.period_s = period_s
        self.substeps = whole_fraction(period_s, plant_step_s, plant, fine=bool(effects))
        self.plant_step_s = period_s / self.substeps
        self.declared = plant  # its physics without the effects
        self._effects = tuple(effects)
        self._state = _start(initial_rad, self.motors, plant.rigid)
        self._tick, self._external = 0, 0.0
        self._commands: list[float | None] = [None] * self.motors
        self._amplifiers = [
            Amplifier(drive, period_s, self.substeps, noise((seed, 1, motor), drive.current_noise_a))
            for motor, drive in enumerate(self.drives)
        ]
        self._scale = LinkScale(self.encoder, noise((seed, 2), self.encoder.noise_counts))
        self._assemble()
        self._latch()

    @property
    def time_s(self) -> float:
        """t_k of the present sampling instant."""
        return self._tick * self.period_s

    def alter(self, *, plant: JointPlant | None = None, effects: Sequence[PlantEffect] | None = None) -> None:
        """Change the physics from now on: a spring that breaks, friction that appears.

        Position and velocity are kept, memories are reset. The plant step stays.

        Args:
            plant: another joint of the same kind; None: unchanged.
            effects: all effects from now on; None: unchanged.

        Raises:
            SimError: a joint of another kind, or impossible values.
        """
        if plant is not None:
            if (plant.arrangement, plant.rigid) != (self.declared.arrangement, self.declared.rigid):
                raise SimError(f'alter: expected arrangement "{self.declared.arrangement}", as before')
            self.declared = plant
        if effects is not None:
            self._effects = tuple(effects)
        self._assemble()

    def _assemble(self) -> None:
        assembly = assemble(self.declared, self._effects, self.plant_step_s)
        self.plant = assembly.joint()
        self._step = integrator(self.plant, self.plant_step_s)
        self._settle = settling(self.plant, self.plant_step_s)
        self._elastic = elasticity(self.plant)
        for amplifier, parts in zip(self._amplifiers, assembly.motors, strict=True):
            amplifier.fit(parts)
        self._scale.fit(assembly.link, self.plant_step_s, self._state[0], self._state[2])

    def command(self, motor: int, torque_nm: float | None) -> None:
        """Command one drive's set-point from the next period on.

        Args:
            torque_nm: at the motor shaft in the drive's own direction; None: the rig's excitation acts.

        Raises:
            SimError: no finite number.
        """
        if torque_nm is not None and not math.isfinite(torque_nm):
            raise SimError(f"torque_nm: expected a finite number, got {torque_nm!r}")
        self._commands[motor] = torque_nm

    def advance(self, periods: int = 1) -> None:
        """Advance by whole control periods."""
        step, settle, state = self._step, self._settle, self._state
        history, deflection = self._scale.history, self._scale.deflection
        first, last = self._amplifiers[0], self._amplifiers[-1]
        for _ in range(periods):
            tau_k, time_s = self._external, self._tick * self.period_s
            for tau1, tau2 in zip(first.schedule, last.schedule, strict=True):
                step(state, tau1, tau2, tau_k)
                if settle is not None:
                    time_s += self.plant_step_s
                    settle(state, time_s)
                if history is not None:
                    history.push(state[0], state[1])
                if deflection is not None:
                    deflection.push(state[0] - state[2], state[1] - state[3])
            self._tick += 1
            self._latch()

    def _latch(self) -> None:
        """Start a period: apply set-points and sample everything."""
        t, state, excitation = self._tick * self.period_s, self._state, self.excitation
        for motor, amplifier in enumerate(self._amplifiers):
            theta, w = state[2 + 2 * motor], state[3 + 2 * motor]
            command = self._commands[motor]
            if command is not None:
                amplifier.latch(command / amplifier.drive.torque_constant_nm_a, t, theta, w)
            elif excitation is not None:
                torque = excitation.torque(motor, t, theta, w)
                amplifier.latch(torque / amplifier.drive.joint_torque_per_ampere, t, theta, w)
            else:
                amplifier.latch(0.0, t, theta, w)
        self._external = excitation.external(t) if excitation is not None and excitation.external else 0.0
        self._scale.sample(state[0], state[2])

    def drive(self, motor: int) -> DriveSignals:
        """Return signals of this drive at the present instant."""
        return self._amplifiers[motor].signals()

    def link_counts(self) -> int:
        """Return the reading of the link encoder at the present instant."""
        return self._scale.counts

    def truth(self) -> Truth:
        """Return the true state of the joint now."""
        return self._told(self._known())

    def _known(self) -> list[float]:
        """Return time, external torque, state; acting and elastic torque and stiffness of each motor."""
        known = [self.time_s, self._external, *self._state]
        for amplifier, elastic in zip(self._amplifiers, self._elastic(self._state), strict=True):
            known += amplifier.schedule[0], *elastic
        return known

    def _told(self, known: Any) -> Truth:
        """Return what is known of an instant, or columns of it over many, as the truth."""
        time_s, external, q, q_rate, *state = known[:8]
        motors = tuple(
            MotorTruth(theta, rate, torque, q - theta, *elastic)
            for theta, rate, torque, *elastic in zip(
                state[::2], state[1::2], known[8::3], known[9::3], known[10::3], strict=False
            )
        )
        acting = motors if self.plant.arrangement == "antagonistic" else motors[:1]
        torque = sum(motor.flexibility_torque_nm for motor in acting)
        stiffness = sum(motor.stiffness_nm_rad for motor in acting)
        return Truth(time_s, q, q_rate, external, torque, stiffness, motors)


def _start(initial_rad: Sequence[float], motors: int, rigid: bool) -> list[float]:
    positions = list(initial_rad) or [0.0] * (1 + motors)
    if len(positions) != 1 + motors or not all(math.isfinite(p) for p in positions):
        raise SimError(f"initial_rad: expected {1 + motors} finite numbers, got {positions!r}")
    if rigid and positions[0] != positions[1]:
        raise SimError(f"initial_rad: expected q = theta at a rigid transmission, got {positions!r}")
    return [value for position in (*positions, 0.0)[:3] for value in (position, 0.0)]


def record(world: World, seconds: float) -> dict[str, NDArray[np.float64]]:
    """Advance a world and record its sensors and the truth as columns.

    Args:
        world: its present state is row 0.
        seconds: length; round(seconds / period) rows.

    Returns:
        Arrays (n,): `time_s`, `motor1_position_rad`, `motor1_velocity_rad_s`, `motor1_torque_nm`,
        `motor1_current_a`, the same for `motor2_`, `link_position_rad`, `external_torque_nm`; and the truth:
        `truth_` followed by `link_position_rad`, `link_velocity_rad_s`, `flexibility_torque_nm`,
        `stiffness_nm_rad` and, per motor, `motor1_` with the fields of `MotorTruth`. Motor torques and
        positions are at the joint; row k's torque acts until row k+1.
    """
    rows = []
    for k in range(round(seconds / world.period_s)):
        if k:
            world.advance()
        readings = [value for motor in range(world.motors) for value in world.drive(motor)[:3]]
        rows.append((*world._known(), *readings, world.link_counts()))
    if not rows:
        return {}
    known, read = np.split(np.array(rows).T, [8 + 3 * world.motors])
    whole: Any = world._told(known)
    columns = {"time_s": whole.time_s, "external_torque_nm": whole.external_torque_nm}
    truth = {f"truth_{Truth._fields[i]}": whole[i] for i in (1, 2, 4, 5)}
    for k, (drive, of_motor) in enumerate(zip(world.drives, whole.motors, strict=True)):
        counts, rate, current = read[3 * k : 3 * k + 3]
        columns |= {
            f"motor{k + 1}_current_a": current,
            f"motor{k + 1}_position_rad": counts / drive.counts_per_rad,
            f"motor{k + 1}_velocity_rad_s": rate * drive.direction / drive.gear_ratio,
            f"motor{k + 1}_torque_nm": current * drive.joint_torque_per_ampere,
        }
        truth |= {f"truth_motor{k + 1}_{name}": values for name, values in of_motor._asdict().items()}
    columns["link_position_rad"] = read[-1] / world.encoder.counts_per_rad + world.encoder.zero_rad
    return columns | truth
