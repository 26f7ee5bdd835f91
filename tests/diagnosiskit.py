"""A world for the diagnosis to be tested in, of its own: many joints at once, Heun's method, plain numpy."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from estimator.model import JointModel, LinkDynamics, Motor, Transmission
from estimator.sample import FloatArray, Record

PERIOD_S = 1e-3
SECONDS = 16.0
PUSHES_S = (2.3, 4.1, 7.7, 9.2, 13.4)
_SUBSTEPS = 2
INERTIA, DAMPING, STIFFNESS = 0.12, 0.7, 140.0
LINK_INERTIA, LINK_DAMPING, GRAVITY = 0.35, 0.12, 4.0
MOTOR_LSB, LINK_LSB, TORQUE_NOISE = 2 * np.pi / 65536, 2 * np.pi / 2**17, 0.01


@dataclass
class World:
    """Joints side by side; each entry of `effects` is {name: value} of one joint."""

    effects: list[dict[str, float]]
    seed: int = 1
    slow: bool = False
    records: list[Record] = field(default_factory=list)
    _time: float = 0.0

    def run(self) -> list[Record]:
        """Simulate and measure: encoders quantised, torque noisy, sampled at 1 kHz."""
        n, m = round(SECONDS / PERIOD_S), len(self.effects)
        rng = np.random.default_rng(self.seed)
        reference = self._reference(n, rng)
        rate = np.gradient(reference, PERIOD_S)
        state = np.zeros((4, m))  # theta, theta', q, q'
        memory = np.zeros(m)
        rows = np.empty((n, 3, m))
        step = PERIOD_S / _SUBSTEPS
        for k in range(n):
            self._time = k * PERIOD_S
            torque = 170.0 * (reference[k] - state[0]) + 6.0 * (rate[k] - state[1])
            rows[k] = state[0], torque, state[2]
            for _ in range(_SUBSTEPS):
                first = self._slope(state, torque, memory)
                second = self._slope(state + step * first, torque, memory)
                before = state[2] - state[0]
                state = state + 0.5 * step * (first + second)
                u = (state[2] - state[0] - before) / self._value("hysteresis_rad", 1.0)
                memory = memory + u * (1.0 - np.abs(memory) * np.sign(u * memory))
        self.records = [self._measured(rows[:, :, j], self.effects[j], rng) for j in range(m)]
        return self.records

    def _reference(self, n: int, rng: np.random.Generator) -> FloatArray:
        time = np.arange(n) * PERIOD_S
        if self.slow:
            return 0.5 * np.sin(2 * np.pi * 0.25 * time)
        tones = np.exp(rng.uniform(np.log(0.12), np.log(3.0), 12))
        waves = np.sin(np.outer(time, 2 * np.pi * tones) + rng.uniform(0, 2 * np.pi, 12)) / tones**0.9
        path = waves.sum(axis=1)
        return np.asarray(0.45 * (path - path[0]) / path.std() * np.minimum(1.0, time / 0.5))

    def _value(self, name: str, default: float = 0.0) -> FloatArray:
        return np.array([e.get(name, default) for e in self.effects])

    def _slope(self, state: FloatArray, torque: FloatArray, memory: FloatArray) -> FloatArray:
        theta, w, q, v = state
        through = STIFFNESS * (q - theta) + self._value("hysteresis_nm") * memory
        x = self._value("coulomb_nm") * w / np.sqrt(w * w + 4e-6) + self._value("offset_nm")
        x = x + self._value("cogging_nm") * np.sin(17.0 * theta)
        x = x + self._value("fading_nm") * np.exp(-self._time / 5.0) * w / np.sqrt(w * w + 4e-6)
        x = x + self._value("bump_nm") * np.exp(-(((theta + 1.0) / 0.12) ** 2))
        acting = (
            torque * (1.0 + self._value("constant")) * (1.0 + self._value("ripple") * np.sin(9.0 * theta))
        )
        inertia = INERTIA + self._value("inertia_kg_m2")
        link = LINK_DAMPING * v + (GRAVITY + self._value("gravity_nm")) * np.sin(q) + through
        link = link + self._value("link_nm") * v / np.sqrt(v * v + 4e-6)
        pushes = [np.exp(-(((self._time - at) / 0.15) ** 2)) for at in PUSHES_S]
        link = link - self._value("push_nm") * sum(pushes)
        return np.array([w, (acting - DAMPING * w - x + through) / inertia, v, -link / LINK_INERTIA])

    @staticmethod
    def _measured(rows: FloatArray, effects: dict[str, float], rng: np.random.Generator) -> Record:
        theta, torque, q = rows.T
        late = effects.get("late_s", 0.0) / PERIOD_S
        index = np.arange(len(q))
        q = np.interp(index - late, index, q) + effects.get("zero_rad", 0.0)
        return Record(
            period_s=PERIOD_S,
            sequence=index,
            motor_position_rad=(np.floor(theta / MOTOR_LSB) * MOTOR_LSB)[:, None],
            motor_torque_nm=(torque + TORQUE_NOISE * rng.standard_normal(len(torque)))[:, None],
            link_position_rad=np.floor(q / LINK_LSB) * LINK_LSB,
        )


def model(error: float = 0.0, *, linked: bool = True) -> JointModel:
    """The joint as declared, its numbers off by a share."""
    motor = Motor(
        inertia_kg_m2=INERTIA * (1 + error),
        viscous_damping_nm_s_rad=DAMPING * (1 - error),
        transmission=Transmission(model="linear"),
    )
    link = LinkDynamics(
        inertia_kg_m2=LINK_INERTIA * (1 - error),
        viscous_damping_nm_s_rad=LINK_DAMPING * (1 + error),
        gravity_nm=GRAVITY * (1 + error),
    )
    return JointModel(arrangement="single", motors=(motor,), link=link if linked else None)
