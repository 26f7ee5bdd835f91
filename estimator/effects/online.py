"""Effects of a joint's model, tick by tick: readings corrected, torques compensated."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from estimator.effects.library import LIBRARY
from estimator.effects.types import Coordinates, EffectType
from estimator.errors import EstimatorError
from estimator.model import Effect, JointModel
from estimator.sample import FloatArray, Sample

__all__ = ["OnlineEffects", "elements"]

# Beyond this nothing is a measurement any more; terms are not evaluated there.
_ABSURD = 1e9


def elements(effect: Effect) -> tuple[EffectType, list[dict[str, float]]]:
    """An effect as its type and one set of plain numbers per element.

    A parameter given as an array makes a sum of elements, e.g. cogging with two harmonics; plain numbers
    beside it belong to every element. What is left out takes its default.

    Raises:
        EstimatorError: no such effect or parameter, a parameter missing, arrays of unequal length.
    """
    kind = LIBRARY.get(effect.name)
    if kind is None:
        raise EstimatorError(f'effect "{effect.name}": expected one of {", ".join(sorted(LIBRARY))}')
    values: dict[str, float | tuple[float, ...]] = {}
    for parameter in kind.parameters:
        value = effect.parameters.get(parameter.name, parameter.default)
        if value is None:
            raise EstimatorError(
                f'effect "{effect.name}": expected parameter {parameter.name}, it is missing'
            )
        values[parameter.name] = value
    unknown = sorted(set(effect.parameters) - set(values))
    if unknown:
        raise EstimatorError(
            f'effect "{effect.name}": unknown parameter {unknown[0]}, expected {", ".join(values)}'
        )
    lengths = {len(value) for value in values.values() if isinstance(value, tuple)}
    if len(lengths) > 1:
        raise EstimatorError(
            f'effect "{effect.name}": expected arrays of equal length, got {sorted(lengths)}'
        )
    count = lengths.pop() if lengths else 1
    return kind, [
        {name: v[i] if isinstance(v, tuple) else v for name, v in values.items()} for i in range(count)
    ]


class _Term:
    """One element of an effect: its weighted terms, with its memory where it has one."""

    __slots__ = ("_kind", "_state", "_values", "_weights")

    def __init__(self, kind: EffectType, values: Mapping[str, float]) -> None:
        self._kind = kind
        self._values = values
        self._weights = tuple(values[name] for name in kind.linear)
        self._state = 0.0

    def reset(self) -> None:
        self._state = 0.0

    def __call__(self, c: Coordinates, period_s: float) -> float:
        if self._kind.law is not None:
            self._state = self._kind.law(self._state, c, period_s, self._values, math)
            return self._weights[0] * self._state
        assert self._kind.terms is not None
        total = 0.0
        for weight, term in zip(self._weights, self._kind.terms(c, self._values, math), strict=True):
            total += weight * term
        return total

    def along(self, c: Coordinates, period_s: float) -> FloatArray:
        """The same over consecutive ticks; c holds arrays (n,)."""
        if self._kind.law is None:
            assert self._kind.terms is not None
            total = np.zeros(len(c.position))
            for weight, column in zip(self._weights, self._kind.terms(c, self._values, np), strict=True):
                total += weight * column
            return total
        n = len(c.position)
        rows = zip(*(np.broadcast_to(field, n).tolist() for field in c), strict=True)
        return np.array([self(Coordinates(*row), period_s) for row in rows])


class Torques(NamedTuple):
    """What effects add to eqs 5 and 4: x_motor and x_transmission per motor, x_link."""

    motor_nm: tuple[float, ...]
    transmission_nm: tuple[float, ...]
    link_nm: float


_NOWHERE = Coordinates(*(0.0 for _ in Coordinates._fields))


class OnlineEffects:
    """All effects of a model at 1 kHz.

    `correct` comes first, on the raw sample. `torques` gives x_motor, x_transmission, x_link from values
    that have passed one light filter G shared by all channels, so that x is in step with G[tau].

    Attributes:
        active: whether the model has any effect; if not, both methods need not be called.
    """

    def __init__(self, model: JointModel, period_s: float) -> None:
        self._period_s = period_s
        self._motor: list[list[_Term]] = []
        self._transmission: list[list[_Term]] = []
        self._drive: list[list[_Term]] = []
        self._offsets: list[float] = []
        self._torque_delays: list[float] = []
        for motor in model.motors:
            self._add_motor(motor.effects)
        self._link: list[_Term] = []
        self._reading: list[_Term] = []
        encoder_delay = self._add_link(model.link_effects)
        self.active = bool(model.link_effects) or any(motor.effects for motor in model.motors)
        self._delays = _Delays(self._torque_delays, encoder_delay, period_s)
        self.reset()

    def _add_motor(self, effects: Sequence[Effect]) -> None:
        motor: list[_Term] = []
        transmission: list[_Term] = []
        drive: list[_Term] = []
        offset = delay = 0.0
        for effect in effects:
            kind, values = elements(effect)
            if kind.on_link:
                raise EstimatorError(f'effect "{effect.name}": expected it under [[link.effect]]')
            if kind.channel == "deflection":
                offset += sum(v["offset_rad"] for v in values)
            elif kind.name == "torque_delay":
                delay += sum(v["delay_s"] for v in values)
            elif kind.channel == "motor_torque":
                drive += [_Term(kind, v) for v in values]
            else:
                into = motor if kind.location == "motor" else transmission
                into += [_Term(kind, v) for v in values]
        self._motor.append(motor)
        self._transmission.append(transmission)
        self._drive.append(drive)
        self._offsets.append(offset)
        self._torque_delays.append(delay)

    def _add_link(self, effects: Sequence[Effect]) -> float:
        delay = 0.0
        for effect in effects:
            kind, values = elements(effect)
            if not kind.on_link:
                raise EstimatorError(f'effect "{effect.name}": expected it under [[motor.effect]]')
            if kind.name == "encoder_delay":
                delay += sum(v["delay_s"] for v in values)
            else:
                into = self._link if kind.location == "link" else self._reading
                into += [_Term(kind, v) for v in values]
        return delay

    def reset(self) -> None:
        """Forget everything: memories, delayed samples, the time since the start."""
        for terms in (*self._motor, *self._transmission, *self._drive, self._link, self._reading):
            for term in terms:
                term.reset()
        self._delays.reset()
        self._first: int | None = None
        self._previous_link: tuple[float, float] | None = None

    def correct(self, sample: Sample) -> Sample:
        """The sample as perfect sensors would have given it.

        Delays are made equal by delaying the channels that are ahead; link encoder and torque errors are
        removed; the offset between the encoders goes into the motor position.

        Args:
            sample: what was measured.

        Returns:
            The corrected sample, with the same sequence number.
        """
        if self._first is None:
            self._first = sample.sequence
        if self._delays.active:
            sample = self._delays.step(sample)
        link = sample.link_position_rad
        if self._reading and abs(link) < _ABSURD:
            error = self._reading_error(link)
            link = sample.link_position_rad - self._reading_error(link - error)
        torque = sample.motor_torque_nm
        if any(self._drive):
            time = (sample.sequence - self._first) * self._period_s
            torque = tuple(
                self._acting(value, time, terms) for value, terms in zip(torque, self._drive, strict=True)
            )
        position = tuple(p + o for p, o in zip(sample.motor_position_rad, self._offsets, strict=True))
        return sample._replace(motor_position_rad=position, motor_torque_nm=torque, link_position_rad=link)

    def _reading_error(self, link: float) -> float:
        c = _NOWHERE._replace(link_position=link)
        return sum(term(c, self._period_s) for term in self._reading)

    def _acting(self, torque: float, time: float, terms: list[_Term]) -> float:
        if not abs(torque) < _ABSURD:
            return torque
        c = _NOWHERE._replace(torque=torque, time=time)
        return torque - sum(term(c, self._period_s) for term in terms)

    def torques(
        self,
        sample: Sample,
        velocity: tuple[float, ...],
        acceleration: tuple[float, ...],
        deflection: tuple[float, ...],
        deflection_rate: tuple[float, ...],
        flexibility_torque: tuple[float, ...],
        time_s: float,
        stiffness: tuple[float, ...] | None = None,
    ) -> Torques:
        """The torques of the effects at this tick.

        Args:
            sample: corrected, its positions and torques having passed G.
            velocity: theta_i', rad/s, through G like all that follows.
            acceleration: theta_i", rad/s².
            deflection: phi_i, rad.
            deflection_rate: phi_i', rad/s.
            flexibility_torque: tau_e,i, N·m.
            time_s: since the start.
            stiffness: sigma_i, N·m/rad; without it tau_e / phi stands for it.

        Returns:
            x_motor and x_transmission per motor, x_link; zeros where the values are absurd or not finite.
        """
        link = self._link_coordinates(sample, velocity, deflection_rate, time_s)
        motor: list[float] = []
        transmission: list[float] = []
        for i, angle in enumerate(sample.motor_position_rad):
            sigma = stiffness[i] if stiffness else _secant(flexibility_torque[i], deflection[i])
            c = link._replace(
                position=angle - self._offsets[i],
                velocity=velocity[i],
                acceleration=acceleration[i],
                deflection=deflection[i],
                deflection_rate=deflection_rate[i],
                flexibility_torque=flexibility_torque[i],
                stiffness=sigma,
                torque=sample.motor_torque_nm[i],
            )
            motor.append(self._sum(self._motor[i], c))
            transmission.append(self._sum(self._transmission[i], c))
        return Torques(tuple(motor), tuple(transmission), self._sum(self._link, link))

    def balance(self, i: int, c: Coordinates) -> FloatArray:
        """x_motor - x_transmission of one motor over consecutive ticks.

        Args:
            i: which motor.
            c: arrays (n,) that have passed G; `position` is corrected, and is taken back to the reading.

        Returns:
            (n,) N·m; zeros where a value is absurd or not finite.
        """
        total = np.zeros(len(c.position))
        if not all(np.all(np.abs(field) < _ABSURD) for field in c):
            return total
        c = c._replace(position=c.position - self._offsets[i])
        for term in self._motor[i]:
            total += term.along(c, self._period_s)
        for term in self._transmission[i]:
            total -= term.along(c, self._period_s)
        return total

    def _link_coordinates(
        self, sample: Sample, velocity: tuple[float, ...], deflection_rate: tuple[float, ...], time_s: float
    ) -> Coordinates:
        if not self._link:
            return _NOWHERE._replace(time=time_s)
        rate = velocity[0] + deflection_rate[0]
        acceleration = 0.0
        if self._previous_link is not None and time_s > self._previous_link[0]:
            acceleration = (rate - self._previous_link[1]) / (time_s - self._previous_link[0])
        self._previous_link = (time_s, rate)
        return _NOWHERE._replace(
            link_position=sample.link_position_rad,
            link_velocity=rate,
            link_acceleration=acceleration,
            time=time_s,
        )

    def _sum(self, terms: list[_Term], c: Coordinates) -> float:
        if not terms:
            return 0.0
        for value in c:
            if not abs(value) < _ABSURD:
                return 0.0
        return sum(term(c, self._period_s) for term in terms)


def _secant(torque: float, deflection: float) -> float:
    return torque / deflection if abs(deflection) > 1e-12 else 0.0


class _Delays:
    """Delays the channels that are ahead until all are as late as the latest.

    The torque acts torque_delay later than reported, the link position is read encoder_delay late: with
    D = max(0, encoder_delay, -torque_delays) the motor positions wait D, the link position
    D - encoder_delay, each torque D + its delay. Between samples values are interpolated linearly.
    """

    __slots__ = ("_history", "_link", "_motor", "_torque", "active")

    def __init__(self, torque_delays_s: Sequence[float], encoder_delay_s: float, period_s: float) -> None:
        common = max(0.0, encoder_delay_s, *(-delay for delay in torque_delays_s))
        self._motor = common / period_s
        self._link = (common - encoder_delay_s) / period_s
        self._torque = tuple((common + delay) / period_s for delay in torque_delays_s)
        self.active = encoder_delay_s != 0.0 or any(torque_delays_s)
        longest = max(self._motor, self._link, *self._torque)
        self._history: deque[Sample] = deque(maxlen=int(longest) + 2)

    def reset(self) -> None:
        self._history.clear()

    def step(self, sample: Sample) -> Sample:
        self._history.append(sample)
        late, share = self._at(sample.sequence - self._motor)
        position = tuple(map(share, late[0].motor_position_rad, late[1].motor_position_rad))
        velocity = tuple(map(share, late[0].motor_velocity_rad_s, late[1].motor_velocity_rad_s))
        external = share(late[0].external_torque_nm, late[1].external_torque_nm)
        torque = []
        for i, delay in enumerate(self._torque):
            late, share = self._at(sample.sequence - delay)
            torque.append(share(late[0].motor_torque_nm[i], late[1].motor_torque_nm[i]))
        late, share = self._at(sample.sequence - self._link)
        return Sample(
            sample.sequence,
            position,
            velocity,
            tuple(torque),
            share(late[0].link_position_rad, late[1].link_position_rad),
            share(late[0].link_velocity_rad_s, late[1].link_velocity_rad_s),
            external,
        )

    def _at(self, when: float) -> tuple[tuple[Sample, Sample], _Mix]:
        newer = self._history[-1]
        for older in reversed(self._history):
            if older.sequence <= when:
                span = newer.sequence - older.sequence
                return (older, newer), _Mix((when - older.sequence) / span if span else 0.0)
            newer = older
        return (newer, newer), _Mix(0.0)


class _Mix:
    """Linear interpolation with a given share of the newer value."""

    __slots__ = ("_share",)

    def __init__(self, share: float) -> None:
        self._share = share

    def __call__(self, older: float, newer: float) -> float:
        return older if self._share == 0.0 else older + self._share * (newer - older)
