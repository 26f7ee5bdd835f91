"""The gate for units, signs, gears and time: what it finds, misses and takes for wrong, on random joints.

    python benchmarks/gate.py [--seeds N] [--first N] [--kinds soft,stiff,…]

Joints of every kind (`tests/gatekit.py`) with undeclared effects, late channels and an inertia up to a fifth
off: as they are, and with each fault of a first installation. A fault counts as named where the correction,
or one that the finding says cannot be separated from it, undoes it to 5 %.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator

import scene
from scene import gatekit

from estimator.gate import Discrepancy, examine


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


def rows(args) -> Iterator[scene.Row]:
    """One row a fault."""
    counts: dict[str, Counter[str]] = {}
    for kind in args.kinds:
        for seed in range(args.first, args.first + args.seeds):
            drawn = gatekit.draw(kind, seed)
            wrong = bool(examine(drawn.record, drawn.model))
            counts.setdefault("healthy", Counter())["else" if wrong else "named"] += 1
            for name, factors in gatekit.faults(drawn).items():
                findings = examine(gatekit.faulty(drawn.record, factors), drawn.model)
                counts.setdefault(name, Counter())[outcome(findings, factors)] += 1
    for name, count in counts.items():
        each = {key: count[key] for key in ("named", "else", "missed")}
        yield {"fault": name, "joints": count.total(), **each}


if __name__ == "__main__":
    columns = {name: f"{{{name}}}" for name in ("fault", "joints", "named")}
    columns |= {"another cause": "{else}", "missed": "{missed}"}
    options = scene.Option("--seeds", 4), scene.Option("--first", 200)
    scene.main(__doc__, rows, columns, *options, scene.Option("--kinds", list(gatekit.KINDS)))
