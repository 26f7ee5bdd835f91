"""The on-line estimators on random joints: errors, 95 % intervals, false alarms, undeclared effects.

    python benchmarks/estimators.py [--mode robust|paper] [--joints 8] [--seconds 20] [--cases NAME,…]
    python benchmarks/estimators.py --undeclared [--motion multisine|point-to-point|hand-guided|…]

Fresh joints, read as drives read them: 4096 to 16384 counts (stiff joints behind a gear of 100), 16 to 18
bits at the link, no velocity, torque noise of 0.1 to 0.5 % of rated. Judged from five seconds on, where the
estimate is valid and observable: its error against the slope of the spring, relative to that slope (in a
gap, to 0.3 of its rms); the share of its 95 % intervals that hold the slope.

The springs of the first table move on random multisines by the integrator of the tests (`tests/joints.py`).
With --undeclared the joints are those of an independent simulator in C (`world.c`), with cubic springs whose
order is declared, and an effect of 3 to 8 % of the torque's amplitude that no file names. Names are counted
by joints: in the end, and those that are given up again; the time is the median to the first of either.
"""

from __future__ import annotations

import sys
import time
from collections import Counter
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import scene
from scene import joints
from world import T, simulate

from estimator import (
    EstimatorSettings,
    JointModel,
    Motor,
    Record,
    Status,
    Transmission,
    make_estimator,
)
from estimator.sample import SIGMA_95

SETTLED_S = 5.0  # the estimate is judged from there on
USABLE = int(Status.VALID | Status.OBSERVABLE)
OFF = (0.8, 1.2)  # k, and the shape above its lower bound, of a declaration that is 20 % off
# name: (spring, model, order, declared off by, stiff, periods that the link is late, Coulomb friction in N·m)
CASES = {
    "linear": ("linear", "linear", None, None, False, 0, 0.0),
    "cubic": ("cubic", "polynomial", 2, None, False, 0, 0.0),
    "cubic, order left out": ("cubic", "polynomial", None, None, False, 0, 0.0),
    "cubic, link 1 period late": ("cubic", "polynomial", 2, None, False, 1, 0.0),
    "cubic, link 3 periods late": ("cubic", "polynomial", 2, None, False, 3, 0.0),
    "cubic, undeclared friction": ("cubic", "polynomial", 2, None, False, 0, 0.3),
    "cubic, stiff": ("cubic", "polynomial", 2, None, True, 0, 0.0),
    "vsa-ii from nothing": ("vsa-ii", "vsa-ii", None, None, False, 0, 0.0),
    "vsa-ii declared right": ("vsa-ii", "vsa-ii", None, (1.0, 1.0), False, 0, 0.0),
    "vsa-ii declared 20 % off": ("vsa-ii", "vsa-ii", None, OFF, False, 0, 0.0),
    "exponential from nothing": ("exponential", "exponential", None, None, False, 0, 0.0),
    "exponential declared 20 % off": ("exponential", "exponential", None, OFF, False, 0, 0.0),
}


def springs(kind, K, rng):
    """(torque, stiffness, per joint what declares it and its lower bound)."""
    if kind == "vsa-ii":
        k, c = rng.uniform(300, 700, K.shape), rng.uniform(1.5, 1.9, K.shape)
        return *joints.vsa_ii(k, c), [
            (("k_nm_rad", a), ("c", b), 1.0) for a, b in zip(k[:, 0], c[:, 0], strict=True)
        ]
    if kind == "exponential":
        b = rng.uniform(3, 12, K.shape)
        return (
            lambda phi: np.sign(phi) * K / b * np.expm1(b * np.abs(phi)),
            lambda phi: K * np.exp(b * np.abs(phi)),
            [(("k_nm_rad", x), ("b_per_rad", y), 0.0) for x, y in zip(K[:, 0], b[:, 0], strict=True)],
        )
    where = 4e-3 if K.max() > 1000 else 0.06  # rad: there the cubic part is a few to thirty percent
    cubic = rng.uniform(0.03, 0.3, K.shape) / where**2 if kind == "cubic" else np.zeros(K.shape)
    return *joints.polynomial(np.stack([K, K * cubic], axis=-1)), [None] * len(K)


class Drawn(NamedTuple):
    """One joint of an ensemble: as it is declared, what its drive read, and the truth."""

    model: JointModel
    record: Record
    stiffness_nm_rad: np.ndarray


def draw_joints(case: str, n_joints: int, seconds: float, seed: int) -> Iterator[Drawn]:
    """The joints of a case."""
    kind, model, order, off, stiff, late, friction = CASES[case]
    rng, n = np.random.default_rng(seed), round(seconds / T)

    def draw(soft, hard):
        return rng.uniform(*(hard if stiff else soft), (n_joints, 1))

    K, B, D = draw((80, 220), (5500, 12000)), draw((0.08, 0.2), (0.3, 1.2)), draw((0.4, 1.2), (2, 10))
    torque, stiffness, declared = springs(kind, K, rng)
    M, Dq, gravity = draw((0.3, 0.6), (0.5, 1.5)), draw((0.1, 1), (0.1, 1)), draw((0, 6), (0, 15))
    plants = joints.Plants(torque, stiffness, B, D, M[:, 0], Dq[:, 0], gravity[:, 0], coulomb=friction)
    size = draw((5, 10), (15, 40))[None]
    truth = joints.simulate(plants, joints.sweep(rng, n, n_joints, 1, T, size, 4.0 if stiff else 3.0), T)
    for j in range(n_joints):
        rated = 1.2 * np.abs(truth.tau[:, j]).max()
        counts = rng.choice([4096, 8192, 16384]) * (100 if stiff else 1)
        bits = rng.choice([17, 18] if stiff else [16, 17, 18])
        noise = rng.uniform(0.001, 0.005) * rated
        record = joints.record(
            truth, j, T, motor_counts=counts, link_bits=bits, velocity_rad_s=None,
            torque_noise=rng.normal(0, noise, (n, 1)), link_delay=late,
        )  # fmt: skip
        parameters = {}
        if off is not None:
            (k_name, k), (shape_name, shape), low = declared[j]
            parameters = {k_name: off[0] * k, shape_name: low + off[1] * (shape - low)}
        known = joints.joint_model(B[j, 0], D[j, 0], model=model, order=order, parameters=parameters)
        yield Drawn(known, record, truth.sigma[:, j, 0])


def effects(rng: np.random.Generator, rated: float, stiffness: float) -> dict[str, dict[str, float | str]]:
    """Settings of each undeclared effect, of a joint of this rated torque, N·m, and stiffness, N·m/rad."""
    torque, share = rated * rng.uniform(0.03, 0.08), rng.uniform(0.03, 0.08)
    friction = {"coulomb": torque, "stribeck": rng.uniform(0.3, 0.8)}
    width = rng.uniform(0.03, 0.15) * rated / stiffness  # of the deflection at rated torque
    return {
        "nothing": {},
        "link 1 period late": {"link_delay": T},
        "link 3 periods late": {"link_delay": 3 * T},
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
    }


EFFECTS = tuple(effects(np.random.default_rng(0), 1.0, 1.0))


def draw_undeclared(effect: str, count: int, seconds: float, motion: str) -> Iterator[Drawn]:
    """Random joints, the same for every effect, with this one."""
    for seed in range(1, count + 1):
        rng = np.random.default_rng(seed)
        stiffness, size = rng.uniform(80, 220), rng.uniform(5, 10)
        inertia, damping = rng.uniform(0.08, 0.2), rng.uniform(0.4, 1.2)
        settings = {
            "spring": "cubic",
            "stiffness": stiffness,
            "cubic": stiffness * rng.uniform(0.03, 0.3) / 0.06**2,
            "inertia": inertia,
            "damping": damping,
            "link_inertia": rng.uniform(0.3, 0.6),
            "link_damping": rng.uniform(0.1, 1),
            "gravity": rng.uniform(0, 6),
            "motor_counts": int(rng.choice([4096, 8192, 16384])),
            "link_bits": int(rng.choice([16, 17, 18])),
            "torque_noise": rng.uniform(0.001, 0.005) * 2 * size,
            "motion": motion,
            "size": rng.uniform(0.5, 1.2) if motion == "point-to-point" else size,
            "top_hz": rng.uniform(0.5, 2.0) if motion == "harmonic" else 3.0,
            "push": size / 2 if motion == "pushes" else size,
            "seconds": seconds,
            "seed": seed,
        }
        motor = Motor(
            inertia_kg_m2=inertia * (1.05 if effect == "inertia 5 % off" else 1.0),
            viscous_damping_nm_s_rad=damping * (0.8 if effect == "damping 20 % off" else 1.0),
            transmission=Transmission(model="polynomial", order=2, parameters={}),
        )
        world = simulate(**(settings | effects(rng, size, stiffness)[effect]))
        model = JointModel(arrangement="single", motors=(motor,))
        yield Drawn(model, world.record, world.stiffness_nm_rad)


def online(drawn: Drawn, mode: str) -> scene.Row:
    """Run a mode over a recording: what is judged, alarms, effects named and after how long, µs a tick.

    Judged is what is usable after five seconds; NaN where nothing ever is.
    """
    estimator = make_estimator(drawn.model, EstimatorSettings(mode=mode), T)
    after, named, out, spent_s = np.nan, set(), [], 0.0
    for sample in drawn.record.samples():
        start = time.process_time()
        estimate = estimator.step(sample)
        spent_s += time.process_time() - start
        out.append((estimate.stiffness_nm_rad, estimate.stiffness_std_nm_rad, estimate.status))
        if sample.sequence % 250 == 0 and (names := estimator.core.undeclared(0)):
            named.update(names)
            after = sample.sequence * T if np.isnan(after) else after
    truth, last = drawn.stiffness_nm_rad, set(estimator.core.undeclared(0))
    stiffness, deviation, status = np.array(out).T
    status = status.astype(int)
    chosen = (status & USABLE == USABLE) & (np.arange(len(truth)) * T >= SETTLED_S)
    changed = status & int(Status.CHANGED) > 0
    found = {
        "us": 1e6 * spent_s / len(truth),
        "false_alarms": int(np.sum(changed[1:] & ~changed[:-1])),
        "usable": float(np.mean(chosen[round(SETTLED_S / T) :])),
        **dict.fromkeys(("rmse", "std", "coverage"), np.nan),
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
    }


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
    """One row a spring, or with --undeclared an effect."""
    for case in args.cases or (EFFECTS if args.undeclared else CASES):
        if args.undeclared:
            drawn = draw_undeclared(case, args.joints, args.seconds, args.motion)
        else:
            drawn = draw_joints(case, args.joints, args.seconds, args.seed)
        yield summary(case, [online(joint, args.mode) for joint in drawn])


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

if __name__ == "__main__":
    scene.main(
        __doc__,
        rows,
        COLUMNS | (NAMED if "--undeclared" in sys.argv else {"µs a tick": "{us:.1f}"}),
        scene.Option("--mode", ("robust", "paper")),
        scene.Option("--joints", 8),
        scene.Option("--seconds", 20.0),
        scene.Option("--seed", 1, "of the springs"),
        scene.Option("--undeclared", False, "effects that no file names"),
        scene.Option("--motion", ("multisine", "point-to-point", "hand-guided", "pushes", "harmonic")),
        scene.Option("--cases", [], "of springs or effects; all if left out"),
    )
