"""The on-line estimators on random joints: errors, 95 % intervals, false alarms, undeclared effects.

    python benchmarks/estimators.py [--mode robust|paper] [--joints 8] [--seconds 20] [--cases NAME,…]
    python benchmarks/estimators.py --undeclared [--motion multisine|point-to-point|hand-guided|…]
    python benchmarks/estimators.py --mixed [--joints 120] [--first 1]

Fresh joints, read as drives read them: 4096 to 16384 counts (stiff joints behind a gear of 100), 16 to 18
bits at the link, no velocity, torque noise of 0.1 to 0.5 % of rated. Judged from five seconds on, where the
estimate is valid and observable: its error against the slope of the spring, relative to that slope (in a
gap, to 0.3 of its rms); the share of its 95 % intervals that hold the slope.

The joints are those of an independent simulator in C (`world.c`). With --undeclared they have cubic springs
whose order is declared, and an effect of 3 to 8 % of the torque's amplitude that no file names. Names are
counted by joints: in the end, and those that are given up again; the time is the median to the first of
either. With --mixed a spring, its declaration, an effect and a motion are drawn for each joint, from the easy
to the hopeless; wrong is what is off by more than a tenth and by more than three standard deviations.
"""

import sys
import time
from collections import Counter
from collections.abc import Iterator, Mapping
from typing import NamedTuple

import numpy as np
import scene
from scene import joints
from world import T, simulate

from estimator import (
    EstimatorSettings,
    JointModel,
    Record,
    Status,
    make_estimator,
)
from estimator.sample import SIGMA_95

SETTLED_S = 5.0  # the estimate is judged from there on
USABLE = int(Status.VALID | Status.OBSERVABLE)
WRONG = 0.1  # of the stiffness
OFF = (0.8, 1.2)  # k, and the shape above its lower bound, of a declaration that is 20 % off


class Case(NamedTuple):
    """A spring of `world.c`, and as what it is declared."""

    spring: str = "cubic"
    model: str = "polynomial"
    order: int | None = 2
    off: tuple[float, float] | None = None  # declared parameters over the true ones; None: none are
    stiff: bool = False
    soft: float = 1.0  # times the spring: it is bent as much further
    pull: float = 0.0  # on the link, over the motion's torque: the deflection stays on one side
    more: Mapping[str, float | str] = {}


CASES = {
    "linear": Case("linear", "linear", None),
    "cubic": Case(),
    "cubic, order left out": Case(order=None),
    "cubic, link 1 period late": Case(more={"link_delay": T}),
    "cubic, link 3 periods late": Case(more={"link_delay": 3 * T}),
    "cubic, undeclared friction": Case(more={"friction": "coulomb", "coulomb": 0.3}),
    "cubic, stiff": Case(stiff=True),
    "vsa-ii from nothing": Case("vsa-ii", "vsa-ii", None),
    "vsa-ii declared right": Case("vsa-ii", "vsa-ii", None, (1.0, 1.0)),
    "vsa-ii declared 20 % off": Case("vsa-ii", "vsa-ii", None, OFF),
    "vsa-ii as a polynomial of 3": Case("vsa-ii", "polynomial", 3),
    "vsa-ii near its end": Case("vsa-ii", "vsa-ii", None, soft=0.06),
    "exponential from nothing": Case("exponential", "exponential", None),
    "exponential declared 20 % off": Case("exponential", "exponential", None, OFF),
    "steep exponential": Case("exponential", "exponential", None, soft=0.03),
    "exponential as unknown": Case("exponential", "unknown", None),
    "exponential as unknown, on one side": Case("exponential", "unknown", None, pull=1.5),
    "vsa-ii as unknown, on one side": Case("vsa-ii", "unknown", None, pull=1.5),
}
# Of a spring's shape: the setting, the parameter, its lower bound, the range that is drawn.
SHAPES = {
    "vsa-ii": ("linkage", "c", 1.0, (1.5, 1.9)),
    "exponential": ("exponent", "b_per_rad", 0.0, (3.0, 12.0)),
}


def effects(rng: np.random.Generator, rated: float, stiffness: float) -> dict[str, dict[str, float | str]]:
    """Settings of each undeclared effect, of a joint of this rated torque, N·m, and stiffness, N·m/rad."""
    torque, share = rated * rng.uniform(0.03, 0.08), rng.uniform(0.03, 0.08)
    friction = {"coulomb": torque, "stribeck": rng.uniform(0.3, 0.8)}
    width = rng.uniform(0.03, 0.15) * rated / stiffness  # of the deflection at rated torque
    return {
        "nothing": {},
        "link 1 period late": {"link_delay": T},
        "link 3 periods late": {"link_delay": 3 * T},
        "torque sampled, not held": {"torque_delay": 0.5 * T},
        "torque 3 periods late": {"torque_delay": 3 * T},
        "Coulomb friction": {"friction": "coulomb", "coulomb": torque},
        "Stribeck friction": {"friction": "stribeck", **friction},
        "LuGre friction": {"friction": "lugre", **friction},
        "gear loss": {"gear_loss": share},
        "LuGre friction and gear loss": {"friction": "lugre", **friction, "gear_loss": share},
        "hysteresis, Bouc-Wen": {
            "hysteresis": "bouc-wen",
            "hysteresis_torque": torque,
            "hysteresis_width": width,
        },
        "hysteresis, Dahl": {"hysteresis": "dahl", "hysteresis_torque": torque, "hysteresis_width": width},
        "backlash": {"backlash": width},
        "transmission damping": {"transmission_damping": stiffness * rng.uniform(0.5e-3, 3e-3)},
        "cogging": {"cogging": torque / 2, "cogging_periods": int(rng.integers(8, 64))},
        "inertia 5 % off": {},
        "damping 20 % off": {},
        "motor of 1024 counts": {"motor_counts": 1024},
        "torque noise 2 % of rated": {"torque_noise": 0.02 * rated},
        "torque behind a filter of 10 ms": {"torque_lag": 0.01},
        "eccentric link encoder": {"eccentricity": rng.uniform(0.2e-3, 2e-3)},
    }


EFFECTS = tuple(effects(np.random.default_rng(0), 1.0, 1.0))
MOTIONS = ("multisine", "point-to-point", "hand-guided", "pushes", "harmonic")


class Drawn(NamedTuple):
    """One joint of an ensemble: as it is declared, what its drive read, and the truth."""

    model: JointModel
    record: Record
    stiffness_nm_rad: np.ndarray


def drawn(case: Case, effect: str, seed: int, seconds: float, motion: str) -> Drawn:
    """A random joint, the same for every effect, with this one."""
    rng = np.random.default_rng(seed)

    def between(soft: tuple[float, float], stiff: tuple[float, float]) -> float:
        return rng.uniform(*(stiff if case.stiff else soft))

    stiffness, size = between((80, 220), (5500, 12000)), between((5, 10), (15, 40))
    motion = "point-to-point" if case.pull else motion  # nothing else holds the joint
    inertia, damping = between((0.08, 0.2), (0.3, 1.2)), between((0.4, 1.2), (2, 10))
    where = 4e-3 if case.stiff else 0.06  # rad: there the cubic part is a few to thirty percent
    settings: dict[str, float | str] = {
        "spring": case.spring,
        "stiffness": stiffness,
        "cubic": stiffness * rng.uniform(0.03, 0.3) / where**2,
        "inertia": inertia,
        "damping": damping,
        "link_inertia": between((0.3, 0.6), (0.5, 1.5)),
        "link_damping": rng.uniform(0.1, 1),
        "gravity": between((0, 6), (0, 15)),
        "motor_counts": int(rng.choice([4096, 8192, 16384])) * (100 if case.stiff else 1),
        "link_bits": int(rng.choice([17, 18] if case.stiff else [16, 17, 18])),
        "torque_noise": rng.uniform(0.001, 0.005) * 2 * size,
        "motion": motion,
        "size": rng.uniform(0.5, 1.2) if motion == "point-to-point" else size,
        "top_hz": rng.uniform(0.5, 2.0) if motion == "harmonic" else 3.0,
        "push": size / 2 if motion == "pushes" else size,
        "pull": case.pull * size,
        "seconds": seconds,
        "seed": seed,
    }
    settings |= {**case.more, **effects(rng, size, stiffness)[effect]}
    parameters = {}
    if case.spring in SHAPES:
        setting, name, low, span = SHAPES[case.spring]
        shape = rng.uniform(*span)
        k = case.soft * (rng.uniform(300.0, 700.0) if case.spring == "vsa-ii" else stiffness)
        settings |= {"stiffness": k, setting: shape}
        if case.off is not None:
            parameters = {"k_nm_rad": case.off[0] * k, name: low + case.off[1] * (shape - low)}
    inertia *= 1.05 if effect == "inertia 5 % off" else 1.0
    damping *= 0.8 if effect == "damping 20 % off" else 1.0
    model = joints.joint_model(inertia, damping, model=case.model, order=case.order, parameters=parameters)
    world = simulate(**settings)
    return Drawn(model, world.record, world.stiffness_nm_rad)


def online(joint: Drawn, mode: str) -> scene.Row:
    """Run a mode over a recording: what is judged, alarms, effects named and after how long, µs a tick.

    Judged is what is usable after five seconds; NaN where nothing ever is.
    """
    estimator = make_estimator(joint.model, EstimatorSettings(mode=mode), T)
    after, named, out, spent_s = np.nan, set(), [], 0.0
    for sample in joint.record.samples():
        start = time.process_time()
        estimate = estimator.step(sample)
        spent_s += time.process_time() - start
        out.append((estimate.stiffness_nm_rad, estimate.stiffness_std_nm_rad, estimate.status))
        if sample.sequence % 250 == 0 and (names := estimator.core.undeclared(0)):
            named.update(names)
            after = sample.sequence * T if np.isnan(after) else after
    truth, last = joint.stiffness_nm_rad, set(estimator.core.undeclared(0))
    stiffness, deviation, status = np.array(out).T
    status = status.astype(int)
    chosen = (status & USABLE == USABLE) & (np.arange(len(truth)) * T >= SETTLED_S)
    changed = status & int(Status.CHANGED) > 0
    found = {
        "us": 1e6 * spent_s / len(truth),
        "false_alarms": int(np.sum(changed[1:] & ~changed[:-1])),
        "usable": float(np.mean(chosen[round(SETTLED_S / T) :])),
        **dict.fromkeys(("rmse", "std", "coverage", "wrong"), np.nan),
        "names": sorted(last),
        "meanwhile": sorted(named - last),
        "named_after_s": after,
    }
    if not chosen.any():
        return found
    size = np.maximum(truth, 0.3 * np.sqrt(np.mean(truth**2)))[chosen]
    error, std = stiffness[chosen] - truth[chosen], deviation[chosen]
    return found | {
        "rmse": float(np.sqrt(np.mean((error / size) ** 2))),
        "std": float(np.median(std / size)),
        "coverage": float(np.mean(np.abs(error) < SIGMA_95 * std)),
        "wrong": float(np.mean((np.abs(error) > WRONG * size) & (np.abs(error) > 3.0 * std))),
    }


def mixed(args) -> Iterator[scene.Row]:
    """One row a motion: random springs, declarations, effects; shares are of all usable time."""
    made: dict[str, list[scene.Row]] = {motion: [] for motion in MOTIONS}
    for seed in range(args.first, args.first + args.joints):
        rng = np.random.default_rng([seed, 1])
        case, effect, motion = (str(rng.choice(list(names))) for names in (CASES, EFFECTS, MOTIONS))
        found = online(drawn(CASES[case], effect, seed, args.seconds, motion), args.mode)
        made[motion].append(found)
        if found["wrong"] > 0.0:
            said = f"{seed}: {case}, {effect}, {motion}: {found['wrong']:.1%} of {found['usable']:.0%} wrong"
            print(said, file=sys.stderr)
    for motion, found in (*made.items(), ("all", [one for each in made.values() for one in each])):
        usable = np.array([one["usable"] for one in found])
        share = usable / max(usable.sum(), 1e-12)
        of_usable = {
            key: float(np.nansum(share * [one[key] for one in found])) for key in ("wrong", "coverage")
        }
        yield {"motion": motion, "joints": len(found), "usable": float(np.mean(usable)), **of_usable}


def summary(case: str, found: list[scene.Row]) -> scene.Row:
    """The figures of several joints together; names with the number of joints."""

    def over(key: str, figure) -> float | None:
        finite = [one[key] for one in found if np.isfinite(one[key])]
        return float(figure(finite)) if finite else None

    def counted(key: str) -> str | None:
        counts = Counter(name for one in found for name in one[key])
        return ", ".join(f"{name} {count}" for name, count in counts.items()) or None

    return {
        "case": case,
        "usable": over("usable", np.mean),
        **{f"rmse_{name}": over("rmse", of) for name, of in (("median", np.median), ("worst", np.max))},
        "std_median": over("std", np.median),
        "coverage": over("coverage", np.mean),
        "coverage_worst": over("coverage", np.min),
        "false_alarms": sum(one["false_alarms"] for one in found),
        "us": over("us", np.median),
        **{key: counted(key) for key in ("names", "meanwhile")},
        "after_s": over("named_after_s", np.median),
    }


def rows(args) -> Iterator[scene.Row]:
    """One row a spring, or with --undeclared an effect, with --mixed a motion."""
    if args.mixed:
        yield from mixed(args)
        return
    for name in args.cases or (EFFECTS if args.undeclared else CASES):
        case, effect = (CASES["cubic"], name) if args.undeclared else (CASES[name], "nothing")
        seeds = range(args.first, args.first + args.joints)
        made = (drawn(case, effect, seed, args.seconds, args.motion) for seed in seeds)
        yield summary(name, [online(joint, args.mode) for joint in made])


COLUMNS = {
    "springs": "{case}",
    "usable": "{usable:.0%}",
    "RMSE: median": "{rmse_median:.3%}",
    "worst": "{rmse_worst:.3%}",
    "std": "{std_median:.3%}",
    "95 % intervals hold: mean": "{coverage:.0%}",
    "worst joint": "{coverage_worst:.0%}",
    "changes said": "{false_alarms}",
}
NAMED = {
    "named in the end": "{names}",
    "only meanwhile": "{meanwhile}",
    "first after / s": "{after_s:.0f}",
}

MIXED = {
    "motion": "{motion}",
    "joints": "{joints}",
    "usable": "{usable:.1%}",
    "wrong of usable": "{wrong:.2%}",
    "95 % intervals hold": "{coverage:.1%}",
}

if __name__ == "__main__":
    more = NAMED if "--undeclared" in sys.argv else {"µs a tick": "{us:.1f}"}
    scene.main(
        __doc__,
        rows,
        MIXED if "--mixed" in sys.argv else COLUMNS | more,
        scene.Option("--mode", ("robust", "paper")),
        scene.Option("--joints", 8),
        scene.Option("--seconds", 20.0),
        scene.Option("--first", 1, "seed of the first joint"),
        scene.Option("--undeclared", False, "effects that no file names"),
        scene.Option(
            "--mixed", False, "a spring, a declaration, an effect and a motion drawn for each joint"
        ),
        scene.Option("--motion", MOTIONS),
        scene.Option("--cases", [], "of springs or effects; all if left out"),
    )
