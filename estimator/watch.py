"""On line: is the model still sufficient? Its residual against the floor that it had when it was fitted.

The balances of eqs 5 and 4 are formed with the model's own parameters and effects, not with those that the
estimator adapts. Averages over about 5 ms go through a light filter that gives derivatives, the balances
through a second one; their squares, averaged over a second, are compared with the floor. The work of one
such step is spread over several ticks.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from estimator.effects import OnlineEffects
from estimator.filters import StateVariableFilter
from estimator.model import JointModel, require, require_finite
from estimator.sample import Estimate, FloatArray, Record, Sample
from estimator.transmissions import TransmissionModel, transmission_model

__all__ = ["Floor", "ResidualWatch", "measure_floor", "watchable"]

_STEP_S = 0.005
_LIGHT_RAD_S = 180.0
_NARROW_RAD_S = 60.0
_MEMORY_S = 1.0  # of the averaged squares
_SETTLE_S = 1.5  # after a start or a gap nothing is judged
_ALARM = 2.5  # residual over floor that raises the alarm, held for _HOLD_S
_CLEAR = 1.6  # and below which it ends
_HOLD_S = 0.5
_PHASES = 3
_LEAST = 0.003  # of the torque: no floor is lower
_CORRELATED = 0.6  # between the balances of motor and link: the effect sits between them
_BOTH = 0.05  # and the weaker of the two has at least this share of the stronger one's power
_MOST_MEASURED_S = 120.0
_SHARE = 0.9  # quantile of the residual's average along the healthy recording that is its floor


@dataclass(frozen=True, slots=True, kw_only=True)
class Floor:
    """What a sufficient model leaves of each balance, behind the watch's own filters.

    Attributes:
        residual_nm: (motors, then the link where its dynamics are known) rms.
        torque_nm: rms of each balance's torque at which that was; more torque lets the floor rise with it.
    """

    residual_nm: tuple[float, ...]
    torque_nm: tuple[float, ...]

    def __post_init__(self) -> None:
        require(len(self.residual_nm) == len(self.torque_nm), "floor: expected as many residuals as torques")
        for residual, torque in zip(self.residual_nm, self.torque_nm, strict=True):
            require_finite(0.0, strict=True, residual_nm=residual, torque_nm=torque)

    def as_dict(self) -> dict[str, list[float]]:
        """For the joint file."""
        return {name: list(values) for name, values in asdict(self).items()}

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> Floor | None:
        """From the joint file; None where it holds none that makes sense."""
        try:
            return cls(
                residual_nm=tuple(float(x) for x in values["residual_nm"]),
                torque_nm=tuple(float(x) for x in values["torque_nm"]),
            )
        except (KeyError, TypeError, ValueError):
            return None


def watchable(model: JointModel) -> bool:
    """Whether every transmission's torque is known from the model alone."""
    return all(m.transmission.model == "none" or m.transmission.parameters for m in model.motors)


def measure_floor(record: Record, model: JointModel) -> Floor:
    """The floor of a model on a recording that it is sufficient for (at most its first two minutes)."""
    watch = ResidualWatch(model, record.period_s, None)
    residuals, torques = [], []
    link = record.link_position_rad
    nothing = Estimate(0, 0, math.nan, math.nan, math.nan, ())
    for k in range(min(len(record), int(_MOST_MEASURED_S / record.period_s))):
        theta, tau = record.motor_position_rad[k].tolist(), record.motor_torque_nm[k].tolist()
        external = 0.0 if record.external_torque_nm is None else float(record.external_torque_nm[k])
        q = math.nan if link is None else float(link[k])
        sample = Sample(int(record.sequence[k]), tuple(theta), (), tuple(tau), q, math.nan, external)
        watch.step(sample, nothing, math.nan)
        if watch.settled:
            residuals.append(watch.residual_nm)
            torques.append(watch.torque_nm)
    require(bool(residuals), f"floor: expected a recording of more than {_SETTLE_S + _MEMORY_S:g} s")
    floor = np.maximum(np.quantile(residuals, _SHARE, axis=0), 1e-12)
    torque = np.maximum(np.sqrt(np.mean(np.square(torques), axis=0)), 1e-12)
    return Floor(residual_nm=tuple(floor.tolist()), torque_nm=tuple(torque.tolist()))


class ResidualWatch:
    """Raises the model alarm, and says where the missing effect is likely to sit.

    Args:
        model: as declared, transmission parameters included.
        period_s: of the samples.
        floor: what the model left when it was fitted; None: only measure.

    Attributes:
        residual_nm: rms of each balance over the last second.
        torque_nm: rms of the torque it is to be compared with.
        settled: whether they mean something yet.
    """

    def __init__(self, model: JointModel, period_s: float, floor: Floor | None) -> None:
        self._model = model
        self._ticks = max(_PHASES, round(_STEP_S / period_s))
        self._dt = self._ticks * period_s
        motors = len(model.motors)
        self._transmissions: list[tuple[TransmissionModel, FloatArray] | None] = []
        for motor in model.motors:
            law = transmission_model(motor.transmission)
            known = law is not None and bool(motor.transmission.parameters)
            self._transmissions.append(
                (law, law.alpha(motor.transmission.parameters)) if known and law is not None else None
            )
        self._linked = model.link is not None and model.has_deflection
        self._balances = motors + int(self._linked)
        self.floor = floor if floor is None or len(floor.residual_nm) == self._balances else None
        self._effects = OnlineEffects(model, self._dt)
        self._light = StateVariableFilter(3, _LIGHT_RAD_S, self._dt)
        self._narrow = StateVariableFilter(2, _NARROW_RAD_S, self._dt)
        self._forget = self._dt / _MEMORY_S
        self._channels = 2 * motors + 2
        self.reset()

    def reset(self) -> None:
        """Forget everything but the model and its floor."""
        self._effects.reset()
        self._sums = [0.0] * self._channels
        self._before: list[float] = []
        self._count = 0
        self._steps = 0
        self._last: int | None = None
        self._inputs = np.zeros(self._channels)
        self._state: FloatArray | None = None
        self._filtered = np.zeros((2, 2 * self._balances))
        self._raw = np.zeros(2 * self._balances)
        self._squares = np.zeros(2 * self._balances)
        self._cross = 0.0
        self._above_s = 0.0
        self.residual_nm: tuple[float, ...] = (math.nan,) * self._balances
        self.torque_nm: tuple[float, ...] = (math.nan,) * self._balances
        self.settled = False
        self.alarm = False
        self.ratio = math.nan

    def step(self, sample: Sample, estimate: Estimate, residual_nm: float) -> bool:
        """Take one sample.

        Args:
            sample: as measured.
            estimate: not needed; the watch does not trust what adapts.
            residual_nm: likewise.

        Returns:
            Whether the alarm is on.
        """
        values = self._values(sample)
        if not all(abs(x) < 1e9 for x in values):
            return self.alarm
        if self._last is not None and not 1 <= sample.sequence - self._last <= self._ticks:
            alarm = self.alarm
            self.reset()
            self.alarm = alarm
        self._last = sample.sequence
        # The torque of a sample acts until the next one: what has acted up to now is half old, half new.
        acting = values.copy()
        motors = len(self._model.motors)
        for i in range(motors, 2 * motors):
            acting[i] = 0.5 * (values[i] + self._before[i]) if self._before else values[i]
        self._before = values
        self._sums = [s + v for s, v in zip(self._sums, acting, strict=True)]
        self._count += 1
        if self._count == self._ticks:
            self._filter([s / self._ticks for s in self._sums], sample.sequence)
            self._sums = [0.0] * self._channels
            self._count = 0
        elif self._count == 1 and self._state is not None:
            self._balance()
        elif self._count == 2 and self._state is not None:
            self._judge()
        return self.alarm

    def describe(self) -> dict[str, Any]:
        """What it found: residual and floor per balance, their largest ratio, the likely location."""
        found: dict[str, Any] = {"watching": self.floor is not None}
        if self.settled:
            found["residual_nm"] = list(self.residual_nm)
        if self.floor is not None:
            found["floor_nm"] = list(self.floor.residual_nm)
        if self.alarm or self.ratio > _CLEAR:
            found["ratio"] = self.ratio
            found["location"] = self.location()
        return found

    def location(self) -> str:
        """Where the effect that the model lacks is likely to sit."""
        motors = len(self._model.motors)
        over = self._over()
        if not self._linked:
            flexible = self._model.motors[int(np.argmax(over))].transmission.model != "none"
            return "motor or transmission" if flexible else "motor"
        worst = int(np.argmax(over[:motors]))
        floor = self.floor.residual_nm if self.floor is not None else (0.0,) * self._balances
        motor = max(float(self._squares[worst]) - floor[worst] ** 2, 0.0)
        link = max(float(self._squares[motors]) - floor[motors] ** 2, 0.0)
        alike = self._cross > _CORRELATED * math.sqrt(float(self._squares[worst] * self._squares[motors]))
        if alike and min(motor, link) > _BOTH * max(motor, link):
            return "transmission"
        return "motor" if motor > link else "link"

    def _values(self, sample: Sample) -> list[float]:
        link = sample.link_position_rad if self._model.has_deflection else 0.0
        external = sample.external_torque_nm
        external = external if self._linked and math.isfinite(external) else 0.0
        return [*sample.motor_position_rad, *sample.motor_torque_nm, link, external]

    def _filter(self, means: list[float], sequence: int) -> None:
        """First part of a step: readings corrected, light filter."""
        motors = len(self._model.motors)
        if self._effects.active:
            sample = Sample(
                sequence // self._ticks,
                tuple(means[:motors]),
                (math.nan,) * motors,
                tuple(means[motors : 2 * motors]),
                means[-2],
                math.nan,
                means[-1],
            )
            sample = self._effects.correct(sample)
            means = self._values(sample)
        inputs = np.array(means)
        if self._state is None:
            self._state = np.zeros((3, self._channels))
            self._state[0] = inputs
            self._inputs = inputs
        step = self._light.smooth
        self._state = (
            step.advance @ self._state + np.outer(step.old, self._inputs) + np.outer(step.new, inputs)
        )
        self._inputs = inputs
        self._steps += 1

    def _balance(self) -> None:
        """Second part: the balances, and the torques that they are compared with."""
        assert self._state is not None
        model, motors = self._model, len(self._model.motors)
        position, rate, acceleration = (row.tolist() for row in self._state)
        q = position[-2]
        phi = [q - position[i] for i in range(motors)]
        torques = [self._flexibility(i, phi[i]) for i in range(motors)]
        tau = position[motors : 2 * motors]
        x_motor = x_transmission = [0.0] * motors
        x_link = 0.0
        if self._effects.active:
            sample = Sample(0, tuple(position[:motors]), (), tuple(tau), q)
            x = self._effects.torques(
                sample,
                tuple(rate[:motors]),
                tuple(acceleration[:motors]),
                tuple(phi),
                tuple(rate[-2] - rate[i] for i in range(motors)),
                tuple(torques),
                self._steps * self._dt,
                tuple(self._stiffness(i, phi[i]) for i in range(motors)),
            )
            x_motor, x_transmission, x_link = list(x.motor_nm), list(x.transmission_nm), x.link_nm
        left, size = [], []
        for i, motor in enumerate(model.motors):
            own = motor.inertia_kg_m2 * acceleration[i] + motor.viscous_damping_nm_s_rad * rate[i]
            left.append(own - tau[i] - torques[i] - x_transmission[i] + x_motor[i])
            size.append(tau[i])
        if self._linked and model.link is not None:
            link = model.link
            gravity = link.gravity_nm * math.sin(q + link.gravity_phase_rad)
            own = link.inertia_kg_m2 * acceleration[-2] + link.viscous_damping_nm_s_rad * rate[-2]
            pulls = motors if model.arrangement == "antagonistic" else 1
            through = sum(torques[:pulls]) + sum(x_transmission[:pulls])
            left.append(position[-1] - own - gravity - through - x_link)
            size.append(through)
        raw = np.array(left + size)
        step = self._narrow.smooth
        self._filtered = (
            step.advance @ self._filtered + np.outer(step.old, self._raw) + np.outer(step.new, raw)
        )
        self._raw = raw

    def _flexibility(self, motor: int, deflection: float) -> float:
        known = self._transmissions[motor]
        return 0.0 if known is None else float(known[0].torque(deflection, known[1]))

    def _stiffness(self, motor: int, deflection: float) -> float:
        known = self._transmissions[motor]
        return 0.0 if known is None else float(known[0].stiffness(deflection, known[1]))

    def _judge(self) -> None:
        """Third part: averages, ratio to the floor, alarm."""
        if self._steps * self._dt < _SETTLE_S - _MEMORY_S:
            return
        now = self._filtered[0]
        self._squares += self._forget * (now * now - self._squares)
        if self._linked:
            worst = int(np.argmax(self._squares[: len(self._model.motors)]))
            link = len(self._model.motors)
            self._cross += self._forget * (float(now[worst] * now[link]) - self._cross)
        if self._steps * self._dt < _SETTLE_S:
            return
        self.settled = True
        rms = np.sqrt(self._squares).tolist()
        self.residual_nm, self.torque_nm = tuple(rms[: self._balances]), tuple(rms[self._balances :])
        if self.floor is None:
            return
        self.ratio = max(self._over())
        limit = _CLEAR if self.alarm else _ALARM
        self._above_s = self._above_s + self._dt if self.ratio > limit else 0.0
        self.alarm = self._above_s > (0.0 if self.alarm else _HOLD_S)

    def _over(self) -> list[float]:
        """Residual over floor for each balance, the floor raised where there is more torque."""
        if self.floor is None:
            return list(self.residual_nm)
        least = _LEAST * max(self.torque_nm)
        return [
            residual / max(floor * max(1.0, torque / usual), least)
            for residual, torque, floor, usual in zip(
                self.residual_nm, self.torque_nm, self.floor.residual_nm, self.floor.torque_nm, strict=True
            )
        ]
