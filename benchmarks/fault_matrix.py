"""Plausible lies of one signal: how much of what is called valid is wrong, and how much of that has no flag?

    python benchmarks/fault_matrix.py [--joints constant,vsa-ii,"vsa-ii fitted"] [--seconds 15] [--seed 0]

In lockstep on the project's simulated joints: seconds of health, then as many of one fault (kinds, sizes and
signals: `tests/faultmatrix.py`). Wrong is off by more than 10 % and by more than five standard deviations.
Then true changes of the stiffness, which are to be followed: the share of the last two seconds that is valid
and within 5 %.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

import numpy as np

from drivelink.output.progress import track

sys.path.insert(0, str(Path(__file__).parent.parent / "tests"))

import faultmatrix as matrix


def measure(joint, seconds, seed):
    """One joint: totals, the worst faults, health, steps."""
    rows = {}
    for fault in track(list(matrix.FAULTS), f"{joint}: faults"):
        rows[f"{' + '.join(fault.signals)}: {fault.name}"] = matrix.outcome(
            joint, fault, seconds, seconds, seed
        )
    samples, valid, wrong, silent = np.sum([list(row) for row in rows.values()], axis=0).tolist()
    worst = sorted(rows.items(), key=lambda item: -item[1].wrong)[:10]
    health = matrix.outcome(joint, None, seconds, seconds, seed)
    return {
        "joint": joint,
        "samples": samples,
        "valid": valid,
        "wrong": wrong,
        "silent": silent,
        "healthy_valid": health.valid / health.samples,
        "worst": {name: row._asdict() for name, row in worst if row.wrong},
        "followed": {
            factor: matrix.stepped(joint, factor, seconds, seconds, seed)[1] for factor in matrix.STEPS
        },
    }


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--joints", default=",".join(matrix.JOINTS))
    parser.add_argument("--seconds", type=float, default=15.0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", action="store_true")
    args = parser.parse_args()
    found = [measure(joint, args.seconds, args.seed) for joint in args.joints.split(",")]
    if args.json:
        print(json.dumps(found))
        return
    print("| joint | valid samples | wrong | wrong without any flag | healthy and valid | steps followed |")
    print("|---|---|---|---|---|---|")
    for row in found:
        shares = [100 * row[key] / max(row["valid"], 1) for key in ("wrong", "silent")]
        followed = ", ".join(f"x{factor:g} {share:.0%}" for factor, share in row["followed"].items())
        print(
            f"| {row['joint']} | {row['valid']} | {row['wrong']} ({shares[0]:.2f} %) "
            f"| {row['silent']} ({shares[1]:.2f} %) | {row['healthy_valid']:.2%} | {followed} |"
        )
    for row in found:
        for name, outcome in row["worst"].items():
            print(f"{row['joint']}: {name}: {outcome}")


if __name__ == "__main__":
    main()
