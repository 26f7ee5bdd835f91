"""Effects that no joint file names, on joints of an independent simulator in C (`world.c`): what the on-line
estimator makes of each.

    python benchmarks/undeclared.py [--mode robust|paper] [--joints 8] [--seconds 30] [--effects NAME,…]
                                    [--motion multisine|point-to-point|hand-guided|pushes|harmonic]

Random joints with cubic springs, order declared, read as drives read them: 4096 to 16384 counts, 16 to 18
bits at the link, no velocity, torque noise of 0.1 to 0.5 % of rated. Judged from five seconds on, where the
estimate is valid and observable: its error against the slope of the spring, relative to that slope (in a gap,
to 0.3 of its rms); the share of its 95 % intervals that hold the slope. Effects are 3 to 8 % of the torque's
amplitude. Names are counted by joints: in the end, and those that are given up again; the time is the median
to the first of either.
"""

from __future__ import annotations

import functools
import subprocess
import tempfile
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
import scene
from ensembles import COLUMNS, T, run, summary

from estimator import JointModel, Motor, Record, Transmission

HERE = Path(__file__).parent


class World(NamedTuple):
    """A recording of `world.c`, and the truth at each of its rows."""

    record: Record
    stiffness_nm_rad: np.ndarray
    flexibility_torque_nm: np.ndarray
    external_torque_nm: np.ndarray


@functools.cache
def program() -> tuple[Path, tempfile.TemporaryDirectory]:
    """Compile `world.c`; the folder lives as long as this process."""
    folder = tempfile.TemporaryDirectory(prefix="world")
    path = Path(folder.name) / "world"
    subprocess.run(["cc", "-O2", "-std=c11", "-o", path, HERE / "world.c", "-lm"], check=True)
    return path, folder


def simulate(played: str | None = None, **settings: float | str) -> World:
    """Run a joint with these settings (`world help` lists them); `played`: positions and velocities."""
    arguments = [f"{name}={value}" for name, value in settings.items()]
    done = subprocess.run(
        [program()[0], *arguments], input=played, capture_output=True, text=True, check=False
    )
    if done.returncode:
        raise SystemExit(f"world.c: {done.stderr.strip()}")
    names, *lines = done.stdout.splitlines()
    table = np.array([line.split(",") for line in lines], dtype=float).T
    column = dict(zip(names.split(","), table, strict=True))
    record = Record(
        period_s=float(settings.get("period", T)),
        sequence=np.arange(len(lines)),
        motor_position_rad=column["motor1_position_rad"][:, None],
        motor_torque_nm=column["motor1_torque_nm"][:, None],
        link_position_rad=column["link_position_rad"],
    )
    truth = (
        column[f"true_{name}"] for name in ("stiffness_nm_rad", "flexibility_torque_nm", "external_torque_nm")
    )
    return World(record, *truth)


def effects(rng: np.random.Generator, rated: float, stiffness: float) -> dict[str, dict[str, float | str]]:
    """Settings of each undeclared effect, of a joint of this rated torque, N·m, and stiffness, N·m/rad."""
    torque, share = rated * rng.uniform(0.03, 0.08), rng.uniform(0.03, 0.08)
    friction = {"coulomb": torque, "stribeck": rng.uniform(0.3, 0.8)}
    width = rng.uniform(0.03, 0.15) * rated / stiffness  # of the deflection at rated torque
    return {
        "nothing": {},
        "link 1 period late": {"link_delay": T},
        "link 3 periods late": {"link_delay": 3 * T},
        "Coulomb friction": {"friction": "coulomb", "coulomb": torque},
        "Stribeck friction": {"friction": "stribeck", **friction},
        "LuGre friction": {"friction": "lugre", **friction},
        "gear loss": {"gear_loss": share},
        "LuGre friction and gear loss": {"friction": "lugre", **friction, "gear_loss": share},
        "hysteresis, Bouc-Wen": {
            "hysteresis": "bouc-wen",
            "hysteresis_torque": torque,
            "hysteresis_width": width,
        },
        "hysteresis, Dahl": {"hysteresis": "dahl", "hysteresis_torque": torque, "hysteresis_width": width},
        "backlash": {"backlash": width},
        "transmission damping": {"transmission_damping": stiffness * rng.uniform(0.5e-3, 3e-3)},
        "cogging": {"cogging": torque / 2, "cogging_periods": int(rng.integers(8, 64))},
        "inertia 5 % off": {},
        "damping 20 % off": {},
        "motor of 1024 counts": {"motor_counts": 1024},
        "torque noise 2 % of rated": {"torque_noise": 0.02 * rated},
    }


EFFECTS = tuple(effects(np.random.default_rng(0), 1.0, 1.0))


def draw(effect: str, seed: int, seconds: float, motion: str) -> tuple[JointModel, World]:
    """A random joint, the same for every effect, with this one: as it is declared, and what it does."""
    rng = np.random.default_rng(seed)
    stiffness, size = rng.uniform(80, 220), rng.uniform(5, 10)
    inertia, damping = rng.uniform(0.08, 0.2), rng.uniform(0.4, 1.2)
    point_to_point = motion == "point-to-point"
    settings = {
        "spring": "cubic",
        "stiffness": stiffness,
        "cubic": stiffness * rng.uniform(0.03, 0.3) / 0.06**2,
        "inertia": inertia,
        "damping": damping,
        "link_inertia": rng.uniform(0.3, 0.6),
        "link_damping": rng.uniform(0.1, 1),
        "gravity": rng.uniform(0, 6),
        "motor_counts": int(rng.choice([4096, 8192, 16384])),
        "link_bits": int(rng.choice([16, 17, 18])),
        "torque_noise": rng.uniform(0.001, 0.005) * 2 * size,
        "motion": motion,
        "size": rng.uniform(0.5, 1.2) if point_to_point else size,
        "top_hz": rng.uniform(0.5, 2.0) if motion == "harmonic" else 3.0,
        "push": size / 2 if motion == "pushes" else size,
        "seconds": seconds,
        "seed": seed,
    }
    declared = inertia * (1.05 if effect == "inertia 5 % off" else 1.0)
    losses = damping * (0.8 if effect == "damping 20 % off" else 1.0)
    spring = Transmission(model="polynomial", order=2, parameters={})
    motor = Motor(inertia_kg_m2=declared, viscous_damping_nm_s_rad=losses, transmission=spring)
    world = simulate(**(settings | effects(rng, size, stiffness)[effect]))
    return JointModel(arrangement="single", motors=(motor,)), world


def counted(found: list[scene.Row], key: str) -> str | None:
    """Names with the number of joints."""
    counts = Counter(name for one in found for name in one[key])
    return ", ".join(f"{name} {count}" for name, count in counts.items()) or None


def rows(args) -> Iterator[scene.Row]:
    """One row an effect."""
    for effect in args.effects:
        found = []
        for seed in range(1, args.joints + 1):
            model, world = draw(effect, seed, args.seconds, args.motion)
            found.append(run(model, world.record, world.stiffness_nm_rad, args.mode))
        after = [one["named_after_s"] for one in found if np.isfinite(one["named_after_s"])]
        yield {
            "case": effect,
            **summary(found),
            "false_alarms": sum(one["false_alarms"] for one in found),
            **{key: counted(found, key) for key in ("names", "meanwhile")},
            "after_s": float(np.median(after)) if after else None,
        }


if __name__ == "__main__":
    columns = {"undeclared": "{case}", **dict(list(COLUMNS.items())[1:-1])}
    scene.main(
        __doc__,
        rows,
        {
            **columns,
            "changes said": "{false_alarms}",
            "named in the end": "{names}",
            "only meanwhile": "{meanwhile}",
            "first after / s": "{after_s:.0f}",
        },
        scene.Option("--mode", ("robust", "paper")),
        scene.Option("--joints", 8),
        scene.Option("--seconds", 30.0),
        scene.Option("--motion", ("multisine", "point-to-point", "hand-guided", "pushes", "harmonic")),
        scene.Option("--effects", list(EFFECTS)),
    )
