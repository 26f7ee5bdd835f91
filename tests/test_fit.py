"""Batch fits of whole recordings: known truth found again, with intervals that mean something."""

import json
from dataclasses import replace

import diagnosiskit as kit
import fleetkit
import joints
import numpy as np
import pytest
import simjoints

from drivelink import jointfile
from drivelink.cli import main
from drivelink.output import plots
from drivelink.output.fitreport import fit_plot
from estimator import EstimatorError, JointModel, LinkDynamics, Motor, Status, Transmission, fit
from estimator.diagnosis import diagnose
from estimator.diagnosis.candidates import Candidate
from estimator.diagnosis.design_matrix import Term
from estimator.diagnosis.problem import Problem
from estimator.effects import LIBRARY
from estimator.gate import judge
from estimator.identify import identify
from estimator.transmissions import MODELS

T = 1e-3


@pytest.fixture(scope="module")
def elbow():
    """Twelve soft joints, 10 s."""
    rng = np.random.default_rng(11)
    N, n = 12, 10_000
    K = rng.uniform(80, 220, (N, 1))
    alpha = np.stack([K, K * rng.uniform(2, 15, (N, 1))], axis=-1)
    torque, stiffness = joints.polynomial(alpha)
    B, D = rng.uniform(0.08, 0.2, (N, 1)), rng.uniform(0.4, 1.2, (N, 1))
    plants = joints.Plants(torque, stiffness, B, D, 0.45, 0.2, 5.0)
    truth = joints.simulate(plants, joints.sweep(rng, n, N, 1, T, 8.0, 3.0), T)
    return plants, alpha[:, 0], truth


def _record(truth, j, **how):
    noise = np.random.default_rng(j).normal(0, 0.04, truth.tau[:, j].shape)
    how = {"motor_counts": 16384, "link_bits": 17, "velocity_rad_s": None, "torque_noise": noise, **how}
    return joints.record(truth, j, T, **how)


def _error(found, alpha, truth, j):
    phi = truth.q[2000::7, j] - truth.theta[2000::7, j, 0]
    model = MODELS["polynomial"]
    return np.sqrt(np.mean((model.stiffness(phi, found.alpha) / model.stiffness(phi, alpha[j]) - 1) ** 2))


def test_stiffness_is_found_to_a_thousandth_also_with_wrong_declared_parameters_and_its_order(elbow):
    plants, alpha, truth = elbow
    for j in range(2):
        wrong = joints.joint_model(1.04 * plants.B[j, 0], 0.85 * plants.D[j, 0])
        (found,) = fit(_record(truth, j), wrong)
        assert _error(found, alpha, truth, j) < 1e-3
        assert found.inertia_kg_m2 == pytest.approx(plants.B[j, 0], rel=2e-3)
        assert found.viscous_damping_nm_s_rad == pytest.approx(plants.D[j, 0], rel=1e-2)
    undeclared = (joints.joint_model(plants.B[j, 0], plants.D[j, 0], order=None) for j in range(3))
    orders = [fit(_record(truth, j), model)[0].alpha.size for j, model in enumerate(undeclared)]
    assert sorted(orders)[1] == 2


def test_a_late_link_encoder_gaps_and_missing_values_do_no_harm(elbow):
    plants, alpha, truth = elbow
    for j in range(2):
        model = joints.joint_model(plants.B[j, 0], plants.D[j, 0])
        (found,) = fit(_record(truth, j, link_delay=2), model)
        assert found.link_delay_s == pytest.approx(2e-3, abs=5e-5)
        assert _error(found, alpha, truth, j) < 2e-3
    whole = _record(truth, 0)
    keep = np.random.default_rng(0).random(len(whole)) > 0.01
    keep[4000:4300] = False
    holed = joints.part(whole, keep)
    holed.link_position_rad[50] = np.nan
    (found,) = fit(holed, joints.joint_model(plants.B[0, 0], plants.D[0, 0]))
    assert _error(found, alpha, truth, 0) < 2e-3


@pytest.mark.slow
def test_intervals_cover_about_as_often_as_they_say(elbow):
    plants, alpha, truth = elbow
    z = []
    for j in range(12):
        (found,) = fit(_record(truth, j), joints.joint_model(plants.B[j, 0], plants.D[j, 0]))
        z += ((found.alpha - alpha[j]) / np.sqrt(np.diag(found.covariance))).tolist()
    # 24 numbers of unit variance: their rms is 1 within 0.15 (one sigma); naive intervals give 3 to 5.
    # These joints lack nothing, but an interval also holds what an effect that the motion does not tell from
    # the spring could make of it (`Search.unseen`): half as much again, so the lower bound is not 0.5.
    assert 0.3 < np.sqrt(np.mean(np.square(z))) < 1.6


@pytest.mark.parametrize("b", [8.0, *(pytest.param(b, marks=pytest.mark.slow) for b in (2.0, 40.0))])
def test_an_exponential_spring_is_found_from_nothing_in_batch_and_on_line(b):
    rng = np.random.default_rng(1)
    n = 6000
    plants = joints.Plants(
        lambda phi: np.sign(phi) * 150.0 / b * np.expm1(b * np.abs(phi)),
        lambda phi: 150.0 * np.exp(b * np.abs(phi)),
        *(0.1, 0.5, 0.45, 0.3, 5.0),
    )
    truth = joints.simulate(plants, joints.sweep(rng, n, 1, 1, T, 6.0, 3.0), T)
    record = _record(truth, 0)
    model = joints.joint_model(0.1, 0.5, model="exponential", order=None)
    (found,) = fit(record, model)
    assert found.parameters["k_nm_rad"] == pytest.approx(150.0, rel=3e-3)
    assert found.parameters["b_per_rad"] == pytest.approx(b, rel=2e-2)
    out = joints.estimates(model, record)[4000:]
    assert not np.any(out[:, 1].astype(int) & Status.CHANGED)
    assert np.sqrt(np.mean((out[:, 3] / truth.sigma[4000:, 0, 0] - 1) ** 2)) < 0.01


def test_what_cannot_be_fitted_is_reported(elbow):
    plants, _, truth = elbow
    model = joints.joint_model(plants.B[0, 0], plants.D[0, 0])
    record, still = _record(truth, 0), joints.recorded(*np.zeros((3, 3000)))
    short = "too short for a bandwidth of 4 Hz: expected at least 60"
    for wrong, how, message in (
        (still, (model,), "stands still"),
        (joints.part(record, slice(100)), (model,), "at least"),
        (joints.part(record, slice(1500)), (model, 2.0 * np.pi * 4.0), short),
        (record, (model, 1e-8), r"bandwidth: expected .* to .* Hz, got 1\.59"),  # of years
        (record, (joints.joint_model(1.0, 1.0, m=2),), "1 motor: expected 2"),
    ):
        with pytest.raises(EstimatorError, match=message):
            fit(wrong, *how)


@pytest.fixture(scope="module")
def wrist():
    """Six stiff joints, 6 s, in slow motion: viscous friction and a late encoder look alike."""
    rng = np.random.default_rng(12)
    N, n = 6, 6000
    K = rng.uniform(6000, 12000, (N, 1))
    alpha = np.stack([K, K * rng.uniform(0, 1.5e4, (N, 1))], axis=-1)
    torque, stiffness = joints.polynomial(alpha)
    B, D = rng.uniform(0.4, 1.2, (N, 1)), rng.uniform(2, 8, (N, 1))
    plants = joints.Plants(torque, stiffness, B, D, 1.5, 2.0, 20.0)
    truth = joints.simulate(plants, joints.sweep(rng, n, N, 1, T, 30.0, 1.5), T)
    return plants, truth


@pytest.mark.parametrize("late", [pytest.param(0, marks=pytest.mark.slow), 1])
def test_no_delay_is_made_of_noise_and_one_that_is_there_has_an_honest_interval(wrist, late):
    plants, truth = wrist
    z = []
    for j in range(6):
        noise = np.random.default_rng(j).normal(0, 0.4, truth.tau[:, j].shape)
        record = joints.record(
            truth, j, T, motor_counts=4e5, link_bits=17, torque_noise=noise, link_delay=late
        )
        (found,) = fit(record, joints.joint_model(plants.B[j, 0], plants.D[j, 0]))
        std = found.nuisance_std["link_delay"]
        assert abs(found.link_delay_s - late * T) <= 4 * std
        assert found.link_delay_s == 0.0 or late
        z.append((found.inertia_kg_m2 - plants.B[j, 0]) / found.nuisance_std["inertia"])
    assert np.sqrt(np.mean(np.square(z))) < 2.0


@pytest.mark.slow
def test_what_is_left_shows_friction_as_a_step_and_hysteresis_as_a_loop(tmp_path):
    effects = [{"coulomb_nm": 0.5}, {"hysteresis_nm": 1.0, "hysteresis_rad": 0.01}]
    (stuck,), (looping,) = (fit(record, kit.model()) for record in kit.World(effects, seconds=6.0).run())
    step = [np.median(stuck.unexplained_nm[side * stuck.velocity_rad_s > 0.3]) for side in (1, -1)]
    assert step == pytest.approx([-0.5, 0.5], abs=0.05)
    directions = (looping.deflection_rate_rad_s > 0.0, looping.deflection_rate_rad_s < 0.0)
    up, down = (np.median(looping.unexplained_nm[rows]) for rows in directions)
    assert 1.0 < up - down < 2.0  # the loop is 2 N·m wide where the motion is longer than its 0.01 rad
    joint = jointfile.parse(fleetkit.JOINT.format(name="elbow"))
    assert plots.save(fit_plot([looping], joint), tmp_path / "fit.png").stat().st_size > 20_000


def test_the_intervals_of_a_joint_that_a_hand_guides_hold_what_noise_takes_off_and_no_more():
    """Noise in the columns takes a sixth off all parameters; the intervals have just that, in closed form."""
    _, record = joints.guided(*joints.polynomial(np.array([[[150.0, 1500.0]]])), 12000)
    (found,) = fit(record, joints.joint_model(0.12, 0.8))
    pairs = (
        (found.alpha[0], 150.0, np.sqrt(found.covariance[0, 0])),
        (found.inertia_kg_m2, 0.12, found.nuisance_std["inertia"]),
        (found.viscous_damping_nm_s_rad, 0.8, found.nuisance_std["damping"]),
    )
    for value, truth, std in pairs:
        assert 0.1 * truth < truth - value < 1.2 * std < 1.5 * (truth - value)


@pytest.mark.parametrize("late", [pytest.param(0, marks=pytest.mark.slow), 5])
def test_a_stiff_spring_is_found_also_where_the_link_is_read_ten_deflections_late(late):
    """Its rate is most of the deflection then: from no stiffness at all a fit ended at a thirtieth of it."""
    plants = joints.Plants(*joints.polynomial(np.array([[[3000.0]]])), 0.12, 0.8, 0.45, 0.3, 3.0)
    truth = joints.simulate(plants, joints.sweep(np.random.default_rng(0), 9000, 1, 1, T, 2.5, 3.0), T)
    record = _record(truth, 0, motor_counts=131072, link_bits=18, link_delay=late)
    (found,) = fit(record, joints.joint_model(0.12, 0.8, order=1))
    std = np.sqrt(found.covariance[0, 0])
    assert abs(found.alpha[0] - 3000.0) < 1.96 * std < 0.03 * 3000.0  # noise of 0.04 N·m
    assert found.link_delay_s == pytest.approx(late * T, abs=1e-4)


@pytest.mark.parametrize(
    "c, zero_rad, size_nm",
    [
        (1.6, 0.05, 0.15),
        *(
            pytest.param(*case, marks=pytest.mark.slow)
            for case in ((1.6, -0.1, 0.6), (1.6, 0.1, 0.3), (1.75, 0.15, 0.3))
        ),
    ],
)
def test_a_vsa_ii_is_found_from_nothing_wherever_its_encoders_start(c, zero_rad, size_nm):
    """A prior about zero drew its shape to a bound, where any stiffness has the same torque."""
    law, alpha = MODELS["vsa-ii"], np.array([8.0, c])
    torque, stiffness = (
        lambda phi, of=of: of(phi.ravel(), alpha).reshape(phi.shape) for of in (law.torque, law.stiffness)
    )
    plants = joints.Plants(torque, stiffness, 0.05, 0.1, 0.1, 0.02, 0.5)
    truth = joints.simulate(plants, joints.sweep(np.random.default_rng(1), 8000, 1, 1, T, size_nm, 3.0), T)
    noise = np.random.default_rng(5).normal(0, 0.01, truth.tau[:, 0].shape)
    record = _record(truth, 0, motor_counts=131072, torque_noise=noise)
    record = replace(record, link_position_rad=record.link_position_rad + zero_rad)
    (found,) = fit(record, joints.joint_model(0.05, 0.1, model="vsa-ii"))
    phi = truth.q[2000::7, 0] - truth.theta[2000::7, 0, 0]
    assert found.deflection_offset_rad == pytest.approx(zero_rad, abs=5e-4)
    assert np.sqrt(np.mean((law.stiffness(phi, found.alpha) / law.stiffness(phi, alpha) - 1) ** 2)) < 0.01
    assert found.excited


def test_no_step_of_a_fit_leads_where_a_spring_carries_powers_of_ten():
    """Half a second late an exponential spring has exp(60) times its torque: normal equations were singular there."""
    k, b = 150.0, 200.0
    plants = joints.Plants(
        lambda phi: np.sign(phi) * k / b * np.expm1(b * np.abs(phi)),
        lambda phi: k * np.exp(b * np.abs(phi)),
        *(0.1, 0.5, 0.45, 0.3, 5.0),
    )
    truth = joints.simulate(plants, joints.sweep(np.random.default_rng(1), 6000, 1, 1, T, 20.0, 3.0), T)
    problem = Problem([_record(truth, 0)], joints.joint_model(0.1, 0.5, model="exponential"), 15.0)
    late = Term(Candidate(LIBRARY["deflection_delay"], None), {})
    found = problem.added(problem.null(), late, 3, begin=0.5)
    assert found.posterior.sigma[0] < problem.torque_rms


def test_the_spring_of_a_serial_joint_bears_on_the_motor_that_sets_its_lever():
    """Nobody declares the lever: undeclared, all that its motor bears would be unexplained."""
    rows = simjoints.measured(simjoints.sea(motors=2, lever=0.1), seconds=8.0)
    record = joints.of_world(rows)
    declared = tuple(
        Motor(inertia_kg_m2=0.125, viscous_damping_nm_s_rad=0.8, transmission=Transmission(model=model))
        for model in ("linear", "none")
    )
    link = LinkDynamics(inertia_kg_m2=0.4, viscous_damping_nm_s_rad=0.1, gravity_nm=6.0)
    carrying, setting = fit(record, JointModel(arrangement="serial", motors=declared, link=link))
    assert abs(carrying.alpha[0] - 150.0) < 1.0
    assert setting.error_rms_nm < 0.001 * setting.torque_rms_nm


def test_command_writes_json_plots_and_a_joint_file_that_loads(elbow, tmp_path, capsys):
    plants, alpha, truth = elbow
    joints.write_csv(_record(truth, 2), tmp_path / "run.csv")
    joint, target, out = tmp_path / "joint.toml", tmp_path / "fitted.toml", tmp_path / "out"
    joint.write_text(
        f'name = "elbow"\n[[motor]]\ninertia_kg_m2 = {plants.B[2, 0]}  # from the drawing\n'
        f'viscous_damping_nm_s_rad = {plants.D[2, 0]}\n[motor.transmission]\nmodel = "polynomial"\norder = 2\n'
    )
    args = ["fit", str(tmp_path / "run.csv"), "--joint", str(joint), "--out"]
    assert main([*args, str(out), "--plots", "--write", str(target)]) == 0
    (entry,) = json.loads((out / "fit.json").read_text())["transmissions"]
    found = entry["parameters"]["coefficients_nm_rad"]
    assert (entry["model"], set(entry["std"])) == ("polynomial", {"coefficients_nm_rad"})
    assert found == pytest.approx(alpha[2].tolist(), rel=2e-2)
    assert found[0] == pytest.approx(alpha[2][0], rel=1e-3)
    assert (out / "fit.png").stat().st_size > 1000
    written = jointfile.load(target)
    assert written.motor[0].transmission.parameters["coefficients_nm_rad"] == pytest.approx(found)
    assert "from the drawing" in target.read_text()
    assert written.provenance["fit"]["recording"] == "run.csv"
    capsys.readouterr()
    # A result is printed before any file is written: what cannot be written takes nothing else with it.
    (tmp_path / "taken").write_text("a file")
    joints.write_csv(joints.part(_record(truth, 2), slice(3000)), tmp_path / "run.csv")
    assert main([*args, str(tmp_path / "taken" / "out")]) != 0
    said = capsys.readouterr()
    assert "torque balance" in said.out and "taken" in said.err and said.err.count("\n") == 1


def test_a_link_of_which_only_its_declaration_tells_keeps_its_inertia_and_the_stiffness_follows():
    """Of a stiff joint only the sum of both inertias shows: the stiffness was 50 % off at a stated 12 %."""
    inertia, damping, link, stiffness = 1.4, 3.0, 0.35, 21e3
    w, size = 2.0 * np.pi * np.array([0.35, 0.8, 1.25, 2.1]), np.array([0.3, 0.15, 0.08, 0.03])
    bent = w**2 * link / stiffness / (1.0 - w**2 * link / stiffness)  # deflection over the motor's motion
    time = np.arange(20_000) * T

    def wave(order, at, scale):
        return np.sin(np.outer(at, w) + 0.5 * np.pi * order) @ (scale * w**order)

    later = time + 0.5 * T
    torque = inertia * wave(2, later, size) + damping * wave(1, later, size)
    torque = torque - stiffness * wave(0, later, size * bent)
    torque += np.random.default_rng(0).normal(0.0, 0.01 * np.std(torque), len(time))
    count = 2.0 * np.pi / 2**23
    theta, q = (joints.quantise(wave(0, time, scale), count) for scale in (size, size * (1.0 + bent)))
    model = joints.joint_model(inertia, damping, model="linear", link=LinkDynamics(inertia_kg_m2=link))
    found = identify(joints.recorded(theta, torque, q), model)
    assert found.model.link.inertia_kg_m2 == pytest.approx(link, rel=0.03)
    assert found.fits[0].parameters["k_nm_rad"] == pytest.approx(stiffness, rel=0.03)


@pytest.mark.parametrize("wrong", [{"inertia_kg_m2": 0.01}, {"inertia_kg_m2": 100.0}, {"gravity_nm": 0.0}])
def test_link_dynamics_that_are_declared_wrong_by_any_factor_are_found_and_said(wrong):
    (record,) = kit.World([{}]).run()
    model = kit.model()
    off = {name: factor * getattr(model.link, name) for name, factor in wrong.items()}
    found = identify(record, replace(model, link=replace(model.link, **off)))
    assert found.model.link.inertia_kg_m2 == pytest.approx(kit.LINK_INERTIA, rel=0.01)
    assert found.model.link.gravity_nm == pytest.approx(kit.GRAVITY, rel=0.01)
    assert found.fits[0].parameters["k_nm_rad"] == pytest.approx(kit.STIFFNESS, rel=0.01)
    (name, value) = next(iter(off.items()))
    (said,) = (note for note in found.notes if "[link.dynamics] should have" in note)
    assert f"{name} = {getattr(found.model.link, name):.4g} (now {value:.4g})" in said
    assert not [note for note in identify(record, model).notes if "[link.dynamics]" in note]


@pytest.mark.parametrize("factor", [0.01, 5.0])
def test_a_motor_inertia_that_is_declared_wrong_by_any_factor_is_found_said_and_never_sufficient(factor):
    (record,) = kit.World([{}]).run()
    model = kit.model(linked=False)
    wrong = joints.with_motor(model, inertia_kg_m2=factor * kit.INERTIA)
    assert judge(record, wrong).inertia[0] == pytest.approx(1.0 / factor, rel=0.3)
    assert not judge(record, model).inertia
    found = identify(record, wrong)
    assert found.model.motors[0].inertia_kg_m2 == pytest.approx(kit.INERTIA, rel=0.02)
    assert found.fits[0].parameters["k_nm_rad"] == pytest.approx(kit.STIFFNESS, rel=0.02)
    assert any("[[motor]] should have inertia_kg_m2 = 0.1" in note for note in found.notes)
    assert diagnose(record, wrong).verdict != "sufficient"
