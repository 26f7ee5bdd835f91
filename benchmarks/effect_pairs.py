"""Two missing effects at once: how often `diagnose` names both, on random joints from published seeds.

    python benchmarks/effect_pairs.py [--seeds N] [--first SEED] [--seconds S] [--json FILE]

Nine pairs over all places of a joint, the joints and sizes of diagnosis_seeds.py. An effect counts as named
where a finding has its name, and as listed where it is a likely alternative of one.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

from diagnosis_seeds import joint_of, listed, measured, wrong_and_certain
from rich.console import Console
from rich.progress import track

from estimator.diagnosis import diagnose

PAIRS = (
    ("coulomb_friction", "gravity"),
    ("cogging", "link_coulomb_friction"),
    ("hysteresis", "motor_inertia"),
    ("viscous_damping", "backlash"),
    ("torque_offset", "encoder_delay"),
    ("coulomb_friction", "kinematic_error"),
    ("torque_lag", "link_inertia"),
    ("back_driving_loss", "contact"),
    ("higher_order_stiffness", "encoder_eccentricity"),
)


def judged(pair: tuple[str, str], seed: int, seconds: float) -> dict[str, Any]:
    """One recording made and diagnosed."""
    declared, real = joint_of(pair, seed)
    outcome = diagnose(measured(real, seconds), declared.model())
    names = [effect.name for effect in outcome.effects]
    likely = listed(outcome.effects)
    return {
        "pair": pair,
        "seed": seed,
        "verdict": outcome.verdict,
        "found": names,
        "named": sum(name in names for name in pair),
        "listed": sum(name in likely for name in pair),
        "surplus": sum(name not in pair for name in names),
        "wrong_and_certain": wrong_and_certain(outcome.effects, pair),
        "after_over_before": outcome.validation.after_rms_nm / outcome.validation.before_rms_nm,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--seeds", type=int, default=1, help="recordings of each pair")
    parser.add_argument("--first", type=int, default=0, help="seed of the first of them")
    parser.add_argument("--seconds", type=float, default=20.0, help="length of a recording")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write every outcome there")
    args = parser.parse_args()
    jobs = [(pair, seed) for pair in PAIRS for seed in range(args.first, args.first + args.seeds)]
    outcomes = [
        judged(pair, seed, args.seconds)
        for pair, seed in track(jobs, "diagnose", console=Console(stderr=True))
    ]
    print(
        "| pair | both named | both listed | surplus | wrong and certain | found |\n|---|---|---|---|---|---|"
    )
    for pair in PAIRS:
        mine = [o for o in outcomes if o["pair"] == pair]
        found = "; ".join(", ".join(o["found"]) or o["verdict"] for o in mine)
        both, likely = (sum(o[key] == 2 for o in mine) for key in ("named", "listed"))
        surplus, certain = sum(o["surplus"] for o in mine), sum(len(o["wrong_and_certain"]) for o in mine)
        counts = f"{both}/{len(mine)} | {likely}/{len(mine)} | {surplus} | {certain}"
        print(f"| {' + '.join(pair)} | {counts} | {found} |")
    both, likely = (sum(o[key] == 2 for o in outcomes) for key in ("named", "listed"))
    print(
        f"\nboth named {both}/{len(outcomes)}, both listed {likely}/{len(outcomes)}, one named at least "
        f"{sum(o['named'] > 0 for o in outcomes)}, surplus {sum(o['surplus'] for o in outcomes)}, "
        f"wrong and certain {sum(len(o['wrong_and_certain']) for o in outcomes)}"
    )
    if args.json:
        args.json.write_text(json.dumps(outcomes, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
