"""Plausible sensor faults: how many samples called valid are wrong, and how many of those carry no flag?

    python benchmarks/fault_matrix.py [--joints constant,vsa-ii,"vsa-ii fitted"] [--health 15] [--seconds 15]

In lockstep on the project's simulated joints, seeded (--seed): seconds of health, then as many of one fault
(kinds, sizes and signals: `tests/faultmatrix.py`; drives that reboot and count from elsewhere are among
them). Wrong is a stiffness that is off by more than 10 % and by more than five standard deviations, and a
torque that is off by more than a quarter of its rms. Named is a fault whose signal `suspected` names most
often, of those in which it names any. Then true changes of the stiffness, which are to be followed: the
share of the last two seconds that is within 5 % and valid, or, with a fitted file, has the model alarm
instead.

With --sizes instead: for each kind of fault the largest size up to which nothing is said of it in eight
seconds (every sample valid, no flag), and by how much the stiffness is off then.
"""

import sys
from collections.abc import Iterator

import numpy as np
import scene
from scene import faultmatrix as matrix


def measure(joint, health, seconds, seed):
    """One joint: totals, the worst faults, health, steps."""
    rows, suspects, right = {}, 0, 0
    for fault in matrix.FAULTS:
        outcome = matrix.outcome(joint, fault, health, seconds, seed)
        rows[f"{' + '.join(fault.signals)}: {fault.name}"] = outcome
        suspects += bool(outcome.suspected)
        right += outcome.names(fault)
    counts = np.sum([row[:6] for row in rows.values()], axis=0).tolist()
    samples, valid, wrong, silent, torque_valid, torque = counts
    worst = sorted(rows.items(), key=lambda item: -item[1].wrong - item[1].torque)[:10]
    healthy = matrix.outcome(joint, None, health, seconds, seed)
    return {
        "joint": joint,
        "samples": samples,
        "valid": valid,
        "wrong": wrong,
        "silent": silent,
        "torque": torque,
        "torque_valid": torque_valid,
        "torque_share": torque / max(torque_valid, 1),
        "suspects": suspects,
        "named": right,
        "wrong_share": wrong / max(valid, 1),
        "silent_share": silent / max(valid, 1),
        "healthy_valid": healthy.valid / healthy.samples,
        "worst": {name: row._asdict() for name, row in worst if row.wrong + row.torque},
        "followed": ", ".join(
            f"x{factor:g} {matrix.stepped(joint, factor, health, seconds, seed)[1]:.0%}"
            for factor in matrix.STEPS
        ),
    }


def unnoticed(joint, seed) -> Iterator[scene.Row]:
    """What is not noticed on one joint, and up to which size."""
    for kind, (text, _, signals, _) in matrix.LADDERS.items():
        for signal in signals:
            size, error = matrix.unnoticed(joint, kind, signal, health_s=8.0, fault_s=8.0, seed=seed)
            said = text.format(size) if size else "always noticed"
            yield {
                "joint": joint,
                "fault": f"{signal}: {kind}",
                "size": said,
                "error": error if size else None,
            }


def rows(args) -> Iterator[scene.Row]:
    """One row a joint; with --sizes one a joint and kind of fault."""
    for joint in args.joints:
        if args.sizes:
            yield from unnoticed(joint, args.seed)
        else:
            yield measure(joint, args.health, args.seconds, args.seed)


def worst(found: list[scene.Row]) -> str:
    """The faults that leave most wrong samples."""
    each = ((row["joint"], *item) for row in found for item in row.get("worst", {}).items())
    return "\n".join(f"{joint}: {name}: {outcome}" for joint, name, outcome in each)


SIZES = {"joint": "{joint}", "fault": "{fault}", "unnoticed up to": "{size}", "stiffness off": "{error:.1%}"}
MATRIX = {
    "joint": "{joint}",
    "valid samples": "{valid}",
    "stiffness wrong": "{wrong} ({wrong_share:.2%})",
    "without any flag": "{silent} ({silent_share:.2%})",
    "torque wrong, of valid ones": "{torque} of {torque_valid} ({torque_share:.2%})",
    "named": "{named} of {suspects}",
    "healthy and valid": "{healthy_valid:.2%}",
    "steps followed": "{followed}",
}

if __name__ == "__main__":
    scene.main(
        __doc__,
        rows,
        SIZES if "--sizes" in sys.argv else MATRIX,
        scene.Option("--joints", list(matrix.JOINTS)),
        scene.Option("--health", 15.0, "seconds"),
        scene.Option("--seconds", 15.0, "of each fault"),
        scene.Option("--seed", 0),
        scene.Option("--sizes", False, "what is not noticed, and up to which size"),
        after=worst,
    )
