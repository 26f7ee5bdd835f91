"""What to move next: recordings that leave a question open, the motion designed for each, a random one.

    python benchmarks/motion.py [--recordings 30] [--seconds 12] [--first 0] [--last 599] [--json FILE]

Joints of an independent simulator in C (`world.c`) with one effect that no file names, or none, in poor
motions: one sine, slow sines, small moves. A recording is ambiguous if `diagnose` says that its motion is too
poor, or gives an alternative. Its joint then plays, by a drive's position loop, the motion that
`diagnose --motion` designs within limits, and as long a random one of the same kind, as large as the limits
allow. Both are diagnosed. Decided: the true effect alone is named, and is likelier than all others together
(sure: with 0.9 or more and without an alternative); of a joint with none: "sufficient". Rival: whether the
truth is among those that the motion is designed for. Damping of the transmission is left out: without
[link.dynamics] no motion tells it from a late sensor.
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import scene
from scene import joints
from world import World, simulate

from estimator.diagnosis import Diagnosis, diagnose
from estimator.diagnosis.fourier import Limits, Shape
from estimator.diagnosis.motion import design
from estimator.driven import Path
from estimator.model import JointModel

LIKELY, SURE = 0.5, 0.9
PERIOD_S = 1e-3
TOO_MUCH = 1.05  # torque over its limit: the drive's loop adds to what the motion needs


class Case(NamedTuple):
    """An effect: its settings in the world, or their ranges, and its names in the library."""

    settings: dict[str, tuple[float, float] | str | float]
    names: tuple[str, ...]


FRICTION = {"coulomb": (0.3, 0.6)}
CASES = {
    "nothing": Case({}, ()),
    "Coulomb friction": Case({"friction": "coulomb", **FRICTION}, ("coulomb_friction",)),
    "Stribeck friction": Case(
        {"friction": "stribeck", "stribeck": (0.5, 0.9), "stribeck_velocity": (0.05, 0.1), **FRICTION},
        ("stribeck_friction",),
    ),
    "gear loss": Case({"gear_loss": (0.06, 0.12)}, ("load_dependent_friction",)),
    "Dahl hysteresis": Case({"hysteresis": "dahl", "hysteresis_torque": (0.3, 0.5)}, ("hysteresis",)),
    "backlash": Case({"backlash": (0.003, 0.006)}, ("backlash",)),
    "hardening": Case({"spring": "cubic", "cubic": (10000, 25000)}, ("higher_order_stiffness",)),
    "cogging": Case({"cogging": (0.15, 0.3), "cogging_periods": 14}, ("cogging",)),
    "late link": Case({"link_delay": (3e-3, 6e-3)}, ("encoder_delay",)),
}
MOTIONS: tuple[dict[str, str | float], ...] = (
    {"motion": "harmonic", "top_hz": 0.7, "size": 4},
    {"motion": "multisine", "top_hz": 0.6, "size": 3},
    {"motion": "point-to-point", "size": 0.15},
)


class Joint(NamedTuple):
    """Settings of the world, the joint as declared, and what its motors may reach."""

    settings: dict[str, float | str]
    model: JointModel
    limits: Limits

    def moved(self, seconds: float, seed: int, path: Path | None = None, **motion: float | str) -> World:
        """Record a motion: one of the world's, or one to play."""
        played = None
        if path is not None:
            rows = zip(path.position[:, 0, 0], path.velocity[:, 0, 0], strict=True)
            played, motion = "".join(f"{x:.9g} {v:.9g}\n" for x, v in rows), {"motion": "played"}
        return simulate(played, **(self.settings | motion | {"seconds": seconds, "seed": seed}))


def joint_of(case: Case, seed: int) -> Joint:
    rng = np.random.default_rng(seed)
    own = {k: rng.uniform(*v) if isinstance(v, tuple) else v for k, v in case.settings.items()}
    settings = {
        "stiffness": rng.uniform(120, 180), "inertia": rng.uniform(0.1, 0.15), "damping": rng.uniform(0.6, 1),
        "link_inertia": rng.uniform(0.3, 0.5), "gravity": rng.uniform(1, 4), "torque_noise": 0.01,
        "motor_counts": 65536, **own,
    }  # fmt: skip
    spring = {"coefficients_nm_rad": (settings["stiffness"],)}
    model = joints.joint_model(settings["inertia"], settings["damping"], order=1, parameters=spring)
    most = {"low_rad": -0.8, "high_rad": 0.8, "velocity_rad_s": 4, "acceleration_rad_s2": 40, "torque_nm": 12}
    limits = Limits(**{name: np.array([float(value)]) for name, value in most.items()})
    return Joint(settings, model, limits)


def ambiguous(outcome: Diagnosis) -> bool:
    """Whether a diagnosis leaves a question open."""
    return outcome.verdict == "insufficient_excitation" or any(f.alternatives for f in outcome.effects)


def decided(outcome: Diagnosis, names: tuple[str, ...]) -> bool:
    """Whether it names what is there, and nothing else."""
    if not names:
        return outcome.verdict == "sufficient"
    named = [f.name for f in outcome.effects if f.probability > LIKELY]
    return outcome.verdict == "effect" and len(outcome.effects) == len(named) == 1 and named[0] in names


def sure(outcome: Diagnosis, names: tuple[str, ...]) -> bool:
    """Whether it does so without a doubt."""
    return decided(outcome, names) and all(
        f.probability >= SURE and not f.alternatives for f in outcome.effects
    )


def said(outcome: Diagnosis) -> str:
    """Verdict in a cell."""
    if not outcome.effects:
        return outcome.verdict.replace("_", " ")
    names = [
        f"{f.name} {f.probability:.2f}" + "".join(f" or {a}" for a in f.alternatives) for f in outcome.effects
    ]
    return ("poor: " if outcome.verdict == "insufficient_excitation" else "") + ", ".join(names)


def rows(args) -> Iterator[scene.Row]:
    """One row an ambiguous recording."""
    made = 0
    for k in range(args.first, args.last + 1):
        (name, case), seed = list(CASES.items())[k % len(CASES)], 1 + k
        joint, motion = joint_of(case, seed), MOTIONS[(k // len(CASES)) % len(MOTIONS)]
        first = joint.moved(args.seconds, seed, **motion).record
        outcome = diagnose(first, joint.model)
        if (args.cases and name not in args.cases) or not ambiguous(outcome):
            continue
        found = design([first], joint.model, outcome, joint.limits, args.seconds)
        numbers = np.random.default_rng(seed).uniform(-1.0, 1.0, (1, Shape.size(1)))
        random = Shape(numbers, args.seconds, joint.limits).path(PERIOD_S)
        best = Path(
            found.position_rad[:, None],
            found.velocity_rad_s[:, None],
            found.acceleration_rad_s2[:, None],
            PERIOD_S,
        )
        row = {
            "joint": k,
            "effect": name,
            "motion": motion["motion"],
            "before": said(outcome),
            "rivals": found.rivals,
            "rival": bool(set(case.names or ("nothing",)) & set(found.rivals)),
        }
        for label, path in (("designed", best), ("random", random)):
            world, torque = joint.moved(args.seconds, seed + 1, path), np.inf
            while (
                torque := float(np.abs(world.record.motor_torque_nm).max())
            ) > TOO_MUCH * joint.limits.torque_nm[0]:
                path = path.scaled(0.9 * joint.limits.torque_nm[0] / torque)
                world = joint.moved(args.seconds, seed + 1, path)
            after = diagnose(world.record, joint.model)
            row |= {
                label: said(after),
                f"{label}_decides": decided(after, case.names),
                f"{label}_sure": sure(after, case.names),
                f"{label}_torque_nm": torque,
            }
        yield row | {"expected": found.decides}
        made += 1
        if made == args.recordings:
            return


def total(made: list[scene.Row]) -> str:
    kinds = [f"{label}_{kind}" for label in ("designed", "random") for kind in ("decides", "sure")]
    best, surely, random, random_surely = (sum(one[kind] for one in made) for kind in kinds)
    unlisted = [one for one in made if not one["rival"]]
    return (
        f"Of {len(made)} ambiguous recordings the designed motion decides {best} ({surely} surely), "
        f"the random one {random} ({random_surely} surely). In {len(unlisted)} the truth is none of the "
        f"rivals: of these the designed motion decides {sum(one['designed_decides'] for one in unlisted)}."
    )


COLUMNS = {
    "effect": "{effect}",
    "recorded": "{motion}",
    "said": "{before}",
    "rival": "{rival}",
    "after the designed motion": "{designed}",
    "decided": "{designed_decides}",
    "torque / N·m": "{designed_torque_nm:.1f}",
    "after a random one": "{random}",
    "decided ": "{random_decides}",
    "torque / N·m ": "{random_torque_nm:.1f}",
}

if __name__ == "__main__":
    scene.main(
        __doc__,
        rows,
        COLUMNS,
        scene.Option("--recordings", 30),
        scene.Option("--seconds", 12.0),
        scene.Option("--first", 0, "number of the first joint"),
        scene.Option("--last", 599, "number of the last joint"),
        scene.Option("--cases", [], "of effects"),
        after=total,
    )
