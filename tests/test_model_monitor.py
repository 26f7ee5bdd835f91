"""The model's monitor: silent while the model is sufficient, an alarm with the right place when it is not."""

import math
from dataclasses import replace

import diagnosiskit as kit
import joints
import pytest

from estimator import transmissions
from estimator.identify import identify
from estimator.model import JointModel
from estimator.model_monitor import ModelMonitor, ResidualBaseline, can_monitor, measure_baseline
from estimator.sample import Estimate, Sample

NOTHING = Estimate(0, 0, 0.0, 0.0, 0.0, ())
PLACES = {"coulomb_nm": "motor", "hysteresis_nm": "transmission", "gravity_nm": "link"}


@pytest.fixture(scope="module")
def runs():
    effects = {
        "healthy": {}, "again": {}, "coulomb_nm": {"coulomb_nm": 0.4}, "gravity_nm": {"gravity_nm": 0.8},
        "hysteresis_nm": {"hysteresis_nm": 0.6, "hysteresis_rad": 0.01},
    }  # fmt: skip
    return dict(zip(effects, kit.World(list(effects.values()), seconds=8.0).run(), strict=True))


@pytest.fixture(scope="module")
def fitted(runs):
    model = identify(runs["healthy"], kit.model()).model
    return model, measure_baseline(runs["healthy"], model)


@pytest.fixture
def monitor(fitted):
    return ModelMonitor(fitted[0], kit.PERIOD_S, fitted[1])


def _play(monitor, record, first=0, external_nm=math.nan):
    samples = (
        s._replace(sequence=first + s.sequence, external_torque_nm=external_nm) for s in record.samples()
    )
    return [monitor.step(sample, NOTHING, 0.0) for sample in samples]


def test_no_alarm_while_the_model_is_sufficient_and_samples_are_bad(runs, monitor):
    for value in (math.nan, math.inf, -1e300):
        assert not monitor.step(Sample(0, (value,), (value,), (value,), value), NOTHING, math.nan)
    assert not any(_play(monitor, runs["again"], first=10))
    assert monitor.settled and monitor.describe()["watching"]


@pytest.mark.parametrize("effect", PLACES)
def test_an_effect_raises_the_alarm_and_its_place_is_named(effect, runs, monitor):
    alarms = _play(monitor, runs[effect], external_nm=0.0)
    assert alarms.index(True) < 4000  # filters that settle for 0.5 s, then whole seconds
    described = monitor.describe()
    assert described["location"] == PLACES[effect] and described["ratio"] > described["limit"] > 1.0
    # Friction of 0.4 N·m is a square wave: the filters take its edges, and it is not all of the residual.
    assert effect != "coulomb_nm" or 0.25 < monitor.residual_nm[0] < 0.45


def test_the_alarm_ends_when_the_effect_is_gone(runs, monitor):
    assert _play(monitor, runs["coulomb_nm"])[-1]
    assert not _play(monitor, runs["again"], first=len(runs["again"]) + 100)[-1]


def test_a_registered_law_is_monitored_like_one_of_the_library(runs, fitted, monkeypatch):
    monkeypatch.setattr(transmissions, "MODELS", dict(transmissions.MODELS))
    transmissions.register("straight", lambda phi: phi, lambda phi: 1.0 + 0.0 * phi)
    model, baseline = fitted
    mine = replace(model.motors[0].transmission, model="straight", order=None)
    monitors = [
        ModelMonitor(joint, kit.PERIOD_S, baseline)
        for joint in (model, joints.with_motor(model, transmission=mine))
    ]
    some = joints.part(runs["coulomb_nm"], slice(2600))
    raised = [_play(monitor, some) for monitor in monitors]
    assert raised[0] == raised[1] and any(raised[0])
    assert monitors[1].residual_nm == pytest.approx(monitors[0].residual_nm)


def test_a_baseline_survives_the_joint_file_and_a_transmission_without_parameters_cannot_be_monitored(fitted):
    assert ResidualBaseline.from_dict(fitted[1].as_dict()) == fitted[1]
    assert ResidualBaseline.from_dict({"residual_nm": "x"}) is None
    assert can_monitor(fitted[0]) and not can_monitor(kit.model())
    motor = kit.model().motors[0]
    rigid = replace(motor, transmission=replace(motor.transmission, model="none"))
    assert can_monitor(JointModel(arrangement="single", motors=(rigid,)))
