"""The watch: silent at the model's floor, an alarm with the right place when an effect appears."""

from __future__ import annotations

import math
from dataclasses import replace

import diagnosiskit as kit
import pytest

from estimator.identify import identify
from estimator.model import JointModel
from estimator.sample import Estimate, Record, Sample
from estimator.watch import Floor, ResidualWatch, measure_floor, watchable

NOTHING = Estimate(0, 0, 0.0, 0.0, 0.0, ())
PLACES = {"coulomb_nm": "motor", "hysteresis_nm": "transmission", "gravity_nm": "link"}


@pytest.fixture(scope="module")
def runs() -> dict[str, Record]:
    effects = {
        "healthy": {},
        "again": {},
        "coulomb_nm": {"coulomb_nm": 0.4},
        "gravity_nm": {"gravity_nm": 0.8},
    }
    effects["hysteresis_nm"] = {"hysteresis_nm": 0.6, "hysteresis_rad": 0.01}
    return dict(zip(effects, kit.World(list(effects.values())).run(), strict=True))


@pytest.fixture(scope="module")
def fitted(runs: dict[str, Record]) -> tuple[JointModel, Floor]:
    model = identify(runs["healthy"], kit.model()).model
    return model, measure_floor(runs["healthy"], model)


def _play(watch: ResidualWatch, record: Record, first: int = 0) -> list[bool]:
    assert record.link_position_rad is not None
    alarms = []
    for k in range(len(record)):
        theta, tau = record.motor_position_rad[k, 0], record.motor_torque_nm[k, 0]
        q = float(record.link_position_rad[k])
        alarms.append(watch.step(Sample(first + k, (theta,), (math.nan,), (tau,), q), NOTHING, 0.0))
    return alarms


def test_no_alarm_while_the_model_is_sufficient(
    runs: dict[str, Record], fitted: tuple[JointModel, Floor]
) -> None:
    watch = ResidualWatch(fitted[0], kit.PERIOD_S, fitted[1])
    assert not any(_play(watch, runs["again"]))
    assert watch.settled
    assert watch.describe()["watching"]


@pytest.mark.parametrize("effect", PLACES)
def test_an_effect_raises_the_alarm_and_its_place_is_named(
    effect: str, runs: dict[str, Record], fitted: tuple[JointModel, Floor]
) -> None:
    watch = ResidualWatch(fitted[0], kit.PERIOD_S, fitted[1])
    alarms = _play(watch, runs[effect])
    assert alarms.index(True) < 4000  # settled after 1.5 s, held for 0.5 s, averaged over 1 s
    assert watch.describe()["location"] == PLACES[effect]


def test_the_alarm_ends_when_the_effect_is_gone(
    runs: dict[str, Record], fitted: tuple[JointModel, Floor]
) -> None:
    watch = ResidualWatch(fitted[0], kit.PERIOD_S, fitted[1])
    assert _play(watch, runs["coulomb_nm"])[-1]
    assert not _play(watch, runs["again"], first=len(runs["again"]) + 100)[-1]


def test_bad_samples_neither_raise_nor_alarm(
    runs: dict[str, Record], fitted: tuple[JointModel, Floor]
) -> None:
    watch = ResidualWatch(fitted[0], kit.PERIOD_S, fitted[1])
    for value in (math.nan, math.inf, -1e300):
        assert not watch.step(Sample(0, (value,), (value,), (value,), value), NOTHING, math.nan)
    assert not any(_play(watch, runs["again"], first=10))


def test_a_floor_survives_the_joint_file(fitted: tuple[JointModel, Floor]) -> None:
    assert Floor.from_dict(fitted[1].as_dict()) == fitted[1]
    assert Floor.from_dict({"residual_nm": "x"}) is None


def test_a_transmission_without_parameters_is_not_watchable(fitted: tuple[JointModel, Floor]) -> None:
    assert watchable(fitted[0])
    assert not watchable(kit.model())
    motor = kit.model().motors[0]
    rigid = replace(motor, transmission=replace(motor.transmission, model="none"))
    assert watchable(JointModel(arrangement="single", motors=(rigid,)))
