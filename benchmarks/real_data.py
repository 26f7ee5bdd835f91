"""Measured machines: what `diagnose` leaves on another recording, beside thirty lines of least squares.

    python benchmarks/real_data.py [--data DIR] [--shaft-line DIR] [--out DIR]

The recordings are not part of the project: DIR (or $DRIVELINK_DATA, or ../shared/data) holds emps/,
kuka_kr300/ and uw_sea/. --shaft-line (or $DRIVELINK_SHAFT_LINE) names a folder with Ice_excitation1.csv … and
their motor files of github.com/aksel-ilveskero/Shaftline-Torque-Estimation, if it has been fetched; it has a
torque sensor.
"""

import os
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import scene
from scene import ROOT, joints
from scipy.signal import butter, sosfiltfilt

from drivelink import jointfile, recording
from drivelink.jointfile import JointFile
from drivelink.jointfile.apply_diagnosis import diagnosed_model
from drivelink.output import report
from drivelink.output.comparison import simulated
from drivelink.output.document import write
from estimator import EstimatorSettings, ExternalStatus, LinkDynamics, Status, make_estimator
from estimator.diagnosis import diagnose
from estimator.diagnosis.frame import Corrections, Frame, Signals
from estimator.filters import StateVariableFilter
from estimator.model import JointModel
from estimator.sample import FloatArray, Record

SENSOR_HZ = 40.0  # below it the sensor's torque is compared
SETTLED_S = 3.0  # of a recording: what the estimator says before is not judged
BEHIND_KG_M2 = 6.0e-5  # of the shaft line between its second encoder and its torque sensor
JOINT = """
name = "{name}"
arrangement = "single"
[[motor]]
inertia_kg_m2 = {inertia}
viscous_damping_nm_s_rad = {damping}
transmission = {{ model = "linear" }}
[bus]
period_s = {period}
"""
UW = JOINT.format(name="uw_sea", inertia=5.878e-4, damping=0.0, period=0.005)
SHAFT = JOINT.format(name="shaft_line", inertia=0.0086, damping=0.003, period=0.001)


class Run(NamedTuple):
    """One diagnosis: machine, training and validation data, bandwidth, stiffness that is known of it."""

    joint: str
    train: str
    validation: str
    bandwidth_hz: float
    known_nm_rad: float | None


RUNS = (
    Run("emps", "emps/train.csv", "emps/pulses.csv", 40.0, None),
    Run("kuka_axis3", "kuka_kr300/axis3_A.csv", "kuka_kr300/axis3_B.csv", 15.0, 4.10e6),
    Run("kuka_axis3", "kuka_kr300/axis3_B.csv", "kuka_kr300/axis3_A.csv", 15.0, 4.10e6),
    Run("kuka_axis2", "kuka_kr300/axis2_A.csv", "kuka_kr300/axis2_B.csv", 15.0, 7.52e6),
    Run("kuka_axis2", "kuka_kr300/axis2_B.csv", "kuka_kr300/axis2_A.csv", 15.0, 7.52e6),
    *(
        Run("uw_sea", f"uw_sea/uw_{a}.csv", f"uw_sea/uw_{b}.csv", 10.0, 0.462)
        for a in ("InnerLoop", "DoubleLoopReference", "DoubleLoopDisturbance")
        for b in ("InnerLoop", "DoubleLoopReference", "DoubleLoopDisturbance")
        if a != b
    ),
)
SHAFT_RUNS = tuple(
    Run("shaft_line", str(a), str(b), 20.0, 35.7) for a in (1, 2, 3) for b in (1, 2, 3) if a != b
)


def baseline(train: Record, validation: Record, model: JointModel, bandwidth_hz: float) -> float:
    """Relative error of least squares: inertia, viscous and Coulomb friction, offset, one stiffness."""
    (a, y), (b, z) = (_columns(record, model, bandwidth_hz) for record in (train, validation))
    scale = np.linalg.norm(a, axis=0)
    error = z - b @ (np.linalg.lstsq(a / scale, y, rcond=1e-10)[0] / scale)
    return float(np.std(error) / np.std(z))


def _columns(record: Record, model: JointModel, bandwidth_hz: float) -> tuple[FloatArray, FloatArray]:
    frame = Frame.make(model, Signals(record, bandwidth_hz), Corrections.none(1))
    c = frame.motors[0]
    sign = np.tanh(c.velocity / (0.02 * np.max(np.abs(c.velocity))))
    columns = [c.acceleration, c.velocity, sign, np.ones_like(sign)]
    columns += [-c.deflection] if frame.flexible[0] else []
    return np.stack([frame.project(x) for x in columns], axis=1), frame.project(c.torque)


def joint_of(run: Run) -> JointFile:
    """The joint as it is declared."""
    inline = {"uw_sea": UW, "shaft_line": SHAFT}
    if run.joint in inline:
        return jointfile.parse(inline[run.joint])
    return jointfile.load(ROOT / "examples" / f"{run.joint}.toml")


def _shaft_rows(folder: Path, number: str) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Encoders and sensors, the motor's file, and a grid of a millisecond that both cover, s."""
    rows = np.genfromtxt(folder / f"Ice_excitation{number}.csv", delimiter=",", skip_header=1)
    motor = np.genfromtxt(folder / f"Ice_excitation{number}_motor.csv", delimiter=",", skip_header=1)
    time = np.arange(max(rows[0, 0], motor[0, 0]), min(rows[-1, 0], motor[-1, 0]), 1e-3)
    return rows, motor, time


def shaft_sensor(folder: Path, number: str) -> FloatArray:
    """The torque sensor between the encoders on the grid of `shaft_record`, N·m."""
    rows, _, time = _shaft_rows(folder, number)
    return np.interp(time, rows[:, 0], rows[:, 6])


def against_sensor(model: JointModel, record: Record, sensor_nm: FloatArray) -> dict[str, Any]:
    """rms error below SENSOR_HZ of what the shaft carries, as a share of its variation there.

    "on_line" is what the estimator said at each sample, "valid" how often it vouched for it, "twist" the
    stiffness times the measured twist. "external" is the external torque on what turns between the second
    encoder and the sensor, where it is valid, against the sensor behind the same filter.
    """
    behind = replace(model, link=LinkDynamics(inertia_kg_m2=BEHIND_KG_M2))
    estimator = make_estimator(behind, EstimatorSettings(), record.period_s)
    assert record.link_position_rad is not None
    said, external = [], []
    for sample in record.samples():
        said.append(estimator.step(sample))
        reported = estimator.external
        external.append(reported.external_torque_nm if reported.status & ExternalStatus.VALID else np.nan)
    k = model.motors[0].transmission.parameters.get("k_nm_rad", np.nan)
    assert isinstance(k, float)
    twist = k * (record.link_position_rad - record.motor_position_rad[:, 0])
    slow = butter(4, SENSOR_HZ, output="sos", fs=1.0 / record.period_s)
    late = slice(int(SETTLED_S / record.period_s), None)
    true = sosfiltfilt(slow, sensor_nm)[late]

    def error(torque: FloatArray) -> float:
        x = sosfiltfilt(slow, np.nan_to_num(torque))[late]
        left = min(float(np.std(sign * x - true)) for sign in (1.0, -1.0))  # the sensor's sign is its own
        return left / float(np.std(true))

    push = np.array(external)
    good = np.isfinite(push)
    if not any(good[late]):
        push, good = np.full_like(push, np.nan), np.ones_like(good)
    bridged = np.interp(np.arange(len(push)), np.flatnonzero(good), push[good])
    same = StateVariableFilter(3, EstimatorSettings().external_bandwidth_rad_s, record.period_s)
    behind_filter = -sosfiltfilt(slow, same.apply(sensor_nm)[0])[late][good[late]]
    pushed = sosfiltfilt(slow, bridged)[late][good[late]]
    return {
        "external": float(np.std(pushed - behind_filter) / np.std(behind_filter)),
        "external_valid": float(np.mean(np.isfinite(push[late]))),
        "on_line": error(np.array([one.flexibility_torque_nm for one in said])),
        "valid": float(np.mean([one.status & Status.VALID for one in said[late]])),
        "twist": error(twist),
    }


def shaft_record(folder: Path, number: str) -> Record:
    """Both encoders and the motor's torque, which has a clock of its own, on one grid of a millisecond."""
    rows, motor, time = _shaft_rows(folder, number)
    theta, q = (np.radians(np.interp(time, rows[:, 0], rows[:, column])) for column in (1, 2))
    return joints.recorded(theta, np.interp(time, motor[:, 0], motor[:, 2]), q)


def on_line(model: JointModel, record: Record) -> str:
    """Shares of the samples with a valid stiffness and with all valid, and the stiffness in the end."""
    estimator = make_estimator(model, EstimatorSettings(), record.period_s)
    said = [estimator.step(sample) for sample in record.samples()]
    shares = (
        np.mean([one.status & bit > 0 for one in said]) for bit in (Status.STIFFNESS_VALID, Status.VALID)
    )
    known = [one for one in said if one.status & Status.STIFFNESS_VALID][-1:]
    last = [f": {one.stiffness_nm_rad:.3g} ± {1.96 * one.stiffness_std_nm_rad:.2g}" for one in known]
    return " / ".join(f"{share:.0%}" for share in shares) + "".join(last)


def diagnosed(run: Run, data: Path, out: Path | None) -> dict[str, Any]:
    """Diagnose one machine; reports are of measured data and go where they are asked for."""
    joint = joint_of(run)
    if run.joint == "shaft_line":
        train, validation = (shaft_record(data, number) for number in (run.train, run.validation))
    else:
        train, validation = (recording.read(data / name, joint) for name in (run.train, run.validation))
    outcome = diagnose(train, joint.model(), run.bandwidth_hz, validation)
    models = {"declared": joint.model(), "found": diagnosed_model(joint, outcome)}
    document = report.as_json(outcome, simulated(validation, **models), run.validation)
    sensor = None
    if run.joint == "shaft_line":
        torque = shaft_sensor(data, run.validation)
        sensor = against_sensor(models["found"], validation, torque[: len(validation)])
    if out is not None:
        folder = out / f"{run.joint}-{Path(run.train).stem}-{Path(run.validation).stem}"
        folder.mkdir(parents=True, exist_ok=True)
        title = report.Title(run.joint, Path(run.train).name, Path(run.validation).name)
        write(folder, "report", document, report.html_page(outcome, title))
    return {
        **run._asdict(),
        "sensor": sensor,
        "on_line": ", ".join(on_line(model, validation) for model in models.values()),
        "baseline_relative": baseline(train, validation, joint.model(), run.bandwidth_hz),
        **document,
    }


def rows(args) -> Iterator[scene.Row]:
    """One row a diagnosis."""
    if not (args.data / RUNS[0].train).exists():
        sys.exit(f"real_data: no measured data in {args.data}: expected emps/, kuka_kr300/ and uw_sea/ there")
    jobs = [(run, args.data) for run in RUNS]
    jobs += [(run, args.shaft_line) for run in SHAFT_RUNS] if args.shaft_line else []
    for run, data in jobs:
        one = diagnosed(run, data, args.out)
        parameters, std = (one["transmissions"][0][key] for key in ("parameters", "std"))
        stiffness, sensor = None, None
        if parameters:
            known = one["known_nm_rad"]
            stiffness = f"{parameters['k_nm_rad']:.3g} ± {1.96 * std['k_nm_rad']:.2g} (95 %) / {known:.3g}"
        if one["sensor"] is not None:
            form = "{on_line:.1%} ({valid:.0%}), {twist:.1%}, {external:.1%} ({external_valid:.0%})"
            sensor = form.format(**one["sensor"])
        yield {
            **one,
            "pair": f"{Path(one['train']).stem} → {Path(one['validation']).stem}",
            "of_baseline": one["error"]["validation"]["after_relative"] / one["baseline_relative"],
            "found": ", ".join(effect["name"] for effect in one["effects"]) or one["verdict"],
            "stiffness": stiffness,
            "against_sensor": sensor,
        }


def ratios(found: list[scene.Row]) -> str:
    """Mean and worst of the errors over the baseline's."""
    each = [row["of_baseline"] for row in found]
    mean = np.exp(np.mean(np.log(each)))
    return f"error over the baseline's: geometric mean {mean:.2f}, worst {max(each):.2f}"


if __name__ == "__main__":
    data = Path(os.environ.get("DRIVELINK_DATA", ROOT.parent / "shared" / "data"))
    shaft = os.environ.get("DRIVELINK_SHAFT_LINE")
    scene.main(
        __doc__,
        rows,
        {
            "machine": "{joint}, {bandwidth_hz:g} Hz",
            "train → other": "{pair}",
            "baseline": "{baseline_relative:.1%}",
            "before → after": (
                "{error[validation][before_relative]:.1%} → {error[validation][after_relative]:.1%}"
            ),
            "of baseline": "{of_baseline:.2f}",
            "found": "{found}",
            "stiffness / known": "{stiffness}",
            "on line on the other, as declared, as found: stiffness / all valid": "{on_line}",
            "torque against sensor: on line (valid), twist, external torque (valid)": "{against_sensor}",
        },
        scene.Option("--data", data, metavar="DIR"),
        scene.Option("--shaft-line", Path(shaft) if shaft else None, metavar="DIR"),
        scene.Option("--out", None, "reports go there", metavar="DIR"),
        after=ratios,
    )
