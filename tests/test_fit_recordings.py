"""Several recordings of one joint, and joints with one encoder: what `fit` finds of machine, runs and load."""

import json
import math
import os
import re
import tomllib
from dataclasses import replace
from pathlib import Path

import diagnosiskit as kit
import joints
import numpy as np
import pytest

from drivelink import jointfile, recording
from drivelink.cli import main
from drivelink.jointfile.document import MAX_LINE_BYTES
from drivelink.runs import Runs
from estimator import LinkDynamics, Record, fit
from estimator.identify import identify

ROOT = Path(__file__).resolve().parents[1]
KUKA = Path(os.environ.get("DRIVELINK_DATA", ROOT.parent / "shared" / "data")) / "kuka_kr300"
JOINT = f'name = "elbow"\n[[motor]]\ninertia_kg_m2 = {kit.INERTIA}\n[motor.transmission]\nmodel = "linear"\n'
LATE_S = 0.0012
ZEROS_RAD = (0.004, -0.003)
FRICTION_NM = (0.0, 0.3)


@pytest.fixture(scope="module")
def runs() -> list[Record]:
    """Two motions of one joint whose encoder is late; zeros and friction are another on the second day."""
    made = []
    for seed, zero, friction in zip((5, 6), ZEROS_RAD, FRICTION_NM, strict=True):
        rig = {"late_s": LATE_S, "zero_rad": zero, "coulomb_nm": friction}
        made += kit.World([rig], seed=seed, seconds=7.0).run()
    return made


def test_machine_is_shared_and_runs_keep_their_own(runs):
    model = kit.model(error=0.01, linked=False)
    both = identify(runs, model)
    (one,) = both.fits
    alone = [fit(run, model)[0] for run in runs]
    assert one.parameters["k_nm_rad"] == pytest.approx(kit.STIFFNESS, rel=2e-3)
    assert one.link_delay_s == pytest.approx(LATE_S, abs=3 * one.nuisance_std["link_delay"])
    for run, zero, friction in zip(alone, ZEROS_RAD, FRICTION_NM, strict=True):
        # Encoders round down: half of their steps is part of the zero that is read.
        assert run.deflection_offset_rad == pytest.approx(zero, abs=kit.MOTOR_LSB + kit.LINK_LSB)
        assert run.coulomb_nm == pytest.approx(friction, abs=0.05)
        apart = float(one.alpha[0] - run.alpha[0])
        assert abs(apart) < 3.0 * math.hypot(math.sqrt(one.covariance[0, 0]), math.sqrt(run.covariance[0, 0]))
    # Written is what belongs to the machine; zeros that contradict each other are nobody's.
    assert [e.name for e in both.model.link_effects] == ["encoder_delay"]
    assert both.model.motors[0].effects == ()
    assert any("deflection_offset differs between the recordings" in note for note in both.notes)


@pytest.mark.slow
def test_a_zero_that_all_recordings_share_is_written():
    rig = {"zero_rad": ZEROS_RAD[0]}
    runs = [kit.World([rig], seed=seed).run()[0] for seed in (7, 8)]
    found = identify(runs, kit.model(error=0.01, linked=False))
    (effect,) = found.model.motors[0].effects
    assert effect.name == "deflection_offset"
    assert effect.parameters["offset_rad"] == pytest.approx(ZEROS_RAD[0], abs=kit.MOTOR_LSB + kit.LINK_LSB)


@pytest.mark.slow
def test_each_recording_is_validated_by_the_others(runs):
    model = kit.model(error=0.01, linked=False)
    found = identify([*runs, kit.World([{"late_s": LATE_S}], seed=9).run()[0]], model)
    for one in found.recordings:
        assert one.validation is not None
        # The others determine the machine as well as all do: nothing is fitted to noise. Filters leave 3e-4 of a torque.
        assert one.validation.relative == pytest.approx(one.train.relative, rel=0.1, abs=1e-4)
    stranger = kit.World([{"late_s": LATE_S, "inertia_kg_m2": 0.5 * kit.INERTIA}], seed=9).run()[0]
    *_, last = identify([*runs, stranger], model).recordings
    assert last.validation is not None
    assert last.validation.relative > 3.0 * found.recordings[-1].validation.relative  # type: ignore[union-attr]


def test_the_command_takes_several_and_says_how_each_does(runs, tmp_path, capsys):
    paths = [tmp_path / name for name in ("monday.csv", "tuesday.csv")]
    for run, path in zip(runs, paths, strict=True):
        joints.write_csv(run, path)
    joint, target = tmp_path / "joint.toml", tmp_path / "written.toml"
    joint.write_text(JOINT)
    asked = ["fit", *map(str, paths), "--joint", str(joint), "--out", str(tmp_path), "--write", str(target)]
    assert main(asked) == 0
    said = capsys.readouterr().out
    document = json.loads((tmp_path / "fit.json").read_text())
    assert [one["recording"] for one in document["recordings"]] == ["monday.csv", "tuesday.csv"]
    for one in document["recordings"]:
        assert f"{one['validation']['rms_nm']:.5f} N·m  {100.0 * one['validation']['relative']:.2f} %" in said
    written = tomllib.loads(target.read_text())
    assert written["motor"][0]["transmission"]["parameters"] == document["transmissions"][0]["parameters"]
    assert written["provenance"]["fit"]["recording"] == "monday.csv, tuesday.csv"
    assert len(written["provenance"]["floor"]["residual_nm"]) == 1
    # One in degrees among others is named.
    assert runs[1].link_position_rad is not None
    wrong = replace(
        runs[1],
        motor_position_rad=np.degrees(runs[1].motor_position_rad),
        link_position_rad=np.degrees(runs[1].link_position_rad),
    )
    joints.write_csv(wrong, paths[1])
    assert main(["fit", *map(str, paths), "--joint", str(joint), "--strict"]) == 3
    error = capsys.readouterr().err
    assert "tuesday.csv" in error and "monday.csv" not in error and "degrees" in error


ARM = LinkDynamics(inertia_kg_m2=0.4, viscous_damping_nm_s_rad=0.1, gravity_nm=6.0, gravity_phase_rad=0.3)
ROTOR, DAMPING, DRY, OFFSET = 0.12, 0.7, 0.8, 0.25


def _arm(seed: int, seconds: float = 16.0) -> Record:
    """A rigid joint that carries a link: one encoder, gravity, dry friction, a current offset."""
    T, substeps = 1e-3, 4
    n = round(seconds / T)
    rng, time = np.random.default_rng(seed), np.arange(n) * T
    tones, phases = np.geomspace(0.15, 2.5, 8), rng.uniform(0.0, 2.0 * np.pi, 8)
    path = np.sum(np.sin(np.outer(time, 2 * np.pi * tones) + phases) / tones**0.8, axis=1)
    path = (path - path[0]) * np.minimum(1.0, time / 0.5) / path.std()
    theta = omega = 0.0
    rows = np.empty((n, 2))
    rate = np.gradient(path, T)
    for k in range(n):
        torque = 60.0 * (path[k] - theta) + 8.0 * (rate[k] - omega)
        rows[k] = theta, torque
        for _ in range(substeps):
            load = ARM.gravity_nm * math.sin(theta + ARM.gravity_phase_rad) + DRY * math.tanh(omega / 2e-3)
            load += (DAMPING + ARM.viscous_damping_nm_s_rad) * omega + OFFSET
            omega += T / substeps * (torque - load) / (ROTOR + ARM.inertia_kg_m2)
            theta += T / substeps * omega
    theta_read = joints.quantise(rows[:, 0], 2.0 * np.pi / 65536)
    return joints.recorded(theta_read, rows[:, 1] + 0.02 * rng.standard_normal(n))


@pytest.fixture(scope="module")
def arm() -> Record:
    return _arm(1)


@pytest.mark.parametrize("gravity_nm", [0.0, 4.0])
def test_gravity_and_friction_of_a_joint_with_one_encoder(arm, gravity_nm):
    link = replace(ARM, gravity_nm=gravity_nm, gravity_phase_rad=0.0)
    found = identify(arm, joints.joint_model(ROTOR, 0.6, model="none", link=link))
    link, (motor,) = found.model.link or link, found.model.motors
    for name, truth in (("gravity_nm", ARM.gravity_nm), ("gravity_phase_rad", ARM.gravity_phase_rad)):
        # Amplitude and phase share with a constant torque what the arc does not separate: the interval shows it.
        assert abs(getattr(link, name) - truth) < 3.0 * found.link_std[name]
        assert found.link_std[name] < 0.1 * truth
    effects = {e.name: e.parameters["torque_nm"] for e in motor.effects}
    assert effects["coulomb_friction"] == pytest.approx(DRY, rel=0.03)
    assert effects["torque_offset"] == pytest.approx(OFFSET, abs=0.1)
    # Only the sums of both sides' inertias and dampings act.
    assert motor.inertia_kg_m2 + link.inertia_kg_m2 == pytest.approx(ROTOR + ARM.inertia_kg_m2, rel=0.01)
    both = motor.viscous_damping_nm_s_rad + link.viscous_damping_nm_s_rad
    assert both == pytest.approx(DAMPING + ARM.viscous_damping_nm_s_rad, rel=0.05)
    assert found.fits[0].error_rms_nm < 0.02 * found.fits[0].torque_rms_nm


def test_what_is_written_of_a_joint_with_one_encoder_is_what_is_printed_and_fitted_again_it_stays(
    arm, tmp_path, capsys
):
    joints.write_csv(arm, tmp_path / "arm.csv")
    joint, target = tmp_path / "arm.toml", tmp_path / "written.toml"
    joint.write_text(
        f'name = "arm"\n[[motor]]\ninertia_kg_m2 = {ROTOR}\n[motor.transmission]\nmodel = "none"\n'
        f"[link.dynamics]\ninertia_kg_m2 = {ARM.inertia_kg_m2}\ngravity_nm = 5.0\n"
    )
    assert main(["fit", str(tmp_path / "arm.csv"), "--joint", str(joint), "--write", str(target)]) == 0
    said, written = capsys.readouterr().out, tomllib.loads(target.read_text())
    dry = next(e for e in written["motor"][0]["effect"] if e["name"] == "coulomb_friction")["parameters"]
    printed = [float(number) for number in re.findall(r"\d+\.\d+", said)]
    for x in (
        dry["torque_nm"],
        written["link"]["dynamics"]["gravity_nm"],
        written["motor"][0]["inertia_kg_m2"],
    ):
        assert any(abs(x - number) < 0.01 * x for number in printed)  # digits follow the uncertainty
    again = identify(arm, jointfile.load(target).model())
    (motor,) = again.model.motors
    second = {e.name: e.parameters["torque_nm"] for e in motor.effects}
    assert second["coulomb_friction"] == pytest.approx(dry["torque_nm"], rel=0.01)
    assert again.model.link is not None
    assert again.model.link.gravity_nm == pytest.approx(written["link"]["dynamics"]["gravity_nm"], rel=0.01)


@pytest.mark.skipif(not KUKA.exists(), reason=f"no measured data in {KUKA} (see $DRIVELINK_DATA)")
@pytest.mark.parametrize("axis", [2, 3])
def test_two_recordings_of_a_robot_find_its_delay_and_one_stiffness(axis):
    """The authors regress 2.6 to 2.9 ms of skew between the encoders of these axes."""
    declared = jointfile.load(ROOT / "examples" / f"kuka_axis{axis}.toml")
    records = [recording.read(KUKA / f"axis{axis}_{run}.csv", declared) for run in "AB"]
    found = identify(records, declared.model())
    (both,) = found.fits
    assert both.link_delay_s == pytest.approx(2.6e-3, abs=3e-4)
    for record in records:
        (alone,) = fit(record, declared.model())
        apart = float(both.alpha[0] - alone.alpha[0])
        assert abs(apart) < 1.96 * math.sqrt(both.covariance[0, 0] + alone.covariance[0, 0])
    assert both.stiffens
    assert all(one.validation is not None for one in found.recordings)


def test_of_many_recordings_some_are_named_and_the_reason_is_said(tmp_path, capsys):
    """The reason was cut off behind the names, and a joint file with all names in one line was not read again."""
    (joint := tmp_path / "elbow.toml").write_text(JOINT)
    paths = [tmp_path / f"{k:0120d}.csv" for k in range(60)]
    for path in paths:
        path.write_text(
            "time_s,motor1_position_rad,motor1_torque_nm,link_position_rad\n"
            + "".join(f"{k * 1e-3},{k * 1e-3},1.0,{k * 1e-3}\n" for k in range(10))
        )
    assert main(["fit", *map(str, paths), "--joint", str(joint)]) == 3
    said = capsys.readouterr().err
    assert "… (60 in all): " in said and "too short" in said
    runs = Runs(jointfile.load_text(joint), tuple(paths), (), ())
    assert len(runs.named) < MAX_LINE_BYTES
