"""How often `diagnose` finds something in a second healthy recording, against the fitted file of the first.

    python benchmarks/healthy.py [--seeds N] [--first N] [--seconds S]

Joints of `world.c`, the independent simulator, drawn from their seeds: linear, cubic and exponential springs,
bodies, gravity, encoders, noise of the torque, a link encoder that is late by up to two periods, a declared
inertia up to 5 % off. The second recording has a motion of its own, in kind, size and speed. Where a hand
moves or pushes the link, no link dynamics are declared.
"""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import scene
import world
from scene import joints

from estimator import JointModel, LinkDynamics
from estimator.diagnosis import diagnose
from estimator.errors import EstimatorError
from estimator.identify import identify

MODELS = {"linear": "linear", "cubic": "polynomial", "exponential": "exponential"}
MOTIONS = ("multisine", "point-to-point", "hand-guided", "pushes")


def joint(rng: np.random.Generator) -> tuple[dict[str, float | str], JointModel]:
    """A joint's settings in `world.c`, and how it is declared."""
    spring = str(rng.choice(list(MODELS)))
    stiffness, inertia = float(rng.uniform(60.0, 300.0)), float(rng.uniform(0.05, 0.3))
    made: dict[str, float | str] = {
        "spring": spring,
        "stiffness": stiffness,
        "cubic": stiffness * float(rng.uniform(5.0, 50.0)),
        "exponent": float(rng.uniform(2.0, 8.0)),
        "inertia": inertia,
        "damping": float(rng.uniform(0.3, 1.5)),
        "link_inertia": inertia * float(rng.uniform(1.5, 5.0)),
        "link_damping": float(rng.uniform(0.05, 0.5)),
        "gravity": float(rng.choice([0.0, 0.02 * stiffness])),
        "link_delay": 1e-3 * float(rng.integers(0, 41)) / 20.0,
        "motor_counts": float(rng.choice([4096, 16384])) * 16.0,
        "link_bits": float(rng.integers(17, 21)),
        "torque_noise": float(rng.choice([0.0, 0.01, 0.05])),
    }
    inertia *= float(rng.uniform(0.95, 1.05))
    link = LinkDynamics(
        inertia_kg_m2=float(made["link_inertia"]) * float(rng.uniform(0.95, 1.05)),
        viscous_damping_nm_s_rad=float(made["link_damping"]),
        gravity_nm=float(made["gravity"]),
    )
    damping = float(made["damping"])
    return made, joints.joint_model(inertia, damping, model=MODELS[spring], order=None, link=link)


def motion(rng: np.random.Generator, kind: str, stiffness: float) -> dict[str, float | str]:
    size = 0.6 if kind == "point-to-point" else 0.05 * stiffness
    return {
        "motion": kind,
        "size": size * float(rng.uniform(0.7, 1.4)),
        "top_hz": float(rng.uniform(2.0, 5.0)),
        "push": 0.03 * stiffness * float(rng.uniform(0.7, 1.4)),
        "seed": float(rng.integers(1, 10_000)),
    }


def rows(args) -> Iterator[scene.Row]:
    for seed in range(args.first, args.first + args.seeds):
        rng = np.random.default_rng([seed, 7])
        settings, model = joint(rng)
        kinds = "multisine", str(rng.choice(MOTIONS))
        first, second = (
            world.simulate(
                seconds=args.seconds, **settings, **motion(rng, kind, float(settings["stiffness"]))
            )
            for kind in kinds
        )
        linked = kinds[1] in MOTIONS[:2] and bool(rng.random() < 0.7)
        declared = model if linked else replace(model, link=None)
        try:
            fitted = identify(first.record, declared)
            said = diagnose(second.record, fitted.model)
            found, left = said.verdict, said.validation.after_relative
            names = ", ".join(f"{one.name} ({one.probability:.2f})" for one in said.effects)
        except EstimatorError as error:
            found, names, left = "refused", str(error), float("nan")
        yield {
            "seed": seed,
            "spring": settings["spring"],
            "motion": kinds[1],
            "linked": "yes" if linked else "no",
            "verdict": found,
            "names": names,
            "left": left,
        }


def counted(found: list[scene.Row]) -> str:
    verdicts = [row["verdict"] for row in found]
    each = ", ".join(f"{verdicts.count(one)} {one}" for one in dict.fromkeys(verdicts))
    return f"of {len(found)} healthy second recordings: {each}"


if __name__ == "__main__":
    columns = {
        "seed": "{seed}",
        "spring": "{spring}",
        "second motion": "{motion}",
        "link declared": "{linked}",
        "verdict": "{verdict}",
        "found": "{names}",
        "left": "{left:.2%}",
    }
    options = scene.Option("--seeds", 60), scene.Option("--first", 1), scene.Option("--seconds", 20.0)
    scene.main(__doc__, rows, columns, *options, after=counted)
