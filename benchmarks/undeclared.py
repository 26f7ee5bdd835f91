"""Effects that no joint file names, on joints of an independent simulator in C (`world.c`): what the on-line
estimator makes of each.

    python benchmarks/undeclared.py [--mode robust|balance] [--joints 8] [--seconds 30] [--effects NAME,…]
                                    [--motion multisine|point-to-point|hand-guided|pushes|harmonic] [--json]

Random joints with cubic springs, order declared, read as drives read them: 4096 to 16384 counts, 16 to 18
bits at the link, no velocity, torque noise of 0.1 to 0.5 % of rated. Judged from five seconds on, where the
estimate is valid and observable: its error against the slope of the spring, relative to that slope's rms;
the share of its 95 % intervals that hold the slope. Effects are 3 to 8 % of the torque's amplitude. `named`
counts joints in which an effect is named in the end, `after` is the median time to the first name.
"""

from __future__ import annotations

import argparse
import functools
import json
import subprocess
import tempfile
from collections import Counter
from pathlib import Path
from typing import NamedTuple

import numpy as np

from estimator import (
    EstimatorSettings,
    JointModel,
    Motor,
    Record,
    Status,
    Transmission,
    make_estimator,
)
from estimator.sample import SIGMA_95

T = 1e-3
SETTLED_S = 5.0
USABLE = int(Status.VALID | Status.OBSERVABLE)
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


def simulate(**settings: float | str) -> World:
    """Run a joint with these settings (`world help` lists them)."""
    arguments = [f"{name}={value}" for name, value in settings.items()]
    done = subprocess.run([program()[0], *arguments], capture_output=True, text=True, check=False)
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
    spring = Transmission(model="polynomial", order=2, parameters={})
    motor = Motor(inertia_kg_m2=declared, viscous_damping_nm_s_rad=damping, transmission=spring)
    world = simulate(**(settings | effects(rng, size, stiffness)[effect]))
    return JointModel(arrangement="single", motors=(motor,)), world


class Judged(NamedTuple):
    """One joint: what the estimate of its stiffness is worth; nan: never usable."""

    usable: float
    rmse: float
    coverage: float
    std: float
    names: tuple[str, ...]
    named_after_s: float


def judge(model: JointModel, world: World, mode: str) -> Judged:
    """Run the on-line estimator over a recording."""
    estimator = make_estimator(model, EstimatorSettings(mode=mode), T)
    stiffness, std, usable = (np.zeros(len(world.record)) for _ in range(3))
    after = np.nan
    for k, sample in enumerate(world.record.samples()):
        _, status, _, stiffness[k], std[k] = estimator.step(sample)[:5]
        usable[k] = status & USABLE == USABLE and k * T >= SETTLED_S
        if k % 250 == 0 and np.isnan(after) and estimator.core.undeclared(0):
            after = k * T
    good = usable > 0
    names, truth = tuple(estimator.core.undeclared(0)), world.stiffness_nm_rad
    share = float(np.mean(usable[round(SETTLED_S / T) :]))
    if not good.any():
        return Judged(share, np.nan, np.nan, np.nan, names, after)
    error, size = stiffness[good] - truth[good], np.sqrt(np.mean(truth**2))
    held = np.mean(np.abs(error) < SIGMA_95 * std[good])
    return Judged(
        share, np.sqrt(np.mean(error**2)) / size, held, float(np.median(std[good])) / size, names, after
    )


def measure(effect: str, joints: int, seconds: float, motion: str, mode: str) -> dict:
    """One row of the table."""
    found = [judge(*draw(effect, seed, seconds, motion), mode) for seed in range(1, joints + 1)]
    usable, rmse, coverage, std = np.array([one[:4] for one in found]).T
    some = bool(np.isfinite(rmse).any())
    after = [one.named_after_s for one in found if np.isfinite(one.named_after_s)]
    return {
        "undeclared": effect,
        "usable": float(usable.mean()),
        "rmse_median": float(np.nanmedian(rmse)) if some else None,
        "rmse_worst": float(np.nanmax(rmse)) if some else None,
        "std_median": float(np.nanmedian(std)) if some else None,
        "coverage": float(np.nanmean(coverage)) if some else None,
        "coverage_worst": float(np.nanmin(coverage)) if some else None,
        "named": dict(Counter(name for one in found for name in one.names)),
        "named_after_s": float(np.median(after)) if after else None,
    }


def cells(row: dict) -> tuple[str, ...]:
    """A row in words."""

    def percent(name: str, digits: int) -> str:
        return "–" if row[name] is None else f"{100 * row[name]:.{digits}f}"

    names = ", ".join(f"{name} {count}" for name, count in row["named"].items()) or "–"
    after = "–" if row["named_after_s"] is None else f"{row['named_after_s']:.0f} s"
    return (
        row["undeclared"],
        percent("usable", 0),
        f"{percent('rmse_median', 2)} / {percent('rmse_worst', 2)}",
        percent("std_median", 3),
        f"{percent('coverage', 0)} / {percent('coverage_worst', 0)}",
        names,
        after,
    )


HEADER = (
    "undeclared",
    "valid %",
    "RMSE %: median / worst",
    "std %",
    "95 % intervals hold %: mean / worst",
    "named",
    "after",
)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--mode", choices=["robust", "balance", "paper"], default="robust")
    parser.add_argument("--joints", type=int, default=8)
    parser.add_argument("--seconds", type=float, default=30.0)
    parser.add_argument("--motion", default="multisine")
    parser.add_argument("--effects", default=",".join(name.replace(",", ";") for name in EFFECTS))
    parser.add_argument("--json", action="store_true")
    args = parser.parse_args()
    wanted = [name.replace(";", ",") for name in args.effects.split(",")]
    if unknown := set(wanted) - set(EFFECTS):
        parser.error(f"--effects: {', '.join(unknown)}: expected of {'; '.join(EFFECTS)}")
    if not args.json:
        print("| " + " | ".join(HEADER) + " |\n|" + "---|" * len(HEADER))
    rows = []
    for effect in wanted:
        rows.append(measure(effect, args.joints, args.seconds, args.motion, args.mode))
        if not args.json:
            print("| " + " | ".join(cells(rows[-1])) + " |", flush=True)
    if args.json:
        print(json.dumps(rows))


if __name__ == "__main__":
    main()
