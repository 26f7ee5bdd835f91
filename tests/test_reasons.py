"""Why an estimate is not valid: one sentence, and a limit that the user declares."""

import re
from dataclasses import replace
from pathlib import Path

import gatekit
import numpy as np
import pytest
from onlinekit import PERIOD_S, declared, motion

from estimator import EstimatorError, EstimatorSettings, Sample, Status, make_estimator
from estimator.online import _in_words
from estimator.reasons import CHANGES, REASONS, percent, reason_text, why_not_valid

CORE = Path(__file__).parent.parent / "estimator" / "core" / "src"


def test_every_reason_and_change_of_the_core_has_its_words():
    reasons, causes = ((CORE / file).read_text(encoding="utf-8") for file in ("reasons.rs", "causes.rs"))
    named = set(re.findall(r'Reason::\w+(?:\(_\))? => "(\w+)"', reasons))
    assert named == set(REASONS) - {"stale", "alarm", "contradicted"}
    assert set(re.findall(r'entry\(Cause::\w+, "(\w+)"', causes)) - {"nothing", "noise"} == set(CHANGES)


@pytest.mark.parametrize("limit", [0.0, -0.1, 1.5, float("nan")])
def test_a_limit_that_cannot_be_is_refused_with_its_name(limit):
    with pytest.raises(EstimatorError, match="valid_within"):
        EstimatorSettings(valid_within=limit)


@pytest.fixture(scope="module")
def quadratic():
    return motion("quadratic", 4.0)


def replayed(samples, settings, model=None):
    """(whether valid, reason, relative standard deviation) of each sample."""
    estimator = make_estimator(model or declared("quadratic"), settings, PERIOD_S)
    rows = []
    for sample in samples:
        estimate = estimator.step(sample)
        why = why_not_valid(estimate.status, estimator)
        relative = estimate.stiffness_std_nm_rad / estimate.stiffness_nm_rad
        rows.append((bool(estimate.status & Status.VALID), why, relative))
    return rows


def test_valid_is_what_was_asked_for_and_everything_else_has_a_reason(quadratic):
    usual = replayed(quadratic.samples, EstimatorSettings())
    tight = float(np.quantile([relative for valid, _, relative in usual if valid], 0.9))
    strict = replayed(quadratic.samples, EstimatorSettings(valid_within=tight))
    assert 0 < sum(valid for valid, *_ in strict) < sum(valid for valid, *_ in usual)
    assert all(relative < tight for valid, _, relative in strict if valid)
    for rows in (usual, strict):
        assert all((why is None) == valid for valid, why, _ in rows)
    imprecise = [(why[1], relative) for _, why, relative in strict if why and why[0] == "imprecise"]
    asked = f"asked for ± {100 * tight:.2g} %"
    assert imprecise and all(f"± {100 * r:.2g} %" in text and asked in text for text, r in imprecise)


def test_a_joint_at_rest_settles_and_then_waits_for_motion():
    rest = [Sample(k, (0.1,), (np.nan,), (0.0,), 0.1) for k in range(2000)]
    names = [why[0] for _, why, _ in replayed(rest, EstimatorSettings()) if why]
    assert list(dict.fromkeys(names)) == ["settling", "unmoved"]


def test_samples_that_cannot_be_used_are_the_reason(quadratic):
    spoilt = [
        s._replace(link_position_rad=np.nan) if k > 3000 else s for k, s in enumerate(quadratic.samples)
    ]
    *_, (_, why, _) = replayed(spoilt, EstimatorSettings())
    assert why == ("rejected", REASONS["rejected"])


def test_a_changed_torque_gain_is_named_with_what_looks_like_it():
    samples = motion("quadratic", 12.0).samples
    for k in range(8001, len(samples)):
        samples[k] = samples[k]._replace(motor_torque_nm=tuple(1.4 * t for t in samples[k].motor_torque_nm))
    rows = replayed(samples, EstimatorSettings())
    texts = {why[1] for _, why, _ in rows[8000:] if why and why[0] == "changed"}
    assert any("torque gain" in text and text.endswith("changed") for text in texts), texts


def test_a_wrong_inertia_is_not_called_imprecise(quadratic):
    model = declared("quadratic")
    motors = [
        replace(m, inertia_kg_m2=8.0 * m.inertia_kg_m2, inertia_std_relative=0.01) for m in model.motors
    ]
    rows = replayed(quadratic.samples, EstimatorSettings(), replace(model, motors=tuple(motors)))
    assert {why[0] for _, why, _ in rows[2000:] if why} & {"unexplained", "changed"}


def test_the_services_bits_have_their_reasons(quadratic):
    estimator = make_estimator(declared("quadratic"), EstimatorSettings(), PERIOD_S)
    for bit, name in ((Status.STALE, "stale"), (Status.MODEL_ALARM, "alarm")):
        assert why_not_valid(int(bit), estimator) == (name, REASONS[name])
    assert why_not_valid(int(Status.VALID | Status.GAP), estimator) is None


@pytest.mark.parametrize(("factor", "valid"), [(1.0, True), (3.0, False)])
def test_a_rigid_joint_is_valid_while_its_balance_is_explained(factor, valid):
    drawn = gatekit.draw("none", 100, effects=False, seconds=6.0)
    (motor,) = drawn.model.motors
    wrong = replace(motor, inertia_kg_m2=factor * motor.inertia_kg_m2)
    estimator = make_estimator(
        replace(drawn.model, motors=(wrong,)), EstimatorSettings(), drawn.record.period_s
    )
    said = [bool(estimator.step(sample).status & Status.VALID) for sample in drawn.record.samples()]
    assert set(said[len(said) // 2 :]) == {valid}
    assert (estimator.why() or ("",))[0] == ("" if valid else "unexplained")


def test_the_sentences_are_those_of_the_documentation():
    assert reason_text("imprecise", share=0.44, asked=0.2) == "stiffness known to ± 44 %, asked for ± 20 %"
    assert (
        reason_text("imprecise", share=0.2004, asked=0.2) == "stiffness known to ± 20.04 %, asked for ± 20 %"
    )
    assert reason_text("unexplained", share=0.9951).startswith("the model leaves 100 % of the")
    text = reason_text("changed", motor=2, changes=["torque_scale", "stiffness"])
    assert text == "motor 2: torque gain or stiffness has changed"
    assert reason_text("changed") == "the joint has changed"


def test_what_is_suspected_has_the_digits_that_its_interval_leaves():
    said = _in_words("motor_position", 1, "scale", 0.4, 0.00035)
    assert said == "motor position of motor 1: its scale is 1.40000 ± 0.00069 times what it was"
    assert _in_words("link_position", 0, "zero", 0.0213, 0.004).endswith("by 0.0213 ± 0.0078 rad")
    assert _in_words("motor_torque", 2, "delay", 0.0123, 0.0).endswith(
        "it is 12.300 ± 0.000 ms later than it was"
    )


def test_a_share_has_four_digits_at_most():
    assert [percent(x, 2) for x in (0.0057, 0.1201, 1.0283, 56.2052)] == [
        "0.57 %",
        "12.01 %",
        "102.8 %",
        "5621 %",
    ]
