"""Plausible sensor faults: how many samples called valid are wrong, and how many of those carry no flag?

    python benchmarks/fault_matrix.py [--joints constant,vsa-ii,"vsa-ii fitted"] [--health 15] [--seconds 15]

In lockstep on the project's simulated joints, seeded (--seed): seconds of health, then as many of one fault
(kinds, sizes and signals: `tests/faultmatrix.py`). Wrong is off by more than 10 % and by more than five
standard deviations. Named is a fault whose signal `suspected` names most often, of those in which it names
any. Then true changes of the stiffness, which are to be followed: the share of the last two seconds that is
within 5 % and valid, or, with a fitted file, has the model alarm instead.

With --sizes instead: for each kind of fault the largest size up to which nothing is said of it in eight
seconds (every sample valid, no flag), and by how much the stiffness is off then.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.progress import track

sys.path.insert(0, str(Path(__file__).parent.parent / "tests"))

import faultmatrix as matrix


def measure(joint, health, seconds, seed):
    """One joint: totals, the worst faults, health, steps."""
    rows, suspects, right = {}, 0, 0
    for fault in track(list(matrix.FAULTS), f"{joint}: faults", console=Console(stderr=True)):
        outcome = matrix.outcome(joint, fault, health, seconds, seed)
        rows[f"{' + '.join(fault.signals)}: {fault.name}"] = outcome
        suspects += bool(outcome.suspected)
        right += outcome.names(fault)
    samples, valid, wrong, silent = np.sum([row[:4] for row in rows.values()], axis=0).tolist()
    worst = sorted(rows.items(), key=lambda item: -item[1].wrong)[:10]
    healthy = matrix.outcome(joint, None, health, seconds, seed)
    return {
        "joint": joint,
        "samples": samples,
        "valid": valid,
        "wrong": wrong,
        "silent": silent,
        "suspects": suspects,
        "named": right,
        "healthy_valid": healthy.valid / healthy.samples,
        "worst": {name: row._asdict() for name, row in worst if row.wrong},
        "followed": {
            factor: matrix.stepped(joint, factor, health, seconds, seed)[1] for factor in matrix.STEPS
        },
    }


def sizes(joints, seed):
    """The table of what is not noticed."""
    print(
        "| fault | "
        + " | ".join(f"{joint}: unnoticed up to | error of the stiffness" for joint in joints)
        + " |"
    )
    print("|---|" + "---|---|" * len(joints))
    for kind, (text, _, signals, _) in matrix.LADDERS.items():
        for signal in signals:
            cells = []
            for joint in joints:
                size, error = matrix.unnoticed(joint, kind, signal, health_s=8.0, fault_s=8.0, seed=seed)
                cells += [text.format(size) if size else "always noticed", f"{error:.1%}" if size else ""]
            print(f"| {signal}: {kind} | " + " | ".join(cells) + " |", flush=True)


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--joints", default=",".join(matrix.JOINTS))
    parser.add_argument("--health", type=float, default=15.0, metavar="SECONDS")
    parser.add_argument("--seconds", type=float, default=15.0, help="of each fault")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--sizes", action="store_true", help="what is not noticed, and up to which size")
    parser.add_argument("--json", action="store_true")
    args = parser.parse_args()
    if args.sizes:
        sizes(args.joints.split(","), args.seed)
        return
    found = [measure(joint, args.health, args.seconds, args.seed) for joint in args.joints.split(",")]
    if args.json:
        print(json.dumps(found))
        return
    print("| joint | valid samples | wrong | without any flag | named | healthy and valid | steps followed |")
    print("|---|---|---|---|---|---|---|")
    for row in found:
        shares = [100 * row[key] / max(row["valid"], 1) for key in ("wrong", "silent")]
        followed = ", ".join(f"x{factor:g} {share:.0%}" for factor, share in row["followed"].items())
        print(
            f"| {row['joint']} | {row['valid']} | {row['wrong']} ({shares[0]:.2f} %) "
            f"| {row['silent']} ({shares[1]:.2f} %) | {row['named']} of {row['suspects']} "
            f"| {row['healthy_valid']:.2%} | {followed} |"
        )
    for row in found:
        for name, outcome in row["worst"].items():
            print(f"{row['joint']}: {name}: {outcome}")


if __name__ == "__main__":
    main()
