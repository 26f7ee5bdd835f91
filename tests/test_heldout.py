"""What data that took no part in a fit say about its intervals: ratios of errors that are known in closed form."""

from dataclasses import replace

import diagnosiskit as kit
import joints
import numpy as np
import pytest

from drivelink import jointfile
from drivelink.jointfile.apply_diagnosis import diagnosed_model
from estimator.batch import fit, fit_joint
from estimator.diagnosis import diagnose
from estimator.diagnosis.covariance import hac_covariance
from estimator.diagnosis.heldout import held_out
from estimator.diagnosis.problem import Problem
from estimator.diagnosis.search import Search
from estimator.diagnosis.stiffness import middle
from estimator.diagnosis.twins import twins
from estimator.errors import EstimatorError
from estimator.freerun import free_run
from estimator.harm import Unseen, _Figure, harm, harm_of_parts
from estimator.identify import _fitted, identify
from estimator.model import JointModel, Transmission
from estimator.model_monitor import measure_baseline, seconds_of
from estimator.sample import FloatArray, Record
from estimator.transmissions import MODELS

T, SECONDS, BANDWIDTH_HZ = 1e-3, 20.0, 15.0
TONES_HZ = (0.35, 0.8, 1.25)  # of the motion; all have whole periods in the recording
SOFT, STIFF = 130.0, 150.0
STRANGE_HZ, STRANGE_NM = 3.1, 0.5  # of a torque that no law of the joint explains


def motion(amplitude: float = 1.0) -> tuple[FloatArray, FloatArray, FloatArray]:
    """(theta, phi, the motor's own torque B theta" + D theta') half a period after each sample."""
    w = 2.0 * np.pi * np.array(TONES_HZ)
    size = amplitude * np.array([0.4, 0.2, 0.1])
    time = np.arange(round(SECONDS / T)) * T

    def wave(order: int, at: FloatArray, scale: FloatArray) -> FloatArray:
        return np.asarray(np.sin(np.outer(at, w) + 0.5 * np.pi * order) @ (scale * w**order))

    later = time + 0.5 * T
    own = kit.INERTIA * wave(2, later, size) + kit.DAMPING * wave(1, later, size)
    # Not the shape of the acceleration: inertia and stiffness stay apart.
    return wave(0, time, size), wave(0, time, amplitude * np.array([0.010, -0.008, 0.012])), own


def record(stiffness: float, amplitude: float = 1.0, strange_nm: float = STRANGE_NM) -> Record:
    """A joint with that spring, and one torque from elsewhere, at its balance to the last digit."""
    theta, phi, own = motion(amplitude)
    strange = strange_nm * np.sin(2.0 * np.pi * STRANGE_HZ * (np.arange(len(theta)) + 0.5) * T)
    torque = own - stiffness * np.interp(np.arange(len(phi)) + 0.5, np.arange(len(phi)), phi) + strange
    return joints.recorded(theta, torque, theta + phi)


def mean_squares(amplitude: float = 1.0) -> tuple[float, float]:
    """(of the deflection, of the strange torque)."""
    return float(np.mean(motion(amplitude)[1] ** 2)), 0.5 * STRANGE_NM**2


@pytest.fixture(scope="module")
def healthy() -> Record:
    return kit.World([{}], seed=5, seconds=8.0).run()[0]


@pytest.fixture
def model() -> JointModel:
    return kit.model(linked=False)


@pytest.mark.slow
def test_a_true_model_leaves_as_much_in_data_that_took_no_part(model):
    first, second = (kit.World([{}], seed=seed).run()[0] for seed in (21, 22))
    alone, both = Problem([first], model, BANDWIDTH_HZ), Problem([first, second], model, BANDWIDTH_HZ)
    for found, problem in (
        (held_out(alone), alone),
        (held_out(alone, second), alone),
        (held_out(both), both),
    ):
        assert 1.0 <= found.surplus(problem.null()) < 1.1


def test_a_model_that_holds_in_one_recording_only_is_found_out_by_the_other(model):
    """Another stiffness there leaves (K2 - K1) phi beside the strange torque, which both have."""
    deflection, strange = mean_squares()
    expected = ((STIFF - SOFT) ** 2 * deflection + strange) / strange
    soft, stiff = record(SOFT), record(STIFF)
    problem = Problem([stiff], model, BANDWIDTH_HZ)
    fitted = problem.null()
    assert held_out(problem, soft).surplus(fitted) == pytest.approx(expected, rel=0.02)
    # Blocks of one recording are alike: they cannot show it.
    assert held_out(problem).surplus(fitted) == pytest.approx(1.0, abs=0.02)
    # Where the torque is larger, so much of the error may be the torque's.
    problem = Problem([soft], model, BANDWIDTH_HZ)
    larger = float(np.var(stiff.motor_torque_nm) / np.var(soft.motor_torque_nm))
    assert held_out(problem, stiff).surplus(problem.null()) == pytest.approx(expected / larger, rel=0.02)


def test_a_larger_motion_alone_is_no_error_of_the_model_and_too_short_data_are_refused(model):
    """The same relative error, an absolute one that is four times as large."""
    small, large = record(SOFT, 1.0, STRANGE_NM), record(SOFT, 2.0, 2.0 * STRANGE_NM)
    problem = Problem([small], model, BANDWIDTH_HZ)
    assert held_out(problem, large).surplus(problem.null()) == pytest.approx(1.0, abs=0.02)
    with pytest.raises(EstimatorError, match="at least 10 independent rows"):
        held_out(problem, small.rows(small.sequence < 500))
    problem = Problem([large], model, BANDWIDTH_HZ)
    assert held_out(problem, small).surplus(problem.null()) == 1.0


def test_a_zero_within_its_own_uncertainty_is_none_of_the_machine(model):
    """Another recording, whose encoders began elsewhere, is not moved by it; how near it is, is written."""
    found = identify(record(SOFT), model)
    value, std = found.fits[0].deflection_offset_rad, found.fits[0].nuisance_std["shift"]
    assert abs(value) < std
    (effect,) = found.model.motors[0].effects
    assert (effect.name, effect.parameters) == ("deflection_offset", {"offset_rad": 0.0})
    assert abs(value) < found.model.motors[0].zero_std_rad <= np.hypot(value, std)


def test_fit_widens_by_what_each_recording_shows_when_left_out(model):
    """Together they are fitted by the mean stiffness: half of the difference is left in each."""
    records = [record(SOFT), record(STIFF)]
    deflection, strange = mean_squares()
    square = (STIFF - SOFT) ** 2 * deflection
    expected = (square + strange) / (0.25 * square + strange)
    joint = fit_joint(records, model, 2.0 * np.pi * BANDWIDTH_HZ)
    assert joint.surplus == pytest.approx(expected, rel=0.02)
    wide, narrow = (hac_covariance(joint.problem, joint.fitted, x) for x in (joint.surplus, 1.0))
    assert wide[0, 0] == pytest.approx(expected * narrow[0, 0], rel=0.05)
    assert joint.covariance[0, 0] >= wide[0, 0]  # with what a missing effect may contribute
    found = identify(records, model, 2.0 * np.pi * BANDWIDTH_HZ)
    assert found.fits[0].covariance[0, 0] >= wide[0, 0]
    assert any(f"{np.sqrt(expected):.1f} times the error" in note for note in found.notes)


def test_the_residual_baseline_expects_the_error_of_other_data(model):
    known = Transmission(model="linear", parameters={"k_nm_rad": SOFT})
    model = joints.with_motor(model, transmission=known)
    once, twice = (measure_baseline(record(SOFT), model, surplus) for surplus in (1.0, 4.0))
    assert twice.residual_nm[0] == pytest.approx(2.0 * once.residual_nm[0])
    assert twice.log_std == once.log_std


def test_errors_beyond_the_residual_widen_what_the_data_tell_not_what_is_declared(model):
    problem = Problem([record(SOFT)], joints.with_motor(model, inertia_std_relative=1e-6), BANDWIDTH_HZ)
    fitted = problem.null()
    (inertia,) = (j for j, slot in enumerate(fitted.slots) if slot.name == "motor_inertia")
    before, after = (np.diag(hac_covariance(problem, fitted, surplus)) for surplus in (1.0, 4.0))
    assert after[0] == pytest.approx(4.0 * before[0], rel=0.02)
    assert after[inertia] == pytest.approx(before[inertia], rel=1e-3)


@pytest.mark.parametrize(("name", "said"), [("torque_drift", True), ("coulomb_friction", False)])
def test_an_effect_on_a_reading_is_as_improbable_as_it_is_far_off(name, said, model):
    """A torque scale that changes by half within seconds is none; friction's prior is a share of the torque."""
    search = Search(Problem([record(SOFT)], model, BANDWIDTH_HZ))
    found = search.with_effect(search.null, name, 0)
    assert found is not None
    (mine,) = (j for j, slot in enumerate(found.slots) if slot.kind == "term")
    prior = []
    for off in (0.0, 5.0):
        x = found.posterior.x.copy()
        x[mine] = found.regression.mean[mine] + off * found.regression.std[mine]
        prior.append(replace(found, posterior=found.posterior._replace(x=x)).log_prior(50.0, 1.0))
    assert prior[0] - prior[1] == pytest.approx(12.5 if said else 0.0)


@pytest.mark.parametrize(("amplitude", "open_"), [(1.0, True), (20.0, False)])
def test_a_scale_and_a_part_of_a_ripple_are_told_apart_by_a_whole_turn(amplitude, open_, model):
    search = Search(Problem([record(SOFT, amplitude)], model, BANDWIDTH_HZ))
    found = search.with_effect(search.null, "encoder_scale", None)
    assert found is not None
    alike = [(twin.instead, twin.measured) for twin in twins(found, search.problem)]
    assert alike == [(frozenset({("kinematic_error", 0)}), False)] * open_


def sprung(share: float, link: float = 1.0, **more: object) -> JointModel:
    """The joint with a spring, and a link's inertia, of so many times the true one."""
    law = Transmission(model="linear", parameters={"k_nm_rad": share * kit.STIFFNESS}, **more)
    known = joints.with_motor(kit.model(), transmission=law)
    assert known.link is not None
    return replace(known, link=replace(known.link, inertia_kg_m2=link * kit.LINK_INERTIA))


SURE = {"covariance": ((0.01,),)}  # data do not move it


@pytest.mark.parametrize(
    ("declared", "written", "said"),
    [
        (sprung(0.5), sprung(1.0), "None"),
        (sprung(1.0), sprung(1.0), "None"),
        (kit.model(), sprung(1.0), "None"),
        (sprung(1.0), sprung(0.5), "N·m of the torque, the declared one"),
        (kit.model(), sprung(3.0), "no model"),
        (sprung(1e-3), sprung(1e-3), "more than its spring carries"),
        # On line: the balance leaves less than no model, but the declared file is right.
        (kit.model(), sprung(1.0, **SURE), "None"),
        (kit.model(), sprung(0.95, **SURE), "valid estimates leave"),
        (kit.model(), kit.model(), "do not determine the stiffness of motor 1"),
        # The motors' balances know nothing of the link's inertia.
        (sprung(1.0), sprung(1.0, 1.3), "free runs over held-out data err"),
        (sprung(1.0, 1.3), sprung(1.0), "None"),
    ],
)
def test_a_file_that_is_worse_than_the_declared_one_is_not_written(declared, written, said, healthy):
    assert said in str(harm(declared, written, [Unseen.whole(healthy)]))


@pytest.mark.parametrize(("seen", "worse"), [(0.6, True), (0.93, False), (1.0, False)])
def test_validity_that_falls_by_more_than_its_standard_error_is_harm(seen, worse, healthy, monkeypatch):
    written = sprung(1.0)

    def replayed(of: JointModel, *_: object) -> FloatArray:
        valid = np.full(10, seen if of is written else 0.95) + np.linspace(-0.05, 0.0, 10)
        return np.column_stack((valid, np.full((10, 2), np.nan)))

    monkeypatch.setattr("estimator.harm._replayed", replayed)
    assert ("estimates are valid" in str(harm(kit.model(), written, [Unseen.whole(healthy)]))) is worse


@pytest.mark.parametrize(("more", "said"), [(0.0, "None"), (1.0, "valid estimates leave")])
def test_what_valid_estimates_leave_is_compared_over_the_same_samples(more, said, healthy, monkeypatch):
    """The declared model, which is valid in the easy half alone, leaves as much there."""
    written, easy = sprung(1.0), np.arange(400) % 2 == 0

    def replayed(of: JointModel, *_: object) -> FloatArray:
        valid = easy | (of is written)
        left = np.where(easy, 1.0 + more * (of is written), 100.0)
        return np.column_stack((valid, np.where(valid, left, np.nan), np.full(400, np.nan)))

    monkeypatch.setattr("estimator.harm._replayed", replayed)
    assert said in str(harm(kit.model(), written, [Unseen.whole(healthy)]))


def axis(more: str) -> jointfile.JointFile:
    return jointfile.parse(
        f'name = "axis"\n[[motor]]\ninertia_kg_m2 = {kit.INERTIA}\nviscous_damping_nm_s_rad = {kit.DAMPING}\n{more}\n'
    )


RIGID = 'transmission = { model = "none" }'


def test_a_constant_torque_of_a_rigid_joint_is_written_beside_what_is_found():
    """The file's balance leaves what the diagnosis says that it leaves."""
    joint = axis(RIGID)
    theta, _, own = motion()
    torque = own + 0.8 * np.sign(np.gradient(theta)) + 0.5
    found = diagnose(joints.recorded(theta, torque, None), joint.model(), BANDWIDTH_HZ)
    assert [effect.name for effect in found.effects] == ["coulomb_friction"]
    (offset,) = (e for e in diagnosed_model(joint, found).motors[0].effects if e.name == "torque_offset")
    assert offset.parameters["torque_nm"] == pytest.approx(0.5, abs=0.02)


@pytest.mark.parametrize("gear", [1.0, 50.0])
def test_gravity_of_a_rigid_joint_that_declares_none_is_named_and_written(gear):
    """Once a turn, cogging looks like it where the motor has no gear."""
    joint = axis(f"{RIGID}\ndrive = {{ node_id = 1, gear_ratio = {gear} }}")
    theta, _, own = motion(8.0)
    turned = np.interp(np.arange(len(theta)) + 0.5, np.arange(len(theta)), theta)
    moved = joints.recorded(theta, own + 2.0 * np.sin(turned) - 1.0 * np.cos(turned), None)
    found = diagnose(moved, joint.model(), BANDWIDTH_HZ)
    (gravity,) = found.effects
    assert gravity.name == "gravity" and set(gravity.alternatives) <= {"cogging"}
    assert gravity.probability == 0.5 if gear == 1.0 else gravity.probability > 0.9
    assert gravity.parameters == pytest.approx({"sin_nm": 2.0, "cos_nm": -1.0}, abs=0.01)
    assert found.curves[0].fitted_nm == pytest.approx(found.curves[0].residual_nm, abs=0.05)
    written = diagnosed_model(joint, found)
    assert max(second.residual_nm[0] for second in seconds_of(moved, written)) < 0.02
    assert free_run(moved, written).fit_percent["motor1_position"] > 98.0
    assert diagnose(moved, written, BANDWIDTH_HZ).verdict == "sufficient"


def test_a_constant_torque_of_the_motors_side_alone_is_written_as_the_zero_of_its_encoders():
    """As `fit` does: with half of it as either, or all as a torque, what the spring carries was off by it."""
    joint = axis('transmission = { model = "linear" }')
    healthy, zero = record(SOFT, strange_nm=0.0), 0.008
    assert healthy.link_position_rad is not None
    found = diagnose(replace(healthy, link_position_rad=healthy.link_position_rad + zero), joint.model())
    assert [(effect.name, effect.alternatives) for effect in found.effects] == [
        ("torque_offset", ("deflection_offset",))
    ]
    (written,) = (e for e in diagnosed_model(joint, found).motors[0].effects if "offset" in e.name)
    assert written.name == "deflection_offset"
    assert written.parameters["offset_rad"] == pytest.approx(zero, rel=0.02)


def test_the_last_quarter_is_judged_by_a_model_made_of_the_others(healthy):
    model, made = kit.model(), []

    def make(records: list[Record]) -> JointModel:
        made.append(len(records[0]))
        return identify(records, model).model

    assert harm_of_parts(model, identify(healthy, model).model, [healthy], make) is None
    assert made == [len(healthy) * 3 // 4]


@pytest.mark.parametrize(("variance", "determined"), [(4.0, True), (1e4, False), (-1.0, False)])
def test_a_variance_below_zero_is_no_certainty(variance, determined):
    found = middle(MODELS["linear"], np.array([100.0]), np.array([[variance]]), np.array([0.01]))
    assert found.determined is determined


def test_an_inertia_of_zero_is_none_that_was_found(healthy):
    """Where a joint is guided by hand and its drive is off, no inertia explains the torque that is read."""
    motor = kit.model().motors[0]
    (one,) = fit(healthy, kit.model())
    assert _fitted(motor, replace(one, inertia_kg_m2=0.0)).inertia_kg_m2 == motor.inertia_kg_m2


@pytest.mark.parametrize("linked", [True, False])
def test_a_damping_that_nobody_declared_is_no_anchor_at_zero(healthy, linked):
    undamped = joints.with_motor(kit.model(linked=linked), viscous_damping_nm_s_rad=0.0)
    (fitted,) = identify(healthy, undamped).fits
    error = abs(fitted.viscous_damping_nm_s_rad - kit.DAMPING)
    assert error < max(3.0 * fitted.nuisance_std["damping"], 0.02 * kit.DAMPING)
    assert fitted.nuisance_std["damping"] < 0.1 * kit.DAMPING


def test_a_deflection_that_a_law_cannot_have_is_an_error_that_says_so(healthy):
    far = replace(healthy, motor_position_rad=1e6 * healthy.motor_position_rad)
    with pytest.raises(EstimatorError, match="more than a transmission of model"):
        identify(far, joints.with_motor(kit.model(), transmission=Transmission(model="vsa-ii")))


def test_what_is_quoted_is_what_was_judged():
    """One block that falls outweighs in the mean square the nine that rise."""
    figure = _Figure(np.array([1.0] * 9 + [100.0]), np.array([4.0] * 9 + [25.0]))
    assert figure.rises(1e-6)
    written, declared = figure.roots(1e-6)
    assert written > declared
