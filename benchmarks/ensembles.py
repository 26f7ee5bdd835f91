"""Stiffness on line over random joints of another integrator: errors, intervals, false alarms.

    python benchmarks/ensembles.py [--mode robust|paper] [--joints 8] [--seconds 20] [--cases NAME,…]

Fresh joints on random multisines, read as drives read them: 4096 to 16384 counts (stiff joints behind a gear
of 100), 16 to 18 bits at the link, no velocity, torque noise of 0.1 to 0.5 % of rated. From five seconds on,
where the estimate is valid and observable. The integrator is that of the tests (`tests/joints.py`).
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import scene
from scene import joints

from estimator import EstimatorSettings, JointModel, Record, Status, make_estimator
from estimator.sample import SIGMA_95

T = 1e-3
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
COLUMNS = {
    "springs": "{case}",
    "usable": "{usable:.0%}",
    "RMSE: median": "{rmse_median:.3%}",
    "worst": "{rmse_worst:.3%}",
    "std": "{std_median:.3%}",
    "95 % intervals hold: mean": "{coverage:.0%}",
    "worst joint": "{coverage_worst:.0%}",
    "false alarms": "{false_alarms}",
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
    torque_noise_nm: float
    jerk_rad_s3: float  # rms, of the link


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
        jerk = np.diff(truth.q[:, j].reshape(n), 3) / T**3
        yield Drawn(known, record, truth.sigma[:, j, 0], noise, float(np.sqrt(np.mean(jerk**2))))


def judged(stiffness, std, truth, usable) -> scene.Row:
    """Share usable after five seconds; error and interval there, relative to the truth.

    Where that is next to nothing (in a gap) they are relative to 0.3 of its rms. NaN: never usable.
    """
    usable = usable & (np.arange(len(truth)) * T >= SETTLED_S)
    share = float(np.mean(usable[round(SETTLED_S / T) :]))
    if not usable.any():
        return {"usable": share, "rmse": np.nan, "std": np.nan, "coverage": np.nan}
    size = np.maximum(truth, 0.3 * np.sqrt(np.mean(truth**2)))[usable]
    error, std = stiffness[usable] - truth[usable], std[usable]
    return {
        "usable": share,
        "rmse": float(np.sqrt(np.mean((error / size) ** 2))),
        "std": float(np.median(std / size)),
        "coverage": float(np.mean(np.abs(error) < SIGMA_95 * std)),
    }


def run(model: JointModel, record: Record, truth: np.ndarray, mode: str) -> scene.Row:
    """Run the on-line estimator over a recording: as `judged`, alarms, effects named and after how long."""
    estimator = make_estimator(model, EstimatorSettings(mode=mode), T)
    out, after, named = np.empty((len(record), 5)), np.nan, set()
    for k, sample in enumerate(record.samples()):
        out[k] = estimator.step(sample)[:5]
        if k % 250 == 0 and (names := estimator.core.undeclared(0)):
            named.update(names)
            after = k * T if np.isnan(after) else after
    status = out[:, 1].astype(int)
    changed = (status & int(Status.CHANGED)) > 0
    return {
        **judged(out[:, 3], out[:, 4], truth, status & USABLE == USABLE),
        "false_alarms": int(np.sum(changed[1:] & ~changed[:-1])),
        "names": sorted(estimator.core.undeclared(0)),
        "meanwhile": sorted(named - set(estimator.core.undeclared(0))),
        "named_after_s": after,
    }


def summary(found: list[scene.Row]) -> scene.Row:
    """The figures of several joints together."""
    usable, rmse, std, coverage = (
        np.array([one[key] for one in found]) for key in ("usable", "rmse", "std", "coverage")
    )
    some = bool(np.isfinite(rmse).any())
    return {
        "usable": float(usable.mean()),
        "rmse_median": float(np.nanmedian(rmse)) if some else None,
        "rmse_worst": float(np.nanmax(rmse)) if some else None,
        "std_median": float(np.nanmedian(std)) if some else None,
        "coverage": float(np.nanmean(coverage)) if some else None,
        "coverage_worst": float(np.nanmin(coverage)) if some else None,
    }


def rows(args) -> Iterator[scene.Row]:
    """One row a case."""
    for case in args.cases:
        drawn = draw_joints(case, args.joints, args.seconds, args.seed)
        found = [run(joint.model, joint.record, joint.stiffness_nm_rad, args.mode) for joint in drawn]
        alarms = sum(one["false_alarms"] for one in found)
        yield {"case": case, **summary(found), "false_alarms": alarms}


OPTIONS = (
    scene.Option("--joints", 8),
    scene.Option("--seconds", 20.0),
    scene.Option("--seed", 1),
    scene.Option("--cases", list(CASES)),
)

if __name__ == "__main__":
    scene.main(__doc__, rows, COLUMNS, *OPTIONS, scene.Option("--mode", ("robust", "paper")))
