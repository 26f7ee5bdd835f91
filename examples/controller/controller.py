"""What the joint is to do, from estimates and samples: no bus, no zenoh and no clock of its own.

Position and stiffness of an antagonistic joint are regulated by PD control of its motors with on-line gravity
compensation (De Luca, Siciliano, Zollo, Automatica 41, 2005), with deflections phi* from the identified
springs in the place of K^-1 g(q):

    tau_i = Kp (q_d - phi*_i - theta_i) - Kd theta_i' - tau_e,i(phi*_i)
    tau_e,1(phi*_1) + tau_e,2(phi*_2) = -g(q),    sigma_1(phi*_1) + sigma_2(phi*_2) = sigma_d
"""

import math
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, NamedTuple

from scipy.optimize import root

from drivelink.jointfile import JointFile
from drivelink.pubsub.wire import EstimateMessage, ExternalMessage
from estimator.errors import EstimatorError
from estimator.sample import Sample, Status
from estimator.transmissions import MODELS

NO_TORQUE = (0.0, 0.0)
KP_NM_RAD, KD_NM_S_RAD = 0.2, 0.02
VELOCITY_RAD_S = 150.0  # bandwidth of the velocities, which are differences of positions
Spring = Callable[[float], tuple[float, float]]  # deflection: torque, stiffness


@dataclass(frozen=True, slots=True, kw_only=True)
class Settings:
    """Limits and times."""

    # Each is (q, sigma).
    targets: tuple[tuple[float, float], ...] = ((0.4, 0.75), (-0.3, 0.55), (0.3, 0.85), (0.0, 0.6))
    way_s: float = 1.5  # from one target to the next, for ever
    rest_s: float = 1.0  # at each
    reaction: str = "stop"  # to a contact: "stop" stays, "retract" yields, "soften" lowers the stiffness
    retract_rad: float = 0.15
    soft_nm_rad: float = 0.4
    clear_s: float = 0.5  # without a contact before the joint goes on
    deadline_s: float = (
        0.010  # age of the newest estimate, and of the newest usable one, that ends the torque
    )
    hold_s: float = 0.3  # without a fault before the joint moves again
    identify_s: float = 20.0  # of unknown springs; of known ones a fifth
    certainty: float = 0.02  # relative standard deviation of the stiffness that ends it
    torque_nm: float = 0.4  # limit of each motor
    position_rad: float = 1.2  # limit of |q|
    deflection_rad: float = 1.15  # limit of |phi_i|; the VSA-II's linkage is stretched out at 1.217
    speed_rad_s: float = 15.0  # limit of the link


class Cycle(NamedTuple):
    """What one SYNC brought: estimate, sample, external torque if known, the estimate's age in s."""

    estimate: EstimateMessage
    sample: Sample
    external: ExternalMessage | None = None
    age_s: float = 0.0


class Controller:
    """Moves the joint to its targets, and takes the torque away whenever anything is in doubt.

    `phase` is "waiting" for estimates and drives, "identify" (open loop), "run", "react" to a contact or
    "safe" (no torque, because of a fault); `report(phase, reason, age of the last estimate)` is called at
    each change.
    """

    def __init__(
        self,
        joint: JointFile,
        settings: Settings,
        report: Callable[[str, str, float], None] = lambda *_: None,
    ) -> None:
        self.phase, self.report, self.settings = "waiting", report, settings
        self._gravity_nm = joint.link.dynamics.gravity_nm if joint.link.dynamics else 0.0
        self._T, self._springs, self._phi = joint.bus.period_s, (), (0.5, -0.5)  # the last solution
        self._fresh_s = self._usable_s = self._fault_s = self._contact_s = -math.inf
        self._begin_s, self._target, self._way = 0.0, 0, ((0.0, 0.6), (0.0, 0.6))  # from, to: (q, sigma)
        self._cycle: Cycle | None = None
        self._rates = [0.0, 0.0, 0.0]  # of theta_1, theta_2, q
        self._doubtful = self._known = False
        self._last = NO_TORQUE

    def __str__(self) -> str:
        """Where the joint is and, while it moves to a target, where it goes."""
        if self._cycle is None:
            return "no estimate yet"
        estimate, (_, (q_d, sigma_d)) = self._cycle.estimate, self._way
        q, sigma = f"{self._cycle.sample.link_position_rad:+.3f}", f"{estimate.stiffness_nm_rad:.3f}"
        sigma = sigma.replace("nan", "–")
        if self.phase in ("run", "react"):
            q, sigma = f"{q} (to {q_d:+.2f})", f"{sigma} (to {sigma_d:.2f})"
        torques = " ".join(f"{torque:+.3f}" for torque in self._last)
        return f"link {q} rad, stiffness {sigma} N·m/rad, motors {torques} N·m"

    def set_springs(self, transmissions: Sequence[Mapping[str, Any]]) -> None:
        """Take the identified transmissions from the daemon's status; what is impossible is left out."""
        if len(transmissions) == 2 and all(entry.get("parameters") for entry in transmissions):
            with suppress(EstimatorError, KeyError):
                self._springs = tuple(_spring(t["model"], t["parameters"]) for t in transmissions)

    def step(self, now_s: float, cycle: Cycle | None, *, enabled: bool, faulted: bool) -> tuple[float, float]:
        """Give the torques of the motors, N·m; `cycle`: what arrived since the last call, if anything."""
        if cycle is not None:
            self._take(cycle, now_s)
        fault = self._fault(now_s, enabled, faulted)
        if not fault and cycle is not None:
            self._change_phase(cycle, now_s)
            torques = self._torques(now_s)
            bound = self.settings.torque_nm
            self._last = max(-bound, min(bound, torques[0])), max(-bound, min(bound, torques[1]))
            if not all(map(math.isfinite, torques)):
                fault = "the control law has no solution here"
        if fault:
            self._fault_s, self._last = now_s, NO_TORQUE
            if self.phase not in ("safe", "waiting"):
                self._enter("safe", now_s, fault)
        return self._last

    def _take(self, cycle: Cycle, now_s: float) -> None:
        estimate, sample = cycle.estimate, cycle.sample
        if not estimate.status & Status.STALE:
            self._fresh_s = now_s - cycle.age_s
            if estimate.usable:
                self._usable_s = self._fresh_s
        before, self._cycle = self._cycle.sample if self._cycle else sample, cycle
        periods = sample.sequence - before.sequence
        if 0 < periods < 20:
            share = 1.0 - math.exp(-VELOCITY_RAD_S * periods * self._T)
            now, old = _positions(sample), _positions(before)
            for i in range(3):
                self._rates[i] += share * ((now[i] - old[i]) / (periods * self._T) - self._rates[i])
        elif periods:
            self._rates = [0.0, 0.0, 0.0]

    def _fault(self, now_s: float, enabled: bool, faulted: bool) -> str:
        """Say what speaks against moving; empty: nothing."""
        limits = self.settings
        if self._cycle is None or now_s - self._fresh_s > limits.deadline_s:
            return "estimates are stale"
        status, (one, two, q) = self._cycle.estimate.status, _positions(self._cycle.sample)
        moves = self.phase in ("run", "react")
        doubts = {
            "the joint has changed": moves and status & Status.CHANGED,
            "the daemon's model is not sufficient": moves and status & Status.MODEL_ALARM,
        }
        self._doubtful = self._doubtful or any(doubts.values())
        faults = {
            "a drive reports a fault": faulted or status & Status.DRIVE_FAULT,
            "a drive is not enabled": not enabled,
            "positions have started anew": status & Status.RESTARTED and self.phase != "waiting",
            "the link is beyond its limit": not abs(q) <= limits.position_rad,
            "a transmission is beyond its limit": not max(abs(q - one), abs(q - two))
            <= limits.deflection_rad,
            "the link is too fast": abs(self._rates[2]) > limits.speed_rad_s,
            **doubts,
            "estimates are not valid": moves and now_s - self._usable_s > limits.deadline_s,
        }
        return next((reason for reason, holds in faults.items() if holds), "")

    def _change_phase(self, cycle: Cycle, now_s: float) -> None:
        settings, estimate, elapsed_s = self.settings, cycle.estimate, now_s - self._begin_s
        sigma_std, sigma = estimate.stiffness_std_nm_rad, estimate.stiffness_nm_rad
        certain = bool(self._springs) and estimate.usable and sigma_std < settings.certainty * sigma
        contact = cycle.external is not None and cycle.external.contact
        if contact:
            self._contact_s = now_s
        if self.phase in ("waiting", "safe") and now_s - self._fault_s >= settings.hold_s:
            self._known = certain
            self._enter("run" if certain and not self._doubtful else "identify", now_s)
        elif self.phase == "identify" and certain and not estimate.status & Status.CHANGED:
            if elapsed_s >= settings.identify_s / (5.0 if self._known else 1.0):
                self._doubtful = False
                self._enter("run", now_s)
        elif self.phase == "run" and contact:
            self._enter("react", now_s, f"contact: {settings.reaction}")
        elif self.phase == "run" and elapsed_s >= settings.way_s + settings.rest_s:
            self._target = (self._target + 1) % len(settings.targets)
            self._enter("run", now_s)
        elif self.phase == "react" and now_s - self._contact_s >= settings.clear_s:
            self._enter("run", now_s)

    def _enter(self, phase: str, now_s: float, reason: str = "") -> None:
        """Begin a phase, or the way to the next target."""
        changed, self.phase, self._begin_s = phase != self.phase, phase, now_s
        if changed:
            self.report(phase, reason, now_s - self._fresh_s)
        if self._cycle is not None:
            q, sigma = self._cycle.sample.link_position_rad, self._cycle.estimate.stiffness_nm_rad
            to = self.settings.targets[self._target] if phase == "run" else (q, sigma)
            if phase == "react" and self.settings.reaction == "soften":
                to = q, self.settings.soft_nm_rad
            elif phase == "react" and self.settings.reaction == "retract" and self._cycle.external:
                to = (
                    q + math.copysign(self.settings.retract_rad, self._cycle.external.external_torque_nm),
                    sigma,
                )
            self._way = (q, sigma), to

    def _torques(self, now_s: float) -> tuple[float, float]:
        elapsed_s = now_s - self._begin_s
        if self.phase == "identify":
            return identification(elapsed_s, small=not self._known)
        if self.phase not in ("run", "react") or self._cycle is None:
            return NO_TORQUE
        seconds = self.settings.way_s if self.phase == "run" else 0.2 * self.settings.way_s
        x = min(1.0, elapsed_s / seconds)
        share = x * x * x * (10.0 - 15.0 * x + 6.0 * x * x)  # rest to rest
        q_d, sigma_d = (a + share * (b - a) for a, b in zip(*self._way, strict=True))
        *thetas, q = _positions(self._cycle.sample)
        self._phi = deflections(self._springs, -self._gravity_nm * math.sin(q), sigma_d, self._phi)
        each = zip(self._springs, self._phi, thetas, self._rates, strict=False)
        first, second = (
            KP_NM_RAD * (q_d - phi - theta) - KD_NM_S_RAD * rate - spring(phi)[0]
            for spring, phi, theta, rate in each
        )
        return first, second


def _positions(sample: Sample) -> tuple[float, float, float]:
    return sample.motor_position_rad[0], sample.motor_position_rad[1], sample.link_position_rad


def _spring(model: str, parameters: Mapping[str, Any]) -> Spring:
    law = MODELS[model]
    alpha = law.alpha({k: tuple(v) if isinstance(v, list) else v for k, v in parameters.items()}).tolist()
    return lambda phi: law.at(phi, alpha)


def deflections(
    springs: tuple[Spring, ...], torque_nm: float, sigma_nm_rad: float, start: tuple[float, float]
) -> tuple[float, float]:
    """Solve for the deflections with this total torque and stiffness; the nearest where there are none."""

    def left(phi: Sequence[float]) -> list[float]:
        (torque, sigma), (other, more) = (law(x) for law, x in zip(springs, phi, strict=True))
        return [torque + other - torque_nm, sigma + more - sigma_nm_rad]

    one, two = root(left, start, tol=1e-8).x.clip(-1.1, 1.1)
    return float(one), float(two)


def identification(time_s: float, *, small: bool) -> tuple[float, float]:
    """Give open-loop torques that identify the springs: a pretension that swings, and five tones on top.

    Unknown springs begin with four seconds of little pretension: they are identified near the middle first.
    """
    grown = min(1.0, max(0.0, 0.5 * (time_s - 4.0))) if small else 1.0
    pretension = 0.04 + grown * (0.02 + 0.07 * (1.0 - math.cos(0.5 * math.pi * time_s)))
    fade, hz = min(1.0, 2.0 * time_s), (0.7, 1.3, 2.1, 3.4, 5.0)

    def tones(shift: float, phase: float) -> float:  # Schroeder's phases keep the peaks of the sum low
        angles = (math.tau * shift * f * time_s + phase - math.pi * k * k / 5 for k, f in enumerate(hz))
        return 0.04 * sum(map(math.sin, angles))

    return fade * (tones(1.0, 0.0) - pretension), fade * (tones(1.07, 1.0) + pretension)
