"""Simulates a model under the measured motor torque: the second judge beside the torque balance.

The torque is held over each period, as a drive holds it. Windows of the recording run side by side. Each
starts from the measured state, for a joint without position control drifts in any long free run.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from estimator.choices import choice
from estimator.effects import Coordinates, EffectType, elements
from estimator.errors import EstimatorError
from estimator.filters import smoothed
from estimator.gate import without_hold
from estimator.model import Effect, JointModel, Transmission
from estimator.sample import FloatArray, Record
from estimator.transmissions import RIGID, TransmissionModel, transmission_model

_RESOLVED = 0.1
_SMOOTHED = 21
_STEP = 1e-6

Element = tuple[EffectType, Mapping[str, float]]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FreeRun:
    """Measured and simulated positions."""

    time_s: FloatArray = field(repr=False)  # (n,)
    measured_rad: FloatArray = field(repr=False)  # (n, c), by column of `channels`
    simulated_rad: FloatArray = field(repr=False)  # (n, c)
    # "motor1_position", …, "link_position" where the link is simulated, "motor1_deflection", …
    channels: tuple[str, ...]
    horizon_s: float  # time between new starts from the measured state
    # NRMSE fit of each channel, 100 (1 - |y - y_sim| / |y - mean y|), as MATLAB's `compare`
    fit_percent: Mapping[str, float]
    # the same of motion at constant velocity from the same starts: what no model reaches for nothing
    coasting_percent: Mapping[str, float]
    # effects with memory, which act along the measured motion instead of the simulated one
    as_measured: tuple[str, ...]

    @property
    def residual_rad(self) -> FloatArray:
        """(n, c) measured minus simulated."""
        return self.measured_rad - self.simulated_rad


def nrmse_fit(measured: FloatArray, simulated: FloatArray) -> float:
    """Return 100 (1 - |y - y_sim| / |y - mean y|) in %; NaN if y does not vary."""
    spread = float(np.linalg.norm(measured - np.mean(measured)))
    return 100.0 * (1.0 - float(np.linalg.norm(measured - simulated)) / spread) if spread else np.nan


def free_run(record: Record, model: JointModel, horizon_s: float | None = None) -> FreeRun:
    """Simulate a model under the motor torque of a recording.

    The integrator splits position and velocity (second order); where damping or dry friction is stiffer than
    the step, velocity is implicit. Without link dynamics, or with the link held, the measured link drives the
    transmissions.

    Args:
        record: windows begin anew behind each gap.
        model: every flexible transmission has parameters.
        horizon_s: length of a window, s; left out: that of reports (`simulation_s`), or the longest of its
            half, its quarter, … whose fit is above zero in every channel, which a drifting run is not.

    Raises:
        EstimatorError: a transmission has no parameters, or no window fits into the recording.
    """
    model = without_hold([record], model)
    if horizon_s is not None:
        return _windows(record, model, horizon_s)
    horizon = simulation_s(record)
    while True:
        made = _windows(record, model, horizon)
        shorter = horizon / 2.0
        if min(made.fit_percent.values()) > 0.0 or shorter < 2 * _SMOOTHED * record.period_s:
            return made
        horizon = shorter


def simulation_s(record: Record) -> float:
    """Return the length of the windows in which a model is judged, s: a second, or what gaps leave of it."""
    return min(choice("horizon"), unbroken_s(record))


def unbroken_s(record: Record) -> float:
    """Return a window for free runs, s: half of the rows lie in unbroken pieces as long."""
    sizes = np.sort([end - begin for begin, end in _pieces(record)])
    lasting = np.cumsum(sizes) >= np.sum(sizes) / 2.0
    return float(sizes[np.argmax(lasting)]) * record.period_s if len(sizes) else 0.0


def _pieces(record: Record) -> list[tuple[int, int]]:
    """Return first row and end of each piece whose states are smoothed over no gap."""
    cuts = np.flatnonzero(np.diff(record.sequence) != 1) + 1
    begins, ends = [0, *(cuts + _SMOOTHED // 2)], [*cuts, len(record)]
    return [(int(a), int(b)) for a, b in zip(begins, ends, strict=True) if a < b]


def _windows(record: Record, model: JointModel, horizon_s: float) -> FreeRun:
    size = max(round(horizon_s / record.period_s), 2)
    whole = [k for begin, end in _pieces(record) for k in range(begin, end - size + 1, size)]
    if not whole:
        raise EstimatorError(f"expected a run without gaps of {horizon_s:g} s for a free run")
    rows = np.asarray(whole)[None, :] + np.arange(size)[:, None]  # (size, windows)
    joint = Bodies(record, model)
    outputs = joint.run(rows)
    order = rows.T.reshape(-1)
    simulated = outputs.transpose(1, 0, 2).reshape(len(order), -1)
    start = np.repeat(joint.smoothed[rows[0]], size, axis=0)
    rate = np.repeat(joint.rate[rows[0]], size, axis=0)
    ahead = np.tile(np.arange(size) * record.period_s, len(whole))[:, None]
    sets = [joint.channels(x) for x in (joint.measured[order], simulated, start + ahead * rate)]
    names = joint.names
    measured, run, coasting = sets
    return FreeRun(
        time_s=record.time_s[order],
        measured_rad=measured,
        simulated_rad=run,
        channels=names,
        horizon_s=size * record.period_s,
        fit_percent={name: nrmse_fit(measured[:, j], run[:, j]) for j, name in enumerate(names)},
        coasting_percent={name: nrmse_fit(measured[:, j], coasting[:, j]) for j, name in enumerate(names)},
        as_measured=tuple(sorted(joint.remembered)),
    )


class Bodies:
    """Bodies of a joint with what acts on them; state columns: motors, then the link."""

    def __init__(self, record: Record, model: JointModel) -> None:
        self.record, self.model, self.m = record, model, len(model.motors)
        self.time = record.time_s
        self.laws = [_law(motor.transmission) for motor in model.motors]
        self.carried = self.laws[0] is None
        self.swings = model.link is not None and not self.carried
        self.alphas = [
            law.alpha(motor.transmission.parameters) if law else np.zeros(0)
            for law, motor in zip(self.laws, model.motors, strict=True)
        ]
        self.elements = [_elements(motor.effects) for motor in model.motors]
        self.link_elements = _elements(model.link_effects)
        acting = [[e for e in mine if e[0].channel == "torque" and _instant(e[0])] for mine in self.elements]
        self.through = [[e for e in mine if e[0].location == "transmission"] for mine in acting]
        self.on_motor = [[e for e in mine if e[0].location == "motor"] for mine in acting]
        self.zero = [[e for e in mine if e[0].channel == "deflection"] for mine in self.elements]
        self.on_link = [e for e in self.link_elements if e[0].location == "link" and _instant(e[0])]
        self.reading = [e for e in self.link_elements if e[0].channel == "link_position"]
        self.remembered: set[str] = set()
        q = record.link_position_rad
        if q is None:
            if model.has_deflection:
                raise EstimatorError("link_position_rad: expected for a flexible transmission, it is missing")
            q = record.motor_position_rad[:, 0]
        self.measured = np.column_stack([record.motor_position_rad, q])
        if len(record) < _SMOOTHED:
            raise EstimatorError(f"expected at least {_SMOOTHED} samples for a free run, got {len(record)}")
        self.smoothed, self.rate = (
            smoothed(self.measured, _SMOOTHED, order, record.period_s) for order in (0, 1)
        )
        self.state = self.smoothed.copy()
        self.state[:, -1] -= self.reading_error(self.smoothed[:, -1], self.rate[:, -1])
        self.inertia = self._inertias()
        self.torque = self._acting()
        self.given = self.remembered_torques()

    @property
    def names(self) -> tuple[str, ...]:
        """Names of `channels`."""
        motors = [f"motor{i + 1}_position" for i in range(self.m)]
        link = ["link_position"] if self.swings else []
        flexible = [f"motor{i + 1}_deflection" for i in range(self.m) if self.laws[i]]
        return (*motors, *link, *flexible)

    def channels(self, x: FloatArray) -> FloatArray:
        """Return the positions and deflections (n, c) of states (n, m + 1)."""
        columns = [x[:, i] for i in range(self.m)]
        if self.swings:
            columns.append(x[:, -1])
        columns += [x[:, -1] - x[:, i] for i in range(self.m) if self.laws[i]]
        return np.column_stack(columns)

    def run(self, rows: NDArray[np.int64]) -> FloatArray:
        """Return the (size, windows, m + 1) simulated readings of windows of rows (size, windows)."""
        steps = self.steps()
        h = self.record.period_s / steps
        x, v = self.state[rows[0]].copy(), self.rate[rows[0]].copy()
        out = np.empty((*rows.shape, self.m + 1))
        with np.errstate(all="ignore"):  # a run that leaves the world has a fit of minus infinity
            for k, row in enumerate(rows):
                self._hold(row, x, v)
                out[k] = x
                out[k, :, -1] += self.reading_error(x[:, -1], v[:, -1])
                for _ in range(steps):
                    x += 0.5 * h * v
                    v += h * self._gain(x, v, row, h)
                    x += 0.5 * h * v
        return np.nan_to_num(out, nan=1e9, posinf=1e9, neginf=-1e9).clip(-1e9, 1e9)

    def steps(self, *, driven: bool = False) -> int:
        """Return steps of a period that resolve the fastest oscillation; the link's if motors are driven."""
        stiffness = np.zeros(self.m)
        for i, (law, alpha) in enumerate(zip(self.laws, self.alphas, strict=True)):
            if law:
                stiffness[i] = np.max(np.abs(law.both(self.state[:, -1] - self.state[:, i], alpha)[1]))
        square = 0.0 if driven else float(np.max(stiffness / self.inertia[:-1]))
        if self.swings:
            square += float(np.sum(stiffness) / self.inertia[-1])
        return max(1, math.ceil(self.record.period_s * math.sqrt(square) / _RESOLVED))

    def _hold(self, row: NDArray[np.int64], x: FloatArray, v: FloatArray) -> None:
        """Without dynamics of its own the link is where it is measured; a carried one moves with motor 1."""
        if self.carried:
            x[:, -1], v[:, -1] = x[:, 0], v[:, 0]
        elif self.model.link is None:
            x[:, -1], v[:, -1] = self.state[row, -1], self.rate[row, -1]

    def _gain(self, x: FloatArray, v: FloatArray, row: NDArray[np.int64], h: float) -> FloatArray:
        """Mean acceleration over a step: half implicit, fully where the damping is stiffer than the step."""
        bodies = np.arange(self.m + self.swings)
        rates = np.repeat(v[None], len(bodies) + 1, axis=0)
        rates[bodies + 1, :, bodies] += _STEP
        same = np.tile(x, (len(rates), 1)), rates.reshape(-1, self.m + 1), np.tile(row, len(rates))
        moved = self.acceleration(*same).reshape(rates.shape)
        a: FloatArray = moved[0]
        slope = np.zeros_like(v)
        slope[:, bodies] = (moved[bodies + 1, :, bodies].T - a[:, bodies]) / _STEP
        stiff = np.minimum(slope, 0.0) * h
        a /= 1.0 - np.where(stiff > -1.0, 0.5, 1.0) * stiff
        if self.carried:
            a[:, -1] = a[:, 0]
        return a

    def acceleration(self, x: FloatArray, v: FloatArray, row: NDArray[np.int64]) -> FloatArray:
        """Return the accelerations of states (w, m + 1) and rates at these rows."""
        force = self.torque[row] - self.given[row]
        if self.carried or self.swings:
            force[:, -1] -= self._link_load(x[:, -1], v[:, -1])
        second = self.model.arrangement == "antagonistic"
        for i, motor in enumerate(self.model.motors):
            spring, on_motor, c = self._motor(i, x, v, row)
            force[:, i] += spring - on_motor - motor.viscous_damping_nm_s_rad * c.velocity
            if i == 0 or second:
                force[:, -1] -= spring
        if self.carried:
            force[:, 0] += force[:, -1]
        if not self.swings:
            force[:, -1] = 0.0
        return np.asarray(force / self.inertia, dtype=np.float64)

    def _motor(
        self, i: int, x: FloatArray, v: FloatArray, row: NDArray[np.int64]
    ) -> tuple[FloatArray, FloatArray, Coordinates]:
        """Torque through the transmission, further torque on the motor, and the coordinates."""
        c = _coordinates(x[:, i], v[:, i], x[:, -1], v[:, -1], self.torque[row, i], self.time[row])
        law = self.laws[i]
        if law:
            phi = c.deflection - _sum(self.zero[i], c)
            spring, k = law.both(phi, self.alphas[i])
            c = c._replace(deflection=phi, flexibility_torque=spring, stiffness=k)
        else:
            spring = np.zeros(len(x))
        on_motor = _sum(self.on_motor[i], c)
        for kind, values in self.through[i]:
            if (reaction := kind.reaction(c, values)) is not None:
                on_motor = on_motor + np.array([values[name] for name in kind.linear]) @ reaction
        return spring + _sum(self.through[i], c), on_motor, c

    def _link_load(self, q: FloatArray, rate: FloatArray) -> FloatArray:
        link, c = self.model.link, _coordinates(q, rate, q, rate, 0.0 * q, 0.0 * q)
        load = _sum(self.on_link, c)
        if link is None:
            return load
        turned = np.sin(q + link.gravity_phase_rad)
        return load + link.viscous_damping_nm_s_rad * rate + link.gravity_nm * turned

    def reading_error(self, q: FloatArray, rate: FloatArray) -> FloatArray:
        """Error of the link encoder's reading."""
        c = _coordinates(q, rate, q, rate, 0.0 * q, 0.0 * q)
        return _sum(self.reading, c)

    def _acting(self) -> FloatArray:
        """(n, m + 1) torque that acts on each body from outside: measured, less the measurement's error."""
        record, n = self.record, len(self.record)
        out = np.zeros((n, self.m + 1))
        for i in range(self.m):
            tau = record.motor_torque_nm[:, i]
            out[:, i] = tau - self.torque_error(i, tau)
        if record.external_torque_nm is not None:
            out[:, -1] = np.nan_to_num(record.external_torque_nm)
        return out

    def torque_error(self, i: int, tau: FloatArray) -> FloatArray:
        """Return the error (n,) of a motor's measured torque (n,)."""
        zero = 0.0 * tau
        c = _coordinates(zero, zero, zero, zero, tau, self.time)
        c = c._replace(torque_rate=np.gradient(tau, self.record.period_s))
        return _sum([e for e in self.elements[i] if e[0].channel == "motor_torque"], c)

    def remembered_torques(self) -> FloatArray:
        """(n, m + 1) torque of effects with memory along the measured motion, as a load on each body."""
        out = np.zeros((len(self.record), self.m + 1))
        x, v = self.state, self.rate
        for i in range(self.m):
            c = _coordinates(x[:, i], v[:, i], x[:, -1], v[:, -1], self.torque[:, i], self.time)
            for one in [e for e in self.elements[i] if e[0].remembers]:
                self.remembered.add(one[0].name)
                load, through = _sum([one], c), one[0].location == "transmission"
                out[:, i] += -load if through else load
                if through and (i == 0 or self.model.arrangement == "antagonistic"):
                    out[:, -1] += load
        return out

    def _inertias(self) -> FloatArray:
        """(m + 1,) of motors and link; a carried link belongs to the first motor."""
        one = _coordinates(*(np.zeros(1) for _ in range(6)))
        one = one._replace(acceleration=np.ones(1), link_acceleration=np.ones(1))
        link = self.model.link
        own = [motor.inertia_kg_m2 for motor in self.model.motors]
        own.append(1.0 if link is None else link.inertia_kg_m2)
        for j, mine in enumerate([*self.elements, self.link_elements]):
            own[j] += float(_sum([e for e in mine if _is_inertia(e[0])], one)[0])
        if self.carried and link is not None:
            own[0] += own[-1]
        return np.array(own)


def _law(transmission: Transmission) -> TransmissionModel | None:
    law = transmission_model(transmission)
    if law is None and transmission.model != RIGID:
        raise EstimatorError("transmission.model: expected a law for a free run, got an unknown one")
    if law is not None and not transmission.parameters:
        raise EstimatorError("transmission.parameters: expected for a free run, they are missing: fit first")
    return law


def _elements(effects: tuple[Effect, ...]) -> list[Element]:
    return [(kind, values) for kind, sets in map(elements, effects) for values in sets]


def _is_inertia(kind: EffectType) -> bool:
    return kind.coordinates[0] in ("acceleration", "link_acceleration")


def _instant(kind: EffectType) -> bool:
    """Whether an effect is a function of the present position and velocity."""
    return not kind.remembers and not _is_inertia(kind)


def _sum(mine: list[Element], c: Coordinates) -> FloatArray:
    total = np.zeros(np.shape(c.position))
    for kind, values in mine:
        weights = np.array([values[name] for name in kind.linear])
        total = total + weights @ kind.terms(c, values)
    return total


def _coordinates(
    theta: FloatArray,
    omega: FloatArray,
    q: FloatArray,
    rate: FloatArray,
    tau: FloatArray,
    time: FloatArray,
) -> Coordinates:
    zero = np.zeros_like(theta)
    return Coordinates(
        position=theta, velocity=omega, acceleration=zero, deflection=q - theta, deflection_rate=rate - omega,
        flexibility_torque=zero, stiffness=zero, torque=tau, torque_rate=zero, link_position=q,
        link_velocity=rate, link_acceleration=zero, time=time,
    )  # fmt: skip
