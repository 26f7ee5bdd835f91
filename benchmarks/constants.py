"""Every choice constant of `estimator/`, halved and doubled: does any figure get worse by more than a fifth?

    python benchmarks/constants.py [--only NAME,…] [--seeds N]

A choice is an entry of `estimator.choices.CHOICES` or `estimator.priors.PRIORS`; `tests/literals.py` says
what other numbers are. The figures are formed with half and with twice its value (of a share above one half:
of what it leaves to one), in a forked process, on a few short recordings that are made once. A figure that
gets worse by more than a fifth names a mechanism to replace, not a number: such changes are shown. An entry
of `estimator/core/src/choices.rs` keeps its value where it is compiled: `compiled.py` varies it there.
"""

from __future__ import annotations

import json
import os
import resource
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
import scene
from diagnosis_seeds import joint_of, measured, wrong_and_certain
from scene import gatekit, literals

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


class Case(NamedTuple):
    """A recording, the joint as declared, its effects, its stiffness."""

    record: Record
    model: JointModel
    effects: tuple[str, ...]
    stiffness_nm_rad: float


Fault = tuple[Record, JointModel, dict[str, float]]


def cases(seeds: int) -> Iterator[Case]:
    """Recordings to diagnose."""
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
    """What is judged."""
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


def forked(
    recordings: Sequence[Case], faulty: Sequence[Fault], constant: literals.Constant | None, factor: float
) -> dict[str, float] | str:
    """The figures with one constant changed, in a process that ends with it; or what that breaks."""
    reader, writer = os.pipe()
    child = os.fork()
    if child == 0:
        resource.setrlimit(resource.RLIMIT_CPU, (LONGEST_S, LONGEST_S))
        try:
            if constant is not None:
                constant.set(factor)
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
    made: dict[str, float] | str = json.loads(text) if text else "it took too long, or died"
    return made


def rows(args) -> Iterator[scene.Row]:
    """The figures as they are, and each change that makes one worse by more than a fifth."""
    chosen = [
        c for c in literals.constants(scene.ROOT / "estimator") if not args.only or c.label in args.only
    ]
    recordings, faulty = list(cases(args.seeds)), list(faults())
    usual = forked(recordings, faulty, None, 1.0)
    if isinstance(usual, str):
        raise SystemExit(usual)
    yield {"constant": "as it is", "factor": 1.0, "worse": None, "tried": 2 * len(chosen), **usual}
    for constant in chosen:
        for factor in FACTORS:
            found = forked(recordings, faulty, constant, factor)
            row = {"constant": constant.label, "factor": factor}
            if isinstance(found, str):
                yield row | dict.fromkeys(FIGURES) | {"worse": found}
            elif worse := [name for name in FIGURES if found[name] > FIFTH * usual[name] + 1e-12]:
                yield row | found | {"worse": ", ".join(worse)}


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
    "worse by more than a fifth": "{worse}",
}

if __name__ == "__main__":
    scene.main(
        __doc__,
        rows,
        COLUMNS,
        scene.Option("--only", [], "of choices, as choices.order; all if left out"),
        scene.Option("--seeds", 1, "simulated joints of each kind"),
        after=lambda found: (
            f"{len(found) - 1} of {found[0]['tried']} changes make a figure worse by more than a fifth."
        ),
    )
