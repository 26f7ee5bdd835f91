"""A simulated fleet: joints that stay, drift, step, or get an effect, and a recording of each a night.

    python benchmarks/fleet_world.py DIR [--joints 40] [--nights 25] [--seconds 10] [--seed 0]

Writes DIR/joints/NAME.toml, DIR/recordings/NAME-DATE.csv and DIR/truth.json. The world is of its own: all
recordings side by side in numpy, Heun's method; it shares no code with the estimator. A joint's motion
differs from night to night, its spring by 0.2 % and its damping by 1 % (temperature); declared inertias are
off by up to half a per cent.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import dataclass
from datetime import date, timedelta
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

PERIOD_S = 0.002
SUBSTEPS = 2
DRIFT = 0.03  # of the stiffness, over all nights
STEP = 0.02
TEMPERATURE = 0.002  # of the stiffness, from night to night
DAMPING = 0.01  # likewise
SHARES = {"drift": 0.4, "step": 0.15, "effect": 0.15}  # of the joints; the rest is healthy
EFFECTS = ("coulomb", "cogging", "hysteresis")
NAMES = {
    "coulomb": {"coulomb_friction", "stribeck_friction", "asymmetric_friction", "presliding_friction"},
    "cogging": {"cogging"},
    "hysteresis": {"hysteresis"},
}
FIRST_NIGHT = date(2026, 1, 5)


@dataclass(frozen=True, slots=True)
class Joint:
    """What is true of one joint."""

    name: str
    kind: str  # healthy, drift, step, effect
    stiffness_nm_rad: float
    inertia_kg_m2: float
    link_inertia_kg_m2: float
    change_relative: float
    since_night: int
    effect: str | None

    def stiffness(self, night: int, nights: int) -> float:
        """In a night, before temperature."""
        share = 0.0
        if self.kind == "drift":
            share = night / (nights - 1)
        elif self.kind == "step":
            share = float(night >= self.since_night)
        return self.stiffness_nm_rad * (1.0 + self.change_relative * share)


def fleet(joints: int, nights: int, rng: np.random.Generator) -> list[Joint]:
    """Joints of every kind, in a random order."""
    kinds = [kind for kind, share in SHARES.items() for _ in range(round(share * joints))]
    kinds += ["healthy"] * (joints - len(kinds))
    made = []
    for number, kind in enumerate(rng.permutation(kinds)):
        sign = -1.0 if rng.random() < 0.7 else 1.0
        change = {"drift": DRIFT, "step": STEP}.get(str(kind), 0.0) * sign
        made.append(
            Joint(
                name=f"axis{number:03d}",
                kind=str(kind),
                stiffness_nm_rad=float(np.exp(rng.uniform(np.log(90.0), np.log(260.0)))),
                inertia_kg_m2=float(rng.uniform(0.08, 0.2)),
                link_inertia_kg_m2=float(rng.uniform(0.25, 0.5)),
                change_relative=change,
                since_night=int(rng.integers(nights // 4, max(3 * nights // 4, 1))) if kind != "drift" else 0,
                effect=str(rng.choice(EFFECTS)) if kind == "effect" else None,
            )
        )
    return made


def simulate(joints: list[Joint], nights: int, seconds: float, rng: np.random.Generator) -> Array:
    """(joints · nights, rows, 3): motor position, motor torque, link position as measured."""
    pairs = [(joint, night) for joint in joints for night in range(nights)]
    m, n = len(pairs), round(seconds / PERIOD_S)

    def of(value: object) -> Array:
        return np.array(value, dtype=np.float64)

    active = [j.effect if j.effect and night >= j.since_night else None for j, night in pairs]
    stiffness = of([j.stiffness(night, nights) for j, night in pairs])
    stiffness *= 1.0 + TEMPERATURE * rng.standard_normal(m)
    inertia, link = of([j.inertia_kg_m2 for j, _ in pairs]), of([j.link_inertia_kg_m2 for j, _ in pairs])
    damping = 0.7 * (1.0 + DAMPING * rng.standard_normal(m))
    coulomb, cogging, hysteresis = (of([0.5 * (a == name) for a in active]) for name in EFFECTS)
    reference = _references(n, m, rng)
    rate = np.gradient(reference, PERIOD_S, axis=0)
    state, memory = np.zeros((4, m)), np.zeros(m)  # theta, theta', q, q'
    rows = np.empty((n, 3, m))
    step = PERIOD_S / SUBSTEPS

    def slope(state: Array, torque: Array) -> Array:
        theta, w, q, v = state
        through = stiffness * (q - theta) + hysteresis * memory
        lost = damping * w + coulomb * np.tanh(w / 0.004) + cogging * np.sin(19.0 * theta)
        return np.array(
            [w, (torque - lost + through) / inertia, v, -(through + 0.12 * v + 4.0 * np.sin(q)) / link]
        )

    for k in range(n):
        torque = 170.0 * (reference[k] - state[0]) + 6.0 * (rate[k] - state[1])
        rows[k] = state[0], torque, state[2]
        for _ in range(SUBSTEPS):
            first = slope(state, torque)
            second = slope(state + step * first, torque)
            before = state[2] - state[0]
            state = state + 0.5 * step * (first + second)
            u = (state[2] - state[0] - before) / 0.004
            memory = memory + u * (1.0 - np.abs(memory) * np.sign(u * memory))
    return _measured(rows, rng)


def _references(n: int, m: int, rng: np.random.Generator) -> Array:
    time = np.arange(n)[:, None] * PERIOD_S
    path = np.zeros((n, m))
    for _ in range(10):
        tone = np.exp(rng.uniform(np.log(0.15), np.log(3.0), m))
        path += np.sin(2.0 * np.pi * tone * time + rng.uniform(0.0, 2.0 * np.pi, m)) / tone**0.9
    path = 0.45 * (path - path[0]) / path.std(axis=0)
    return np.asarray(path * np.minimum(1.0, time / 0.5))


def _measured(rows: Array, rng: np.random.Generator) -> Array:
    """Encoders quantised, torque noisy."""
    motor, link = 2.0 * np.pi / 65536, 2.0 * np.pi / 2**17
    rows[:, 0] = np.floor(rows[:, 0] / motor) * motor
    rows[:, 1] += 0.01 * rng.standard_normal(rows[:, 1].shape)
    rows[:, 2] = np.floor(rows[:, 2] / link) * link
    return rows.transpose(2, 0, 1)


def joint_file(joint: Joint, error: float) -> str:
    """Its TOML, with an inertia that is a little off."""
    return (
        f'name = "{joint.name}"\narrangement = "single"\n[[motor]]\n'
        f"inertia_kg_m2 = {joint.inertia_kg_m2 * (1.0 + error):.6g}\nviscous_damping_nm_s_rad = 0.7\n"
        '[motor.transmission]\nmodel = "linear"\n[link.dynamics]\n'
        f"inertia_kg_m2 = {joint.link_inertia_kg_m2:.6g}\nviscous_damping_nm_s_rad = 0.12\ngravity_nm = 4.0\n"
        f"[bus]\nperiod_s = {PERIOD_S:g}\n"
    )


def write_csv(path: Path, samples: Array) -> None:
    """One recording, (rows, 3)."""
    time_s = np.arange(len(samples)) * PERIOD_S
    names = "time_s,motor1_position_rad,motor1_torque_nm,link_position_rad"
    table = np.column_stack((time_s, samples))
    np.savetxt(path, table, delimiter=",", header=names, comments="", fmt="%.9g")


def make(folder: Path, joints: int, nights: int, seconds: float, seed: int) -> list[Joint]:
    """Write a fleet; return what is true of it."""
    rng = np.random.default_rng(seed)
    truth = fleet(joints, nights, rng)
    for name in ("joints", "recordings"):
        (folder / name).mkdir(parents=True, exist_ok=True)
    for joint in truth:
        text = joint_file(joint, float(rng.uniform(-0.005, 0.005)))
        (folder / "joints" / f"{joint.name}.toml").write_text(text, encoding="utf-8")
    per_batch = max(1, 400 // nights)  # joints at once: memory
    for begin in range(0, joints, per_batch):
        batch = truth[begin : begin + per_batch]
        for k, samples in enumerate(simulate(batch, nights, seconds, rng)):
            joint, night = batch[k // nights], k % nights
            day = FIRST_NIGHT + timedelta(days=night)
            write_csv(folder / "recordings" / f"{joint.name}-{day}.csv", samples)
    entries = [{name: getattr(joint, name) for name in Joint.__slots__} for joint in truth]
    (folder / "truth.json").write_text(json.dumps(entries, indent=1) + "\n", encoding="utf-8")
    return truth


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("folder", type=Path, metavar="DIR")
    parser.add_argument("--joints", type=int, default=40)
    parser.add_argument("--nights", type=int, default=25)
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    truth = make(args.folder, args.joints, args.nights, args.seconds, args.seed)
    print(f"{len(truth)} joints, {len(truth) * args.nights} recordings in {args.folder}")


if __name__ == "__main__":
    main()
