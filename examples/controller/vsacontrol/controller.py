"""The controller without its surroundings: estimates and samples in, torques out, safe whenever in doubt.

No clock, no bus, no zenoh: the same object runs in lockstep with a simulated joint and in a process of its
own.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from drivelink.pubsub.wire import EstimateMessage, ExternalMessage
from estimator.sample import Sample, Status
from vsacontrol.identify import Excitation
from vsacontrol.laws import ControlLaw, Regulator
from vsacontrol.monitor import MismatchMonitor, Moment
from vsacontrol.phases import SAFE_TORQUES, Drives, Event, Phase, Reaction, Settings
from vsacontrol.plant import Joint, State
from vsacontrol.references import Reference, Waypoint
from vsacontrol.springs import Law, springs_of
from vsacontrol.tracking import StateTracker

__all__ = ["Controller"]

_DOUBTS = Status.CHANGED | Status.MODEL_ALARM
_STEERED = (Phase.APPROACH, Phase.RUN, Phase.REACT)  # phases in which the springs' model steers the joint
_DISPUTED = 0.7  # share of a tolerated mismatch above which no identification ends
_AHEAD_PERIODS = 1.5  # from a sample to the middle of the period in which the torque that follows acts


class Controller:
    """Follows a reference by a control law, on the strength of the daemon's estimates.

    Args:
        joint: declared constants.
        law: the control law of the phase `run`.
        reference: what the joint is to do.
        period_s: T.
        springs: a fixed spring model; None: the one that the daemon has estimated.
        settings: limits and times.
        excitation: of the identification.

    Attributes:
        reference: as given.
        phase: the present one.
        events: changes of phase.
        reference_s: time in the reference at the last sample.
        mismatch: undeclared torque at a motor at the last sample, as a share of what is tolerated.
    """

    def __init__(
        self,
        joint: Joint,
        law: ControlLaw,
        reference: Reference,
        period_s: float,
        *,
        springs: tuple[Law, ...] | None = None,
        settings: Settings | None = None,
        excitation: Excitation | None = None,
    ) -> None:
        self.reference = reference
        self.phase = Phase.WAITING
        self.events: list[Event] = []
        self.reference_s = self.mismatch = 0.0
        self._law, self._period_s = law, period_s
        self._fixed = springs
        self._estimated: tuple[Law, ...] | None = None
        self._settings = settings or Settings()
        self._excitation = excitation or Excitation()
        self._tracker = StateTracker(period_s, ahead_periods=_AHEAD_PERIODS)
        self._monitor = MismatchMonitor(joint, period_s)
        self._approach_law = Regulator(joint=joint)
        self._approach = reference
        self._sequence: int | None = None
        self._fresh_s = self._valid_s = self._fault_s = self._disputed_s = -math.inf
        self._begin_s = 0.0  # of this phase, in bus time
        self._bus_s = 0.0
        self._contact_s = -math.inf  # bus time of the last contact
        self._mismatched = 0
        self._last = self._faded_from = SAFE_TORQUES
        self._doubtful = self._known = False

    @property
    def springs(self) -> tuple[Law, ...] | None:
        """The spring model in use; None: there is none yet."""
        return self._fixed or self._estimated

    @property
    def done(self) -> bool:
        """Whether the reference has been followed to its end."""
        return self.phase is Phase.RUN and self.reference_s >= self.reference.length_s

    def set_springs(self, transmissions: Sequence[Mapping[str, Any]]) -> None:
        """Take the identified transmissions from the daemon's status document."""
        self._estimated = springs_of(transmissions) or self._estimated

    def cycle(
        self,
        estimate: EstimateMessage,
        sample: Sample,
        drives: Drives,
        now_s: float,
        age_s: float = 0.0,
        external: ExternalMessage | None = None,
    ) -> tuple[float, float]:
        """One SYNC's estimate and sample in, the torques that follow from them out.

        Args:
            estimate: of this cycle.
            sample: of the same cycle.
            drives: what the master knows.
            now_s: monotonic time.
            age_s: of the estimate, which may have waited on its way.
            external: what the world does to the link, by the newest message; None: unknown.
        """
        periods = 0 if self._sequence is None else sample.sequence - self._sequence
        self._sequence = sample.sequence
        self._bus_s += max(0, periods) * self._period_s
        if not estimate.status & Status.STALE:
            self._fresh_s = now_s - age_s
            if estimate.valid:
                self._valid_s = now_s - age_s
        state = self._tracker.step(sample.sequence, sample.link_position_rad, sample.motor_position_rad)
        fault = self._fault(estimate, sample, drives, now_s) or self._beyond(sample, state.dq)
        if fault:
            return self._go_safe(fault, now_s)
        if self.phase is Phase.RUN:
            self.reference_s += max(0, periods) * self._period_s
        if external is not None and external.contact:
            self._contact_s = self._bus_s
            if self.phase in (Phase.APPROACH, Phase.RUN):
                self._begin_reaction(estimate, sample, external, now_s)
        self._move_on(estimate, sample, drives, now_s)
        torques = self._torques(state)
        if not all(map(math.isfinite, torques)):
            return self._go_safe("the law has no solution here", now_s)
        bound = self._settings.torque_nm
        elapsed_s = self._bus_s - self._begin_s
        share = 1.0 if self.phase is Phase.REACT else min(1.0, elapsed_s / self._settings.fade_s)
        faded = (f + share * (t - f) for f, t in zip(self._faded_from, torques, strict=True))
        one, two = (max(-bound, min(bound, torque)) for torque in faded)
        self._last = one, two
        return self._last

    def watch(self, drives: Drives, now_s: float) -> tuple[float, float] | None:
        """Between two cycles: safe torques when something is wrong, else None.

        Args:
            drives: what the master knows.
            now_s: monotonic time.
        """
        if self.phase is Phase.WAITING:
            return SAFE_TORQUES
        if now_s - self._fresh_s > self._settings.deadline_s:
            return self._go_safe("estimates are stale", now_s)
        if drives.faulted:
            return self._go_safe("a drive reports a fault", now_s)
        return SAFE_TORQUES if self.phase is Phase.SAFE else None

    # What is wrong

    def _fault(self, estimate: EstimateMessage, sample: Sample, drives: Drives, now_s: float) -> str:
        """What speaks against moving, in words; empty: nothing."""
        status = estimate.status
        mismatch = self._mismatch(estimate, sample, now_s)
        if now_s - self._fresh_s > self._settings.deadline_s:
            return "estimates are stale"
        if drives.faulted or status & Status.DRIVE_FAULT:
            return "a drive reports a fault"
        if self.phase in (Phase.IDENTIFY, *_STEERED) and not drives.enabled:
            return "a drive is not enabled"
        if status & Status.RESTARTED and self.phase is not Phase.WAITING:
            return "positions have started anew"
        if self.phase not in _STEERED:
            return ""
        if now_s - self._valid_s > self._settings.deadline_s:
            return "estimates are not valid"
        self._doubtful = True  # unless none of what follows applies, the springs are identified again
        if status & Status.CHANGED:
            return "the joint has changed"
        if status & Status.MODEL_ALARM:
            return "the daemon's model is not sufficient"
        if mismatch:
            return "an undeclared torque acts"
        self._doubtful = False
        return ""

    def _mismatch(self, estimate: EstimateMessage, sample: Sample, now_s: float) -> bool:
        """Whether the joint does something else than the daemon's model says, for some cycles."""
        settings = self._settings
        modelled = tuple(t.flexibility_torque_nm for t in estimate.transmissions)
        moment = Moment(
            sample.sequence,
            sample.link_position_rad,
            sample.motor_position_rad,
            sample.motor_torque_nm,
            modelled,
        )
        self.mismatch = self._monitor.step(moment) / settings.motor_mismatch_nm
        self._mismatched = self._mismatched + 1 if self.mismatch > 1.0 else 0
        if self.mismatch > _DISPUTED:
            self._disputed_s = now_s
        return self._mismatched >= settings.mismatch_cycles

    def _beyond(self, sample: Sample, speed_rad_s: float) -> str:
        """Which limit the joint is beyond; empty: none."""
        settings, q = self._settings, sample.link_position_rad
        if abs(q) > settings.position_rad:
            return "the link is beyond its limit"
        if any(abs(q - theta) > settings.deflection_rad for theta in sample.motor_position_rad):
            return "a transmission is beyond its limit"
        return "the link is too fast" if abs(speed_rad_s) > settings.speed_rad_s else ""

    def _go_safe(self, reason: str, now_s: float) -> tuple[float, float]:
        self._fault_s = now_s
        if self.phase not in (Phase.SAFE, Phase.WAITING):
            self._enter(Phase.SAFE, now_s, reason)
        self._last = SAFE_TORQUES
        return SAFE_TORQUES

    # What comes next

    def _enter(self, phase: Phase, now_s: float, reason: str = "") -> None:
        self.phase = phase
        self._begin_s = self._bus_s
        self._faded_from = SAFE_TORQUES if phase is Phase.SAFE else self._last
        self.events.append(Event(now_s, phase, reason, now_s - self._fresh_s))

    def _move_on(self, estimate: EstimateMessage, sample: Sample, drives: Drives, now_s: float) -> None:
        elapsed_s = self._bus_s - self._begin_s
        if self.phase in (Phase.WAITING, Phase.SAFE):
            settings = self._settings
            hold_s = settings.doubt_s if self._doubtful else settings.hold_s
            if drives.enabled and now_s - self._fault_s >= hold_s:
                self._known = estimate.valid and self.springs is not None
                if self._known and not self._doubtful and self._certain(estimate, now_s):
                    self._begin_approach(estimate, sample, now_s)
                else:
                    self._enter(Phase.IDENTIFY, now_s)
        elif self.phase is Phase.IDENTIFY:
            settings = self._settings
            enough_s = settings.again_s if self._known else settings.identify_s
            if elapsed_s >= enough_s and self._certain(estimate, now_s):
                self._doubtful = False
                self._begin_approach(estimate, sample, now_s)
        elif self.phase is Phase.REACT and self._bus_s - self._contact_s >= self._settings.clear_s:
            self._begin_approach(estimate, sample, now_s)
        elif self.phase is Phase.APPROACH and elapsed_s >= self._approach.length_s:
            self._enter(Phase.RUN, now_s)

    def _certain(self, estimate: EstimateMessage, now_s: float) -> bool:
        """Whether the springs are known well enough to be controlled by."""
        known = estimate.valid and not estimate.status & _DOUBTS and self.springs is not None
        bound = self._settings.certainty * estimate.stiffness_nm_rad
        undisputed = now_s - self._disputed_s >= self._settings.hold_s
        return known and undisputed and estimate.stiffness_std_nm_rad < bound

    def _begin_approach(self, estimate: EstimateMessage, sample: Sample, now_s: float) -> None:
        """Go to where the way that was under way began, and take it from there again."""
        reference, settings = self.reference, self._settings
        index = reference.index(self.reference_s)
        self.reference_s = reference.begins_s[index]
        goal = reference.at(self.reference_s)
        here = Waypoint(0.0, 0.0, sample.link_position_rad, estimate.stiffness_nm_rad)
        there = Waypoint(settings.approach_s, settings.rest_s, goal.q[0], goal.sigma[0])
        self._approach = Reference([here, there])
        self._enter(Phase.APPROACH, now_s)

    def _begin_reaction(
        self, estimate: EstimateMessage, sample: Sample, external: ExternalMessage, now_s: float
    ) -> None:
        """Stop, give way or soften where the link is now, until nothing has touched it for a while."""
        settings, q, sigma = self._settings, sample.link_position_rad, estimate.stiffness_nm_rad
        way_s, there = settings.retract_s, q
        if settings.reaction is Reaction.RETRACT:
            there += math.copysign(settings.retract_rad, external.external_torque_nm)
        elif settings.reaction is Reaction.SOFTEN:
            sigma = settings.soft_nm_rad
        begin = Waypoint(0.0, 0.0, q, estimate.stiffness_nm_rad)
        self._approach = Reference([begin, Waypoint(way_s, 0.0, there, sigma)])
        self._enter(Phase.REACT, now_s, f"contact: {settings.reaction}")

    def _torques(self, state: State) -> tuple[float, float]:
        elapsed_s = self._bus_s - self._begin_s
        ahead_s = _AHEAD_PERIODS * self._period_s
        if self.phase is Phase.IDENTIFY:
            return self._excitation.torques(elapsed_s, again=self._known)
        springs = self.springs
        if springs is None:
            return SAFE_TORQUES
        if self.phase in (Phase.APPROACH, Phase.REACT):
            return self._approach_law.torques(state, self._approach.at(elapsed_s + ahead_s), springs)
        if self.phase is Phase.RUN:
            return self._law.torques(state, self.reference.at(self.reference_s + ahead_s), springs)
        return SAFE_TORQUES
