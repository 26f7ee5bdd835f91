"""Torque profiles of the rig."""

import numpy as np
import pytest
from simjoints import PERFECT, sea

from sim.errors import SimError
from sim.excitation import KINDS, build
from sim.variation import suitable
from sim.world import World, record

REQUIRED = {"sines": {"frequency_hz": 0.5}}


def profile(table, seconds=20.0, motors=1, motor=0):
    excitation = build(table, motors)
    return np.array([excitation.torque(motor, t, 0.0, 0.0) for t in np.arange(0.0, seconds, 0.01)])


@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_keeps_to_its_amplitude_and_repeats(kind):
    table = {"kind": kind, "amplitude_nm": 2.0, **REQUIRED.get(kind, {})}
    torque = profile(table)
    assert np.abs(torque).max() <= 2.0 * 4.3  # a sum of 12 tones of one sine's rms, all at their peak
    assert (np.std(torque) > 0.5) == (kind != "none")
    assert np.array_equal(torque, profile(table))


@pytest.mark.parametrize("kind", ["multisine", "steps", "rich"])
def test_motors_move_differently_and_another_seed_is_another_motion(kind):
    table = {"kind": kind, "amplitude_nm": 1.0}
    one, two = profile(table, motors=2), profile(table, motors=2, motor=1)
    assert abs(np.corrcoef(one, two)[0, 1]) < 0.5
    assert not np.allclose(one, profile(table | {"seed": 1}, motors=2))


def test_offset_ramp_and_hold():
    torque = profile({"kind": "none", "offset_nm": 3.0, "ramp_s": 2.0}, 4.0)
    assert torque[:201] == pytest.approx(np.linspace(0.0, 3.0, 201))
    assert torque[201:] == pytest.approx(3.0)
    table = {"kind": "none", "centre_rad": [0.1, -0.1], "centring_nm_rad": 10.0, "centring_nm_s_rad": 2.0}
    excitation = build(table, 2)
    assert excitation.torque(0, 0.0, 0.3, 0.5) == pytest.approx(-10.0 * 0.2 - 1.0)
    assert excitation.torque(1, 0.0, -0.1, 0.0) == pytest.approx(0.0)


def test_an_external_torque_acts_on_the_link_and_is_recorded():
    table = {"kind": "none", "external": {"kind": "sines", "amplitude_nm": 2.0, "frequency_hz": 0.5}}
    r = record(World(sea(gravity=0.0), (PERFECT,), excitation=build(table, 1)), 1.0)
    assert r["external_torque_nm"] == pytest.approx(2.0 * np.sin(np.pi * r["time_s"]))
    assert r["truth_link_position_rad"][-1] > 0.1


@pytest.mark.parametrize("motors", [1, 2])
def test_a_suitable_torque_moves_any_joint_within_bounds(motors):
    plant = sea(motors=motors)
    r = record(World(plant, (PERFECT,) * motors, excitation=build(suitable(plant), motors)), 10.0)
    assert 0.1 < np.ptp(r["truth_motor1_position_rad"]) < 3.0
    assert np.std(r["truth_motor1_deflection_rad"]) > 0.005


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ({"kind": "square"}, "excitation.kind: expected one of none, sines"),
        ({"kind": "sines", "amplitude_nm": 1.0}, "excitation.frequency_hz: expected this key"),
        ({"kind": "multisine"}, "excitation.amplitude_nm: expected this key"),
        ({"kind": "none", "amplitude": 1.0}, "excitation.amplitude: unknown key"),
        ({"kind": "chirp", "amplitude_nm": "1"}, "expected a finite number, got '1'"),
        ({"kind": "chirp", "amplitude_nm": True}, "expected a finite number, got True"),
        ({"kind": "chirp", "amplitude_nm": 1.0, "low_hz": 5.0, "high_hz": 1.0}, "0 < low_hz < high_hz"),
        ({"kind": "multisine", "amplitude_nm": 1.0, "tones": 2.5}, "tones: expected a whole number"),
        ({"kind": "steps", "amplitude_nm": 1.0, "hold_s": 0.0}, "hold_s: expected a number >= 0.001"),
        ({"kind": "none", "external": 3.0}, "excitation.external: expected a table"),
        ({"kind": "none", "external": {"kind": "sines"}}, r"excitation.external.amplitude_nm: expected"),
        ({"kind": "steps", "amplitude_nm": [1.0, 2.0]}, r"amplitude_nm: expected 1 number\(s\), got 2"),
    ],
)
def test_a_wrong_table_is_one_clear_line(table, message):
    with pytest.raises(SimError, match=message) as caught:
        build(table, 1)
    assert "\n" not in str(caught.value)
