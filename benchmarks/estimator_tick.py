"""Speed of the estimators: one tick, batch fits, a diagnosis.

    python benchmarks/estimator_tick.py [--ticks N]

Two-motor VSA joints at 1 kHz on encoder counts. A tick is timed alone, with nothing compiled at run time;
the percentiles are over all ticks after the first three seconds. The diagnosis is of the paper's quadratic
joint as `drivelink sim` makes it, with friction that the model lacks: CPU time of one thread.
"""

from __future__ import annotations

import gc
import time
from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
import scene
from diagnosis_seeds import measured

from drivelink import jointfile
from estimator import EstimatorSettings, JointModel, Motor, Record, Sample, Transmission, fit, make_estimator
from estimator.diagnosis import diagnose
from estimator.model_monitor import ModelMonitor, measure_baseline

T = 1e-3
_CASES = {
    "robust, polynomial": ("polynomial", EstimatorSettings()),
    "robust, vsa-ii": ("vsa-ii", EstimatorSettings()),
    "robust, black box": ("unknown", EstimatorSettings()),
    "paper": ("polynomial", EstimatorSettings(mode="paper")),
}


def joint(name: str, motors: int) -> JointModel:
    motor = Motor(
        inertia_kg_m2=0.02,
        viscous_damping_nm_s_rad=0.02,
        transmission=Transmission(model=name, order=2 if name == "polynomial" else None),
    )
    return JointModel(arrangement="antagonistic" if motors == 2 else "single", motors=(motor,) * motors)


def record(n: int, motors: int) -> Record:
    """A motion that obeys eq 5 by construction: theta and phi are given, the torque follows."""
    t = np.arange(n) * T
    theta, torque = np.empty((n, motors)), np.empty((n, motors))
    q = 0.3 * np.sin(1.1 * t)
    for i in range(motors):
        w1, w2 = 4.0 + i, 9.0 - i
        phi = 0.3 * np.sin(w1 * t) + 0.15 * np.sin(w2 * t)
        beta = np.arcsin(1.75 * np.sin(phi / 2)) - phi / 2
        spring = 0.5 * beta * (1.75 * np.cos(phi / 2) / np.sqrt(1 - (1.75 * np.sin(phi / 2)) ** 2) - 1)
        theta[:, i] = q - phi
        omega = np.gradient(theta[:, i], T)
        torque[:, i] = 0.02 * np.gradient(omega, T) + 0.02 * omega - spring
    step = 2 * np.pi / 65536
    return Record(
        period_s=T,
        sequence=np.arange(n),
        motor_position_rad=np.floor(theta / step) * step,
        motor_torque_nm=torque,
        link_position_rad=np.floor(q / step) * step,
    )


def ticks(name: str, settings: EstimatorSettings, n: int) -> dict[str, float]:
    """Percentiles of one tick in microseconds."""
    return percentiles(make_estimator(joint(name, 2), settings, T).step, list(record(n, 2).samples()))


def percentiles(step: Callable[[Sample], object], samples: list[Sample]) -> dict[str, float]:
    """Of a call's time over all samples but the first 3000, in microseconds."""
    clock = time.perf_counter_ns
    spent = np.empty(len(samples))
    gc.collect()
    gc.disable()
    for k, sample in enumerate(samples):
        begin = clock()
        step(sample)
        spent[k] = clock() - begin
    gc.enable()
    late = spent[3000:] / 1e3
    return {f"p{p:g}".replace(".", ""): float(np.percentile(late, p)) for p in (50, 90, 99, 99.9)}


def monitored(n: int) -> dict[str, float]:
    """Percentiles of one tick of the model's monitor in microseconds."""
    motor = replace(
        joint("vsa-ii", 1).motors[0],
        transmission=Transmission(model="vsa-ii", parameters={"k_nm_rad": 0.5, "c": 1.75}),
    )
    model = JointModel(arrangement="antagonistic", motors=(motor, motor))
    data = record(n, 2)
    monitor = ModelMonitor(model, T, measure_baseline(data, model))
    return percentiles(monitor.core.step, list(data.samples()))


def batch(name: str) -> float:
    """Seconds to fit 1e5 samples of one transmission; the best of three."""
    data = record(100_000, 1)
    spent = []
    for _ in range(3):
        begin = time.perf_counter()
        fit(data, joint(name, 1))
        spent.append(time.perf_counter() - begin)
    return min(spent)


def diagnosis(seconds: float) -> float:
    """CPU seconds to diagnose one motor at 1 kHz."""
    declared = jointfile.load(scene.ROOT / "drivelink" / "joints" / "quadratic.toml")
    data = measured(declared, seconds, ["coulomb_friction=0.0005"])
    begin = time.thread_time()
    diagnose(data, declared.model())
    return time.thread_time() - begin


def rows(args) -> Iterator[scene.Row]:
    """One row a case; ticks in µs, the rest in its unit."""
    for case, (name, settings) in _CASES.items():
        yield {"case": f"one tick, {case} / µs", **ticks(name, settings, args.ticks)}
    yield {"case": "one tick, monitor, vsa-ii / µs", **monitored(args.ticks)}
    other = dict.fromkeys(("p90", "p99", "p999"))
    for name in ("polynomial", "vsa-ii"):
        yield {"case": f"fit of 1e5 samples, {name} / s", "p50": batch(name), **other}
    for seconds in (10.0, 30.0):
        yield {"case": f"diagnose {seconds:g} s at 1 kHz / s of CPU", "p50": diagnosis(seconds), **other}


if __name__ == "__main__":
    cells = {"p50": "{p50:.4g}", "p90": "{p90:.3g}", "p99": "{p99:.3g}", "p99.9": "{p999:.3g}"}
    scene.main(__doc__, rows, {"": "{case}", **cells}, scene.Option("--ticks", 20_000))
