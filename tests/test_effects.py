"""The library: complete, each effect the same for arrays and numbers, and able to run on line."""

from __future__ import annotations

import math

import numpy as np
import pytest

from estimator import EstimatorSettings, make_estimator
from estimator.effects import LIBRARY, STOP_EXPONENT, Coordinates, elements
from estimator.errors import EstimatorError
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


NOWHERE = Coordinates(*(0.0 for _ in Coordinates._fields))


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


@pytest.mark.parametrize(("exponent", "shape"), [(1.0, 1.0), (2.0, 0.5), (1.5, 0.7), (50.0, 1.0)])
def test_memory_over_a_path_is_the_law_integrated_in_small_steps(exponent, shape):
    rng = np.random.default_rng(4)
    path = np.cumsum(0.05 * rng.standard_normal(900)) + np.sin(np.arange(900) / 90.0)
    z, states, small = 0.0, [0.0], 100
    for increment in np.diff(path).tolist():
        for _ in range(small):
            sign, u = math.copysign(1.0, increment), abs(increment) / small
            y = z * sign
            rate = 1.0 - abs(y) ** (exponent - 1.0) * (shape * y + (1.0 - shape) * abs(y))
            z = sign * (min(y + u, 1.0) if exponent >= STOP_EXPONENT else y + u * rate)
        states.append(z)
    values = {"displacement_rad": 1.0, "exponent": exponent, "shape": shape}
    terms = LIBRARY["hysteresis"].terms(NOWHERE._replace(deflection=path), values)
    np.testing.assert_allclose(terms[0], states, atol=2e-3)


def test_dahl_friction_is_exact_for_any_increment():
    path = 0.1 * np.cumsum([0.0, -math.log(0.8), 3.0])
    values = {"displacement_rad": 0.1, "exponent": 1.0, "shape": 1.0}
    z = LIBRARY["presliding_friction"].terms(NOWHERE._replace(position=path), values)[0]
    assert z[1:] == pytest.approx([0.2, 1.0 - 0.8 * math.exp(-3.0)], abs=1e-9)


def test_arrays_of_parameters_are_sums_of_elements():
    waves = {"sin_nm": (1.0, 0.5), "cos_nm": 0.0, "periods_per_rev": (6.0, 12.0)}
    made = elements(Effect(name="cogging", parameters=waves))[1]
    assert [(v["periods_per_rev"], v["sin_nm"]) for v in made] == [(6.0, 1.0), (12.0, 0.5)]


@pytest.mark.parametrize(
    ("effect", "message"),
    [
        (Effect(name="friction"), 'effect "friction": expected one of'),
        (Effect(name="coulomb_friction"), "expected parameter torque_nm"),
        (Effect(name="coulomb_friction", parameters={"torque_nm": 1.0, "x": 1.0}), "unknown parameter x"),
    ],
)
def test_a_wrong_effect_is_one_line(effect, message):
    with pytest.raises(EstimatorError, match=message):
        elements(effect)
