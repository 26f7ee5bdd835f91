"""How cost grows: with the length of a recording (fit, diagnose), and with the effects in the model (a tick).

    python benchmarks/growth.py [--seconds 10,20,40] [--diagnose-seconds 10,20] [--json FILE]

CPU time of one thread; the baseline is the first row of each table. Recordings are of the paper's quadratic
joint as `drivelink sim` makes it, with friction that the model lacks.
"""

from __future__ import annotations

import argparse
import json
import statistics
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from rig import PERIOD_S, free_endpoint, joint

from drivelink.demo.simulate import world_from_joint
from estimator import Record, fit, make_estimator
from estimator.diagnosis import diagnose
from estimator.model import Effect, JointModel
from sim.world import record

EFFECTS = (
    Effect(name="coulomb_friction", parameters={"torque_nm": 0.02, "smoothing_rad_s": 0.01}),
    Effect(name="torque_offset", parameters={"torque_nm": 0.005}),
    Effect(name="cogging", parameters={"sin_nm": 0.002, "cos_nm": 0.002, "periods_per_rev": 12.0}),
    Effect(
        name="hysteresis",
        parameters={"torque_nm": 0.01, "displacement_rad": 0.02, "exponent": 1.0, "shape": 0.5},
    ),
)
TICKS = 6000


def recording(seconds: float) -> Record:
    """One motor at 1 kHz."""
    world = world_from_joint(joint("robust", free_endpoint(), motors=1), effects=["coulomb_friction=0.0005"])
    columns = record(world, seconds)
    return Record(
        period_s=PERIOD_S,
        sequence=np.arange(len(columns["time_s"])),
        motor_position_rad=columns["motor1_position_rad"][:, None],
        motor_torque_nm=columns["motor1_torque_nm"][:, None],
        link_position_rad=columns["link_position_rad"],
    )


def cpu_s(action: Any) -> float:
    """CPU time of a call."""
    start = time.thread_time()
    action()
    return time.thread_time() - start


def tick_us(model: JointModel, data: Record) -> float:
    """Median of one tick."""
    settings = joint("robust", free_endpoint(), motors=1).estimator
    estimator = make_estimator(model, settings, PERIOD_S)
    clock, spent = time.thread_time_ns, []
    for sample in data.samples():
        start = clock()
        estimator.step(sample)
        spent.append(clock() - start)
    return statistics.median(spent[len(spent) // 2 :]) / 1e3


def measure(fit_s: list[float], diagnose_s: list[float]) -> dict[str, list[dict[str, Any]]]:
    """All tables."""
    model = joint("robust", free_endpoint(), motors=1).model()
    data = {seconds: recording(seconds) for seconds in sorted({*fit_s, *diagnose_s, TICKS * PERIOD_S})}
    (motor,) = model.motors
    ticks = []
    for count in range(len(EFFECTS) + 1):
        declared = replace(model, motors=(replace(motor, effects=EFFECTS[:count]),))
        ticks.append({"what": f"effects: {count}", "cost": tick_us(declared, data[TICKS * PERIOD_S])})
    return {
        "fit, CPU s": [{"what": f"{s:g} s", "cost": cpu_s(lambda s=s: fit(data[s], model))} for s in fit_s],
        "diagnose, CPU s": [
            {"what": f"{s:g} s", "cost": cpu_s(lambda s=s: diagnose(data[s], model))} for s in diagnose_s
        ],
        "one tick of one motor, CPU µs": ticks,
    }


def report(tables: dict[str, list[dict[str, Any]]]) -> str:
    """The tables in Markdown."""
    lines = []
    for title, rows in tables.items():
        lines += [f"| {title} | | of the first |", "|---|---|---|"]
        lines += [f"| {r['what']} | {r['cost']:.3g} | {r['cost'] / rows[0]['cost']:.2f}× |" for r in rows]
        lines.append("")
    return "\n".join(lines)


def numbers(text: str) -> list[float]:
    """Of a list with commas."""
    return [float(part) for part in text.split(",")]


def main() -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--seconds", type=numbers, default=[10.0, 20.0, 40.0], help="of recordings to fit")
    parser.add_argument("--diagnose-seconds", type=numbers, default=[10.0, 20.0], help="… and to diagnose")
    parser.add_argument("--json", type=Path, help="also write the numbers there")
    args = parser.parse_args()
    tables = measure(args.seconds, args.diagnose_seconds)
    print(report(tables))
    if args.json:
        args.json.write_text(json.dumps(tables, indent=1), encoding="utf-8")


if __name__ == "__main__":
    main()
