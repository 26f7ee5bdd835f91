"""Each effect does to the joint what its physics says: the torque it takes is found again from the motion."""

import math
from functools import cache

import numpy as np
import pytest
from simjoints import HARDENING, LINEAR, PERFECT, PERFECT_ENCODER, RIGID, measured, sea

from estimator.effects import LIBRARY
from sim.effects import LISTED, UNLISTED, make, parse
from sim.effects.memory import Delayed, Slip
from sim.errors import SimError
from sim.world import World

PERIOD_S = 0.001

# NAME=VALUE of a noticeable size in the joint of `simjoints.sea` (torques of about 10 N·m, phi of 0.05 rad).
NOTICEABLE = {
    "coulomb_friction": 1.0, "stribeck_friction": 1.0, "asymmetric_friction": 1.0, "presliding_friction": 1.0,
    "load_dependent_friction": 0.1, "viscous_damping": 1.0, "quadratic_damping": 1.0, "cogging": 0.5,
    "torque_offset": 1.0, "torque_constant": 0.1, "torque_saturation": 0.003, "torque_drift": 0.2,
    "motor_inertia": 0.05, "torque_delay": 0.002, "torque_lag": 0.004, "back_driving_loss": 0.1,
    "hysteresis": 1.0, "backlash": 0.01,
    "asymmetric_stiffness": 1000.0, "higher_order_stiffness": 1e6, "transmission_damping": 1.0,
    "kinematic_error": 0.005, "deflection_offset": 0.01, "encoder_eccentricity": 0.005,
    "encoder_delay": 0.002, "deflection_delay": 0.02, "encoder_scale": 0.02, "gravity": 2.0, "link_coulomb_friction": 1.0,
    "link_viscous_damping": 1.0, "link_inertia": 0.1, "contact": 50.0,
    "damaged_tooth": 1.0, "cold_grease": 1.0, "phase_imbalance": 0.1, "mesh_stiffness": 0.2, "creep": 50.0,
    "cable_pull": 1.0, "air_drag": 1.0, "interpolation_error": 0.001,
}  # fmt: skip


def switched_on(name, plant=None, seconds=2.0, **further):
    text = ",".join([f"{name}={NOTICEABLE[name]}", *(f"{key}={value}" for key, value in further.items())])
    return measured(plant or sea(HARDENING), parse(text), seconds=seconds, step_s=0.00025)


def motor_remainder(r, plant):
    """Mean over each period of what is missing in eq 5: x = tau + tau_e - B theta" - D theta'."""
    motor = plant.motors[0]
    w, theta = r["truth_motor1_velocity_rad_s"], r["truth_motor1_position_rad"]
    momentum = motor.inertia_kg_m2 * np.diff(w) + motor.viscous_damping_nm_s_rad * np.diff(theta)
    return r["motor1_torque_nm"][:-1] + over_periods(declared_torque(r, plant)) - momentum / PERIOD_S


def link_remainder(r, plant):
    """Mean over each period of what is missing in eq 4."""
    link, q = plant.link, r["truth_link_position_rad"]
    momentum = link.inertia_kg_m2 * np.diff(r["truth_link_velocity_rad_s"])
    momentum = momentum + link.viscous_damping_nm_s_rad * np.diff(q)
    static = declared_torque(r, plant) + link.gravity_nm * np.sin(q)
    return -over_periods(static) - momentum / PERIOD_S


def declared_torque(r, plant):
    law = plant.motors[0].law()
    return np.array([law.torque(phi) for phi in r["truth_motor1_deflection_rad"]])


def over_periods(x):
    """Mean of a smooth signal over each period, by Simpson's rule on a cubic: error of order T^4."""
    mean, second = 0.5 * (x[1:] + x[:-1]), x[2:] - 2.0 * x[1:-1] + x[:-2]
    mean[1:-1] -= 0.5 * (second[1:] + second[:-1]) / 12.0
    return mean


def slope(x, regressor):
    """Least squares of x on one regressor, ends left out."""
    inside = slice(5, -5)
    return float(regressor[inside] @ x[inside] / (regressor[inside] @ regressor[inside]))


# Sign at the motor, at the link.
ACROSS = {"motor": (1.0, 0.0), "link": (0.0, 1.0), "transmission": (-1.0, 1.0)}
OMEGA, THETA, LINK, LINK_RATE = (f"truth_{n}" for n in (
    "motor1_velocity_rad_s", "motor1_position_rad", "link_position_rad", "link_velocity_rad_s"))  # fmt: skip
TAU = "motor1_torque_nm"
PHI, TAU_E = "truth_motor1_deflection_rad", "truth_motor1_flexibility_torque_nm"
LAWS = {
    "viscous_damping": ("motor", lambda r: r[OMEGA]),
    "quadratic_damping": ("motor", lambda r: r[OMEGA] * abs(r[OMEGA])),
    "cogging": ("motor", lambda r: np.sin(24.0 * r[THETA])),
    "torque_offset": ("motor", lambda r: np.ones_like(r["time_s"])),
    "coulomb_friction": ("motor", lambda r: np.sign(r[OMEGA])),
    "asymmetric_friction": ("motor", lambda r: np.where(r[OMEGA] > 0, 1.0, -0.4)),
    "load_dependent_friction": ("motor", lambda r: np.sign(r[OMEGA]) * abs(r[TAU_E])),
    # tau_e drives the motor while it has the velocity's sign
    "back_driving_loss": ("motor", lambda r: r[TAU_E] * (r[OMEGA] * r[TAU_E] > 0.0)),
    "asymmetric_stiffness": ("transmission", lambda r: r[PHI] ** 2),
    "higher_order_stiffness": ("transmission", lambda r: r[PHI] ** 5),
    "transmission_damping": ("transmission", lambda r: r[LINK_RATE] - r[OMEGA]),
    "gravity": ("link", lambda r: np.sin(r[LINK])),
    "link_coulomb_friction": ("link", lambda r: np.sign(r[LINK_RATE])),
    "link_viscous_damping": ("link", lambda r: r[LINK_RATE]),
    "air_drag": ("link", lambda r: r[LINK_RATE] * abs(r[LINK_RATE])),
    # In a period: what a drive that errs reports is another torque than acts.
    "motor_inertia": ("motor", lambda r: np.diff(r[OMEGA]) / PERIOD_S),
    "link_inertia": ("link", lambda r: np.diff(r[LINK_RATE]) / PERIOD_S),
    "torque_constant": ("motor", lambda r: -r[TAU][:-1]),
    "torque_saturation": (
        "motor",
        lambda r: (r[TAU] * (1.0 - (1.0 + 0.006 * r[TAU] ** 2) ** -0.5) / 0.003)[:-1],
    ),
    "torque_drift": ("motor", lambda r: (r[TAU] * np.expm1(-r["time_s"] / 20.0))[:-1]),
}


@pytest.mark.parametrize("name", LAWS)
def test_an_effect_takes_its_torque_from_where_it_acts_alone(name):
    plant = sea(HARDENING)
    r = switched_on(name, plant)
    place, law = LAWS[name]
    for remainder, sign in zip((motor_remainder, link_remainder), ACROSS[place], strict=True):
        if sign:
            # The signs of dry friction change within periods that this mean does not resolve: half a percent.
            inside = law(r)
            inside = inside if len(inside) < len(r["time_s"]) else over_periods(inside)
            found = slope(sign * remainder(r, plant), inside)
            assert found == pytest.approx(NOTICEABLE[name], rel=0.01)
        else:
            assert np.std(remainder(r, plant)[5:-5]) < 2e-3


def test_a_delayed_torque_acts_later_by_exactly_that_time():
    r = switched_on("torque_delay")
    assert r["truth_motor1_torque_nm"][2:] == pytest.approx(r["motor1_torque_nm"][:-2], abs=1e-9)
    # 1.25 periods on a quarter-period grid: one step of the set-point before the last, then the last one.
    # 0.1 periods in steps of a half: 20 % of the first step is still the old one.
    for delay_s, steps, torques, expected in (
        (0.00125, 4, (8.0, 4.0), [8, 4, 4, 4]),
        (0.0001, 2, (10.0,), [2, 0]),
    ):
        delayed = Delayed(delay_s, 0.001, steps)
        for torque in torques:
            delayed.schedule(torque)
        assert delayed.schedule(0.0) == pytest.approx(expected)


def test_a_lagging_torque_acts_or_is_reported_behind_a_low_pass():
    lag, r = NOTICEABLE["torque_lag"], switched_on("torque_lag")
    acting = r["truth_motor1_torque_nm"]
    rate = np.gradient(acting, PERIOD_S)
    # Acting + lag * rate = reported; the mean of a period stands half a period after its beginning.
    assert slope(r["motor1_torque_nm"] - acting, rate) == pytest.approx(lag + 0.5 * PERIOD_S, rel=0.05)
    late = measured(sea(HARDENING), parse(f"torque_lag={-lag}"), seconds=2.0, step_s=0.00025)
    reported = late["motor1_torque_nm"]
    rate = np.gradient(reported, PERIOD_S)
    assert slope(late["truth_motor1_torque_nm"] - reported, rate) == pytest.approx(lag, abs=PERIOD_S)


def test_backlash_leaves_a_range_without_torque():
    r = switched_on("backlash", sea(LINEAR))
    phi, inside = r[PHI], np.abs(r[PHI]) < 0.01
    assert inside.any() and (~inside).any()
    assert r[TAU_E] == pytest.approx(150.0 * (phi - np.clip(phi, -0.01, 0.01)))
    assert r["truth_stiffness_nm_rad"] == pytest.approx(np.where(inside, 0.0, 150.0))
    stated = switched_on("backlash", sea(LINEAR), stiffness_nm_rad=150.0)
    assert stated[LINK] == pytest.approx(r[LINK], abs=1e-9)


def test_the_gears_error_bends_the_spring_and_does_no_work():
    plant = sea(HARDENING, damping=0.0, gravity=0.0)
    drives = (PERFECT,)
    error = parse("kinematic_error=0.01,periods_per_rev=16")
    world = World(plant, drives, PERFECT_ENCODER, effects=[error], initial_rad=(0.3, 0.25))
    law = plant.motors[0].law()

    def total():
        t = world.truth()
        (m,) = t.motors
        seen = m.deflection_rad + 0.01 * math.sin(16.0 * m.position_rad)
        assert m.flexibility_torque_nm == pytest.approx(law.torque(seen))
        kinetic = 0.5 * 0.4 * t.link_velocity_rad_s**2 + 0.5 * 0.125 * m.velocity_rad_s**2
        return kinetic + law.potential(seen)

    before = total()
    world.advance(3000)
    assert total() == pytest.approx(before, rel=1e-6)  # Runge-Kutta's own loss


def test_contact_pushes_back_on_one_side_only():
    plant = sea(HARDENING)
    r = switched_on("contact", plant, position_rad=0.05)
    depth = np.maximum(0.0, r["truth_link_position_rad"] - 0.05)
    assert 0.0 < np.mean(depth > 0.0) < 1.0
    assert slope(link_remainder(r, plant), over_periods(depth)) == pytest.approx(50.0, rel=0.01)


READINGS = {
    "deflection_offset": lambda q: q + 0.01,
    "encoder_eccentricity": lambda q: q + 0.005 * np.sin(q),
    "encoder_scale": lambda q: 1.02 * q,
    "interpolation_error": lambda q: q + 0.001 * np.sin(64.0 * q),
}


@cache
def healthy():
    return measured(sea(HARDENING), seconds=0.5, step_s=0.00025)


@pytest.mark.parametrize("name", READINGS)
def test_a_reading_errs_and_the_joint_does_not(name):
    r, clean = switched_on(name, seconds=0.5), healthy()
    assert r["truth_link_position_rad"] == pytest.approx(clean["truth_link_position_rad"])
    assert r["link_position_rad"] == pytest.approx(READINGS[name](r[LINK]), abs=1e-9)


def test_a_late_deflection_is_read_beside_the_present_motor():
    r = measured(sea(HARDENING), make("deflection_delay", {"delay_s": 0.02}))
    phi = np.interp(r["time_s"] - 0.02, r["time_s"], r[LINK] - r[THETA])
    assert r["link_position_rad"][25:] == pytest.approx((r[THETA] + phi)[25:], abs=2e-5)


@pytest.mark.parametrize("delay_s", [0.002, 0.0023, 0.0001])
def test_a_late_encoder_reads_where_the_link_was(delay_s):
    r = measured(sea(HARDENING), make("encoder_delay", {"delay_s": delay_s}))
    t, q = r["time_s"], r["truth_link_position_rad"]
    was = np.interp(t - delay_s, t, q)
    # Linear interpolation between periods is good to q" T²/8 = 1e-5 rad here.
    assert r["link_position_rad"][5:] == pytest.approx(was[5:], abs=1e-5)
    assert np.abs(r["link_position_rad"] - q).max() > 100 * 1e-5 * delay_s / 0.002


def test_deflection_offset_of_a_two_motor_joint_is_at_that_motor():
    r = measured(sea(motors=2), parse("deflection_offset=0.01,motor=2"), seconds=0.2)
    assert r["motor1_position_rad"] == pytest.approx(r["truth_motor1_position_rad"], abs=1e-9)
    assert r["motor2_position_rad"] == pytest.approx(r["truth_motor2_position_rad"] - 0.01, abs=1e-9)


def world_at_rest(effect, plant=None):
    return World(plant or sea(RIGID, gravity=0.0), (PERFECT,), PERFECT_ENCODER, effects=[parse(effect)])


def pushed(effect, torque_nm, periods, plant=None):
    """Position and velocity of a joint at rest that is pushed for so long."""
    world = world_at_rest(effect, plant)
    world.command(0, torque_nm / PERFECT.gear_ratio)
    world.advance(periods)
    motor = world.truth().motors[0]
    return world, motor.position_rad, motor.velocity_rad_s


def test_dry_friction_holds_below_its_level_and_slides_or_creeps_above():
    _, position, velocity = pushed("coulomb_friction=0.5", 0.49, 2000)
    # Viscous damping within a step, which the stop does not see: h³ D tau / 12 J² a step.
    assert abs(position) < 1e-7 and velocity == 0.0
    assert pushed("stribeck_friction=0.5", 0.88, 500)[2] == 0.0  # level 0.5 + 0.4 N·m at rest
    assert pushed("stribeck_friction=0.5", 0.92, 500)[2] > 0.01
    _, _, w = pushed("coulomb_friction=0.5,smoothing_rad_s=0.05", 0.25, 5000)
    # w / hypot(w, v0) = 1/2, less what the viscous damping of 0.9 N·m·s/rad carries.
    # Sampled after the step's braking, so below the mean by half of h tau / J = 2.4e-4 rad/s: half a percent.
    assert 0.5 * w / math.hypot(w, 0.05) + 0.9 * w == pytest.approx(0.25, rel=1e-2)


@pytest.mark.parametrize(("exponent", "elements"), [(1.0, 1.0), (2.0, 4.0), (60.0, 1.0), (60.0, 4.0)])
def test_slip_builds_up_saturates_and_dissipates(exponent, elements):
    slip, torque = Slip(2.0, 0.01, exponent, 1.0, elements), []
    x = 0.1 * np.sin(np.linspace(0.0, 4.0 * np.pi, 4001))
    for position in x.tolist():
        slip.commit(position)
        torque.append(slip.torque(position))
    assert np.max(np.abs(torque)) == pytest.approx(2.0, rel=0.07)
    assert np.trapezoid(torque[2001:], x[2001:]) > 0.5 * 4 * 2.0 * 0.1  # near the rectangle 4 F X
    assert slip.torque(1.0) == pytest.approx(2.0)


def test_dahl_follows_its_closed_form():
    slip = Slip(1.0, 0.01, 1.0, 1.0, 1.0)
    for k in range(101):
        slip.commit(0.0003 * k)
    assert slip.torque(0.03) == pytest.approx(-math.expm1(-3.0), rel=1e-3)
    for k in range(1, 101):
        slip.commit(0.03 - 0.0003 * k)
    turned = -math.expm1(-3.0)
    assert slip.torque(0.0) == pytest.approx(-1.0 + (1.0 + turned) * math.exp(-3.0), rel=1e-3)


def test_hysteresis_opens_a_loop_on_both_sides_and_creep_relaxes():
    plant = sea(HARDENING)
    r = switched_on("hysteresis", plant)
    on_motor, on_link = -motor_remainder(r, plant)[5:-5], link_remainder(r, plant)[5:-5]
    assert on_motor == pytest.approx(on_link, abs=1e-3)
    assert 0.5 < np.max(np.abs(on_motor)) <= 1.01
    assert np.sum(on_motor * np.diff(r[PHI])[5:-5]) > 0.0  # it takes energy out
    r = measured(sea(LINEAR), parse("creep=50,time_constant_s=0.05"), seconds=2.0, step_s=0.00025)
    expected, decay = [0.0], math.exp(-PERIOD_S / 0.05)
    for dphi in np.diff(r[PHI]):
        expected.append(expected[-1] * decay + 50.0 * dphi * 0.05 / PERIOD_S * (1.0 - decay))
    # Of 2 N·m; the deflection is taken as straight within a step here and within a period there.
    left = over_periods(np.array(expected))[5:-5]
    assert -motor_remainder(r, sea(LINEAR))[5:-5] == pytest.approx(left, abs=1e-2)


@cache
def two_motors(*effects):
    return measured(sea(HARDENING, motors=2), *(parse(effect) for effect in effects), seconds=0.25)


@pytest.mark.parametrize("name", [*LISTED, *UNLISTED])
def test_every_effect_changes_what_is_recorded_of_a_joint_of_two_motors(name):
    # Contact begins inside the wall; all else shows in the first quarter of a second.
    r = two_motors(f"{name}={NOTICEABLE[name]}{',position_rad=-0.01' if name == 'contact' else ''}")
    assert all(np.isfinite(column).all() for column in r.values())
    read = [column for column in r if column.endswith("position_rad") and "truth" not in column]
    assert max(np.abs(r[column] - two_motors()[column]).max() for column in read) > 1e-7


def test_every_effect_of_the_library_is_simulated_and_each_has_a_noticeable_size():
    assert {*LISTED} == {*LIBRARY} and {*NOTICEABLE} == {*LISTED, *UNLISTED}


def test_an_effect_is_written_name_value_and_further_parameters():
    effect = parse("cogging=0.1,periods_per_rev=12,motor=2")
    assert (effect.name, effect.motor) == ("cogging", 1)
    assert effect.values == {"sin_nm": 0.1, "cos_nm": 0.0, "periods_per_rev": 12.0}
    assert parse("stribeck_friction=0.5").values["stribeck_nm"] == pytest.approx(0.4)
    assert make("coulomb_friction", {"torque_nm": 1}, motor=1).motor == 1


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("coulomb_friction", "expected NAME=VALUE"),
        ("coulomb_friction=", "expected NAME=VALUE"),
        ("magic=1", 'effect "magic": expected one of coulomb_friction'),
        ("colomb_friction=1", r'effect "colomb_friction": did you mean coulomb_friction\?'),
        ("coulomb_friction=much", 'expected a number, got "much"'),
        ("coulomb_friction=nan", "expected a finite number"),
        ("coulomb_friction=1,torque=3", "unknown parameter, expected torque_nm"),
        ("coulomb_friction=1,motor=3", "expected 1 or 2, got 3"),
    ],
)
def test_a_wrong_effect_is_one_clear_line(text, message):
    with pytest.raises(SimError, match=message) as caught:
        parse(text)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "text",
    [
        "coulomb_friction=-1", "stribeck_friction=1,stribeck_velocity_rad_s=0", "torque_delay=-0.001",
        "cogging=1,periods_per_rev=0", "presliding_friction=1,displacement_rad=0", "coulomb_friction=1,motor=2",
        "higher_order_stiffness=1,power=2.5", "creep=1,time_constant_s=0", "hysteresis=1",
    ],
)  # fmt: skip
def test_values_that_cannot_be_are_refused_when_the_world_is_built(text):
    effect = parse(text)
    plant = sea(RIGID) if effect.name == "hysteresis" else sea()  # a rigid transmission has none of its own
    with pytest.raises(SimError, match=f"^{effect.name}: "):
        World(plant, (PERFECT,), PERFECT_ENCODER, effects=[effect])
