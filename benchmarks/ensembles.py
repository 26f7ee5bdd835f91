"""Stiffness on line over random joints of another integrator: errors, intervals, false alarms.

    python benchmarks/ensembles.py [--mode robust|balance] [--joints 8] [--seconds 20] [--cases NAME,…]
                                  [--json]

Fresh joints on random multisines, read as drives read them: 4096 to 16384 counts (stiff joints behind a gear
of 100), 16 to 18 bits at the link, no velocity, torque noise of 0.1 to 0.5 % of rated. From five seconds on,
where the estimate is valid and observable. The integrator is that of the tests (`tests/joints.py`).
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import NamedTuple

import numpy as np
from rich.console import Console
from rich.progress import track

from estimator import EstimatorSettings, JointModel, Record, Status, make_estimator
from estimator.sample import SIGMA_95

sys.path.insert(0, str(Path(__file__).parent.parent / "tests"))

import joints

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


def draw_joints(case, n_joints, seconds, seed):
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
            truth,
            j,
            T,
            motor_counts=counts,
            link_bits=bits,
            velocity_rad_s=None,
            torque_noise=rng.normal(0, noise, (n, 1)),
            link_delay=late,
        )
        parameters = {}
        if off is not None:
            (k_name, k), (shape_name, shape), low = declared[j]
            parameters = {k_name: off[0] * k, shape_name: low + off[1] * (shape - low)}
        known = joints.joint_model(B[j, 0], D[j, 0], model=model, order=order, parameters=parameters)
        jerk = np.diff(truth.q[:, j].reshape(n), 3) / T**3
        yield Drawn(known, record, truth.sigma[:, j, 0], noise, float(np.sqrt(np.mean(jerk**2))))


def judged(stiffness, std, truth, usable):
    """(usable share after 5 s, relative RMSE, coverage of the 95 % intervals) of one joint."""
    if not usable.any():
        return 0.0, np.nan, np.nan
    error = stiffness[usable] - truth[usable]
    return (
        np.mean(usable[round(SETTLED_S / T) :]),
        np.sqrt(np.mean((error / truth[usable]) ** 2)),
        np.mean(np.abs(error) < SIGMA_95 * std[usable]),
    )


def summary(found):
    """The figures of several joints together, from `judged`; None where no joint has any."""
    usable, rmse, coverage = np.array(found).T
    some = bool(np.isfinite(rmse).any())
    return {
        "usable": float(np.mean(usable)),
        "rmse_relative_median": float(np.nanmedian(rmse)) if some else None,
        "rmse_relative_worst": float(np.nanmax(rmse)) if some else None,
        "coverage": float(np.nanmean(coverage)) if some else None,
    }


def percent(value, digits=0):
    return "-" if value is None else f"{100 * value:.{digits}f}"


def table(header, rows):
    """Print a table in Markdown."""
    print("| " + " | ".join(header) + " |")
    print("|" + "---|" * len(header))
    for row in rows:
        print("| " + " | ".join(map(str, row)) + " |")


def arguments(description):
    """The command line of a program over random joints."""
    parser = argparse.ArgumentParser(
        description=description, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--joints", type=int, default=8)
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--cases", default=",".join(name.replace(",", ";") for name in CASES))
    parser.add_argument("--mode", choices=["robust", "balance"], default="robust")
    parser.add_argument("--json", action="store_true")
    args = parser.parse_args()
    args.cases = [name.replace(";", ",") for name in args.cases.split(",")]
    return args


def measure(case, n_joints, seconds, seed, mode="robust"):
    """One row."""
    found, alarms = [], 0
    for joint in draw_joints(case, n_joints, seconds, seed):
        estimator = make_estimator(joint.model, EstimatorSettings(mode=mode), T)
        out = np.array([estimator.step(sample)[:5] for sample in joint.record.samples()])
        status = out[:, 1].astype(int)
        usable = (status & USABLE == USABLE) & (np.arange(len(out)) * T >= SETTLED_S)
        found.append(judged(out[:, 3], out[:, 4], joint.stiffness_nm_rad, usable))
        changed = (status & int(Status.CHANGED)) > 0
        alarms += int(np.sum(changed[1:] & ~changed[:-1]))
    return {"case": case, **summary(found), "false_alarms": alarms}


def main():
    args = arguments(__doc__)
    rows = [
        measure(case, args.joints, args.seconds, args.seed, args.mode)
        for case in track(args.cases, "cases", console=Console(stderr=True))
    ]
    if args.json:
        print(json.dumps(rows))
        return
    table(
        ("springs", "usable", "RMSE %: median", "worst", "95 % intervals cover", "false alarms"),
        (
            (
                r["case"],
                f"{percent(r['usable'])} %",
                percent(r["rmse_relative_median"], 2),
                percent(r["rmse_relative_worst"], 2),
                f"{percent(r['coverage'])} %",
                r["false_alarms"],
            )
            for r in rows
        ),
    )


if __name__ == "__main__":
    main()
