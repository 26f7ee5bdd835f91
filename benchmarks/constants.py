"""Every choice constant of `estimator/`, halved and doubled: does any figure get worse by more than a fifth?

    python benchmarks/constants.py [--only NAME,…] [--seeds N]
    python benchmarks/constants.py --compiled [--only NAME,…] [--joints N]

A choice is an entry of `estimator.choices.CHOICES` or `estimator.priors.PRIORS`; `tests/literals.py` says
what other numbers are. The figures are formed with half and with twice its value (of a share above one half:
of what it leaves to one). A figure that gets worse by more than a fifth names a mechanism to replace, not a
number: such changes are shown.

Without --compiled they are formed in a forked process, on a few short recordings that are made once. With it
the sources are copied, one number of `estimator/core/src/choices.rs` changed, the core compiled, and random
joints (`estimators.py --mixed`) run with it: the share of time without a usable estimate, the share of that
which is wrong, and the share of 95 % intervals that do not hold.
"""

import json
import os
import re
import resource
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import scene
from diagnosis_seeds import joint_of, measured, wrong_and_certain
from scene import gatekit, literals

from estimator.choices import ON_LINE
from estimator.diagnosis import diagnose
from estimator.gate import examine
from estimator.model import JointModel
from estimator.sample import Record

FACTORS = (0.5, 2.0)
FIFTH = 1.2
SEED = 300  # of the simulated recordings: none that a constant was chosen on
SECONDS = 10.0
LONGEST_S = 900  # of CPU, for the figures with one change
GATE_KINDS = ("soft", "geared")
EFFECTS: tuple[tuple[str, ...], ...] = (
    (),
    ("coulomb_friction", "gravity"),
    ("hysteresis", "encoder_delay"),
    ("cogging", "motor_inertia"),
)
FIGURES = ("missed", "surplus", "certain", "left", "stiffness", "refused", "unnamed")  # better the smaller
OF_JOINTS = ("unusable", "wrong", "uncovered")
CHANCE = 0.005  # of the time: what a figure of random joints may change by chance
TABLE = "estimator/core/src/choices.rs"
LOAD = """
import importlib.machinery, importlib.util, runpy, sys
_, core, program, *sys.argv[1:] = sys.argv
loader = importlib.machinery.ExtensionFileLoader("estimator._core", core)
spec = importlib.util.spec_from_loader("estimator._core", loader, origin=core)
sys.modules["estimator._core"] = module = importlib.util.module_from_spec(spec)
loader.exec_module(module)
sys.argv[0] = program
sys.path.insert(0, program.rpartition("/")[0])
runpy.run_path(program, run_name="__main__")
"""


class Case(NamedTuple):
    """A recording, the joint as declared, its effects, its stiffness."""

    record: Record
    model: JointModel
    effects: tuple[str, ...]
    stiffness_nm_rad: float


Fault = tuple[Record, JointModel, dict[str, float]]
Found = dict[str, float] | str  # the figures, or what a change breaks


def cases(seeds: int) -> Iterator[Case]:
    for names in EFFECTS:
        for seed in range(SEED, SEED + seeds):
            declared, real = joint_of(names, seed)
            (k,) = real.model().motors[0].transmission.parameters.values()
            yield Case(measured(real, SECONDS), declared.model(), names, float(k))


def faults() -> Iterator[Fault]:
    """Recordings of joints that are healthy, and that have each fault of a first installation."""
    for kind in GATE_KINDS:
        drawn = gatekit.draw(kind, SEED)
        for factors in ({}, *gatekit.faults(drawn).values()):
            yield gatekit.faulty(drawn.record, factors), drawn.model, factors


def undone(factors: dict[str, float], record: Record, model: JointModel) -> bool:
    """Whether what the gate finds undoes a fault, or nothing is found where there is none."""
    changes = {c.channel: c.factor for found in examine(record, model) for c in found.changes}
    return gatekit.named_rightly(factors, changes, lambda a, b: abs(a / b - 1.0) < 0.05)


def figures(recordings: Sequence[Case], faulty: Sequence[Fault]) -> dict[str, float]:
    """What is judged of an interpreted choice."""
    found: dict[str, list[float]] = {name: [] for name in FIGURES}
    for case in recordings:
        outcome = diagnose(case.record, case.model)
        k = outcome.transmissions[0].parameters.get("k_nm_rad")
        names = [effect.name for effect in outcome.effects]
        found["missed"].append(sum(name not in names for name in case.effects))
        found["surplus"].append(sum(name not in case.effects for name in names))
        found["certain"].append(len(wrong_and_certain(outcome.effects, case.effects)))
        found["left"].append(outcome.validation.after_relative)
        off = abs(np.log(k / case.stiffness_nm_rad)) if isinstance(k, float) else 1.0
        found["stiffness"].append(off)
    for record, model, factors in faulty:
        found["unnamed" if factors else "refused"].append(not undone(factors, record, model))
    middle = {"left": lambda left: np.exp(np.mean(np.log(left))), "stiffness": np.mean}
    return {name: float(middle.get(name, sum)(values)) for name, values in found.items()}


def times(value: Any, factor: float) -> Any:
    """A choice with a factor; whole numbers stay whole and above zero."""
    if isinstance(value, tuple):
        return tuple(times(x, factor) for x in value)
    if 0.5 < value < 1.0:  # a share
        return 1.0 - (1.0 - value) / factor
    return max(1, round(value * factor)) if isinstance(value, int) else value * factor


def forked(
    recordings: Sequence[Case], faulty: Sequence[Fault], constant: literals.Constant | None, factor: float
) -> Found:
    """The figures with one constant changed, in a process that ends with it; or what that breaks."""
    reader, writer = os.pipe()
    child = os.fork()
    if child == 0:
        resource.setrlimit(resource.RLIMIT_CPU, (LONGEST_S, LONGEST_S))
        try:
            if constant is not None:
                entry = constant.table[constant.key]
                field = "std" if hasattr(entry, "std") else "value"
                changed = {field: times(getattr(entry, field), factor)}
                constant.table[constant.key] = entry._replace(**changed)
            outcome: object = figures(recordings, faulty)
        except Exception as error:  # noqa: BLE001 - whatever a wild constant breaks is the answer
            outcome = f"{type(error).__name__}: {error}"
        with os.fdopen(writer, "w", encoding="utf-8") as pipe:
            json.dump(outcome, pipe)
        os._exit(0)
    os.close(writer)
    with os.fdopen(reader, encoding="utf-8") as pipe:
        text = pipe.read()
    os.waitpid(child, 0)
    made: Found = json.loads(text) if text else "it took too long, or died"
    return made


@contextmanager
def copied() -> Iterator[Path]:
    """What the core is compiled of, in a folder of its own."""
    with tempfile.TemporaryDirectory() as name:
        for part in ("Cargo.toml", "Cargo.lock", "estimator/core", "drivelink/core"):
            source, place = scene.ROOT / part, Path(name) / part
            place.parent.mkdir(parents=True, exist_ok=True)
            shutil.copytree(source, place) if source.is_dir() else shutil.copy(source, place)
        yield Path(name)


def compiled(folder: Path, joints: int, name: str | None, factor: float) -> Found:
    """The figures with one entry of the compiled table changed, or what that breaks."""
    text = (scene.ROOT / TABLE).read_text(encoding="utf-8")
    if name is not None:
        line = re.search(rf"(?m)^    {name.upper()}: (\w+) = ([\d.e-]+),", text)
        assert line is not None, name
        value = times((float if line[1] == "f64" else int)(line[2]), factor)
        text = f"{text[: line.start(2)]}{value!r}{text[line.end(2) :]}"
    (folder / TABLE).write_text(text, encoding="utf-8")
    command = ["cargo", "rustc", "-q", "--release", "--locked", "--lib", "--features", "python"]
    command += ["--manifest-path", "drivelink/core/Cargo.toml", "--crate-type", "cdylib"]
    subprocess.run(command, cwd=folder, env=os.environ | {"PYO3_PYTHON": sys.executable}, check=True)
    core, program = next((folder / "target/release").glob("*drivelink_core.so")), "estimators.py"
    command = [sys.executable, "-c", LOAD, str(core), str(Path(__file__).with_name(program)), "--mixed"]
    command += ["--joints", str(joints), "--json", str(folder / "rows.json")]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        return done.stderr.strip().splitlines()[-1]
    whole = json.loads((folder / "rows.json").read_text(encoding="utf-8"))[-1]
    return dict(zip(OF_JOINTS, (1.0 - whole["usable"], whole["wrong"], 1.0 - whole["coverage"]), strict=True))


def judged(
    chosen: dict[str, Any], figures: Callable[[Any, float], Found], chance: float
) -> Iterable[scene.Row]:
    """The figures as they are, and each change that makes one worse by more than a fifth."""
    usual = figures(None, 1.0)
    if isinstance(usual, str):
        raise SystemExit(usual)
    nothing = dict.fromkeys((*FIGURES, *OF_JOINTS, "worse"))
    yield nothing | usual | {"constant": "as it is", "factor": 1.0, "tried": len(chosen) * len(FACTORS)}
    for label, constant in chosen.items():
        for factor in FACTORS:
            found = figures(constant, factor)
            row = nothing | {"constant": label, "factor": factor}
            if isinstance(found, str):
                yield row | {"worse": found}
            elif worse := [name for name in usual if found[name] > FIFTH * usual[name] + chance]:
                yield row | found | {"worse": ", ".join(worse)}


def rows(args) -> Iterator[scene.Row]:
    """Those of the interpreted choices, or of the compiled ones."""
    if args.compiled:
        with copied() as folder:
            names = {name: name for name in args.only or ON_LINE}
            yield from judged(names, partial(compiled, folder, args.joints), CHANCE)
        return
    chosen = {
        one.label: one
        for one in literals.constants(scene.ROOT / "estimator")
        if not args.only or one.label in args.only
    }
    yield from judged(chosen, partial(forked, list(cases(args.seeds)), list(faults())), 1e-12)


COLUMNS = {
    "constant": "{constant}",
    "factor": "{factor:g}",
    "effects missed": "{missed:.0f}",
    "surplus": "{surplus:.0f}",
    "wrong and certain": "{certain:.0f}",
    "error left": "{left:.3g}",
    "stiffness off, log": "{stiffness:.3g}",
    "healthy joints refused": "{refused:.0f}",
    "faults not named": "{unnamed:.0f}",
    "not usable": "{unusable:.1%}",
    "wrong of usable": "{wrong:.2%}",
    "not held": "{uncovered:.1%}",
    "worse by more than a fifth": "{worse}",
}

if __name__ == "__main__":
    scene.main(
        __doc__,
        rows,
        COLUMNS,
        scene.Option("--compiled", False, "those of the compiled core"),
        scene.Option("--only", [], "of choices, as choices.order; all if left out"),
        scene.Option("--seeds", 1, "simulated joints of each kind"),
        scene.Option("--joints", 40, "random ones, with --compiled"),
        after=lambda found: (
            f"{len(found) - 1} of {found[0]['tried']} changes make a figure worse by more than a fifth."
        ),
    )
