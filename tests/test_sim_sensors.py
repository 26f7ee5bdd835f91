"""Drives and encoders report what real ones would: counts, per milles, revolutions per minute, noise."""

import math
from dataclasses import replace
from itertools import islice

import numpy as np
import pytest
from simjoints import EXCITATION, PERFECT_ENCODER, sea

from sim.errors import SimError
from sim.excitation import build
from sim.sensors import DriveHardware, LinkEncoder, noise
from sim.world import World, record

DRIVE = DriveHardware(
    counts_per_rev=4096.0,
    gear_ratio=50.0,
    torque_constant_nm_a=0.05,
    rated_current_a=4.0,
    current_noise_a=0.01,
)


def recorded(drive, encoder=PERFECT_ENCODER, **kwargs):
    return record(World(sea(), (drive,), encoder, excitation=build(EXCITATION, 1), **kwargs), 3.0)


def test_positions_are_whole_counts_of_the_motor_shaft():
    r = recorded(DRIVE)
    step = 2.0 * math.pi / (4096 * 50)
    counts = r["motor1_position_rad"] / step
    assert counts == pytest.approx(np.round(counts), abs=1e-6)
    error = r["motor1_position_rad"] - r["truth_motor1_position_rad"]
    assert np.abs(error).max() <= step / 2 * (1 + 1e-9)
    assert np.std(error) == pytest.approx(step / math.sqrt(12.0), rel=0.05)  # uniform within a count


def test_velocity_comes_in_whole_revolutions_per_minute():
    r = recorded(DRIVE)
    rpm = r["motor1_velocity_rad_s"] * 50.0 * 60.0 / (2.0 * math.pi)
    assert rpm == pytest.approx(np.round(rpm), abs=1e-9)
    assert np.abs(r["motor1_velocity_rad_s"] - r["truth_motor1_velocity_rad_s"]).max() < 0.11 / 50.0


def test_current_is_noisy_and_comes_in_per_mille_of_the_rated_current():
    r = recorded(DRIVE)
    permille = r["motor1_current_a"] / 0.004
    assert permille == pytest.approx(np.round(permille), abs=1e-6)
    error = r["motor1_torque_nm"] - r["truth_motor1_torque_nm"]
    per_ampere = 0.05 * 50.0
    # Noise of 10 mA and a step of 4 mA add as squares; 3000 draws give it to 1.3 %.
    assert np.std(error) == pytest.approx(per_ampere * math.hypot(0.01, 0.004 / math.sqrt(12.0)), rel=0.05)
    assert r["motor1_torque_nm"] == pytest.approx(r["motor1_current_a"] * per_ampere)


def test_directions_turn_what_is_reported_and_not_what_happens():
    plain = recorded(DRIVE)
    turned = recorded(replace(DRIVE, direction=-1), replace(PERFECT_ENCODER, direction=-1))
    for name in ("truth_link_position_rad", "truth_motor1_torque_nm"):
        assert turned[name] == pytest.approx(plain[name])
    world = World(sea(), (replace(DRIVE, direction=-1),), LinkEncoder(direction=-1), initial_rad=(0.1, 0.2))
    assert world.drive(0).position_counts == -round(0.2 * 4096 * 50 / (2 * math.pi))
    assert world.link_counts() == -round(0.1 * 262144 / (2 * math.pi))
    world.command(0, 0.1)
    world.advance()
    assert world.truth().motors[0].torque_nm == pytest.approx(-0.1 * 50)
    opposite = World(sea(), (replace(DRIVE, torque_direction=-1),))
    opposite.command(0, 0.1)
    opposite.advance()
    assert opposite.truth().motors[0].torque_nm == pytest.approx(-5.0)


def test_the_drive_limits_its_current():
    world = World(sea(), (DRIVE,))
    world.command(0, 100.0)
    world.advance()
    assert world.truth().motors[0].torque_nm == pytest.approx(3.0 * 4.0 * 0.05 * 50.0)


def test_the_link_encoder_has_its_counts_zero_and_noise():
    encoder = LinkEncoder(counts_per_rev=65536.0, zero_rad=0.5, noise_counts=2.0)
    r = recorded(DRIVE, encoder)
    step = 2.0 * math.pi / 65536.0
    error = (r["link_position_rad"] - r["truth_link_position_rad"]) / step
    assert np.std(error) == pytest.approx(math.hypot(2.0, 1.0 / math.sqrt(12.0)), rel=0.05)
    assert World(sea(), (DRIVE,), encoder).link_counts() == pytest.approx(-65536 * 0.5 / (2 * math.pi), abs=8)


def test_noise_is_the_same_for_the_same_seed_and_else_another():
    assert list(islice(noise((1, 2), 1.0), 5000)) == list(islice(noise((1, 2), 1.0), 5000))
    assert list(islice(noise((1, 2), 1.0), 5)) != list(islice(noise((2, 2), 1.0), 5))
    assert list(islice(noise((1,), 0.0), 3)) == [0.0] * 3


@pytest.mark.parametrize(
    ("kind", "key", "value"),
    [
        (DriveHardware, "counts_per_rev", 0.0),
        (DriveHardware, "gear_ratio", -1.0),
        (DriveHardware, "rated_current_a", math.nan),
        (DriveHardware, "max_current_a", 0.0),
        (DriveHardware, "current_noise_a", -1.0),
        (DriveHardware, "direction", 0),
        (LinkEncoder, "counts_per_rev", 0.0),
        (LinkEncoder, "direction", 2),
    ],
)
def test_impossible_hardware_is_one_clear_line(kind, key, value):
    with pytest.raises(SimError, match=f"^{key}: expected "):
        kind(**{key: value})
