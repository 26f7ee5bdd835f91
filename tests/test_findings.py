"""What a diagnosis says, and of what it does not: healthy recordings, shares of certainty, one-way motions."""

import io
import re
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import diagnosiskit as kit
import joints
import numpy as np
import pytest
from rich.console import Console

from drivelink.output.document import as_text, show
from drivelink.output.numbers import Units
from drivelink.output.report import as_json, sections
from drivelink.output.sentences import sentence
from estimator import fit
from estimator.choices import choice
from estimator.diagnosis import Diagnosis, Errors, Finding, advice_for, diagnose
from estimator.diagnosis.candidates import Candidate
from estimator.diagnosis.curves import _bases
from estimator.diagnosis.design_matrix import Term
from estimator.diagnosis.findings import rivals_of
from estimator.diagnosis.heldout import Held
from estimator.diagnosis.law_parameters import Base
from estimator.diagnosis.order import bends
from estimator.diagnosis.probabilities import believed, chances, standing
from estimator.diagnosis.problem import Problem
from estimator.diagnosis.result import Rival
from estimator.diagnosis.search import Search, _Tried
from estimator.diagnosis.twins import Twin
from estimator.diagnosis.verdict import Judge, _Judged
from estimator.effects import LIBRARY
from estimator.identify import identify
from estimator.model import Effect, JointModel, Motor, Transmission
from estimator.transmissions import MODELS


def finding(name: str, probability: float, **more: Any) -> Finding:
    return Finding(
        name=name, location="motor", motor=0, parameters={}, std={}, probability=probability, **more
    )


def outcome(*effects: Finding, advice: tuple[str, ...] = ()) -> Diagnosis:
    errors = Errors(1.0, 0.1, 0.1, 0.01)
    return Diagnosis(
        verdict="effect", bandwidth_hz=10.0, effects=effects, train=errors, validation=errors,
        floor_nm=(0.1,), transmissions=(), advice=advice,
    )  # fmt: skip


TWIN = {"alternatives": ("motor_inertia",), "alternative_probabilities": (0.4,)}


@pytest.mark.parametrize(
    ("effects", "said"),
    [
        ([finding("cogging", 0.9)], "The model lacks cogging (motor): "),
        ([finding("cogging", 0.46, **TWIN)], "Most likely the model lacks cogging (motor) (0.46), else motor inertia (0.40): "),
        ([finding("cogging", 0.40, **TWIN)], "Most likely the model lacks one of cogging (motor) (0.40), motor inertia (0.40): "),
        ([finding("cogging", 0.2)], "Something at the motor has no likely name yet (record another motion, faster, slower and wider): "),
        ([finding("cogging", 0.95), finding("gravity", 0.2, alternatives=("deflection_offset",), alternative_probabilities=(0.2,))],
         "The model lacks cogging (motor); something at the motor has no likely name yet (gravity or deflection offset: cover"),
        ([finding("cogging", 0.95), finding("motor_inertia", 0.5)], "The model lacks cogging (motor); most likely motor inertia (motor) (0.50): "),
    ],
)  # fmt: skip
def test_an_effect_is_said_as_surely_as_it_is_known(effects, said):
    assert sentence(outcome(*effects, advice=("about another effect",))).startswith(said)
    two = replace(outcome(*effects), transmissions=(None, None))
    assert sentence(two).startswith(said.replace("the motor", "motor 1").replace("(motor)", "(motor 1)"))


def test_each_candidate_has_one_probability_whoever_names_it():
    def account(*names: str) -> Any:
        keys = frozenset((name, 0) for name in names)
        terms = [SimpleNamespace(candidate=SimpleNamespace(key=(name, 0))) for name in names]
        return SimpleNamespace(keys=keys, named=keys, terms=terms)

    found = account("back_driving_loss", "cogging")
    beside = [
        (0.3, found),
        (0.3, account("back_driving_loss", "gravity")),
        (0.4, account("gravity", "cogging")),
    ]
    chance = chances(found, beside)
    assert chance["gravity", 0] == pytest.approx(0.7)
    for k, own in enumerate((0.6, 0.7)):
        stands = standing(found, k, beside, chance)
        assert stands.probability == pytest.approx(own)
        assert stands.alternatives == (("gravity", chance["gravity", 0]),)


@pytest.mark.parametrize(("share", "reported"), [(0.1, "coulomb_friction"), (0.7, "stribeck_friction")])
def test_a_law_is_reported_unless_a_simpler_one_of_the_phenomenon_is_more_probable(share, reported):
    """What is written is what is named, at the probability that is stated; another phenomenon has its own."""

    def account(name: str, family: str, parameters: int, score: float) -> Any:
        keys = frozenset({(name, 0)})
        return SimpleNamespace(
            keys=keys,
            named=keys,
            terms=[name],
            families=frozenset({family}),
            parameters=parameters,
            score=score,
        )

    found = account("stribeck_friction", "friction", 4, share)
    simpler, other = account("coulomb_friction", "friction", 2, 0.2), account("cogging", "ripple", 3, 0.6)
    held: Any = SimpleNamespace(
        scores=lambda one: one.score, weights=lambda every, _: np.array([one.score for one in every])
    )
    assert believed(held, found, [simpler, other]).keys == {(reported, 0)}


def test_a_further_ripple_is_listed_by_the_name_of_its_kind():
    terms = [SimpleNamespace(candidate=SimpleNamespace(key=("encoder_eccentricity", None)))]
    keys = frozenset({("encoder_eccentricity", None), ("kinematic_error", 0)})
    found: Any = SimpleNamespace(keys=keys, named=keys, terms=terms)
    ripple = Twin(frozenset({("encoder_eccentricity", None)}), frozenset({("kinematic_error'", 0)}), False)
    chance = chances(found, [(1.0, found)], [ripple])
    assert chance["kinematic_error", 0] == 1.0
    assert standing(found, 0, [(1.0, found)], chance, [ripple]) == (0.5, (("kinematic_error", 0.5),))


def test_what_was_found_stands_among_the_candidates_though_it_was_not_promising_at_first():
    def alone(name: str, left: float) -> Any:
        candidate = SimpleNamespace(kind=SimpleNamespace(name=name, location="motor"), motor=0)
        regression = SimpleNamespace(residual=lambda _: np.full(2, left))
        return SimpleNamespace(
            terms=[SimpleNamespace(candidate=candidate)], keys={(name, 0)}, regression=regression,
            posterior=SimpleNamespace(x=None),
        )  # fmt: skip

    problem = SimpleNamespace(
        group=np.zeros(2, int), equations=1, torque_rms=1.0, model=SimpleNamespace(motors=(0,))
    )
    singles, found = [alone("coulomb_friction", 0.2)], alone("load_dependent_friction", 0.1)
    search: Any = SimpleNamespace(problem=problem, singles=lambda: singles, seen=[*singles, found])
    chance = {("coulomb_friction", 0): 0.4, ("load_dependent_friction", 0): 0.6}
    rivals = rivals_of(search, [finding("load_dependent_friction", 0.6)], chance)
    assert [(r.name, r.error_relative, r.probability) for r in rivals] == [
        ("load_dependent_friction", 0.1, 0.6), ("coulomb_friction", 0.2, 0.4),
    ]  # fmt: skip
    made = as_json(
        replace(outcome(finding("load_dependent_friction", 0.6)), rivals=tuple(rivals)), {}, "a.csv"
    )
    assert [one["motor"] for one in (*made["effects"], *made["candidates"])] == [1, 1, 1]


def test_advice_says_once_what_separates_several_from_one():
    said = advice_for("coulomb_friction", ("cogging", "stribeck_friction", "gravity"))
    assert [line.split(":")[0] for line in said] == [
        "Coulomb friction or cogging or gravity", "Coulomb friction or Stribeck friction",
    ]  # fmt: skip


def test_a_report_says_once_what_is_alike_and_breaks_no_number_in_40_columns():
    rivals = tuple(Rival(f"effect_{k}", "motor", 0, 0.1 if k else 0.05) for k in range(8))
    one = replace(
        outcome(finding("cogging", 0.9)),
        rivals=rivals, train=Errors(0.0027, 1.269e-4, 0.12, 0.0056),
    )  # fmt: skip
    one.effects[0].parameters["phase_rad"], one.effects[0].std["phase_rad"] = 0.0, 460.0
    told = sections(one, Units(linear=False))
    wide = as_text(told)
    assert "effect 1 " in wide and "and 6 more" in wide and "effect 2 " not in wide
    assert "0.002700 N·m, 12.00 %" in wide and "0.000127 N·m, 0.56 %" in wide
    assert re.search(r"phase_rad +│ not determined", wide)
    narrow = io.StringIO()
    show(told, Console(file=narrow, width=40))
    assert "0.002700 N·m, 12.00 %" in narrow.getvalue()


def test_a_free_curve_that_raises_the_error_is_not_said_to_explain_it():
    unlisted = finding("unlisted", 1.0, coordinates=("position", "torque"))
    worse = replace(outcome(unlisted), verdict="unexplained", validation=Errors(1.0, 3.0, 0.82, 2.47))
    said = sentence(worse)
    assert (
        "what was tried over position and torque does not lower the torque balance's error on held-out data"
        in said
    )
    assert said.endswith("82.00 %: it may be in the former alone.") and "library" not in said
    assert "No other effect explains" not in as_text(sections(worse, Units(linear=False)))


@pytest.mark.parametrize(
    ("verdict", "before", "after", "said", "kept"),
    [
        ("effect", 0.5, 0.3, "effect", "after"),
        ("effect", 0.5, 0.9, "insufficient_excitation", "before"),  # the declared one leaves less
        ("effect", 0.5, 1.2, "insufficient_excitation", "before"),
        ("unexplained", 0.5, 0.9, "unexplained", "before"),
        ("unexplained", 1.5, 1.2, "insufficient_excitation", "before"),  # the torque is of something else
        ("sufficient", 0.5, 0.9, "sufficient", "before"),
    ],
)
def test_a_model_that_is_worse_on_held_out_data_is_not_shown(verdict, before, after, said, kept, monkeypatch):
    left = {"before": before, "after": after}
    judge: Any = Judge.__new__(Judge)
    judge.held = SimpleNamespace(
        squared=lambda one: left[one] ** 2,
        errors=lambda one, other: Errors(left[one], left[other], left[one], left[other]),
    )
    judged = _Judged(verdict, [finding("cogging", 1.0)], "before", "after", [])  # type: ignore[arg-type]
    monkeypatch.setattr(Judge, "_explained", lambda *_: judged)
    made = judge._judged([], None)
    assert (made.verdict, made.after) == (said, kept)


@pytest.mark.parametrize(("held", "verdict"), [(0.1, "sufficient"), (1.2, "insufficient_excitation")])
def test_a_model_that_leaves_the_torque_of_other_data_is_not_sufficient(held, verdict, monkeypatch):
    judge: Any = Judge.__new__(Judge)
    judge.problem, judge.found = SimpleNamespace(frames=[None]), None
    judge.held = SimpleNamespace(errors=lambda *_: Errors(held, held, held, held))
    monkeypatch.setattr(Judge, "_left", lambda *_: 0.1)
    monkeypatch.setattr("estimator.diagnosis.verdict.poor", lambda _: False)
    assert judge._named([])[0] == verdict


def test_no_stiffness_is_fitted_where_the_balance_leaves_more_than_the_spring_carries(monkeypatch):
    (record,) = kit.World([{}], seed=31, seconds=8.0).run()
    monkeypatch.setattr("estimator.batch.middle", lambda *_: SimpleNamespace(determined=True))
    shaken = 20.0 * np.sin(2.0 * np.pi * 1.7 * record.time_s) + record.motor_torque_nm[:, 0]
    (one,) = fit(replace(record, motor_torque_nm=shaken[:, None]), kit.model(linked=False))
    assert one.error_rms_nm > 5.0 and not one.parameters
    assert fit(record, kit.model(linked=False))[0].parameters


def test_a_healthy_spring_that_is_bent_to_one_side_has_no_offset():
    """There a constant torque, a zero and the spring make up for each other; only held-out data tell which is needed."""
    _, record = joints.pulled(*joints.polynomial(np.array([[[150.0, 1500.0]]])), 9.0, 16000)
    first, second = (joints.part(record, rows) for rows in (slice(0, 8000), slice(8000, 16000)))
    said = diagnose(second, identify(first, joints.joint_model(0.12, 0.8)).model)
    assert (said.verdict, said.effects) == ("sufficient", ())


@pytest.mark.parametrize(
    ("before", "after", "confirmed", "of"),
    [
        ([1e-2] * 10, [2e-3] * 10, True, ""),
        ([1e-5] * 10, [9e-6] * 10, False, ""),  # less than filters and rounding leave
        ([1e-2, 1e-3] * 5, [1e-3, 9e-3] * 5, False, ""),  # less than its scatter
        ([1e-3] * 10, [8e-4] * 10, False, ""),  # less than a law leaves, for one with more parameters
        ([1e-2] * 10, [2e-3] * 10, True, "curve"),
        ([1e-3] * 10, [8e-4] * 10, False, "curve"),  # less than a law leaves, of which a curve may be
        ([1e-3] * 10, [8e-4] * 10, False, "declared"),  # the same, for one more of a declared phenomenon
        ([1e-3] * 10, [8e-4] * 10, True, "another"),
    ],
)
def test_held_out_data_confirm_only_what_is_more_than_scatter_and_rounding(
    before, after, confirmed, of, monkeypatch
):
    monkeypatch.setattr(Held, "squared", lambda _, one: float(np.mean(one.squares)))
    monkeypatch.setattr(Held, "scores", lambda _, one, among: -0.5 * np.log(one.squares))
    monkeypatch.setattr(Held, "_relative", lambda _, floor: np.square(floor))
    held: Any = Held.__new__(Held)
    held.problem, law = SimpleNamespace(floor=choice("floor")), SimpleNamespace(floor=0.02)
    held._laws, like = {"declared": 2}, {"bends": set(), "regression": law}
    two = SimpleNamespace(parameters=(1, 2))
    rest, found = (
        SimpleNamespace(
            squares=np.array(x), parameters=k, extra="a curve" if k and of == "curve" else None,
            families=frozenset(own), **like,
            terms=[SimpleNamespace(candidate=SimpleNamespace(family=one, kind=two)) for one in own],
        )
        for k, (x, own) in enumerate(((before, ()), (after, [of] if of else ())))
    )  # fmt: skip
    assert held.confirms(found, rest) is confirmed


def test_a_law_moves_half_of_the_way_to_a_bound_of_its_shape_and_its_torque_as_far():
    """Beside a shape that stopped half way a stiffness went all the way: a VSA-II ended at 10 MN·m/rad."""
    (record,) = kit.World([{}], seconds=5.0).run()
    model, law = joints.with_motor(kit.model(), transmission=Transmission(model="vsa-ii")), MODELS["vsa-ii"]
    frame, begin = Problem([record], model, 15.0).frames[0], np.array([100.0, 1.5])
    phi = np.sqrt(np.mean(frame.motors[0].deflection ** 2, keepdims=True))
    for step, share in (([10.0, 0.1], 1.0), ([10.0, 1.5], 0.5), ([10.0, -1.0], 0.25)):
        (alpha,) = Base((begin,)).moved(frame, np.array(step)).alpha
        assert alpha[1] == pytest.approx(1.5 + share * step[1])
        torque = law.torque(phi, begin) + law.jacobian(phi, begin) @ (share * np.array(step))
        assert law.torque(phi, alpha) == pytest.approx(torque)
    still = replace(frame, motors=tuple(c._replace(deflection=0.0 * c.deflection) for c in frame.motors))
    assert Base((begin,)).moved(still, np.array([10.0, 0.1])).alpha[0] == pytest.approx([110.0, 1.6])


def test_what_an_effect_adds_to_a_covariance_is_symmetric():
    shift, steep = np.array([[1e6, 3.0, 0.7], [-0.3, 2e5, 11.0]]), np.array([1.0, 0.7])
    precision = np.eye(2) + 1e12 * np.outer(steep, steep)
    added = _Tried(Candidate(LIBRARY["backlash"], 0), {}, 1, 1.0, shift, precision, steep).covariance
    assert np.array_equal(added, added.T) and np.any(added)


@pytest.mark.parametrize(("gain", "share"), [(4.0, 1.0), (0.0, 1.0), (-3.0, np.exp(-3.0)), (-np.inf, 0.0)])
def test_an_effect_that_the_motion_shows_to_be_absent_adds_nothing_to_an_interval(gain, share):
    """As likely as not before the data: what these cannot tell counts in full, what they rule out does not."""
    shift, precision, side = np.array([[2.0]]), np.array([[4.0]]), np.array([1.0])
    tried = _Tried(Candidate(LIBRARY["backlash"], 0), {}, 1, gain, shift, precision, side)
    assert tried.covariance[0, 0] == pytest.approx(share * 2.0**2 / 4.0)


@pytest.mark.parametrize("known", [True, False])
def test_a_number_is_no_effect_within_the_deviation_that_the_joint_file_knows(known):
    (record,), model = kit.World([{}]).run(), kit.model()
    (motor,), link = model.motors, model.link
    assert link is not None
    motor, link = (
        replace(one, viscous_damping_nm_s_rad=1.15 * one.viscous_damping_nm_s_rad) for one in (motor, link)
    )
    if known:
        motor = replace(motor, viscous_damping_std_nm_s_rad=0.15 * motor.viscous_damping_nm_s_rad)
        link = replace(link, viscous_damping_std_nm_s_rad=0.15 * link.viscous_damping_nm_s_rad)
    verdict = diagnose(record, replace(model, motors=(motor,), link=link)).verdict
    assert verdict == ("sufficient" if known else "effect")


@pytest.mark.parametrize(("std_nm", "verdict"), [(0.04, "sufficient"), (None, "effect")])
@pytest.mark.parametrize("more_nm", [pytest.param(0.06, marks=pytest.mark.slow), -0.06])
def test_an_effect_that_was_fitted_may_be_off_by_its_deviation(std_nm, verdict, more_nm):
    (record,) = kit.World([{"coulomb_nm": 0.5 + more_nm}]).run()
    std = {} if std_nm is None else {"torque_nm": std_nm}
    level = {"torque_nm": 0.5, "smoothing_rad_s": 0.002}
    friction = Effect(name="coulomb_friction", parameters=level, std=std)
    assert diagnose(record, joints.with_motor(kit.model(), effects=(friction,))).verdict == verdict


def test_a_zero_of_the_encoders_is_within_what_they_read_beside_a_spring_of_no_stiffness():
    (record,) = kit.World([{}], seconds=5.0).run()
    model = joints.with_motor(kit.model(), transmission=Transmission(model="exponential"))
    problem = Problem([record], model, 15.0)
    null = problem.null()
    zero = Term(Candidate(LIBRARY["deflection_offset"], 0), {})
    soft = Base((np.array([7e-15, 0.15]),))
    assert np.isfinite(problem.fit((zero,), soft, null.corrections).posterior.evidence)


@pytest.mark.parametrize("speed", [0.0, 2.0])
def test_a_one_way_motion_has_no_free_curve_over_time(speed):
    time = np.arange(8000) * kit.PERIOD_S
    motion = speed * time + 0.2 * np.sin(2.0 * time) + 0.05 * np.sin(9.0 * time)
    record = joints.recorded(motion, np.cos(3.0 * time), motion + 0.01 * np.cos(3.0 * time))
    problem = Problem([record], kit.model(), 15.0)
    bases = _bases(problem.frames[0], problem.null(), "motor", 0)
    over_time = [names for names, _ in bases if names == ("velocity", "time")]
    assert bool(over_time) is (speed == 0.0)


def test_a_free_curve_has_the_same_terms_in_a_longer_recording():
    record = kit.World([{}], seed=31, seconds=10.0).run()[0]
    short, long = (Problem([one], kit.model(), 15.0) for one in (joints.part(record, slice(6000)), record))
    for place in ("motor", "transmission", "link"):
        for names, basis in _bases(short.frames[0], short.null(), place, 0):
            columns = {basis(one.frames[0].motors[0]).shape[1] for one in (short, long)}
            assert len(columns) == 1, names


def test_of_the_motors_dry_friction_there_is_one_law():
    rubbing = kit.World([{"coulomb_nm": 0.4}], seed=31, seconds=8.0).run()
    search = Search(Problem(rubbing, kit.model(), 15.0))
    dry = [e.candidate for e in search._library if e.candidate.rubs]
    assert {"coulomb_friction", "presliding_friction"} <= {one.kind.name for one in dry}
    coulomb = next(one for one in search.screen(search.null, dry[0]) if one.candidate.rubs)
    beside = search.screen(search.problem.added(search.null, coulomb), dry[0])
    assert not any(term.candidate.rubs for term in beside)


UNLISTED = Finding(
    name="unlisted", location="transmission", motor=0, parameters={}, std={},
    coordinates=("deflection", "deflection_rate"),
)  # fmt: skip


STIFFENING = Finding(
    name="higher_order_stiffness", location="transmission", motor=0,
    parameters={"coefficient": 400.0, "power": 3.0}, std={},
)  # fmt: skip


@pytest.mark.parametrize(
    ("spring", "found", "raised"),
    [
        ({"model": "polynomial"}, [STIFFENING], True),
        ({"model": "polynomial"}, [UNLISTED], True),
        # What the joint file says is left, and the effect stays an effect.
        ({"model": "polynomial", "order": 1}, [STIFFENING], False),
        ({"model": "polynomial", "parameters": {"coefficients_nm_rad": (150.0,)}}, [STIFFENING], False),
        ({"model": "vsa-ii"}, [STIFFENING], False),
        ({"model": "linear"}, [UNLISTED], False),
        ({"model": "polynomial"}, [], False),  # nothing to raise it for
    ],
)
def test_a_curve_of_the_deflection_belongs_to_a_spring_of_open_order(spring, found, raised):
    motor = Motor(inertia_kg_m2=0.1, transmission=Transmission(**spring))
    assert bends(JointModel(arrangement="single", motors=(motor,)), found) is raised
