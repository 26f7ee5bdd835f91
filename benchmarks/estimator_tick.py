"""Speed of the estimators: one tick, batch fits, a diagnosis.

    python benchmarks/estimator_tick.py [--ticks N]

The demo's two-motor VSA at 1 kHz. A tick is timed alone, with nothing compiled at run time; the percentiles
are over all ticks after the first three seconds. Fits (the best of three) and diagnoses are of the paper's
quadratic joint, the latter with friction that the model lacks: CPU time of one thread.
"""

import gc
import time
from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
import scene
from diagnosis_seeds import measured

from drivelink import jointfile
from drivelink.jointfile import JointFile
from estimator import EstimatorSettings, JointModel, Sample, Transmission, fit, make_estimator
from estimator.diagnosis import diagnose
from estimator.model_monitor import ModelMonitor, measure_baseline

_CASES = {
    "robust, polynomial": ("polynomial", EstimatorSettings()),
    "robust, vsa-ii": ("vsa-ii", EstimatorSettings()),
    "robust, black box": ("unknown", EstimatorSettings()),
    "paper": ("polynomial", EstimatorSettings(mode="paper")),
}


def packaged(name: str) -> JointFile:
    """A joint file of the demo, without link dynamics."""
    joint = jointfile.load(scene.ROOT / "drivelink" / "joints" / f"{name}.toml")
    return joint.model_copy(update={"link": joint.link.model_copy(update={"dynamics": None})})


def model_of(joint: JointFile, transmission: Transmission) -> JointModel:
    model = joint.model()
    return replace(model, motors=tuple(replace(m, transmission=transmission) for m in model.motors))


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


def rows(args) -> Iterator[scene.Row]:
    """One row a case; ticks in µs, the rest in its unit."""
    vsa, quadratic = packaged("vsa-ii"), packaged("quadratic")
    data, period_s = measured(vsa, args.ticks * vsa.bus.period_s), vsa.bus.period_s
    for case, (name, settings) in _CASES.items():
        spring = Transmission(model=name, order=2 if name == "polynomial" else None)
        step = make_estimator(model_of(vsa, spring), settings, period_s).step
        yield {"case": f"one tick, {case} / µs", **percentiles(step, list(data.samples()))}
    known = model_of(vsa, Transmission(model="vsa-ii", parameters={"k_nm_rad": 0.5, "c": 1.75}))
    step = ModelMonitor(known, period_s, measure_baseline(data, known)).core.step
    yield {"case": "one tick, monitor, vsa-ii / µs", **percentiles(step, list(data.samples()))}
    other = dict.fromkeys(("p90", "p99", "p999"))
    data = measured(quadratic, 100.0)
    for name in ("polynomial", "exponential"):
        model, spent = model_of(quadratic, Transmission(model=name)), []
        for _ in range(3):
            begin = time.perf_counter()
            fit(data, model)
            spent.append(time.perf_counter() - begin)
        yield {"case": f"fit of 1e5 samples, {name} / s", "p50": min(spent), **other}
    for seconds in (10.0, 30.0):
        data = measured(quadratic, seconds, ["coulomb_friction=0.0005"])
        begin = time.thread_time()
        diagnose(data, quadratic.model())
        spent_s = time.thread_time() - begin
        yield {"case": f"diagnose {seconds:g} s at 1 kHz / s of CPU", "p50": spent_s, **other}


if __name__ == "__main__":
    cells = {"p50": "{p50:.4g}", "p90": "{p90:.3g}", "p99": "{p99:.3g}", "p99.9": "{p999:.3g}"}
    scene.main(__doc__, rows, {"": "{case}", **cells}, scene.Option("--ticks", 20_000))
