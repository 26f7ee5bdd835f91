"""Mode "robust": the joint's estimator for the signals real drives give.

Per tick: guard the input, bridge gaps, align the channels, follow the deflection, read torque and stiffness
off the curve there. What the curve is learned from is done in small parts between the ticks (`learner`).
"""

from __future__ import annotations

import math
from typing import Any

from estimator.alignment import Alignment
from estimator.arrangement import check_arrangement, joint_estimate
from estimator.effects import OnlineEffects
from estimator.inputs import InputGuard
from estimator.learner import Learner
from estimator.model import JointModel
from estimator.sample import Estimate, Sample, Status
from estimator.settings import EstimatorSettings

__all__ = ["RobustEstimator"]

_SAID_S = 0.5  # how long a restart is reported
_TRUST_S = 0.02  # how long an estimate is carried over rejected samples
# Plain integers: an IntFlag costs a microsecond per operation.
_VALID, _OBSERVABLE = int(Status.VALID), int(Status.OBSERVABLE)
_CHANGED, _RESTARTED = int(Status.CHANGED), int(Status.RESTARTED)
_REJECTED = int(Status.INPUT_REJECTED)
_FORESEEN_S = 0.04  # how far ahead a deflection is told from its last motion
_BRIDGED = 0.4  # rad that the filter turns by in a gap: a longer one is not learned from
_HOME = 0.01  # of a jump: what is as near to the first zero is that zero again


class RobustEstimator:
    """See `estimator.online.Estimator`."""

    def __init__(self, model: JointModel, settings: EstimatorSettings, period_s: float) -> None:
        check_arrangement(model)
        self._T = period_s
        self._arrangement = model.arrangement
        self._flexible = model.has_deflection
        self._guard = InputGuard(model, period_s)
        self._effects = OnlineEffects(model, period_s)
        self._alignment = Alignment(period_s)
        self._learner = Learner(model, settings, period_s, self._alignment, self._effects)
        self._tracks, self._deflections = self._learner.tracks, self._learner.deflections
        self._pairs = list(zip(self._tracks, self._deflections, strict=True))
        self._excitation = self._learner.excitation
        self._torques = 1 + len(self._tracks)  # where they begin among the inputs
        self.reset()

    def reset(self) -> None:
        """Forget everything."""
        self._guard.reset()
        self._alignment.reset()
        self._effects.reset()
        self._learner.reset()
        self._zeros = [0.0] * (1 + 2 * len(self._tracks))
        self._moved = False
        self._said = 0
        self._rejected = 0
        self._started = False
        self._sequence = 0  # of the last sample that was used
        self._last: list[float] = []
        self._estimate: Estimate | None = None

    def distrust(self) -> None:
        """The next sample may not be of its moment: learn nothing until the filters have forgotten it."""
        self._learner.unsettle(self._learner.settle)
        self._learner.postpone_search()

    @property
    def residual_nm(self) -> float:
        """Largest misfit among the motors' balances at the last update, N·m; nan until there is a model."""
        return max((abs(x) for x in self._learner.misfits_nm), default=math.nan)

    def parameters(self) -> list[dict[str, Any]]:
        """Current transmission parameters and their standard deviations, one entry a motor."""
        return [track.parameters() for track in self._tracks]

    def step(self, sample: Sample) -> Estimate:
        """The estimate at this sample; never raises, whatever floats it holds."""
        try:
            return self._step(sample)
        except (ArithmeticError, ValueError):  # numbers beyond what the guard foresees: begin anew
            self.reset()
            parts = tuple(track.estimate(math.nan, math.nan, 0.0)[0] for track in self._tracks)
            return joint_estimate(self._arrangement, sample.sequence, _REJECTED | _RESTARTED, parts)

    def _step(self, sample: Sample) -> Estimate:
        periods, restart, status, frozen, jumps = self._guard.check(sample)
        if periods == 0:
            return self._carry(sample.sequence, status)
        if self._effects.active:
            sample = self._effects.correct(sample)
        self._rejected = 0
        inputs = [sample.link_position_rad, *sample.motor_position_rad, *sample.motor_torque_nm]
        if jumps:
            self._move_zeros(self._measured(jumps, sample))
        self._sequence = sample.sequence
        if self._moved:
            inputs = [value - zero for value, zero in zip(inputs, self._zeros, strict=True)]
        if frozen:
            self.distrust()
        inputs = self._alignment.align(inputs, restart)
        if restart:
            self._restart(inputs)
        elif periods > 1:
            self._bridge(inputs, periods)
        else:
            self._advance(inputs)
        return self._conclude(sample.sequence, status)

    def _measured(self, jumps: tuple[float, ...], sample: Sample) -> tuple[float, ...]:
        """Jumps of positions, measured by a deflection that went on as it was: the guard is coarse."""
        m = len(self._tracks)
        ahead = (sample.sequence - self._sequence + abs(self._alignment.periods)) * self._T
        if len(jumps) <= m or ahead > _FORESEEN_S:
            return jumps
        better = list(jumps)
        link = sample.link_position_rad - self._zeros[0]
        for i, (track, deflection) in enumerate(self._pairs):
            if not track.channels or deflection.unsettled > 0:
                continue
            off = link - (sample.motor_position_rad[i] - self._zeros[1 + i]) - deflection.at(ahead)
            if jumps[i] and not jumps[m]:
                better[i] = -off
            elif jumps[m] and not jumps[i]:
                better[m] = off
        return tuple(better)

    def _move_zeros(self, jumps: tuple[float, ...]) -> None:
        """An encoder has moved its zero: go on as if it had not."""
        m = len(self._tracks)
        for i in range(m):
            self._zeros[1 + i] = _moved_zero(self._zeros[1 + i], jumps[i])
        if len(jumps) > m:
            self._zeros[0] = _moved_zero(self._zeros[0], jumps[m])
        self._moved = any(self._zeros)
        for track in self._tracks:
            track.reopen_shift()

    def _advance(self, inputs: list[float]) -> None:
        """One period: the deflections of this moment, and a part of the learning."""
        q, torques, added = inputs[0], self._torques, self._learner.effect_nm
        for i, (track, deflection) in enumerate(self._pairs):
            if track.channels:
                theta = inputs[1 + i]
                deflection.update(theta, q - theta, self._last[torques + i] + track.acting_nm - added[i])
        self._last = inputs
        self._learner.take(inputs)

    def _bridge(self, inputs: list[float], periods: int) -> None:
        """The periods that are missing, along a straight line.

        A motion at the filter's bandwidth w loses (w n T)²/12 of its amplitude by that, for n T of a memory
        1/w: half a percent at w n T = 0.4. Up to there the gap is forgotten; beyond, what has been made up is
        not learned from.
        """
        last = self._last
        for k in range(1, periods):
            share = k / periods
            self._advance([a + share * (b - a) for a, b in zip(last, inputs, strict=True)])
        self._advance(inputs)
        if periods * self._T * self._learner.bandwidth_rad_s > _BRIDGED and periods > 2:
            self._learner.postpone_search()
            self._learner.unsettle(self._learner.settle)

    def _restart(self, inputs: list[float]) -> None:
        """Everything that has a past begins anew where the joint is now; what has been learned is kept."""
        self._learner.restart(inputs)
        self._last = inputs
        self._said = round(_SAID_S / self._T) if self._started else 0
        self._started = True

    # -- the estimate --------------------------------------------------------------------------------

    def _conclude(self, sequence: int, status: int) -> Estimate:
        valid, observable, changed = True, True, False
        ahead = abs(self._alignment.periods) * self._T  # what waits for the latest channel
        parts = []
        for i, (track, deflection) in enumerate(self._pairs):
            part, of_use = track.estimate(deflection.at(ahead), deflection.at(0.0), deflection.link_rate)
            parts.append(part)
            if not of_use:
                valid = False
            if track.channels:
                if deflection.unsettled > 0:
                    valid = False
                if not self._excitation[i].excited:
                    observable = False
                if track.changed:
                    changed = True
        if valid and not status & _REJECTED:
            status |= _VALID
            if observable and self._flexible and self._learner.unsettled <= 0:
                status |= _OBSERVABLE
        if changed:
            status |= _CHANGED
        if self._said > 0:
            self._said -= 1
            status |= _RESTARTED
        estimate = joint_estimate(self._arrangement, sequence, status, tuple(parts))
        self._estimate = estimate
        return estimate

    def _carry(self, sequence: int, status: int) -> Estimate:
        """What is said where the sample cannot be used: the last estimate, for a while."""
        self._rejected += 1
        last = self._estimate
        if last is None:
            parts = tuple(track.estimate(math.nan, math.nan, 0.0)[0] for track in self._tracks)
            return joint_estimate(self._arrangement, sequence, status, parts)
        status |= last.status & (_CHANGED | _RESTARTED)
        since = self._rejected * self._T
        if since > _TRUST_S:
            return last._replace(sequence=sequence, status=status)
        ahead = since + abs(self._alignment.periods) * self._T
        told = [
            track.estimate(deflection.at(ahead), deflection.at(0.0), deflection.link_rate)
            for track, deflection in self._pairs
        ]
        if all(of_use for _, of_use in told):
            status |= last.status & _VALID
        return joint_estimate(self._arrangement, sequence, status, tuple(part for part, _ in told))


def _moved_zero(zero: float, jump: float) -> float:
    """Where an encoder's zero is after a jump; one that jumps back has come home exactly."""
    moved = zero + jump
    return 0.0 if abs(moved) < _HOME * abs(jump) else moved
