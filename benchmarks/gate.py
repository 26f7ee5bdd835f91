"""The gate for units, signs, gears and time: what it finds, misses and takes for wrong, on random joints.

    python benchmarks/gate.py [--seeds N] [--first N] [--kinds soft,stiff,…] [--json FILE]

Joints of every kind (`tests/gatekit.py`) with undeclared effects, late channels and an inertia up to a fifth
off: as they are, and with each fault of a first installation. A fault counts as named where the correction,
or one that the finding says cannot be separated from it, undoes it to 5 %.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections import Counter
from pathlib import Path

from rich.console import Console
from rich.progress import track

from estimator.gate import Discrepancy, examine

sys.path.insert(0, str(Path(__file__).parent.parent / "tests"))

import gatekit


def outcome(findings: list[Discrepancy], factors: dict[str, float]) -> str:
    """ "named", "else" (another cause) or "missed"."""
    if not findings:
        return "missed"
    options = [[f.changes for f in findings]]
    for k, finding in enumerate(findings):
        options += [[*options[0][:k], other, *options[0][k + 1 :]] for other in finding.alternatives]
    for option in options:
        changes = {c.channel: c.factor for group in option for c in group}
        if gatekit.named_rightly(factors, changes, lambda a, b: abs(a / b - 1.0) < 0.05):
            return "named"
    return "else"


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--seeds", type=int, default=4, metavar="N")
    parser.add_argument("--first", type=int, default=200, metavar="N")
    parser.add_argument("--kinds", default=",".join(gatekit.KINDS), metavar="K,…")
    parser.add_argument("--json", type=Path, metavar="FILE")
    args = parser.parse_args()
    counts: dict[str, Counter[str]] = {}
    jobs = [(k, s) for k in args.kinds.split(",") for s in range(args.first, args.first + args.seeds)]
    for kind, seed in track(jobs, "gate", console=Console(stderr=True)):
        drawn = gatekit.draw(kind, seed)
        wrong = bool(examine(drawn.record, drawn.model))
        counts.setdefault("healthy", Counter())["else" if wrong else "named"] += 1
        for name, factors in gatekit.faults(drawn).items():
            findings = examine(gatekit.faulty(drawn.record, factors), drawn.model)
            counts.setdefault(name, Counter())[outcome(findings, factors)] += 1
    print("| fault | joints | named | another cause | missed |\n|---|---|---|---|---|")
    for name, count in counts.items():
        print(f"| {name} | {count.total()} | {count['named']} | {count['else']} | {count['missed']} |")
    if args.json:
        args.json.write_text(json.dumps(counts, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
