"""What is learned of the transmissions, in small parts between the ticks.

Samples are collected into blocks of about 15 ms. While the next block is being collected, the last one goes
through the filters, and one motor's balance becomes an equation of its joint recursive estimation
(`regression`, `kalman`, `track`). Each tick does one part of that, so no tick waits for all of it.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial

import numpy as np

from estimator.alignment import Alignment
from estimator.bank import FilterBank
from estimator.deflection import DeflectionFilter
from estimator.delaysearch import DelaySearch
from estimator.effects import Coordinates, OnlineEffects
from estimator.excitation import Excitation
from estimator.model import JointModel
from estimator.noise import NoiseMeter
from estimator.regression import Signals
from estimator.rigid import RigidTrack
from estimator.settings import EstimatorSettings
from estimator.track import Track

__all__ = ["Learner"]

_BLOCK_S = 0.015  # at the usual bandwidth; shorter above it …
_BLOCK_PHASE = 0.9  # … so that the bandwidth turns by no more than this in a block, rad
_TURNS = 2  # blocks from one update of a motor to its next: two motors take turns
_SETTLE_DELAYS = 4.5  # filter delays after which a wrong start is forgotten
_FRICTION_SPEEDS = 0.02  # of the largest velocity: over which Coulomb friction changes its sign
_LEAST_SPEED = 1e-12  # rad/s
_SMALL_DELAY = 0.1  # periods: left to the regression
_PAST_DELAYS = 5.5  # filter delays that a nonlinear basis is recomputed over


class Learner:
    """Feeds the tracks of a joint. `take` is given each tick's link position, motor positions and torques.

    Args:
        model: the joint.
        settings: bandwidth and method.
        period_s: T.
        alignment: told when the link encoder turns out to be late.
        effects: what the model declares.

    Attributes:
        tracks: one a motor.
        deflections: their deflections of this moment.
        effect_nm: x_motor - x_transmission per motor, the latest that is known.
        delay_s: of the filters. bandwidth_rad_s: of the slower one.
        settle: periods after which a wrong start has left them.
        unsettled: how many are still to go.
    """

    def __init__(
        self,
        model: JointModel,
        settings: EstimatorSettings,
        period_s: float,
        alignment: Alignment,
        effects: OnlineEffects,
    ) -> None:
        self._T, self._alignment, self._effects = period_s, alignment, effects
        block_s = min(_BLOCK_S, _BLOCK_PHASE / settings.bandwidth_rad_s)
        self._block = block = max(1, round(block_s / period_s))
        dt = _TURNS * block * period_s
        self.tracks = [
            Track(motor, settings, period_s, dt) if motor.flexible else RigidTrack(motor, period_s)
            for motor in model.motors
        ]
        # Channels: the link, each motor's position and basis, each motor's torque, what is formed.
        m = len(self.tracks)
        self._first: list[int] = []
        positions = 1
        for track in self.tracks:
            self._first.append(positions)
            positions += 1 + track.channels
        self._positions = positions
        self._bank = FilterBank(positions, m, 2 * m, settings.bandwidth_rad_s, period_s, block)
        self.delay_s = delay = self._bank.delay_s
        self.bandwidth_rad_s = bandwidth = self._bank.main.bandwidth_rad_s
        self.settle = math.ceil(_SETTLE_DELAYS * delay / period_s)
        past = math.ceil(_PAST_DELAYS * delay / period_s / block) * block
        self._shaped = any(isinstance(track, Track) and track.shaped for track in self.tracks)
        self._responses = self._bank.remember(past) if self._shaped else np.zeros((0, 0))
        self._past = np.zeros((past, m))
        self.deflections = [
            DeflectionFilter(
                motor.inertia_kg_m2, motor.viscous_damping_nm_s_rad, bandwidth, period_s, block * period_s
            )
            for motor in model.motors
        ]
        self._jerks = [0.0] * m
        self.excitation = [Excitation(self._bank, dt) for _ in range(m)]
        self._noise = NoiseMeter(1 + m, period_s)
        self._torques = 1 + m  # where they begin among the inputs
        self._placed = np.array(self._first)  # channels of the motors' positions
        self._flexible = model.has_deflection
        lead = next((i for i, motor in enumerate(model.motors) if motor.flexible), 0)
        motor = model.motors[lead]
        self._lead = np.array([0, 1 + lead, 1 + m + lead])
        self._search = DelaySearch(motor.inertia_kg_m2, motor.viscous_damping_nm_s_rad, bandwidth, period_s)
        self._wide = np.zeros((block, positions))
        self._formed = np.zeros((block, 2 * m))
        self._parts = self._share_out()
        self.reset()

    def _share_out(self) -> list[list[Callable[[], None]]]:
        """The parts of the work on one block, over the ticks of the next one."""
        motors = range(len(self.tracks))
        # Of about equal weight: the heaviest one makes the slowest tick.
        parts: list[Callable[[], None]] = [self._collect, self._measure_noise]
        parts += [partial(self._widen, i) for i in motors]
        parts += [self._pass_light]
        if self._effects.active:
            parts += [self._form_effects]
        parts += [self._pass_main, self._gather, self._regress, self._learn, self._correct, self._prepare]
        parts += [self._account]
        parts += [partial(self._tune, i) for i in motors]
        parts += [self._publish]
        ticks: list[list[Callable[[], None]]] = [[] for _ in range(self._block)]
        for k, part in enumerate(parts):
            ticks[k * self._block // len(parts)].append(part)
        return ticks

    def reset(self) -> None:
        """Forget everything."""
        for track in self.tracks:
            track.reset()
        for excitation in self.excitation:
            excitation.reset()
        for deflection in self.deflections:
            deflection.reset()
        self._noise.reset()
        self._search.restart()
        m = len(self.tracks)
        self.effect_nm = [0.0] * m
        self._formed[:] = 0.0
        self._speeds = np.full(m, _LEAST_SPEED)
        self._blocks = 0
        self.misfits_nm = [math.nan] * m
        self._begin()

    def restart(self, inputs: list[float]) -> None:
        """Filters at rest where the joint is now; what has been learned is kept."""
        q = inputs[0]
        start = np.array(inputs)[None, :]
        wide = [q if q == q else 0.0]
        for i, track in enumerate(self.tracks):
            theta = inputs[1 + i]
            wide.append(theta)
            if track.channels:
                wide += track.columns(start[:, 0] - theta)[0].tolist()
            self.deflections[i].restart(theta, q - theta)
        self._bank.rest(wide, inputs[self._torques :])
        self._noise.restart()
        self._search.postpone()
        self._begin()

    def _begin(self) -> None:
        self._rows: list[list[float]] = []
        self._ready: list[list[float]] = []
        self._tick = 0
        self._known = 0  # periods of the past
        self.unsettle(self.settle)

    def unsettle(self, periods: int) -> None:
        """The filters hold something wrong; for so many periods nothing is learned from them."""
        self.unsettled = max(periods, 0)
        self._usable = False
        self._turn = -1

    def postpone_search(self) -> None:
        """The delay search begins to collect anew."""
        self._search.postpone()

    # -- one period ----------------------------------------------------------------------------------

    def take(self, inputs: list[float]) -> None:
        """One period: collect it, and do a part of the work on the last block."""
        if self._ready:
            for part in self._parts[self._tick]:
                part()
        self._rows.append(inputs)
        self.unsettled -= 1
        self._tick += 1
        if self._tick == self._block:
            self._ready, self._rows = self._rows, []
            self._tick = 0
        if self._search.busy:
            late = self._search.work()
            if late is not None:
                self._realign(late)

    def _collect(self) -> None:
        """The block as arrays; the past of its deflections."""
        self._samples = samples = np.array(self._ready)
        if not self._flexible:
            samples[:, 0] = 0.0
        self._usable = self.unsettled <= 0
        self._turn = self._blocks % _TURNS if self._blocks % _TURNS < len(self.tracks) else -1
        self._blocks += 1
        self._phi = phi = samples[:, :1] - samples[:, 1 : self._torques]
        if self._shaped:
            past = self._past
            past[: -len(phi)] = past[len(phi) :]
            past[-len(phi) :] = phi
            self._known += len(phi)
        if self._flexible and self._usable:
            self._search.see(samples[:, self._lead])

    def _measure_noise(self) -> None:
        self._noise.see(self._samples[:, : self._torques])

    def _widen(self, i: int) -> None:
        """The channels that a track's basis wants."""
        first, track = self._first[i], self.tracks[i]
        self._wide[:, first] = self._samples[:, 1 + i]
        if track.channels:
            self._wide[:, first + 1 : first + 1 + track.channels] = track.columns(self._phi[:, i])

    def _pass_light(self) -> None:
        self._wide[:, 0] = self._samples[:, 0]
        self._light = self._bank.pass_light(self._wide, self._samples[:, self._torques :])
        self._rates = rates = self._light[1].take(self._placed, axis=1)
        if self._usable:
            np.maximum(self._speeds, np.abs(rates).max(axis=0), out=self._speeds)

    def _form_effects(self) -> None:
        """x_motor - x_transmission of the declared effects, from lightly filtered values."""
        value, rate, acceleration = self._light
        zero = np.zeros(self._block)
        time = (np.arange(self._block) + (self._blocks - 1) * self._block) * self._T
        for i, (first, track) in enumerate(zip(self._first, self.tracks, strict=True)):
            phi = value[:, 0] - value[:, first]
            torque, stiffness = track.along(phi)
            c = Coordinates(
                position=value[:, first],
                velocity=rate[:, first],
                acceleration=acceleration[:, first],
                deflection=phi,
                deflection_rate=rate[:, 0] - rate[:, first],
                flexibility_torque=torque,
                stiffness=stiffness,
                torque=value[:, self._positions + i],
                torque_rate=zero,
                link_position=zero,
                link_velocity=zero,
                link_acceleration=zero,
                time=time,
            )
            x = self._effects.balance(i, c)
            self._formed[:, 2 * i + 1] = x
            self.effect_nm[i] = float(x[-1])

    def _pass_main(self) -> None:
        """Coulomb friction formed, and everything through F."""
        self._formed[:, ::2] = np.tanh(self._rates / (_FRICTION_SPEEDS * self._speeds))
        self._bank.pass_main(self._formed)

    # -- one update of one motor -----------------------------------------------------------------------

    def _gather(self) -> None:
        i = self._turn
        if i < 0:
            return
        track, first = self.tracks[i], self._first[i]
        last, torque = self._positions + len(self.tracks) + 2 * i, self._positions + i
        rows = self._bank.outputs()
        link, motor = [row[0] for row in rows], [row[first] for row in rows]
        self._signals = Signals(
            link,
            motor,
            [row[torque] for row in rows],
            [row[first + 1 : first + 1 + track.channels] for row in rows],
            [row[last] for row in rows],
            [row[last + 1] for row in rows],
        )
        noise = self._noise.variance[1 + i] + self._noise.variance[0]
        self._resolution = math.sqrt(noise)
        self.excitation[i].update(link[1] - motor[1], noise, self._usable)
        self._jerks[i] = link[3] - motor[3]

    def _regress(self) -> None:
        i = self._turn
        if i < 0:
            return
        track, excited = self.tracks[i], self.excitation[i].excited
        late = self.delay_s + (self._tick + 1) * self._T  # what the filters say is of the block's end
        track.update(self._signals, excited, self._usable, late, self._resolution)
        self.misfits_nm[i] = track.misfit_nm

    def _learn(self) -> None:
        if self._turn >= 0:
            self.tracks[self._turn].learn()

    def _correct(self) -> None:
        if self._turn >= 0:
            self.tracks[self._turn].correct()

    def _prepare(self) -> None:
        if self._turn >= 0:
            self.tracks[self._turn].prepare()

    def _account(self) -> None:
        if self._turn < 0:
            return
        track = self.tracks[self._turn]
        track.account()
        if isinstance(track, Track) and track.astray:
            track.relearn()
            self.unsettle(self.settle)

    def _tune(self, i: int) -> None:
        track = self.tracks[i]
        if self._usable and isinstance(track, Track):
            self.deflections[i].adopt(track.inertia, track.damping)
            noises = (self._noise.variance[1 + i], self._noise.variance[0])
            self.deflections[i].tune(self._jerks[i], *noises, track.stiffness, track.unmodelled_nm)
            track.deflection_variance = self.deflections[i].variance

    def _publish(self) -> None:
        i = self._turn
        if i < 0:
            return
        track = self.tracks[i]
        deflection = self.deflections[i]
        track.publish(deflection.at(0.0), deflection.link_rate)
        if not isinstance(track, Track) or not self._usable:
            return
        if track.shaped and track.due and self._known >= len(self._past):
            track.hand_over(self._past[:, i], self._bank, self._first[i] + 1, self._responses)
        late = track.take_delay() if self._search.looked else 0.0
        if late:
            track.shift_delay(self._alignment.shift(late))
            self._search.postpone()
            self.unsettle(self.settle)

    def _realign(self, late: float) -> None:
        """The search has found the link encoder late by so many periods: what was learned is void."""
        if abs(late) < _SMALL_DELAY:
            return
        self._alignment.shift(late)
        self._search.postpone()
        self.unsettle(self.settle)
        for track in self.tracks:
            track.relearn()
