"""What stands between the wire and the mathematics: gaps, values that are no numbers, positions that jump."""

from __future__ import annotations

import math
from typing import NamedTuple

from estimator.model import JointModel
from estimator.sample import Sample, Status

__all__ = ["Accepted", "InputGuard"]

_PATIENCE = 8  # samples at a new place before a jump is believed, at least …
_PATIENCE_S = 0.016  # … and so long
_MARGIN = 12.0  # times the largest curvature seen lately
_PEAK_S = 2.0  # how long a curvature is remembered
_FLOOR_RAD = 1e-3  # no jump is smaller than this
_COUNTS = 3.0  # counts of an encoder are no jump either
_FIRST = 8  # samples after a start that are not judged
_TORQUE_MARGIN = 10.0  # times the acceleration that the largest torque seen gives the motor
_STILL_S = 0.02  # a channel that repeats itself for less is never frozen
_STOPPED_COUNTS = 10.0  # … nor is a position that was slower than so many counts in that time
_LEARNING_S = 2.0  # after the start: how long channels usually repeat themselves
_REJECTED, _GAP = int(Status.INPUT_REJECTED), int(Status.GAP)
_LONGEST_GAP_S = 0.025  # what is longer is not bridged
_ABSURD = 1e6  # rad: no position
_WILD_RAD_S2 = 100.0  # acceleration of the bare motor below which no torque is a surprise …
_WILD = 10.0  # … above which it is, if so many times the largest seen
_TORQUE_S = 60.0  # how long the largest torque is remembered for that
_REVIEW = 8  # samples between two looks at what has been seen, and at the limits that follow from it
_REACH = 3.0  # times the largest velocity seen: how far a position may be after a gap


class Accepted(NamedTuple):
    """What the guard made of a sample.

    Attributes:
        periods: since the last sample that was accepted; 0: this one is not to be used.
        restart: the filters cannot be carried on over what happened.
        status: GAP, INPUT_REJECTED, RESTARTED.
        frozen: a channel has stood still for longer than it ever did while others move.
        jumps: with a restart, by how much each position has moved its zero (motors, then the link).
    """

    periods: int
    restart: bool
    status: int
    frozen: bool = False
    jumps: tuple[float, ...] = ()


class InputGuard:
    """Decides of each sample whether it can be used, and how far it is from the last one that was.

    A position jumps when it leaves the straight line through the last two by more than acceleration can
    explain: the largest lately seen, what the torque can give, and an absolute floor. A single jump is
    left out and bridged; where the new place persists, it is the encoder's zero that has moved, and the
    filters start anew from there. After a gap a place that no velocity seen so far leads to is a jump, too.
    A torque may jump, but one that would throw the bare motor about and is many times the largest one seen
    is left out unless it persists. A channel is frozen when it repeats itself exactly for longer than it
    has ever done in good times, while a position moves; a position only if it stopped out of motion: a link
    that comes to rest while the motors go on, as under a controller, is no fault.
    """

    def __init__(self, model: JointModel, period_s: float) -> None:
        self._flexible = model.has_deflection
        self._motors = len(model.motors)
        self._T = period_s
        self._fade = math.exp(-_REVIEW * period_s / _PEAK_S)
        self._longest = max(3, round(_LONGEST_GAP_S / period_s))
        self._patience = max(_PATIENCE, round(_PATIENCE_S / period_s))
        self._gain = _TORQUE_MARGIN * period_s**2 / min(motor.inertia_kg_m2 for motor in model.motors)
        self._tame = tuple(_WILD_RAD_S2 * motor.inertia_kg_m2 for motor in model.motors)
        self._fade_torque = math.exp(-_REVIEW * period_s / _TORQUE_S)
        self._still = max(4, round(_STILL_S / period_s))
        self._learning = round(_LEARNING_S / period_s)
        self.reset()

    def reset(self) -> None:
        """Forget everything."""
        self._sequence: int | None = None
        self._places: tuple[float, ...] = ()
        self._slopes: list[float] = []
        self._peaks: list[float] = []
        self._steps: list[float] = []  # smallest change seen of each position: its resolution
        self._values: tuple[float, ...] = ()
        self._runs: list[int] = []
        self._usual: list[int] = []
        self._rates: list[float] = []  # mean change in a period, of late
        self._stopped_at: list[float] = []  # … when the present run of repetitions began
        self._torque = 0.0
        self._largest = [0.0] * self._motors  # torques
        self._surprising = list(self._tame)  # … and what is too much beside them
        self._limits: list[float] = []  # bends that are jumps
        self._fastest = [0.0] * (self._motors + self._flexible)  # changes of positions in a period
        self._wild = 0
        self._astray: list[bool] = []  # which positions have jumped
        self._seen = self._samples = 0
        self._motion = 0.0
        self._frozen = False
        self._rejected = 0

    def check(self, sample: Sample) -> Accepted:
        """Judge one sample."""
        places = sample.motor_position_rad
        torques = sample.motor_torque_nm
        if len(places) != self._motors or len(torques) != self._motors:
            return Accepted(0, False, _REJECTED)
        if self._flexible:
            places = (*places, sample.link_position_rad)
        # One sum tells whether every value is a finite number and every position one that can be.
        if not sum(map(abs, places)) < _ABSURD or self._is_wild(torques):
            return Accepted(0, False, _REJECTED)
        if self._sequence is None:
            return self._begin(sample.sequence, places, 0)
        periods = sample.sequence - self._sequence
        if periods <= 0:
            return self._begin(sample.sequence, places, int(Status.RESTARTED))
        if periods > self._longest:
            return self._after_gap(sample.sequence, places, periods)
        self._samples += 1
        turn = self._samples % _REVIEW
        if turn == 0:
            self._review_positions()
        elif turn == 1:
            self._review_torques()
        was_frozen = self._frozen
        frozen = self._stands_still((*places, *torques))
        if self._jumped(places, periods):
            self._rejected += 1
            if was_frozen:  # it was the frozen value that was wrong
                return self._begin(sample.sequence, places, _REJECTED | int(Status.RESTARTED))
            if self._rejected < self._patience:
                return Accepted(0, False, _REJECTED, frozen)
            jumps = tuple(
                new - old - periods * slope if astray and run < _PATIENCE - 2 else 0.0
                for new, old, slope, run, astray in zip(
                    places, self._places, self._slopes, self._runs[: len(places)], self._astray, strict=True
                )
            )
            return self._begin(sample.sequence, places, _REJECTED | int(Status.RESTARTED), jumps)
        self._sequence, self._places = sample.sequence, places
        self._seen += 1
        self._rejected = 0
        status = _GAP if periods > 1 else 0
        return Accepted(periods, False, status | _REJECTED if frozen else status, frozen)

    def _begin(
        self, sequence: int, places: tuple[float, ...], status: int, jumps: tuple[float, ...] = ()
    ) -> Accepted:
        self._sequence, self._places = sequence, places
        self._slopes = [0.0] * len(places)
        self._peaks = self._peaks or [0.0] * len(places)
        self._steps = self._steps or [math.inf] * len(places)
        self._values = ()
        self._rates = [0.0] * len(places)
        self._frozen = False
        self._seen = self._rejected = 0
        self._astray = [False] * len(places)
        self._review_torques()
        self._review_positions()
        return Accepted(1, True, status, False, jumps)

    def _is_wild(self, torques: tuple[float, ...]) -> bool:
        """Whether a torque is no finite number, or beyond anything seen and new."""
        largest = self._largest
        for i, torque in enumerate(torques):
            size = abs(torque)
            if not size < self._surprising[i]:
                if not size < math.inf:
                    return True
                self._wild += 1
                if self._wild < self._patience or size > _ABSURD * self._tame[i]:
                    return True
            if size > largest[i]:
                largest[i] = size
                self._surprising[i] = max(self._tame[i], _WILD * size)
                if size > self._torque:
                    self._torque = size
        self._wild = 0
        return False

    def _review_torques(self) -> None:
        """What has been seen fades, and with it what is too much."""
        self._torque *= self._fade
        self._largest = [self._fade_torque * size for size in self._largest]
        self._surprising = [
            max(tame, _WILD * size) for tame, size in zip(self._tame, self._largest, strict=True)
        ]

    def _review_positions(self) -> None:
        """So do the bends of positions."""
        self._peaks = [self._fade * peak for peak in self._peaks]
        floor = max(_FLOOR_RAD, self._gain * self._torque)
        self._limits = [
            max(floor, _MARGIN * peak, _COUNTS * step)
            for peak, step in zip(self._peaks, self._steps, strict=True)
        ]

    def _after_gap(self, sequence: int, places: tuple[float, ...], periods: int) -> Accepted:
        """The first sample after a gap too long to be bridged; its place is to be one that can be reached."""
        status = int(Status.GAP | Status.RESTARTED)
        jumps: tuple[float, ...] = ()
        if self._samples > self._learning:
            offs = [new - old for new, old in zip(places, self._places, strict=True)]
            jumps = tuple(
                off if abs(off) > _FLOOR_RAD + _REACH * fastest * periods else 0.0
                for off, fastest in zip(offs, self._fastest, strict=True)
            )
            if any(jumps):
                self._rejected += 1
                if self._rejected < self._patience:
                    return Accepted(0, False, _REJECTED | _GAP)
                status |= _REJECTED
        return self._begin(sequence, places, status, jumps if any(jumps) else ())

    def _stands_still(self, values: tuple[float, ...]) -> bool:
        """Whether a channel is frozen; positions come first in `values`."""
        old = self._values
        self._values = values
        if not old:
            self._runs = [0] * len(values)
            self._usual = self._usual or [0] * len(values)
            self._stopped_at = [0.0] * len(values)
            return False
        runs, positions = self._runs, len(self._places)
        moving = 0.0
        longest = 0
        for i, value in enumerate(values):
            if value == old[i]:
                run = runs[i] = runs[i] + 1
                if run == 1 and i < positions:
                    self._stopped_at[i] = self._rates[i]
                if self._samples < self._learning and run > self._usual[i]:
                    self._usual[i] = run
                if run > self._still and run > 3 * self._usual[i] and self._stopped_dead(i):
                    longest = run
            else:
                runs[i] = 0
                if i < positions:
                    moving = 1.0
        # Everything at rest is no fault; one encoder count now and then is no motion.
        self._motion += 0.05 * (moving - self._motion)
        self._frozen = longest > 0 and self._motion > 0.2
        return self._frozen

    def _stopped_dead(self, i: int) -> bool:
        """Whether a channel that repeats itself was moving before; torques always count as moving."""
        if i >= len(self._places):
            return True
        return self._stopped_at[i] * self._still > _STOPPED_COUNTS * self._steps[i]

    def _jumped(self, places: tuple[float, ...], periods: int) -> bool:
        seen = self._seen
        checked = seen >= _FIRST or (seen >= 2 and self._samples > self._learning)
        olds, peaks, rates, last = self._slopes, self._peaks, self._rates, self._places
        jumped = False
        if not self._rejected and True in self._astray:
            self._astray = [False] * len(places)
        slopes = []
        for i, new in enumerate(places):
            change = new - last[i]
            slope = change if periods == 1 else change / periods
            slopes.append(slope)
            bend = abs(slope - olds[i])
            if checked and bend > self._limits[i]:
                self._astray[i] = jumped = True
            if jumped:
                continue
            size = abs(change)
            rates[i] += 0.1 * (size - rates[i])
            if size < self._steps[i] and size:
                self._steps[i] = size
            if size > self._fastest[i] * periods:
                self._fastest[i] = size / periods
            if bend > peaks[i] and seen:  # the first two samples make the first slope
                peaks[i] = bend
                self._limits[i] = max(self._limits[i], _MARGIN * bend)
        if not jumped:
            self._slopes = slopes
        return jumped
