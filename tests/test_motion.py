"""The motion to record next: within its limits, played by the simulated drives, told by the report."""

import json
from dataclasses import replace
from pathlib import Path

import joints
import numpy as np
import pytest

from drivelink import cli, jointfile, recording
from drivelink.demo.simulate import alter, world_from_joint
from drivelink.output import motion as output
from drivelink.output.numbers import Units
from estimator.choices import whole
from estimator.diagnosis import diagnose, motion
from estimator.diagnosis.fourier import Limits, Shape
from estimator.diagnosis.problem import Problem
from estimator.driven import driven
from estimator.freerun import free_run
from estimator.model import Effect
from sim.world import record

ELBOW = Path(__file__).parent.parent / "examples" / "elbow.toml"
MOTION = (
    "[motion]\nposition_rad = [-0.6, 0.6]\nvelocity_rad_s = 3\nacceleration_rad_s2 = 30\ntorque_nm = 12\n"
)


def limits():
    names = ("low_rad", "high_rad", "velocity_rad_s", "acceleration_rad_s2", "torque_nm")
    return Limits(
        **{name: np.array([value]) for name, value in zip(names, (-0.6, 0.6, 3.0, 30.0, 12.0), strict=True)}
    )


def written(folder, excitation, name="run.csv", seconds=8.0, effect="backlash=0.003"):
    """The elbow with an effect, moved so, and its recording."""
    joint = folder / "elbow.toml"
    text = ELBOW.read_text(encoding="utf-8")
    assert text.count('{ kind = "rich" }') == 1
    joint.write_text(text.replace('{ kind = "rich" }', excitation) + "\n" + MOTION)
    world = world_from_joint(jointfile.load(joint), file=joint)
    alter(world, [effect], {})
    return joint, joints.write_csv(joints.of_world(record(world, seconds)), folder / name, digits=9)


def test_random_motions_begin_and_end_at_rest_and_touch_a_limit():
    numbers = np.random.default_rng(1).uniform(-1.0, 1.0, (5, Shape.size(1)))
    numbers[1:, 1:] = numbers[1, 1:]
    path = Shape(numbers, 8.0, limits()).path(1e-3)
    early, late = (np.std(path.velocity[part], axis=(0, 2)) for part in (slice(3000), slice(-3000, None)))
    grown = np.argsort(numbers[1:, 0])
    assert np.all(np.diff((late / early)[1:][grown]) > 0.0)  # they grow as they are asked to
    reach = np.array([np.max(np.abs(x), axis=(0, 2)) for x in path[:3]]) / np.array([[0.6], [3.0], [30.0]])
    np.testing.assert_allclose(np.max(reach, axis=0), 1.0, rtol=1e-9)
    np.testing.assert_allclose(path.position[[0, -1]], 0.0, atol=1e-6)
    rates = np.gradient(path.position, path.period_s, axis=0)
    np.testing.assert_allclose(rates[1:-1], path.velocity[1:-1], atol=1e-3)
    np.testing.assert_allclose(
        np.gradient(path.velocity, 1e-3, axis=0)[1:-1], path.acceleration[1:-1], atol=0.05
    )


def test_what_a_driven_model_reads_its_free_run_gives_back():
    model = jointfile.load(ELBOW).model()
    lossy = Effect(name="hysteresis", parameters={"torque_nm": 0.3, "displacement_rad": 0.004})
    numbers = np.random.default_rng(2).uniform(-1.0, 1.0, (2, Shape.size(1)))
    numbers[:, :2] = -1.0, 0.0  # steady ones
    path = Shape(numbers, 8.0, limits()).path(2e-3)
    for effects in ((), (lossy,)):
        changed = joints.with_motor(model, effects=effects)
        for run in driven(path, changed):
            assert min(free_run(run, changed, 1.0).fit_percent.values()) > 97.0


def test_what_the_likeliest_rival_explains_is_no_noise_of_the_motion_to_come(tmp_path):
    poor = '{ kind = "sines", amplitude_nm = 3.0, frequency_hz = 0.7 }'
    joint, run = written(tmp_path, poor, effect="coulomb_friction=0.5")
    model, record = jointfile.load(joint).model(), recording.read(run)
    outcome = replace(diagnose(record, model), effects=())  # named or not: the recording is the same
    rivals = motion._Rivals(Problem([record], model, outcome.bandwidth_hz), outcome, 4.0, limits())
    assert rivals.models[0].motors[0].effects[-1].name == "coulomb_friction"
    assert len(rivals.models) == 2  # others the recording has ruled out: no motion is made for them
    assert np.std(rivals.noise[2]) < 0.1 * 0.5


def test_a_motion_too_short_for_a_ripple_does_not_tell_it(tmp_path):
    joint, run = written(tmp_path, '{ kind = "rich" }', seconds=5.0, effect="cogging=0.3")
    model, record = jointfile.load(joint).model(), recording.read(run)
    outcome = diagnose(record, model)
    rivals = motion._Rivals(Problem([record], model, outcome.bandwidth_hz), outcome, 4.0, limits())
    numbers = np.random.default_rng(0).uniform(-1.0, 1.0, (1, Shape.size(1)))
    k = next(
        k
        for k, one in enumerate(rivals.fitted)
        if one.terms and one.terms[0].candidate.kind.name == "cogging"
    )
    (period,) = (t.values["periods_per_rev"] for t in rivals.fitted[k].terms)
    told = []
    for share in (1.5, 4.0):  # periods of the ripple within the motion
        path = Shape(numbers, 4.0, limits()).path(rivals.period_s)
        path = path.scaled(share * 2.0 * np.pi / period / np.ptp(path.position))
        told.append(rivals.least(k, rivals.read(driven(path, rivals.models[k])[0])))
    assert told[0] == 0.0 < told[1]


def test_a_motion_that_gains_nothing_promises_nothing():
    zeros, now = np.zeros((100, 1)), (0.95, 0.05)
    paths = dict.fromkeys(("position_rad", "velocity_rad_s", "acceleration_rad_s2", "torque_nm"), zeros)
    for told, said in (
        (np.tile(now, (2, 1)), "No motion of 9.9 s within"),
        (np.eye(2), "1.00, 0.90 without"),
    ):
        found = motion.NextMotion(
            time_s=np.arange(100) * 0.1, rivals=("a", "b"), now=now, told=told, limits=limits(), **paths
        )
        assert said in output.section(found, Units(False)).blocks[0].text


@pytest.mark.slow
def test_a_designed_motion_is_written_played_and_decides(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(motion, "_POPULATION", 5)
    monkeypatch.setattr(motion, "_GENERATIONS", 1)
    monkeypatch.setattr(motion, "whole", lambda name: 3 if name == "motion_rivals" else whole(name))
    joint, poor = written(tmp_path, '{ kind = "sines", amplitude_nm = 3.0, frequency_hz = 0.7 }')
    asked = ["diagnose", str(poor), "--joint", str(joint), "--out", str(tmp_path), "--motion"]
    assert cli.main([*asked, str(tmp_path / "next.csv"), "--motion-seconds", "4"]) == 0
    assert "What to move next" in capsys.readouterr().out and (tmp_path / "next.png").stat().st_size > 10_000
    table = np.genfromtxt(tmp_path / "next.csv", delimiter=",", names=True)
    most = {"position_rad": 0.6, "velocity_rad_s": 3.0, "acceleration_rad_s2": 30.0, "torque_nm": 12.0}
    assert len(table) == 4000
    for name, limit in most.items():
        assert np.max(np.abs(table[f"motor1_{name}"])) <= limit * (1.0 + 1e-6)
    document = json.loads((tmp_path / "report.json").read_text())["motion"]
    likeliest, *others = document["rivals"]
    assert likeliest["effects"] == "backlash" and others and 0.0 < document["decides"] <= 1.0
    page = (tmp_path / "report.html").read_text()
    assert (
        "What to move next" in page and "Model beside machine" in page and "residual of that channel" in page
    )
    assert "--motion" not in page  # it is designed already

    _, played = written(tmp_path, '{ kind = "motion", file = "next.csv" }', "played.csv")
    moved = np.genfromtxt(played, delimiter=",", names=True)["motor1_position_rad"][:4000]
    assert np.std(moved - table["motor1_position_rad"]) < 0.05 * np.std(moved)
    assert cli.main(["diagnose", str(played), "--joint", str(joint), "--out", str(tmp_path), "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["verdict"] == "effect" and report["effects"][0]["name"] == "backlash"


def test_what_is_wrong_is_one_line(tmp_path, capsys):
    joint, _ = written(tmp_path, '{ kind = "none" }', seconds=1.0)
    asked = ["diagnose", str(tmp_path / "run.csv"), "--joint", str(joint)]
    assert cli.main([*asked, "--motion", "next.txt"]) == 2
    assert cli.main([*asked, "--motion", "next.csv", "--motion-seconds", "1"]) == 2
    (tmp_path / "short.csv").write_text("time_s,x\n0\n")
    assert cli.main(["sim", str(joint), "--motion", str(tmp_path / "short.csv"), "--seconds", "1"]) != 0
    assert cli.main(["sim", str(joint), "--motion", str(tmp_path / "no.csv"), "--seconds", "1"]) == 2
    joint.write_text(joint.read_text().replace("[-0.6, 0.6]", "[0.6, -0.6]"))
    assert cli.main(asked) != 0
    errors = capsys.readouterr().err.strip().splitlines()
    assert len(errors) == 5 and "no.csv: no such file" in errors[3]
    assert "[lowest, highest]" in errors[4] and "columns time_s" in errors[2]
    assert errors[2].endswith("motor1_velocity_rad_s")  # and not what numpy says of each line
