"""Control with estimated springs: tracking errors of two laws beside the true and the nominal model.

    python benchmarks/control.py [--seeds N] [--jobs N] [--plots DIR] [--json FILE]

Drives, the daemon's own code and the controller of examples/controller run in lockstep, so that the same
seeds give the same numbers everywhere. Each run identifies the springs for 20 s, then follows its reference
twice: in peace ("quiet") and while a torque of 1 mN·m rms that nobody declared pushes the link ("pushed").
Nominal is a model whose torque, stiffness and derivatives are 20 % too low. --json: medians over the seeds.
"""

from __future__ import annotations

import argparse
import itertools
import json
import os
import statistics
import sys
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict
from pathlib import Path

from rich.console import Console
from rich.progress import track

sys.path.insert(0, str(Path(__file__).parent.parent / "examples" / "controller"))

from vsacontrol.study import KNOWLEDGE, LAWS, Outcome, draw, follow, ratios, table

MEASURES = ("q_rms_rad", "q_max_rad", "sigma_rms_nm_rad", "sigma_max_nm_rad")


def run_all(seeds: int, jobs: int) -> dict[int, list[Outcome]]:
    """All outcomes by seed."""
    cases = list(itertools.product(range(seeds), LAWS, KNOWLEDGE))
    with ProcessPoolExecutor(jobs) as pool:
        runs = [pool.submit(follow, law, knowledge, seed=seed) for seed, law, knowledge in cases]
        found: dict[int, list[Outcome]] = {seed: [] for seed in range(seeds)}
        for (seed, _, _), run in track(
            list(zip(cases, runs, strict=True)), "runs", console=Console(stderr=True)
        ):
            found[seed] += run.result()
    return found


def summary(found: dict[int, list[Outcome]]) -> list[dict[str, object]]:
    """One row for each law, scene and model: medians over the seeds."""
    compared = {seed: ratios(outcomes) for seed, outcomes in found.items()}
    rows: list[dict[str, object]] = []
    for law, scene, knowledge in compared[0]:
        key = (law, scene, knowledge)
        errors = [
            asdict(o.errors)
            for outcomes in found.values()
            for o in outcomes
            if (o.law, o.scene, o.knowledge) == key
        ]
        medians = {name: statistics.median(e[name] for e in errors) for name in MEASURES}
        relative = {
            name: statistics.median(by_seed[key][name] for by_seed in compared.values())
            for name in compared[0][key]
        }
        rows.append({"law": law, "scene": scene, "model": knowledge, **medians, **relative})
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--plots", type=Path, help="folder for the plots of the first seed")
    parser.add_argument("--json", type=Path, help="file for the medians")
    args = parser.parse_args()
    found = run_all(args.seeds, args.jobs)
    for seed, outcomes in found.items():
        print(f"seed {seed}\n\n{table(outcomes)}\n")
    if args.plots:
        for path in draw(found[0], args.plots):
            print(path)
    if args.json:
        args.json.write_text(json.dumps(summary(found), indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
