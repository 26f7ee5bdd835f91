"""Every choice constant of `estimator/`, halved and doubled: does any figure get worse by more than a fifth?

    python benchmarks/constants.py [--list | --report] [--only NAME ...] [--seeds N] [--state FILE]

A choice is an entry of the tables `estimator.choices.CHOICES` and `estimator.priors.PRIORS`, and any other
number that a module defines at its top, unless `NO_CHOICE` says what it is instead. For each one the figures
are formed with half and with twice its value (of a share above one half: of what it leaves to one), on a few
short recordings that are made once, in a forked process, and appended to --state (JSON lines): a run that was
interrupted goes on where it ended. What the gate does not read is not tried on the gate's faults, and what
only the gate reads is tried on nothing else. A figure that gets worse by more than a fifth names a mechanism
to replace, not a number. --report prints what --state holds. The constants of `estimator/core` are compiled:
they are counted, sizes of arrays included, and not varied.
"""

from __future__ import annotations

import argparse
import ast
import importlib
import json
import os
import re
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from estimator.model import JointModel
from estimator.sample import Record

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "tests"))  # gatekit
NO_CHOICE = {  # mathematics, units, rounding, and what a format or the literature defines
    "diagnosis.candidates.LAWS": "Dahl's law, Bouc-Wen with equal parts, elastic up to the limit",
    "diagnosis.covariance._FULL": "keeps rounding from dividing by zero",
    "diagnosis.curves._DEGREE": "cubic splines",
    "diagnosis.motion._GENERATIONS": "effort of a search",
    "diagnosis.motion._POPULATION": "effort of a search",
    "diagnosis.motion._STEPS": "of a second-order integrator in a period of the bandwidth",
    "diagnosis.shape._CUBIC": "least degree whose bend is not constant",
    "driven._NEWTON": "steps, that converge quadratically",
    "driven._PASSES": "of a fixed point whose error falls by the effect's share each time",
    "driven._RESOLVED": "of a second-order integrator: an oscillation of which a step is a twelfth",
    "driven._STEP": "of a difference: square root of the rounding, in rad",
    "flexibility.RELATIVE_STEP": "of central differences: cube root of the rounding",
    "freerun._CUBIC": "least degree whose slope is exact to second order",
    "freerun._SMOOTHED": "samples: the least that average an encoder's rounding, short of the motion's bends",
    "freerun._STEP": "of a difference: square root of the rounding, in rad/s",
    "freerun._SUBSTEPS": "of a second-order integrator: its error is a sixteenth of one step's",
    "gate.causes._DEGREE": "unit",
    "gate.causes._MILLI": "unit",
    "gate.balance._RIDGE": "keeps rounding from deciding between parallel columns",
    "gate.decision._TURN": "one revolution",
    "gate.usable._ABSURD": "one over the rounding",
    "model.HIGHEST_ORDER": "of a polynomial in the joint file",
    "model_monitor._LEAST_SECONDS": "that a standard deviation takes",
    "model_monitor._NOTHING": "keeps a logarithm finite",
    "sample.SIGMA_95": "quantile of the normal distribution",
}
FACTORS = (0.5, 2.0)
STATE = Path(__file__).with_suffix(".jsonl")
GATE_KINDS = ("soft", "geared")
FIFTH = 1.2
SEED = 300  # of the simulated recordings: none that a constant was chosen on
SECONDS = 10.0
EFFECTS: tuple[tuple[str, ...], ...] = (
    (),
    ("coulomb_friction", "gravity"),
    ("hysteresis", "encoder_delay"),
    ("cogging", "motor_inertia"),
)


class Constant(NamedTuple):
    """Where a number stands: module, name, key in a table (None: it is the number itself), value."""

    module: str
    name: str
    key: str | None
    value: float | tuple[float, ...]

    @property
    def gate(self) -> bool:
        """Whether the gate reads it."""
        return self._read("estimator/gate/*.py")

    @property
    def fits(self) -> bool:
        """Whether anything else does: whatever the gate does not name may be read through a function."""
        return not self.gate or self._read("estimator/*.py") or self._read("estimator/diagnosis/*.py")

    def _read(self, modules: str) -> bool:
        name = self.name if self.key is None else f'"{self.key}"'
        paths = [path for path in ROOT.glob(modules) if path.stem not in ("choices", "priors")]
        return any(name in path.read_text(encoding="utf-8") for path in paths)

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
    if 0.5 < value < 1.0:  # a share
        return 1.0 - (1.0 - value) / factor
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
    return [constant for constant in found if constant.label not in NO_CHOICE]


def _number(value: object) -> bool:
    if type(value) is tuple:
        return bool(value) and all(_number(x) for x in value)
    return isinstance(value, int | float) and not isinstance(value, bool)


class Case(NamedTuple):
    """A recording, the joint as declared, its effects; real ones: bandwidth, baseline; stiffness."""

    record: Record
    model: JointModel
    effects: tuple[str, ...]
    bandwidth_hz: float | None = None
    baseline: float | None = None
    stiffness_nm_rad: float | None = None


Fault = tuple[Record, JointModel, dict[str, float]]


def faults() -> list[Fault]:
    """Recordings of joints that are healthy and that have each fault of a first installation."""
    import gatekit

    made: list[Fault] = []
    for kind in GATE_KINDS:
        drawn = gatekit.draw(kind, SEED)
        every = ({}, *gatekit.faults(drawn).values())
        made += [(gatekit.faulty(drawn.record, factors), drawn.model, factors) for factors in every]
    return made


def gate_figures(recordings: Sequence[Fault]) -> dict[str, float]:
    """Errors of the gate."""
    from gate import outcome

    from estimator.gate import examine

    found = [(examine(record, model), factors) for record, model, factors in recordings]
    return {
        "healthy joints refused": float(sum(bool(f) for f, factors in found if not factors)),
        "faults not named": float(sum(outcome(f, factors) != "named" for f, factors in found if factors)),
    }


def cases(data: Path, seeds: int) -> list[Case]:
    """The recordings: simulated ones, and the quickest of the real ones where it has been fetched."""
    from diagnosis_seeds import joint_of, measured
    from real_data import RUNS, baseline
    from real_data import joint_of as real_joint

    from drivelink import recording

    made = []
    for names in EFFECTS:
        for seed in range(SEED, SEED + seeds):
            declared, real = joint_of(names, seed)
            (k,) = real.model().motors[0].transmission.parameters.values()
            known = k if isinstance(k, float) else None
            made.append(Case(measured(real, SECONDS), declared.model(), names, stiffness_nm_rad=known))
    run = RUNS[0]
    if (data / run.train).exists():
        joint = real_joint(run)
        train, other = (recording.read(data / name, joint) for name in (run.train, run.validation))
        floor = baseline(train, other, joint.model(), run.bandwidth_hz)
        made.append(Case(train, joint.model(), (), run.bandwidth_hz, floor, run.known_nm_rad))
    return made


def figures(recordings: Sequence[Case]) -> dict[str, float]:
    """What is judged; all of it is better the smaller it is."""
    from diagnosis_seeds import wrong_and_certain

    from estimator.diagnosis import diagnose

    missed, surplus, certain, left, real, off = [], [], [], [], [], []
    for case in recordings:
        outcome = diagnose(case.record, case.model, case.bandwidth_hz)
        k = outcome.transmissions[0].parameters.get("k_nm_rad")
        if case.stiffness_nm_rad:
            off.append(abs(np.log(k / case.stiffness_nm_rad)) if isinstance(k, float) else 1.0)
        if case.baseline is not None:
            real.append(outcome.validation.after_relative / case.baseline)
            continue
        names = [effect.name for effect in outcome.effects]
        missed.append(sum(name not in names for name in case.effects))
        surplus.append(sum(name not in case.effects for name in names))
        certain.append(len(wrong_and_certain(outcome.effects, case.effects)))
        left.append(outcome.validation.after_relative)
    return {
        "effects missed": float(sum(missed)),
        "surplus": float(sum(surplus)),
        "wrong and certain": float(sum(certain)),
        "error left": float(np.exp(np.mean(np.log(left)))),
        "real error over baseline": float(np.mean(real)) if real else 0.0,
        "stiffness off, log": float(np.mean(off)),
    }


def _forked(
    recordings: Sequence[Case], faulty: Sequence[Fault], constant: Constant | None, factor: float
) -> dict[str, float] | str:
    """The figures with one constant changed, in a process that ends with it."""
    reader, writer = os.pipe()
    child = os.fork()
    if child == 0:
        try:
            if constant is not None:
                constant.set(factor)
            outcome: object = {
                **(figures(recordings) if constant is None or constant.fits else {}),
                **(gate_figures(faulty) if constant is None or constant.gate else {}),
            }
        except Exception as error:  # noqa: BLE001 - whatever a wild constant breaks is the answer
            outcome = f"{type(error).__name__}: {error}"
        with os.fdopen(writer, "w", encoding="utf-8") as pipe:
            json.dump(outcome, pipe)
        os._exit(0)
    os.close(writer)
    with os.fdopen(reader, encoding="utf-8") as pipe:
        text = pipe.read()
    os.waitpid(child, 0)
    made: dict[str, float] | str = json.loads(text) if text else "it died"
    return made


def compiled() -> int:
    """Numbers written at the top of the modules of `estimator/core`."""
    pattern = re.compile(
        r"^(?:pub(?:\([a-z]+\))? )?const [A-Z0-9_]+: (?:f64|usize|u\d+|i\d+) = [-\d]", re.MULTILINE
    )
    sources = (ROOT / "estimator" / "core" / "src").rglob("*.rs")
    paths = (path for path in sources if path.name != "tests.rs")
    return sum(len(pattern.findall(path.read_text(encoding="utf-8"))) for path in paths)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    default = Path(os.environ.get("DRIVELINK_DATA", ROOT.parent / "shared" / "data"))
    parser.add_argument("--list", action="store_true", help="only list the constants")
    parser.add_argument("--report", action="store_true", help="only print what has been measured")
    parser.add_argument("--only", nargs="*", metavar="NAME", help="beginnings of names as --list gives them")
    parser.add_argument("--seeds", type=int, default=1, help="simulated joints of each kind")
    parser.add_argument("--state", type=Path, default=STATE, metavar="FILE")
    parser.add_argument("--data", type=Path, default=default, metavar="DIR")
    parser.add_argument("--json", type=Path, metavar="FILE", help="also write the figures there")
    args = parser.parse_args()
    everything = constants()
    chosen = [c for c in everything if not args.only or any(c.label.startswith(name) for name in args.only)]
    if args.list:
        for constant in chosen:
            print(f"{constant.label} = {constant.value}")
        print(
            f"{len(chosen)} constants; {compiled()} more in estimator/core, which are compiled and not varied"
        )
        return
    done: dict[tuple[str, float], Any] = {}
    if args.state.exists():
        for line in args.state.read_text(encoding="utf-8").splitlines():
            entry = json.loads(line)
            done[entry["constant"], entry["factor"]] = entry["figures"]
    recordings: list[Case] = []
    faulty: list[Fault] = []
    by_label = {c.label: c for c in chosen}
    jobs = [("as it is", 1.0), *((label, factor) for label in by_label for factor in FACTORS)]
    for label, factor in jobs:
        if args.report or (label, factor) in done:
            continue
        recordings, faulty = recordings or cases(args.data, args.seeds), faulty or faults()
        done[label, factor] = _forked(recordings, faulty, by_label.get(label), factor)
        with args.state.open("a", encoding="utf-8") as state:
            state.write(
                json.dumps({"constant": label, "factor": factor, "figures": done[label, factor]}) + "\n"
            )
        print(f"{label} x {factor:g}", file=sys.stderr)
    _report(done, jobs)
    if args.json:
        figures_ = [{"constant": name, "factor": f, "figures": found} for (name, f), found in done.items()]
        args.json.write_text(json.dumps(figures_, indent=1) + "\n", encoding="utf-8")


def _report(done: dict[tuple[str, float], Any], jobs: list[tuple[str, float]]) -> None:
    """The figures as they are, and the changes that make one worse by more than a fifth."""
    reference = done["as it is", 1.0]
    changed = [job for job in jobs[1:] if job in done]
    print(
        f"{len(jobs) // 2} choice constants, and {compiled()} compiled ones that are not varied. "
        f"{len(changed)} of {len(jobs) - 1} changes were measured.\n"
    )
    print("| constant | factor | " + " | ".join(reference) + " | worse by more than a fifth |")
    print("|---" * (len(reference) + 3) + "|")
    for label, factor in [jobs[0], *changed]:
        found = done[label, factor]
        if isinstance(found, str):
            print(f"| {label} | {factor:g} | {found} |" + " |" * len(reference))
            continue
        worse = [name for name, value in found.items() if value > FIFTH * reference[name] + 1e-12]
        if worse or (label, factor) == jobs[0]:
            numbers = " | ".join(f"{found[name]:.3g}" if name in found else "" for name in reference)
            print(f"| {label} | {factor:g} | {numbers} | {', '.join(worse)} |")


if __name__ == "__main__":
    main()
