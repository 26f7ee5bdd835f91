"""The library: complete, each effect the same for arrays and numbers, and able to run on line."""

from __future__ import annotations

import math

import numpy as np
import pytest

from estimator import EstimatorSettings, make_estimator
from estimator.effects import LIBRARY, Coordinates, elements
from estimator.model import Effect, JointModel, Motor, Transmission
from estimator.sample import Sample

VALUES = {"power": 5.0, "exponent": 2.0, "shape": 0.5, "side": -1.0, "periods_per_rev": 7.0}


def _values(name: str) -> dict[str, float]:
    return {p.name: VALUES.get(p.name, 0.03 + 0.01 * k) for k, p in enumerate(LIBRARY[name].parameters)}


def _joint(*effects: Effect) -> JointModel:
    motor = tuple(e for e in effects if not LIBRARY[e.name].on_link)
    link = tuple(e for e in effects if LIBRARY[e.name].on_link)
    transmission = Transmission(model="linear", parameters={"k_nm_rad": 100.0})
    return JointModel(
        arrangement="single",
        motors=(Motor(inertia_kg_m2=0.1, transmission=transmission, effects=motor),),
        link_effects=link,
    )


@pytest.mark.parametrize("name", sorted(n for n, k in LIBRARY.items() if not k.remembers))
def test_a_term_is_the_same_for_arrays_and_for_numbers(name):
    kind, values = LIBRARY[name], _values(name)
    rng = np.random.default_rng(3)
    table = rng.standard_normal((len(Coordinates._fields), 40))
    arrays = kind.terms(Coordinates(*table), values)
    assert len(arrays) == len(kind.linear)
    for k, column in enumerate(table.T):
        numbers = kind.terms(Coordinates(*column.tolist()), values)
        np.testing.assert_allclose(arrays[:, k], numbers[:, 0], rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("name", sorted(LIBRARY))
def test_every_effect_that_a_joint_file_may_hold_runs_on_line(name):
    joint = _joint(Effect(name=name, parameters=_values(name)))
    estimator = make_estimator(joint, EstimatorSettings(), 1e-3)
    for k in range(50):
        angle = 0.2 * math.sin(0.05 * k)
        estimate = estimator.step(Sample(k, (angle,), (math.nan,), (angle,), 1.1 * angle))
    assert math.isfinite(estimate.flexibility_torque_nm)


def test_arrays_of_parameters_are_sums_of_elements():
    waves = {"sin_nm": (1.0, 0.5), "cos_nm": 0.0, "periods_per_rev": (6.0, 12.0)}
    made = elements(Effect(name="cogging", parameters=waves))[1]
    assert [(v["periods_per_rev"], v["sin_nm"]) for v in made] == [(6.0, 1.0), (12.0, 0.5)]
