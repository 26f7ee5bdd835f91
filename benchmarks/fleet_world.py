"""A simulated fleet: joints that stay, drift, step, or get an effect, and a recording of each a night.

    python benchmarks/fleet_world.py DIR [--joints 40] [--nights 25] [--seconds 10] [--seed 0]

Writes DIR/joints/NAME.toml, DIR/recordings/NAME-DATE.csv and DIR/truth.json. The simulator is `world.c`. A
joint's motion differs from night to night, its spring by 0.2 % and its damping by 1 % (temperature); declared
inertias are off by up to half a per cent.
"""

from __future__ import annotations

import argparse
import json
import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from datetime import date, timedelta
from pathlib import Path

import numpy as np
from undeclared import program, simulate

PERIOD_S = 0.002
DRIFT = 0.03  # of the stiffness, over all nights
STEP = 0.02
TEMPERATURE = 0.002  # of the stiffness, from night to night
DAMPING = 0.01  # likewise
DAMPING_NM_S_RAD, LINK_DAMPING_NM_S_RAD, GRAVITY_NM = 0.7, 0.12, 4.0
SHARES = {"drift": 0.4, "step": 0.15, "effect": 0.15}  # of the joints; the rest is healthy
EFFECTS = {
    "coulomb": {"friction": "coulomb", "coulomb": 0.5},
    "cogging": {"cogging": 0.5, "cogging_periods": 19},
    "hysteresis": {"hysteresis": "dahl", "hysteresis_torque": 0.5, "hysteresis_width": 0.004},
}
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
                effect=str(rng.choice(list(EFFECTS))) if kind == "effect" else None,
            )
        )
    return made


def settings(joint: Joint, night: int, nights: int, seconds: float, rng: np.random.Generator) -> dict:
    """What `world.c` is to simulate."""
    active = joint.effect is not None and night >= joint.since_night
    return {
        "spring": "linear",
        "stiffness": joint.stiffness(night, nights) * (1.0 + TEMPERATURE * rng.standard_normal()),
        "inertia": joint.inertia_kg_m2,
        "damping": DAMPING_NM_S_RAD * (1.0 + DAMPING * rng.standard_normal()),
        "link_inertia": joint.link_inertia_kg_m2,
        "link_damping": LINK_DAMPING_NM_S_RAD,
        "gravity": GRAVITY_NM,
        "motor_counts": 65536,
        "link_bits": 17,
        "torque_noise": 0.01,
        "size": 8.0,
        "period": PERIOD_S,
        "seconds": seconds,
        "seed": int(rng.integers(1, 2**31)),
        **(EFFECTS[str(joint.effect)] if active else {}),
    }


def joint_file(joint: Joint, error: float) -> str:
    """Its TOML, with an inertia that is a little off."""
    return (
        f'name = "{joint.name}"\narrangement = "single"\n[[motor]]\n'
        f"inertia_kg_m2 = {joint.inertia_kg_m2 * (1.0 + error):.6g}\nviscous_damping_nm_s_rad = 0.7\n"
        '[motor.transmission]\nmodel = "linear"\n[link.dynamics]\n'
        f"inertia_kg_m2 = {joint.link_inertia_kg_m2:.6g}\nviscous_damping_nm_s_rad = 0.12\ngravity_nm = 4.0\n"
        f"[bus]\nperiod_s = {PERIOD_S:g}\n"
    )


def write_csv(path: Path, world: dict) -> None:
    """Simulate one recording."""
    record = simulate(**world).record
    columns = (record.time_s, record.motor_position_rad, record.motor_torque_nm, record.link_position_rad)
    names = "time_s,motor1_position_rad,motor1_torque_nm,link_position_rad"
    np.savetxt(path, np.column_stack(columns), delimiter=",", header=names, comments="", fmt="%.9g")


def make(folder: Path, joints: int, nights: int, seconds: float, seed: int) -> list[Joint]:
    """Write a fleet; return what is true of it."""
    rng = np.random.default_rng(seed)
    truth = fleet(joints, nights, rng)
    for name in ("joints", "recordings"):
        (folder / name).mkdir(parents=True, exist_ok=True)
    jobs = []
    for joint in truth:
        text = joint_file(joint, float(rng.uniform(-0.005, 0.005)))
        (folder / "joints" / f"{joint.name}.toml").write_text(text, encoding="utf-8")
        for night in range(nights):
            path = folder / "recordings" / f"{joint.name}-{FIRST_NIGHT + timedelta(days=night)}.csv"
            jobs.append((path, settings(joint, night, nights, seconds, rng)))
    program()  # compiled once, before the threads ask for it
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        list(pool.map(write_csv, *zip(*jobs, strict=True)))
    entries = [{name: getattr(joint, name) for name in Joint.__slots__} for joint in truth]
    (folder / "truth.json").write_text(json.dumps(entries, indent=1) + "\n", encoding="utf-8")
    return truth


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("folder", type=Path, metavar="DIR")
    parser.add_argument("--joints", type=int, default=40)
    parser.add_argument("--nights", type=int, default=25)
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    made = make(args.folder, args.joints, args.nights, args.seconds, args.seed)
    print(f"{len(made)} joints, {len(made) * args.nights} recordings in {args.folder}")
