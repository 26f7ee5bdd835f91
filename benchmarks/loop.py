"""How the loop closes on each effect of the library: alarm, finding, its name, the residual after it.

    python benchmarks/loop.py [--effects NAME,…] [--share X] [--json FILE]

The joint of `drivelink demo --case friction` with its daemon in lockstep, healthy for 10 s; then the effect,
which takes about a share of the torque. What the black box would keep is diagnosed, and the proposed joint
file's own test watches ten more seconds. The finding comes 15 s after the alarm, plus the time of the
diagnosis on a free processor. `drivelink demo --case …` does the same in three processes in real time.
"""

import tempfile
import time
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import scene
from diagnosis_seeds import LIKELY, sizes

from drivelink import jointfile
from drivelink._core import Tick
from drivelink.daemon.service import Daemon, ServedJoint
from drivelink.demo.simbus import open_sim_bus
from drivelink.demo.simulate import alter, network_from_joint, world_from_joint
from drivelink.jointfile.apply_diagnosis import make_model_monitor
from drivelink.loop import diagnosing, finding
from drivelink.loop.blackbox import AFTER_S
from drivelink.loop.finding import proposal_file, recording_name
from drivelink.recording.sinks import McapSink
from estimator.effects import LIBRARY
from estimator.errors import EstimatorError
from estimator.sample import Sample, Status
from sim.effects import LISTED

ELBOW = Path(__file__).parent.parent / "drivelink" / "joints" / "elbow.toml"
HEALTHY_S, PATIENCE_S, WATCHED_S = 10.0, 45.0, 10.0
TORQUE_NM, STIFFNESS_NM_RAD = 5.0, 120.0  # rms of the motion, stiffness at rest


class Taken:
    """Samples and alarm of every cycle."""

    def __init__(self) -> None:
        self.samples: list[Sample] = []
        self.alarm = False

    def put(self, tick: Tick) -> None:
        self.alarm = self.alarm or bool(tick.estimate.status & Status.MODEL_ALARM)
        if tick.sample is not None:
            self.samples.append(tick.sample)


def effect_text(name: str, share: float) -> str:
    """The effect as `sim --effect` takes it, of a size that takes about that share of the torque."""
    values = sizes(TORQUE_NM, STIFFNESS_NM_RAD, share, np.random.default_rng(0))[name]
    main, *_ = (parameter.name for parameter in LISTED[name].parameters)
    further = "".join(f",{key}={value!r}" for key, value in values.items() if key != main)
    return f"{name}={values[main]!r}{further}"


def closed(name: str, share: float) -> scene.Row:
    """One effect from its begin to the residual after its finding."""
    joint = jointfile.load(ELBOW)
    world, bus, taken = world_from_joint(joint), open_sim_bus(joint.bus), Taken()
    network = network_from_joint(joint, bus, world=world)
    per_s = round(1.0 / joint.bus.period_s)
    result: scene.Row = {"effect": name, "alarm_s": None}
    with (
        bus,
        Daemon([ServedJoint(joint=joint)], publish=False, real_time=False, devices=network.poll) as daemon,
    ):
        (loop_joint,) = daemon.loop.loop_joints
        loop_joint.sink = taken
        daemon.run_lockstep(round(HEALTHY_S * per_s))
        result["false_alarm"] = taken.alarm
        alter(world, [effect_text(name, share)], {})
        begin = len(taken.samples)
        while not taken.alarm and len(taken.samples) < begin + PATIENCE_S * per_s:
            daemon.run_lockstep(per_s // 20)
        if taken.alarm:
            result["alarm_s"] = (len(taken.samples) - begin) / per_s
        daemon.run_lockstep(round(AFTER_S * per_s))
        kept = list(taken.samples)
        daemon.run_lockstep(round(WATCHED_S * per_s))
    return result | judged(name, kept, taken.samples[len(kept) :])


def judged(name: str, kept: Sequence[Sample], after: Sequence[Sample]) -> scene.Row:
    """The finding of what was kept, and the residual of the proposed model on what follows."""
    source = jointfile.load_text(ELBOW)
    with tempfile.TemporaryDirectory() as folder:
        recording = Path(folder) / recording_name(source.joint.name, "model alarm", datetime.now(UTC))
        sink = McapSink(recording, source.joint, source.text)
        for sample in kept:
            sink.sample(sample, sample.sequence * 1_000_000)
        sink.close()
        begin_s = time.process_time()
        try:
            found = diagnosing.make(recording)
        except EstimatorError as error:
            return {"state": finding.FAILED, "sentence": str(error)}
        took_s = time.process_time() - begin_s
        result = {"diagnosis_s": took_s, "state": found["state"], "sentence": found["sentence"]}
        result["error"] = found["error"]
        effects = found["report"]["effects"]
        names = [one["name"] for one in effects]
        rivals = [
            rival
            for one in effects[:1]
            for rival, odds in zip(one["alternatives"], one["alternative_probabilities"], strict=True)
            if odds >= LIKELY
        ]
        result |= {"found": names, "named": names[:1] == [name], "listed": name in names[:1] + rivals}
        result["before_ratio"] = ratio_of(source.joint, kept)[0]
        if found["state"] == finding.PROPOSED:
            proposed = jointfile.load(proposal_file(recording))
            result["after_ratio"], result["alarm_after"] = ratio_of(proposed, [*kept[-2000:], *after])
        return result


def ratio_of(joint: jointfile.JointFile, samples: Sequence[Sample]) -> tuple[float, bool]:
    """The newest residual of a joint file over its own baseline, and whether its own test alarms."""
    monitor = make_model_monitor(joint)
    assert monitor is not None and monitor.baseline is not None
    alarm = False
    for sample in samples:
        alarm = monitor.core.step(sample) or alarm
    pairs = zip(monitor.residual_nm, monitor.baseline.residual_nm, strict=True)
    ratios = [residual / baseline for residual, baseline in pairs]
    return max(ratios), alarm


def shown(one: scene.Row) -> scene.Row:
    """Add what a table says in words."""
    error, after = one.get("error") or {}, one.get("after_ratio")
    said = "yes" if one.get("named") else f"listed ({one['found'][0]})" if one.get("listed") else None
    return one | {
        "finding_s": (one["alarm_s"] or 0.0) + AFTER_S + one.get("diagnosis_s", 0.0),
        "said": said or ", ".join(one.get("found") or ()) or one["state"],
        "error_before": error.get("before_relative"),
        "error_after": error.get("after_relative"),
        "before_ratio": one.get("before_ratio"),
        "after": None if after is None else f"{after:.2g}{' alarm' if one['alarm_after'] else ''}",
    }


def total(made: list[scene.Row]) -> str:
    alarmed = sum(one["alarm_s"] is not None for one in made)
    proposed = [one for one in made if one["state"] == finding.PROPOSED]
    quiet = sum(not one["alarm_after"] for one in proposed)
    return (
        f"Residuals are times their baseline. Of {len(made)} effects {alarmed} alarm, "
        f"{sum(bool(one.get('named')) for one in made)} are named first, "
        f"{sum(bool(one.get('listed')) for one in made)} named or listed. {len(proposed)} lead to a "
        f"proposal; of {quiet} of these the new test stays quiet for {WATCHED_S:g} s. "
        f"False alarms before the effect: {sum(one['false_alarm'] for one in made)}."
    )


COLUMNS = {
    "effect": "{effect}",
    "alarm / s": "{alarm_s:.1f}",
    "finding / s": "{finding_s:.0f}",
    "named": "{said}",
    "error on held-out data": "{error_before:.1%} → {error_after:.1%}",
    "residual before": "{before_ratio:.0f}",
    "after": "{after}",
}

if __name__ == "__main__":
    scene.main(
        __doc__,
        lambda args: (shown(closed(name, args.share)) for name in args.effects),
        COLUMNS,
        scene.Option("--effects", list(LIBRARY)),
        scene.Option("--share", 0.1, "of the torque"),
        after=total,
    )
