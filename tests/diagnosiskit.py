"""Joints with the effects that a diagnosis names: many at once, by the integrator of `joints`."""

from dataclasses import dataclass, field

import joints
import numpy as np

from estimator.model import JointModel, LinkDynamics
from estimator.sample import FloatArray, Record

PERIOD_S = 1e-3
SECONDS = 10.0
DRY = {"coulomb_nm", "stribeck_nm", "fading_nm", "link_nm"}  # steep where the motion turns back
PUSHES_S = (2.3, 4.1, 7.7, 9.2, 13.4)
INERTIA, DAMPING, STIFFNESS = 0.12, 0.7, 140.0
LINK_INERTIA, LINK_DAMPING, GRAVITY = 0.35, 0.12, 4.0
MOTOR_LSB, LINK_LSB, TORQUE_NOISE = 2 * np.pi / 65536, 2 * np.pi / 2**17, 0.01


@dataclass
class World:
    """Joints side by side; each entry of `effects` is {name: value} of one joint."""

    effects: list[dict[str, float]]
    seed: int = 1
    slow: bool = False
    seconds: float = SECONDS
    records: list[Record] = field(default_factory=list)

    def run(self) -> list[Record]:
        """Simulate and measure: encoders quantised, torque noisy, sampled at 1 kHz."""
        n, m = round(self.seconds / PERIOD_S), len(self.effects)
        rng = np.random.default_rng(self.seed)
        reference = self._reference(n, rng)
        rate = np.gradient(reference, PERIOD_S)

        def controller(k: int, x: FloatArray) -> FloatArray:
            return 170.0 * (reference[k] - x[:, :1]) + 6.0 * (rate[k] - x[:, 1:2])

        plants = self._plants(m)
        substeps = 2 if DRY & {name for one in self.effects for name in one} else 1
        size = (n, m, 1)
        truth = joints.simulate(plants, controller, PERIOD_S, substeps, size=size, method=joints.HEUN)
        rows = np.stack([truth.theta[..., 0], truth.tau[..., 0], truth.q], axis=1)
        self.records = [self._measured(rows[:, :, j], self.effects[j], rng) for j in range(m)]
        return self.records

    def _plants(self, m: int) -> joints.Plants:
        inertia = INERTIA + self._value("inertia_kg_m2")
        return joints.Plants(
            *joints.polynomial(np.full((m, 1, 1), STIFFNESS)),
            inertia[:, None],
            np.full((m, 1), DAMPING),
            np.full(m, LINK_INERTIA),
            np.full(m, LINK_DAMPING),
            GRAVITY + self._value("gravity_nm"),
            more=self._more(inertia),
            memories=1,
        )

    def _more(self, inertia: FloatArray) -> joints.More | None:
        names = (
            "coulomb_nm offset_nm cogging_nm second_nm fading_nm bump_nm constant ripple link_nm push_nm "
            "hysteresis_nm stribeck_nm bend_nm_rad2 back_share"
        )
        v = {name: self._value(name) for name in names.split()}
        width = self._value("hysteresis_rad", 1.0)
        on = {name for name, values in v.items() if np.any(values)}

        def more(t: float, x: FloatArray, out: FloatArray, tau: FloatArray) -> None:
            theta, w, q, link_w, memory = x.T
            motor = link = np.zeros(len(x))
            if on & {"bend_nm_rad2", "back_share"}:
                phi = q - theta
                bent = v["bend_nm_rad2"] * np.abs(phi) * phi
                driven = np.maximum((STIFFNESS * phi + bent) * w / np.sqrt(w * w + 4e-6), 0.0)
                motor, link = motor + bent - v["back_share"] * driven, link - bent
            if on & {"coulomb_nm", "stribeck_nm", "fading_nm"}:
                level = v["coulomb_nm"] + v["stribeck_nm"] * np.exp(-((w / 0.05) ** 2))
                motor = motor - (level + v["fading_nm"] * np.exp(-t / 5.0)) * w / np.sqrt(w * w + 4e-6)
            if on & {"offset_nm", "cogging_nm", "second_nm", "bump_nm"}:
                motor = motor - v["offset_nm"] - v["cogging_nm"] * np.sin(17.0 * theta)
                motor = motor - v["second_nm"] * np.sin(34.0 * theta)
                motor = motor - v["bump_nm"] * np.exp(-(((theta + 1.0) / 0.12) ** 2))
            if on & {"constant", "ripple"}:
                gain = (1.0 + v["constant"]) * (1.0 + v["ripple"] * np.sin(9.0 * theta))
                motor = motor + (gain - 1.0) * tau[:, 0]
            if "hysteresis_nm" in on:
                through, rate = v["hysteresis_nm"] * memory, (link_w - w) / width
                motor, link = motor + through, link - through
                out[:, 4] = rate * (1.0 - np.abs(memory) * np.sign(rate * memory))
            if "link_nm" in on:
                link = link - v["link_nm"] * link_w / np.sqrt(link_w * link_w + 4e-6)
            if "push_nm" in on:
                link = link + v["push_nm"] * sum(np.exp(-(((t - at) / 0.15) ** 2)) for at in PUSHES_S)
            out[:, 1] += motor / inertia
            out[:, 3] += link / LINK_INERTIA

        return more if on else None

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

    @staticmethod
    def _measured(rows: FloatArray, effects: dict[str, float], rng: np.random.Generator) -> Record:
        theta, torque, q = rows.T
        late = effects.get("late_s", 0.0) / PERIOD_S
        index = np.arange(len(q))
        if gauge := effects.get("gauge_late_s", 0.0) / PERIOD_S:
            q = theta + np.interp(index - gauge, index, q - theta)
        q = np.interp(index - late, index, q) + effects.get("zero_rad", 0.0)
        q = q + effects.get("eccentric_rad", 0.0) * np.sin(q + 1.0)
        torque = torque + TORQUE_NOISE * rng.standard_normal(len(torque))
        return joints.recorded(joints.quantise(theta, MOTOR_LSB), torque, joints.quantise(q, LINK_LSB))


def model(error: float = 0.0, *, linked: bool = True) -> JointModel:
    """The joint as declared, its numbers off by a share."""
    link = LinkDynamics(
        inertia_kg_m2=LINK_INERTIA * (1 - error),
        viscous_damping_nm_s_rad=LINK_DAMPING * (1 + error),
        gravity_nm=GRAVITY * (1 + error),
    )
    inertia, damping = INERTIA * (1 + error), DAMPING * (1 - error)
    return joints.joint_model(inertia, damping, model="linear", link=link if linked else None)
