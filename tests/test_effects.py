"""The library: complete, the same for arrays and for the loop, and the loop's corrections undo what they should."""

from __future__ import annotations

import math

import numpy as np
import pytest

from estimator.effects import LIBRARY, Coordinates, OnlineEffects, elements
from estimator.effects.memory import advance, trace
from estimator.errors import EstimatorError
from estimator.model import Effect, JointModel, Motor, Transmission
from estimator.sample import Sample

NAMES = {
    "motor": (
        "coulomb_friction stribeck_friction asymmetric_friction presliding_friction load_dependent_friction "
        "viscous_damping quadratic_damping cogging torque_offset torque_constant torque_saturation "
        "torque_drift motor_inertia torque_delay torque_lag back_driving_loss"
    ),
    "transmission": (
        "hysteresis backlash asymmetric_stiffness higher_order_stiffness transmission_damping kinematic_error"
    ),
    "measurement": "deflection_offset encoder_eccentricity encoder_delay encoder_scale",
    "link": "gravity link_coulomb_friction link_viscous_damping link_inertia contact",
}
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


def test_every_name_of_the_contract_is_there_at_its_location() -> None:
    assert {name: kind.location for name, kind in LIBRARY.items()} == {
        name: location for location, names in NAMES.items() for name in names.split()
    }


@pytest.mark.parametrize("name", sorted(n for n, k in LIBRARY.items() if k.terms is not None))
def test_a_term_is_the_same_for_arrays_and_for_numbers(name: str) -> None:
    kind, values = LIBRARY[name], _values(name)
    rng = np.random.default_rng(3)
    table = rng.standard_normal((len(Coordinates._fields), 40))
    assert kind.terms is not None
    arrays = kind.terms(Coordinates(*table), values, np)
    assert len(arrays) == len(kind.linear)
    for k, column in enumerate(table.T):
        numbers = kind.terms(Coordinates(*column.tolist()), values, math)
        np.testing.assert_allclose([a[k] for a in arrays], numbers, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize(("exponent", "shape"), [(1.0, 1.0), (2.0, 0.5), (1.5, 0.7), (50.0, 1.0)])
def test_memory_traced_over_a_path_is_memory_carried_step_by_step(exponent: float, shape: float) -> None:
    rng = np.random.default_rng(4)
    path = np.cumsum(0.05 * rng.standard_normal(3000)) + np.sin(np.arange(3000) / 90.0)
    state, states = 0.0, [0.0]
    for increment in np.diff(path):
        state = float(advance(state, increment, exponent, shape))
        states.append(state)
    # The step takes the law's slope at its middle, the trace looks it up on a table of 0.002.
    np.testing.assert_allclose(trace(path, exponent, shape), states, atol=2e-3)


def test_dahl_friction_is_exact_for_any_increment() -> None:
    assert advance(0.2, 3.0, 1.0, 1.0) == pytest.approx(1.0 - 0.8 * math.exp(-3.0), abs=1e-9)


def test_on_line_torques_have_the_signs_of_the_balances() -> None:
    effects = OnlineEffects(
        _joint(
            Effect(name="coulomb_friction", parameters={"torque_nm": 0.5}),
            Effect(name="asymmetric_stiffness", parameters={"coefficient_nm_rad2": 10.0}),
            Effect(name="link_viscous_damping", parameters={"damping_nm_s_rad": 2.0}),
        ),
        1e-3,
    )
    sample = Sample(0, (0.3,), (math.nan,), (1.0,), 0.4)
    x = effects.torques(sample, (1.0,), (0.0,), (0.1,), (0.2,), (10.0,), 0.0)
    assert x.motor_nm == pytest.approx((0.5,))
    assert x.transmission_nm == pytest.approx((0.1,))
    assert x.link_nm == pytest.approx(2.4)  # the link's velocity is that of motor and deflection together


def test_correct_undoes_what_the_sensors_did() -> None:
    scale, sine, offset = 0.02, 0.01, 0.05
    effects = OnlineEffects(
        _joint(
            Effect(name="encoder_scale", parameters={"relative_error": scale}),
            Effect(name="encoder_eccentricity", parameters={"sin_rad": sine, "cos_rad": 0.0}),
            Effect(name="deflection_offset", parameters={"offset_rad": offset}),
            Effect(name="torque_constant", parameters={"relative_error": 0.1}),
        ),
        1e-3,
    )
    q = 0.8
    reading = (1.0 + scale) * q + sine * math.sin(q)
    corrected = effects.correct(Sample(0, (0.5,), (math.nan,), (2.0,), reading))
    # Two steps of a fixed point that contracts by 3 %: off by 3e-2 cubed of the error.
    assert corrected.link_position_rad == pytest.approx(q, abs=2e-5)
    assert corrected.motor_position_rad == pytest.approx((0.55,))
    assert corrected.motor_torque_nm == pytest.approx((2.2,))


def test_delays_bring_all_channels_to_the_latest_one() -> None:
    effects = OnlineEffects(
        _joint(
            Effect(name="encoder_delay", parameters={"delay_s": 0.0025}),
            Effect(name="torque_delay", parameters={"delay_s": 0.001}),
        ),
        1e-3,
    )
    out = [effects.correct(Sample(k, (1.0 * k,), (math.nan,), (1.0 * k,), 1.0 * k)) for k in range(12)]
    assert out[-1].motor_position_rad == pytest.approx((11 - 2.5,))
    assert out[-1].motor_torque_nm == pytest.approx((11 - 3.5,))
    assert out[-1].link_position_rad == pytest.approx(11.0)
    gap = effects.correct(Sample(15, (15.0,), (math.nan,), (15.0,), 15.0))
    assert gap.motor_position_rad == pytest.approx((12.5,))


def test_absurd_values_add_no_torque_and_raise_nothing() -> None:
    every = [Effect(name=n, parameters=_values(n)) for n in LIBRARY]
    effects = OnlineEffects(_joint(*every), 1e-3)
    for value in (math.nan, math.inf, -1e300, 1e12):
        sample = effects.correct(Sample(1, (value,), (value,), (value,), value))
        x = effects.torques(sample, (value,), (value,), (value,), (value,), (value,), 0.0)
        assert x.motor_nm == (0.0,)
    fresh = effects.torques(
        Sample(2, (0.1,), (0.0,), (0.1,), 0.1), (0.1,), (0.0,), (0.01,), (0.0,), (1.0,), 0.1
    )
    assert all(map(math.isfinite, (*fresh.motor_nm, *fresh.transmission_nm, fresh.link_nm)))


def test_arrays_of_parameters_are_sums_of_elements() -> None:
    waves = Effect(
        name="cogging", parameters={"sin_nm": (1.0, 0.5), "cos_nm": 0.0, "periods_per_rev": (6.0, 12.0)}
    )
    assert [v["periods_per_rev"] for v in elements(waves)[1]] == [6.0, 12.0]
    x = OnlineEffects(_joint(waves), 1e-3).torques(
        Sample(0, (0.3,), (0.0,), (0.0,), 0.3), (0.0,), (0.0,), (0.0,), (0.0,), (0.0,), 0.0
    )
    assert x.motor_nm[0] == pytest.approx(math.sin(1.8) + 0.5 * math.sin(3.6))


@pytest.mark.parametrize(
    ("effect", "message"),
    [
        (Effect(name="friction"), 'effect "friction": expected one of'),
        (Effect(name="coulomb_friction"), "expected parameter torque_nm"),
        (Effect(name="coulomb_friction", parameters={"torque_nm": 1.0, "x": 1.0}), "unknown parameter x"),
    ],
)
def test_a_wrong_effect_is_one_line(effect: Effect, message: str) -> None:
    with pytest.raises(EstimatorError, match=message):
        elements(effect)
