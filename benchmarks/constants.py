"""Every choice constant of `estimator/`, halved and doubled: does any figure get worse by more than a fifth?

    python benchmarks/constants.py [--list] [--only NAME ...] [--seeds N] [--state FILE] [--data DIR]

A constant is a number at the top of a module, or an entry of a table of choices or priors. For each one the
figures of diagnosis seeds and of real data are formed with half and with twice its value, in a process of its
own, and appended to --state (JSON lines): a run that was interrupted goes on where it ended. A figure that
gets worse by more than a fifth names a mechanism to replace, not a number.
"""

from __future__ import annotations

import argparse
import ast
import importlib
import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
FACTORS = (0.5, 2.0)
FIFTH = 1.2
SEED = 300  # of the simulated recordings: none that a constant was chosen on
SECONDS = 10.0
EFFECTS = ("clean", "coulomb_friction", "cogging", "hysteresis", "encoder_delay", "gravity")


class Constant(NamedTuple):
    """Where a number stands: module, name, key in a table (None: it is the number itself), value."""

    module: str
    name: str
    key: str | None
    value: float | tuple[float, ...]

    @property
    def label(self) -> str:
        """Its name for people and for --only."""
        short = self.module.removeprefix("estimator.")
        return f"{short}.{self.name}" if self.key is None else f"{short}.{self.key}"

    def set(self, factor: float) -> None:
        """Put it in with a factor, for this process; whole numbers stay whole and above zero."""
        module = importlib.import_module(self.module)
        if self.key is None:
            setattr(module, self.name, _times(self.value, factor))
            return
        table = getattr(module, self.name)
        entry = table[self.key]
        field = "std" if hasattr(entry, "std") else "value"
        table[self.key] = entry._replace(**{field: _times(getattr(entry, field), factor)})


def _times(value: Any, factor: float) -> Any:
    if isinstance(value, tuple):
        return tuple(_times(x, factor) for x in value)
    return max(1, round(value * factor)) if isinstance(value, int) else value * factor


def constants() -> list[Constant]:
    """All of them, in the order of the modules."""
    found = []
    for path in sorted((ROOT / "estimator").rglob("*.py")):
        module = ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")
        for node in ast.parse(path.read_text(encoding="utf-8")).body:
            target = node.targets[0] if isinstance(node, ast.Assign) else getattr(node, "target", None)
            if not isinstance(node, ast.Assign | ast.AnnAssign) or not isinstance(target, ast.Name):
                continue
            value = getattr(importlib.import_module(module), target.id, None)
            if target.id in ("PRIORS", "CHOICES") and isinstance(value, dict):
                found += [
                    Constant(module, target.id, key, entry.std if hasattr(entry, "std") else entry.value)
                    for key, entry in value.items()
                ]
            elif _number(value):
                found.append(Constant(module, target.id, None, value))
    return found


def _number(value: object) -> bool:
    if type(value) is tuple:
        return bool(value) and all(_number(x) for x in value)
    return isinstance(value, int | float) and not isinstance(value, bool)


def figures(data: Path, seeds: int) -> dict[str, float]:
    """What is judged; all of it is better the smaller it is."""
    from diagnosis_seeds import judged
    from real_data import RUNS, baseline, joint_of

    from drivelink import recording
    from estimator.diagnosis import diagnose

    outcomes = [judged(name, SEED + k, SECONDS) for name in EFFECTS for k in range(seeds)]
    ratios, off = [], []
    for run in RUNS[::2] if (data / RUNS[0].train).exists() else ():
        joint = joint_of(run)
        train, other = (recording.read(data / name, joint) for name in (run.train, run.validation))
        outcome = diagnose(train, joint.model(), run.bandwidth_hz, other)
        floor = baseline(train, other, joint.model(), run.bandwidth_hz)
        ratios.append(outcome.validation.after_relative / floor)
        k = outcome.transmissions[0].parameters.get("k_nm_rad")
        if run.known_nm_rad and isinstance(k, float):
            off.append(abs(np.log(k / run.known_nm_rad)))
    return {
        "seeds not named first, share": float(np.mean([not o["named_first"] for o in outcomes])),
        "seeds surplus, mean": float(np.mean([o["surplus"] for o in outcomes])),
        "seeds error after over before": float(
            np.exp(np.mean(np.log([o["after_over_before"] for o in outcomes])))
        ),
        "real error over baseline": float(np.exp(np.mean(np.log(ratios)))) if ratios else 0.0,
        "real stiffness off, log": float(np.mean(off)) if off else 0.0,
    }


def _child(args: argparse.Namespace, label: str, factor: float) -> dict[str, float] | str:
    command = [sys.executable, __file__, "--child", label, str(factor), "--seeds", str(args.seeds)]
    done = subprocess.run(
        [*command, "--data", str(args.data)],
        capture_output=True,
        text=True,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
    )
    if done.returncode:
        return (done.stderr.strip().splitlines() or ["it failed"])[-1]
    made: dict[str, float] = json.loads(done.stdout.splitlines()[-1])
    return made


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    default = Path(os.environ.get("DRIVELINK_DATA", ROOT.parent / "shared" / "data"))
    parser.add_argument("--list", action="store_true", help="only list the constants")
    parser.add_argument("--only", nargs="*", metavar="NAME", help="beginnings of names as --list gives them")
    parser.add_argument("--seeds", type=int, default=2, help="simulated recordings of each effect")
    parser.add_argument("--state", type=Path, default=Path("constants.jsonl"), metavar="FILE")
    parser.add_argument("--data", type=Path, default=default, metavar="DIR")
    parser.add_argument("--child", nargs=2, metavar=("NAME", "FACTOR"), help=argparse.SUPPRESS)
    args = parser.parse_args()
    everything = constants()
    if args.child:
        for constant in everything:
            if constant.label == args.child[0]:
                constant.set(float(args.child[1]))
        print(json.dumps(figures(args.data, args.seeds)))
        return
    chosen = [c for c in everything if not args.only or any(c.label.startswith(name) for name in args.only)]
    if args.list:
        for constant in chosen:
            print(f"{constant.label} = {constant.value}")
        print(f"{len(chosen)} constants")
        return
    done: dict[tuple[str, float], Any] = {}
    if args.state.exists():
        for line in args.state.read_text(encoding="utf-8").splitlines():
            entry = json.loads(line)
            done[entry["constant"], entry["factor"]] = entry["figures"]
    jobs = [("as it is", 1.0), *((c.label, factor) for c in chosen for factor in FACTORS)]
    for label, factor in jobs:
        if (label, factor) in done:
            continue
        done[label, factor] = _child(args, label, factor)
        with args.state.open("a", encoding="utf-8") as state:
            state.write(
                json.dumps({"constant": label, "factor": factor, "figures": done[label, factor]}) + "\n"
            )
        print(f"{label} x {factor:g}", file=sys.stderr)
    _report(done, jobs)


def _report(done: dict[tuple[str, float], Any], jobs: list[tuple[str, float]]) -> None:
    reference = done["as it is", 1.0]
    print("| constant | factor | " + " | ".join(reference) + " | worse by more than a fifth |")
    print("|---" * (len(reference) + 3) + "|")
    for label, factor in jobs:
        found = done[label, factor]
        if isinstance(found, str):
            print(f"| {label} | {factor:g} | {found} |" + " |" * len(reference))
            continue
        worse = [name for name, value in found.items() if value > FIFTH * reference[name] + 1e-12]
        numbers = " | ".join(f"{value:.3g}" for value in found.values())
        print(f"| {label} | {factor:g} | {numbers} | {', '.join(worse)} |")


if __name__ == "__main__":
    main()
