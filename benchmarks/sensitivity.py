"""What the paper leaves to future work: noise, sampling and wrong parameters, both modes side by side.

    python benchmarks/sensitivity.py [--plots DIR] [--json]

A soft joint (K 150 N·m/rad, cubic part 10 % at its largest deflection) under a rich torque for 12 s. One
thing at a time is made worse; the rest stays at: 16384 counts a revolution, 18-bit link encoder, velocity in
steps of 1 rpm, torque noise 0.2 % of rated, 1 kHz. Errors are root mean squares along the motion after 4 s,
relative to the truth's: the robust mode's stiffness (model-based), the paper's by recursive least squares on
its residual (MBE) and by its regressor (BBE), and both modes' torque.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from estimator import EstimatorSettings, JointModel, Motor, Transmission, make_estimator

sys.path.insert(0, str(Path(__file__).parent.parent / "tests"))

import joints

B, D, M, DQ, G, K1, K3 = 0.125, 0.8, 0.45, 0.2, 5.0, 150.0, 1500.0
RATED_NM = 20.0
SECONDS, SETTLED_S = 12.0, 4.0
FILLS = ("#ffffff", "#56b4e9", "#bbbbbb")
COLUMNS = (
    "stiffness, robust",
    "stiffness, paper MBE",
    "stiffness, paper BBE",
    "torque, robust",
    "torque, paper",
)


@dataclass(frozen=True)
class Setting:
    """One row of the table."""

    counts: float = 16384.0
    torque_noise: float = 0.002
    period_s: float = 1e-3
    inertia: float = 1.0
    damping: float = 1.0
    coulomb_nm: float = 0.0
    delay_periods: int = 0


AXES: dict[str, list[tuple[str, Setting]]] = {
    "encoder / counts": [(f"{c}", Setting(counts=float(c))) for c in (65536, 16384, 4096)],
    "torque noise / rated": [(f"{x:.1%}", Setting(torque_noise=x)) for x in (0.0, 0.002, 0.005, 0.02)],
    "sampling / Hz": [(f"{1 / T:.0f}", Setting(period_s=T)) for T in (5e-4, 1e-3, 2e-3, 4e-3)],
    "inertia declared": [(f"{x - 1:+.0%}", Setting(inertia=x)) for x in (0.95, 1.0, 1.02, 1.05, 1.1)],
    "damping declared": [(f"{x - 1:+.0%}", Setting(damping=x)) for x in (0.5, 0.8, 1.0, 1.2)],
    "undeclared friction / N·m": [(f"{x:g}", Setting(coulomb_nm=x)) for x in (0.0, 0.1, 0.25, 0.5)],
    "link delay / periods": [(f"{x}", Setting(delay_periods=x)) for x in (0, 1, 2)],
}


def simulate(period: float, coulomb: float) -> joints.Truth:
    """A sum of seven tones, held over each period."""
    n = round(SECONDS / period)
    phases = np.random.default_rng(3).uniform(0, 2 * math.pi, 7)
    angles = 2 * math.pi * np.outer(np.arange(n) * period, np.geomspace(0.2, 3.0, 7)) + phases
    tau = 8.0 / math.sqrt(3.5) * np.sin(angles).sum(axis=1)
    torque, stiffness = joints.polynomial(np.array([[[K1, K3]]]))
    one = np.ones(1)
    plants = joints.Plants(
        torque, stiffness, B * one, D * one, M * one, DQ * one, G * one, coulomb=coulomb * one
    )
    return joints.simulate(plants, tau[:, None, None], period, substeps=max(2, round(period / 5e-4)))


def errors(setting: Setting, motion: joints.Truth) -> list[float]:
    """The five relative errors of COLUMNS."""
    T, n = setting.period_s, len(motion.tau)
    rng = np.random.default_rng(1)
    record = joints.record(
        motion,
        0,
        T,
        motor_counts=setting.counts,
        link_bits=18,
        velocity_rad_s=2 * math.pi / 60,
        torque_noise=rng.normal(0, setting.torque_noise * RATED_NM, (n, 1)),
        link_delay=setting.delay_periods,
    )
    transmission = Transmission(model="polynomial", order=2)
    motor = Motor(
        inertia_kg_m2=setting.inertia * B,
        viscous_damping_nm_s_rad=setting.damping * D,
        transmission=transmission,
    )
    model = JointModel(arrangement="single", motors=(motor,))
    truth = {2: motion.tau_e[:, 0, 0], 3: motion.sigma[:, 0, 0]}
    late = np.arange(n) * T > SETTLED_S
    runs = {}
    robust = EstimatorSettings()
    paper = EstimatorSettings(mode="paper", k_r_s2_rad2=1.0)
    for name, settings in (("robust", robust), ("mbe", replace(paper, method="mbe")), ("bbe", paper)):
        estimator = make_estimator(model, settings, T)
        runs[name] = np.array([estimator.step(sample)[:4] for sample in record.samples()])

    def error(name: str, column: int) -> float:
        off = (runs[name][late, column] - truth[column][late]) ** 2
        return float(np.sqrt(np.mean(off) / np.mean(truth[column][late] ** 2)))

    return [error("robust", 3), error("mbe", 3), error("bbe", 3), error("robust", 2), error("mbe", 2)]


def plot(results: dict[str, dict[str, list[float]]], folder: Path) -> Path:
    from drivelink.output.plots import HATCHES, new_figure, save, xy

    folder.mkdir(parents=True, exist_ok=True)
    figure, axes = new_figure("Sensitivity: relative error of the stiffness", rows=len(results), height=2.2)
    for place, (axis, rows) in zip(axes, results.items(), strict=True):
        across = np.arange(len(rows))
        for i in range(3):
            heights = [100 * row[i] for row in rows.values()]
            look = {"color": FILLS[i], "edgecolor": "#222222", "hatch": HATCHES[i], "label": COLUMNS[i]}
            place.bar(across + 0.27 * (i - 1), heights, width=0.25, **look)
        place.set_xticks(across, rows)
        place.set_yscale("log")
        xy(place, {}, "", "error / %", axis)
    return save(figure, folder / "sensitivity.png")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--json", action="store_true", help="print one JSON object only")
    parser.add_argument("--plots", type=Path, metavar="DIR", help="write sensitivity.png there")
    args = parser.parse_args()
    motions: dict[tuple[float, float], joints.Truth] = {}
    results: dict[str, dict[str, list[float]]] = {}
    for axis, settings in AXES.items():
        results[axis] = {}
        for label, setting in settings:
            key = (setting.period_s, setting.coulomb_nm)
            if key not in motions:
                motions[key] = simulate(*key)
            results[axis][label] = errors(setting, motions[key])
    if args.plots is not None:
        plot(results, args.plots)
    if args.json:
        print(json.dumps({"columns": COLUMNS, "results": results}))
        return
    table = Table(title="Relative error along the motion", title_justify="left")
    for column in ("", "", *COLUMNS):
        table.add_column(column, justify="right" if column else "left")
    for axis, rows in results.items():
        for k, (label, row) in enumerate(rows.items()):
            table.add_row(
                axis if k == 0 else "", label, *(f"{x:.3%}" for x in row), end_section=k + 1 == len(rows)
            )
    Console(width=130).print(table)


if __name__ == "__main__":
    main()
