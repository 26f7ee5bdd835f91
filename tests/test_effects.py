"""The library: complete, the same for arrays and for the loop, and the loop's corrections undo what they should."""

from __future__ import annotations

import math

import numpy as np
import pytest

from estimator import EstimatorSettings, make_estimator
from estimator.effects import LIBRARY, STOP_EXPONENT, Coordinates, OnlineEffects, elements
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


NOWHERE = Coordinates(*(0.0 for _ in Coordinates._fields))


@pytest.mark.parametrize("name", sorted(n for n, k in LIBRARY.items() if not k.remembers))
def test_a_term_is_the_same_for_arrays_and_for_numbers(name: str) -> None:
    kind, values = LIBRARY[name], _values(name)
    rng = np.random.default_rng(3)
    table = rng.standard_normal((len(Coordinates._fields), 40))
    arrays = kind.terms(Coordinates(*table), values)
    assert len(arrays) == len(kind.linear)
    for k, column in enumerate(table.T):
        numbers = kind.terms(Coordinates(*column.tolist()), values)
        np.testing.assert_allclose(arrays[:, k], numbers[:, 0], rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("name", sorted(n for n, k in LIBRARY.items() if not k.remembers and not k.on_link))
def test_a_tick_has_the_term_of_the_library(name: str) -> None:
    """What a motor's effect adds on line is its terms over arrays, weighted."""
    kind, values = LIBRARY[name], _values(name)
    if kind.channel != "torque":
        pytest.skip("corrects a reading")
    c = Coordinates(*np.random.default_rng(5).standard_normal(len(Coordinates._fields)).tolist())
    weights = np.array([values[parameter] for parameter in kind.linear])
    x = OnlineEffects(_joint(Effect(name=name, parameters=values)), 1e-3).torques([c], NOWHERE)
    assert sum(x[0]) + sum(x[1]) == pytest.approx(float(weights @ kind.terms(c, values)[:, 0]))


@pytest.mark.parametrize("name", sorted(LIBRARY))
def test_every_effect_that_a_joint_file_may_hold_runs_on_line(name: str) -> None:
    joint = _joint(Effect(name=name, parameters=_values(name)))
    estimator = make_estimator(joint, EstimatorSettings(), 1e-3)
    for k in range(50):
        angle = 0.2 * math.sin(0.05 * k)
        estimate = estimator.step(Sample(k, (angle,), (math.nan,), (angle,), 1.1 * angle))
    assert math.isfinite(estimate.flexibility_torque_nm)


@pytest.mark.parametrize(("exponent", "shape"), [(1.0, 1.0), (2.0, 0.5), (1.5, 0.7), (50.0, 1.0)])
def test_memory_over_a_path_is_the_law_integrated_in_small_steps(exponent: float, shape: float) -> None:
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


def test_dahl_friction_is_exact_for_any_increment() -> None:
    path = 0.1 * np.cumsum([0.0, -math.log(0.8), 3.0])
    values = {"displacement_rad": 0.1, "exponent": 1.0, "shape": 1.0}
    z = LIBRARY["presliding_friction"].terms(NOWHERE._replace(position=path), values)[0]
    assert z[1:] == pytest.approx([0.2, 1.0 - 0.8 * math.exp(-3.0)], abs=1e-9)


def test_on_line_torques_have_the_signs_of_the_balances() -> None:
    effects = OnlineEffects(
        _joint(
            Effect(name="coulomb_friction", parameters={"torque_nm": 0.5}),
            Effect(name="asymmetric_stiffness", parameters={"coefficient_nm_rad2": 10.0}),
            Effect(name="link_viscous_damping", parameters={"damping_nm_s_rad": 2.0}),
        ),
        1e-3,
    )
    c = NOWHERE._replace(velocity=1.0, deflection=0.1, deflection_rate=0.2, link_velocity=1.2)
    motor, transmission, link = effects.torques([c], c)
    assert motor == pytest.approx([0.5])
    assert transmission == pytest.approx([0.1])
    assert link == pytest.approx(2.4)


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
    assert corrected is not None
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
    # The torque waits 3.5 periods: before, nobody knows what it was.
    assert out[:4] == [None] * 4 and None not in out[4:]
    assert out[-1] is not None
    assert out[-1].motor_position_rad == pytest.approx((11 - 2.5,))
    assert out[-1].motor_torque_nm == pytest.approx((11 - 3.5,))
    assert out[-1].link_position_rad == pytest.approx(11.0)
    gap = effects.correct(Sample(15, (15.0,), (math.nan,), (15.0,), 15.0))
    assert gap is not None and gap.motor_position_rad == pytest.approx((12.5,))


def test_a_torque_that_acts_with_a_lag_is_the_mean_of_what_acts_in_each_period() -> None:
    lag_s = 0.006
    effects = OnlineEffects(_joint(Effect(name="torque_lag", parameters={"time_constant_s": lag_s})), 1e-3)
    corrected = [effects.correct(Sample(k, (0.0,), (0.0,), (float(k >= 1),), 0.0)) for k in range(40)]
    acting = [one.motor_torque_nm[0] for one in corrected if one is not None]
    # The mean of 1 - exp(-t/T) from (k - 1) to k milliseconds after the step.
    t = 1e-3 * np.arange(40)
    mean = 1.0 - (np.exp(-t[:-1] / lag_s) - np.exp(-t[1:] / lag_s)) * lag_s / 1e-3
    np.testing.assert_allclose(acting[1:], mean, atol=1e-12)


def test_absurd_values_add_no_torque_and_raise_nothing() -> None:
    every = [Effect(name=n, parameters=_values(n)) for n in LIBRARY]
    effects = OnlineEffects(_joint(*every), 1e-3)
    for value in (math.nan, math.inf, -1e300, 1e12):
        effects.correct(Sample(1, (value,), (value,), (value,), value))
        c = Coordinates(*(value for _ in Coordinates._fields))
        assert effects.torques([c], c)[0] == [0.0]
    c = Coordinates(*(0.1 for _ in Coordinates._fields))
    motor, transmission, link = effects.torques([c], c)
    assert all(map(math.isfinite, (*motor, *transmission, link)))


def test_arrays_of_parameters_are_sums_of_elements() -> None:
    waves = Effect(
        name="cogging", parameters={"sin_nm": (1.0, 0.5), "cos_nm": 0.0, "periods_per_rev": (6.0, 12.0)}
    )
    assert [v["periods_per_rev"] for v in elements(waves)[1]] == [6.0, 12.0]
    motor, *_ = OnlineEffects(_joint(waves), 1e-3).torques([NOWHERE._replace(position=0.3)], NOWHERE)
    assert motor[0] == pytest.approx(math.sin(1.8) + 0.5 * math.sin(3.6))


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


def test_a_scale_that_is_not_above_zero_is_one_line() -> None:
    effect = Effect(name="coulomb_friction", parameters={"torque_nm": 1.0, "smoothing_rad_s": 0.0})
    with pytest.raises(EstimatorError, match="smoothing_rad_s: expected a number above 0, got 0"):
        OnlineEffects(_joint(effect), 1e-3)
